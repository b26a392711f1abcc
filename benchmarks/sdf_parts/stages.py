"""Part 3: what a shape looks like on the way through its training."""

from __future__ import annotations

import numpy as np

from benchmarks.sdf_parts.render import level, shaded
from benchmarks.sdf_parts.study import Study, say
from benchmarks.sdf_parts.tables import number, save_chart, table
from sdfsim.shape.mesh import normal_frame
from sdfsim.shape.sdf import MeshSdf

SHAPES = ("suzanne", "sponge", "torus")
UPDATES = (100, 200, 400, 800)
PIXELS = 300


def measure(study: Study) -> None:
    """Fit with schedules of growing length: each picture is the end of a fit, not a glimpse of an unfinished one."""
    for name in study.names(SHAPES):
        for updates in UPDATES:
            study.fitted(_variant(updates), name, hurried=False, steps=updates)
        for recipe in ("default", "paper"):
            study.fitted(recipe, name)


def tables(study: Study) -> str:
    """Errors and times of the snapshots."""
    rows = []
    for name in _complete(study):
        for place, variant in enumerate(_variants()):
            fit = study.results["fits"][variant][name]
            recipe = {"paper": "paper", "default": "ours, whole"}.get(variant, "ours")
            errors = [fit["errors"]["error_within_0.01"], fit["errors"]["error_in_box"]]
            cells = [recipe, str(fit["updates"]), number(fit["training"]), *(number(error) for error in errors)]
            rows.append(["" if place else name, *cells])
    head = ["shape", "recipe", "updates", "training, s", "error within 0.01", "in box"]
    return table(head, rows) if rows else ""


def draw(study: Study) -> None:
    """A row of shaded zero levels for each shape, the mesh itself last."""
    import matplotlib.pyplot as plt

    names = _complete(study)
    if not names:
        return
    columns = len(_variants()) + 1
    size = (2.0 * columns, 2.8 * len(names))
    figure, panels = plt.subplots(len(names), columns, figsize=size, squeeze=False, layout="constrained")
    for row, name in zip(panels, names, strict=True):
        say(f"drawing {name}")
        frame = normal_frame(study.oracle(name).bounds)
        for panel, variant in zip(row, _variants(), strict=False):
            fit = study.results["fits"][variant][name]
            sdf = study.fitted(variant, name).sdf
            panel.imshow(shaded(level(sdf, frame), sdf, frame, PIXELS))
            who = {"paper": "paper's recipe", "default": "ours, whole recipe"}.get(variant, "ours")
            panel.set_title(f"{who}\n{fit['updates']} updates, {fit['training']:.0f} s", fontsize=8)
            near = fit["errors"]["error_within_0.01"]
            panel.set_xlabel(f"error near {number(near)}\nin box {number(fit['errors']['error_in_box'])}", fontsize=8)
        mesh = study.oracle(name).surface
        row[-1].imshow(shaded(mesh, MeshSdf(mesh), frame, PIXELS))
        row[-1].set_title("the mesh\n", fontsize=8)
        row[0].set_ylabel(name, fontsize=10)
    for panel in np.ravel(panels):
        panel.set_xticks([])
        panel.set_yticks([])
        panel.set_frame_on(False)
    save_chart(figure, study.pictures / "sdf_stages.png")
    plt.close(figure)


def _variant(updates: int) -> str:
    return f"default-{updates}-updates"


def _variants() -> list[str]:
    return [*(_variant(updates) for updates in UPDATES), "default", "paper"]


def _complete(study: Study) -> list[str]:
    fits = study.results.get("fits", {})
    return [name for name in study.meshes if all(name in fits.get(variant, {}) for variant in _variants())]
