"""Parts 1 and 2: our recipe against the paper's at equal time, and the width of our network."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import torch

from benchmarks.sdf_parts.study import ERRORS, Study, interleaved, say
from benchmarks.sdf_parts.tables import OURS, THEIRS, factor, number, plain_ticks, ratio, save_chart, table
from sdfsim.shape.far_field import BOX
from sdfsim.shape.fit import PLANS
from sdfsim.shape.sdf import Sdf

WIDTHS = (32, 64, 128)
WIDTH_SHAPES = ("cube", "suzanne", "sponge", "spot")
REPEATS = 7
HEAD = (
    "within 0.01", "within 0.1", "in box", "gradient", "projected from 0.01", "from 0.1", "sign errors", "updates", "s"
)  # fmt: skip


def measure_recipes(study: Study) -> None:
    """Fit every shape with both recipes, one right after the other, so that both meet the same machine."""
    for name in study.names():
        for recipe in ("default", "paper"):
            study.fitted(recipe, name)


def measure_widths(study: Study) -> None:
    """Fit some shapes with networks of other widths, and time queries of each width."""
    for name in study.names(WIDTH_SHAPES):
        for width in WIDTHS:
            study.fitted(_variant(width), name, width=width)
    names = study.names(WIDTH_SHAPES)
    if not names or "width_queries" in study.results:
        return
    generator = torch.Generator().manual_seed(0)
    sdfs = {width: study.fitted(_variant(width), names[0], width=width).sdf for width in WIDTHS}
    frame = next(iter(sdfs.values())).frame
    points = (2 * torch.rand(study.points, 3, generator=generator, dtype=torch.float64) - 1) * BOX * frame.scale
    points = (points + torch.from_numpy(frame.centre)).float()

    def ask(sdf: Sdf) -> None:
        sdf(points)

    say("timing widths")
    torch.set_num_threads(study.threads)
    took = interleaved({str(width): partial(ask, sdf) for width, sdf in sdfs.items()}, REPEATS)
    study.keep({key: [1e6 / study.points * s for s in took[key]] for key in took}, "width_queries")


def tables_of_recipes(study: Study) -> str:
    """Errors of both recipes by shape, and their factors."""
    fits = study.results.get("fits", {})
    ours, theirs = fits.get("default", {}), fits.get("paper", {})
    both = [name for name in study.meshes if name in ours and name in theirs]
    if not both:
        return ""
    rows, factors = [], []
    for name in both:
        rows.append([name, "ours", *_cells(ours[name])])
        rows.append(["", "paper", *_cells(theirs[name])])
        quotients = [ratio(theirs[name]["errors"][key], ours[name]["errors"][key]) for key in ERRORS]
        factors.append(quotients)
        rows.append(["", "**paper / ours**", *(factor(q) for q in quotients), "", ""])
    middle = [_median([row[i] for row in factors]) for i in range(len(ERRORS))]
    least = [min((row[i] for row in factors if row[i] is not None), default=None) for i in range(len(ERRORS))]
    summary = [["median", *map(factor, middle)], ["least", *map(factor, least)]]
    fitted = sum(ours[name]["passed"] for name in both), sum(theirs[name]["passed"] for name in both)
    updates = [theirs[name]["updates"] for name in both]
    text = [
        f"Lengths relative to the largest extent; budget {study.seconds:g} s for either, certificate included. Within "
        f"all limits: ours {fitted[0]}, paper {fitted[1]} of {len(both)}. The published recipe had {min(updates):,} to "
        f"{max(updates):,} of its {PLANS['paper'].steps:,} updates: this compares {study.seconds:g} s of fitting and "
        "nothing else.",
        table(["shape", "recipe", *HEAD], rows),
        "Factors paper / ours over the shapes (where ours has an error at all):",
        table(["", *HEAD[: len(ERRORS)]], summary),
    ]
    return "\n\n".join(text)


def tables_of_widths(study: Study) -> str:
    """Errors, size and query time of each width."""
    fits = study.results.get("fits", {})
    queries = study.results.get("width_queries", {})
    rows = []
    for name in study.meshes:
        if all(name in fits.get(_variant(width), {}) for width in WIDTHS):
            for place, width in enumerate(WIDTHS):
                rows.append(["" if place else name, str(width), *_cells(fits[_variant(width)][name])])
    if not rows:
        return ""
    layers = PLANS["default"].layers
    sizes = []
    for width in WIDTHS:
        took = queries.get(str(width))
        spread = f"{np.median(took):.2f} ({min(took):.2f} to {max(took):.2f})" if took else "-"
        sizes.append([str(width), f"{weight_bytes(width, layers):,}", spread])
    query = f"s per million points (median, range of {REPEATS}; {study.threads} thread(s))"
    return "\n\n".join([table(["shape", "width", *HEAD], rows), table(["width", "bytes", query], sizes)])


def draw_recipes(study: Study) -> None:
    """Errors of the bare networks over wall-clock time, a panel for each shape."""
    import matplotlib.pyplot as plt

    fits = study.results.get("fits", {})
    names = [n for n in study.meshes if all(n in fits.get(recipe, {}) for recipe in ("default", "paper"))]
    if not names:
        return
    columns = min(4, len(names))
    rows = math.ceil(len(names) / columns)
    # At least a double width for the legend.
    size = (max(3.2 * columns, 6.5), 2.7 * rows + 0.6)
    figure, panels = plt.subplots(rows, columns, figsize=size, squeeze=False, sharex=True, sharey=True)
    flat = list(panels.flat)
    for panel, name in zip(flat, names, strict=False):
        for recipe, label, colour in (("default", "ours", OURS), ("paper", "paper's recipe", THEIRS)):
            curve = np.array(fits[recipe][name]["curve"], dtype=float).reshape(-1, 4)
            for column, where, style in ((2, "near the surface", "-"), (3, "in the box", "--")):
                marker = dict(marker="o", markersize=2.5)
                panel.loglog(curve[:, 1], curve[:, column], style, color=colour, label=f"{label}, {where}", **marker)
        plain_ticks(panel.xaxis)
        panel.set_title(name, fontsize=10)
        panel.grid(True, which="both", linewidth=0.3, alpha=0.6)
    for panel in flat[len(names) :]:
        panel.set_visible(False)
    for place, panel in enumerate(flat[: len(names)]):
        # The lowest of a column carries the axis, also where the last row is short of panels.
        if place + columns >= len(names):
            panel.set_xlabel("wall-clock time, s")
            panel.tick_params(labelbottom=True)
        if place % columns == 0:
            panel.set_ylabel("mean error / extent")
    handles, labels = flat[0].get_legend_handles_labels()
    figure.tight_layout(rect=(0, 0, 1, 1 - 0.55 / size[1]))
    figure.legend(handles, labels, loc="upper center", ncol=4 if columns > 2 else 2, fontsize=9, frameon=False)
    save_chart(figure, study.pictures / "sdf_recipes.png")
    plt.close(figure)


def weight_bytes(width: int, layers: int) -> int:
    """Bytes of a network's float32 weights and biases: 3 inputs, one output."""
    return 4 * (3 * width + width + (layers - 2) * (width * width + width) + width + 1)


def _variant(width: int) -> str:
    """The recipe's own width is the fit of part 1."""
    return "default" if width == PLANS["default"].width else f"default-width-{width}"


def _cells(fit: dict[str, Any]) -> list[str]:
    return [*(number(fit["errors"][key]) for key in ERRORS), str(fit["updates"]), f"{fit['seconds']:.0f}"]


def _median(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
