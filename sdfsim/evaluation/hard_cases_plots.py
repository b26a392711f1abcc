"""The pictures of the hard cases, drawn with matplotlib."""

from __future__ import annotations

import io
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from sdfsim.errors import SdfsimError
from sdfsim.evaluation.hard_cases import GROUPS, Case
from sdfsim.evaluation.hard_cases_results import TEACHER, Study

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLUMNS = 4  # of panels
PANEL = (3.1, 2.3)  # inches
TEACHER_COLOR = "0.35"


def check_matplotlib() -> None:
    """Raises SdfsimError when matplotlib is not installed."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise SdfsimError("the page's plots need matplotlib", "pip install 'sdfsim[bench]'") from error


def group_picture(study: Study, group: str, dpi: int = 90) -> bytes | None:
    """PNG of one group: the first figure along the cases, then what each case draws; None where there is neither."""
    from matplotlib.figure import Figure as Canvas

    members = [case for case in study.cases if case.group == group]
    along = [case for case in members if case.x is not None] if GROUPS[group].axis else []
    drawn = [case for case in members if any(_curve(study, case, who) is not None for who in study.who)]
    panels = (len(along) > 1) + len(drawn)
    if not panels:
        return None
    wide = min(panels, COLUMNS)
    high = -(-panels // wide)
    canvas = Canvas(figsize=(PANEL[0] * wide, PANEL[1] * high), layout="constrained")
    axes = iter(canvas.subplots(high, wide, squeeze=False).flat)
    if len(along) > 1:
        _draw_row(next(axes), study, along)
    for case in drawn:
        _draw_curves(next(axes), study, case)
    for axis in axes:
        axis.set_visible(False)
    buffer = io.BytesIO()
    canvas.savefig(buffer, dpi=dpi, format="png")
    return buffer.getvalue()


def _draw_row(axis: Axes, study: Study, members: list[Case]) -> None:
    """The first figure against the cases' place."""
    figure, group = members[0].figures[0], GROUPS[members[0].group]
    places = [case.x for case in members if case.x is not None]
    for who, style in _styles(study.who):
        found = [study.results.get((case.name, who)) for case in members]
        values = [np.nan if r is None or r.value(figure) is None else r.value(figure) for r in found]
        noise = [0.0 if r is None else r.noise(figure) for r in found]
        axis.errorbar(places, np.array(values, dtype=float), yerr=noise, marker="o", capsize=3, label=who, **style)
    if min(places) > 0 and max(places) / min(places) > 20:
        axis.set_xscale("log")
    if figure.limit:
        axis.axhline(figure.limit, color="tab:red", linewidth=0.8, linestyle=":")
    _label(axis, group.axis, f"{figure.name} ({figure.unit})", "all")
    axis.legend(fontsize=7)


def _draw_curves(axis: Axes, study: Study, case: Case) -> None:
    """What a case draws, of all who took part."""
    for who, style in _styles(study.who):
        curve = _curve(study, case, who)
        if curve is not None:
            axis.plot(*curve, label=who, **style)
    _label(axis, *GROUPS[case.group].curve, case.title)
    axis.legend(fontsize=7)


def _curve(study: Study, case: Case, who: str) -> np.ndarray | None:
    """[2, K] of the case as it is meant, which is the first repetition."""
    result = study.results.get((case.name, who))
    curve = np.array(result.parts[0].curve) if result and result.parts else np.zeros((2, 0))
    return curve if curve.size else None


def _styles(who: Iterable[str]) -> list[tuple[str, dict[str, Any]]]:
    names = list(who)
    teacher = {"color": TEACHER_COLOR, "linestyle": "--", "linewidth": 1.2}
    return [(name, teacher if name == TEACHER else {"color": f"C{k}"}) for k, name in enumerate(names)]


def _label(axis: Axes, x: str, y: str, title: str) -> None:
    axis.set_title(title, fontsize=8)
    axis.set_xlabel(x, fontsize=8)
    axis.set_ylabel(y, fontsize=8)
    axis.tick_params(labelsize=7)
    axis.grid(alpha=0.3)
