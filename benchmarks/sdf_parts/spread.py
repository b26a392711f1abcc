"""Part 6: how many nodes the paper's sampling gives, and how well they cover a surface."""

from __future__ import annotations

from itertools import cycle

import numpy as np

from benchmarks.sdf_parts.study import Study, say
from benchmarks.sdf_parts.tables import number, plain_ticks, save_chart, table
from sdfsim.errors import SdfsimError
from sdfsim.shape.fit_metrics import coverage
from sdfsim.shape.surface_nodes import sample_nodes

GRIDS = tuple(range(5, 17))
CHOSEN = "chosen"
KEYS = ("count", "per_area", "largest_hole", "mean_gap", "uncovered", "off_surface")


def measure(study: Study) -> None:
    """Sample every fitted shape with grids of growing resolution; for comparison also the nodes it comes with."""
    for name in study.names():
        done = study.section("nodes", name)
        if all(str(grid) in done for grid in GRIDS) and CHOSEN in done:
            continue
        say(f"nodes of {name}")
        shape, oracle = study.fitted("default", name), study.oracle(name)
        found = {CHOSEN: coverage(shape.nodes, oracle)}
        for grid in GRIDS:
            try:
                nodes = sample_nodes(shape.sdf, grid=grid)
            except SdfsimError:  # None of so few points reached the surface.
                nodes = np.zeros((0, 3))
            found[str(grid)] = coverage(nodes, oracle)
        study.keep(found, "nodes", name)


def tables(study: Study) -> str:
    """Medians over the shapes, by grid."""
    found = [entry for entry in study.results.get("nodes", {}).values() if entry]
    if not found:
        return ""
    rows = []
    for key in (*map(str, GRIDS), CHOSEN):
        middle = [_median([entry[key][what] for entry in found]) for what in KEYS]
        worst = max((entry[key]["largest_hole"] or np.inf for entry in found), default=np.inf)
        label = "those a fit comes with" if key == CHOSEN else f"{key}³"
        rows.append([label, f"{middle[0]:.0f}", *(number(value) for value in middle[1:]), number(worst)])
    head = ["grid", "nodes", "per area", "largest hole", "mean gap", "farther than 0.1", "off surface", "worst hole"]
    text = f"Medians over {len(found)} shape(s), last the largest hole of any; relative to the largest extent."
    return text + "\n\n" + table(head, rows)


def draw(study: Study) -> None:
    """Largest hole and mean gap over the number of nodes, and nodes per area over the grid."""
    import matplotlib.pyplot as plt

    found = {name: study.results.get("nodes", {}).get(name) for name in study.meshes}
    found = {name: entry for name, entry in found.items() if entry}
    if not found:
        return
    figure, panels = plt.subplots(1, 3, figsize=(13.5, 4.6))
    colours = plt.get_cmap("tab20").colors
    markers = cycle("osv^D")
    for place, (name, entry) in enumerate(found.items()):
        # The dark ten first; the eleventh tells itself apart by its marker.
        style = dict(color=colours[(2 * place + place // 10) % 20], marker=next(markers), markersize=4, linewidth=1.1)
        counts = [entry[str(grid)]["count"] for grid in GRIDS]
        for panel, key in zip(panels, ("largest_hole", "mean_gap"), strict=False):
            # Without nodes there is no distance to them; a gap in the line says so.
            values = [np.nan if (value := entry[str(grid)][key]) is None else value for grid in GRIDS]
            panel.loglog(counts, values, label=name, **style)
            chosen = entry[CHOSEN]
            panel.plot(chosen["count"], chosen[key], "*", markersize=11, color=style["color"], markeredgecolor="black")
        panels[2].plot(GRIDS, [entry[str(grid)]["per_area"] for grid in GRIDS], **style)
    titles = ("largest hole / extent", "mean gap / extent", "nodes per normalised area")
    for axis in (panels[0].xaxis, panels[0].yaxis, panels[1].xaxis, panels[1].yaxis):
        plain_ticks(axis)
    for panel, title in zip(panels, titles, strict=True):
        panel.set_ylabel(title)
        panel.set_xlabel("number of nodes")
        panel.grid(True, which="both", linewidth=0.3, alpha=0.6)
    panels[0].axhline(0.1, color="black", linewidth=0.8, linestyle=":", label="a tenth of the extent")
    panels[2].set_xlabel("N of the sampling grid N³")
    panels[2].set_xticks(GRIDS)
    star = plt.Line2D([], [], marker="*", linestyle="", markersize=10, color="white", markeredgecolor="black")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.tight_layout(rect=(0, 0.18, 1, 1))
    labels.append("the nodes a fit comes with")
    figure.legend([*handles, star], labels, loc="lower center", ncol=6, fontsize=9, frameon=False)
    save_chart(figure, study.pictures / "sdf_nodes.png")
    plt.close(figure)


def _median(values: list[float | None]) -> float:
    """Of all shapes; one without nodes counts as infinitely far."""
    return float(np.median([np.inf if value is None else value for value in values]))
