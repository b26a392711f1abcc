"""The work-precision diagram: error against time, both logarithmic, every point numbered and named beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sdfsim.files import replacing

STYLES = {
    "ours": {"marker": "o", "color": "#1f6fb4"},
    "engine": {"marker": "s", "color": "#c2571a"},
    "baseline": {"marker": "^", "color": "#777777"},
}
Point = dict[str, Any]


def draw(points: Sequence[Point], best: Sequence[Point], steps: str, path: Path) -> None:
    """Write the diagram of a sweep: everything, and beside it what is near the front, closer.

    Args:
        points: of all contenders; those that failed stand along the upper edge as crosses.
        best: the points of the front, by time.
        steps: the horizon of the errors.
        path: of the PNG.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (axes, near, names) = pyplot.subplots(
        1, 3, figsize=(17, 7.5), width_ratios=(1.3, 1.3, 0.8), layout="constrained"
    )
    shown, lowest = ordered(points), least_shown(points, steps)
    for panel in (axes, near):
        _marks(panel, shown, best, steps, lowest)
    for point in points:
        if point["kind"] == "floor" and not point["failed"]:
            axes.axhline(error(point, steps), color="#c2571a", lw=1, ls="--")
            axes.annotate(
                f"chaos floor ({point['label']})", (0.99, error(point, steps)), xycoords=("axes fraction", "data"),
                ha="right", va="bottom", fontsize=8, color="#c2571a",
            )  # fmt: skip
    for place, (number, _) in enumerate((n, p) for n, p in shown if p["failed"] or not p["ms"]):
        axes.plot(0.03 + 0.03 * place, 0.985, "x", color="#b00020", transform=axes.transAxes, clip_on=False)
        axes.annotate(
            str(number), (0.03 + 0.03 * place, 0.955), xycoords="axes fraction", ha="center", fontsize=8,
            color="#b00020",
        )  # fmt: skip
    axes.set_ylabel(f"translation RMSE over {steps} steps, m")
    axes.set_title("lower left is better; whiskers: 95th percentile; triangle down: less still", fontsize=9)
    near.set_title("closer: the front of ours (line) and what is near it", fontsize=9)
    if best:
        _closer(near, best, steps)
    _list_names(names, shown, {p["key"] for p in best})
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110, format="png")
    pyplot.close(figure)


def _marks(axes: Any, shown: Sequence[tuple[int, Point]], best: Sequence[Point], steps: str, lowest: float) -> None:
    """Numbered marks of everything that was measured, and the front as a line."""
    for number, point in shown:
        if point["failed"] or not point["ms"]:
            continue
        x, y = point["ms"]["median"], max(error(point, steps), lowest)
        style = STYLES[point["kind"]] | ({"marker": "v"} if error(point, steps) < lowest else {})
        axes.errorbar(x, y, xerr=[[0], [max(0.0, point["ms"]["p95"] - x)]], ms=7, lw=0.8, **style)
        axes.annotate(str(number), (x, y), xytext=(5, 4), textcoords="offset points", fontsize=8, annotation_clip=True)
    axes.plot([p["ms"]["median"] for p in best], [error(p, steps) for p in best], color="#1f6fb4", lw=1.2, alpha=0.5)
    axes.set(xscale="log", yscale="log", xlabel="milliseconds of computing per simulated second")
    axes.grid(True, which="both", lw=0.3, alpha=0.6)


def _closer(axes: Any, best: Sequence[Point], steps: str) -> None:
    """Limits around the front, with plain numbers along both axes."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    times, errors = [p["ms"]["median"] for p in best], [error(p, steps) for p in best]
    axes.set(xlim=(min(times) / 1.1, 1.35 * max(times)), ylim=(min(errors) / 1.06, 1.06 * max(errors)))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0)))
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_formatter(NullFormatter())


def _list_names(axes: Any, shown: Sequence[tuple[int, Point]], front: set[str]) -> None:
    """What every number stands for; those on the front in bold, failures in red with their reason."""
    axes.axis("off")
    for row, (number, point) in enumerate(shown):
        failed = point["failed"] or ("" if point["ms"] else "not timed")
        told = f"{number:>2}  {point['label']}" + (f": {failed[:40]}" if failed else "")
        colour = "#b00020" if failed else STYLES[point["kind"]]["color"]
        weight = "bold" if point["key"] in front else "normal"
        axes.text(0.0, 1.0 - (row + 0.5) / max(len(shown), 30), told, fontsize=8, color=colour, weight=weight)


def ordered(points: Sequence[Point]) -> list[tuple[int, Point]]:
    """All but the chaos floor, numbered: ours, the engines, the baselines, each by time."""
    rank = {kind: place for place, kind in enumerate(STYLES)}
    drawn = [p for p in points if p["kind"] in rank]
    drawn.sort(key=lambda p: (rank[p["kind"]], p["ms"]["median"] if p["ms"] else float("inf")))
    return list(enumerate(drawn, start=1))


def least_shown(points: Sequence[Point], steps: str) -> float:
    """The least error m that a diagram shows: the teacher repeats itself to the last digit, which is no scale."""
    known = [error(p, steps) for p in points if not p["failed"] and p["kind"] != "engine"]
    return 0.5 * min(known, default=1e-3)


def error(point: Point, steps: str) -> float:
    """Translation RMSE m up to a horizon."""
    return point["errors"][steps]["translation_rmse"]
