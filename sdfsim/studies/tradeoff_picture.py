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
    """Write the diagram of a sweep.

    Args:
        points: of all contenders; those that failed stand along the upper edge as crosses.
        best: the points of the front, by time.
        steps: the horizon of the errors.
        path: of the PNG.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (axes, names) = pyplot.subplots(1, 2, figsize=(13, 7.5), width_ratios=(2.1, 1), layout="constrained")
    shown, lowest = ordered(points), least_shown(points, steps)
    for number, point in shown:
        if point["failed"] or not point["ms"]:
            continue
        x, y = point["ms"]["median"], max(error(point, steps), lowest)
        style = STYLES[point["kind"]] | ({"marker": "v"} if error(point, steps) < lowest else {})
        axes.errorbar(x, y, xerr=[[0], [max(0.0, point["ms"]["p95"] - x)]], ms=7, lw=0.8, **style)
        axes.annotate(str(number), (x, y), xytext=(5, 4), textcoords="offset points", fontsize=8)
    if best:
        axes.plot(
            [p["ms"]["median"] for p in best], [error(p, steps) for p in best], color="#1f6fb4", lw=1.2, alpha=0.5
        )
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
            str(number),
            (0.03 + 0.03 * place, 0.955),
            xycoords="axes fraction",
            ha="center",
            fontsize=8,
            color="#b00020",
        )
    axes.set(xscale="log", yscale="log", xlabel="milliseconds of computing per simulated second")
    axes.set_ylabel(f"translation RMSE over {steps} steps, m")
    axes.grid(True, which="both", lw=0.3, alpha=0.6)
    axes.set_title(
        "lower left is better; line: the front of ours; whiskers: 95th percentile; triangle down: less still",
        fontsize=9,
    )
    names.axis("off")
    keys = {p["key"] for p in best}
    for row, (number, point) in enumerate(shown):
        failed = point["failed"] or ("" if point["ms"] else "not timed")
        told = f"{number:>2}  {point['label']}" + (f": {failed[:40]}" if failed else "")
        colour = "#b00020" if failed else STYLES[point["kind"]]["color"]
        weight = "bold" if point["key"] in keys else "normal"
        names.text(0.0, 1.0 - (row + 0.5) / max(len(shown), 30), told, fontsize=8, color=colour, weight=weight)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110, format="png")
    pyplot.close(figure)


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
