"""Accuracy, speed and size of our SDF networks, compared with the paper's recipe and other representations.

    python -m benchmarks sdf MESH_FOLDER -o DIR [--seconds 60]

MESH_FOLDER holds NAME/visual_geometry.obj for each shape; `kubasic` downloads Kubric's. Each is fitted with our recipe
and the paper's at equal time, with other widths of the network, and with smaller budgets; then queries of one shape are
timed. Fits in DIR are not made again. Writes two records, and DIR/sdf.png.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch

from benchmarks.records import Out, in_turn, progress, write_record
from sdfsim.base.errors import SdfsimError
from sdfsim.data.public_shapes import public_folder
from sdfsim.evaluation.harness import Job, Panel, draw, line, machine, measure, why_failed
from sdfsim.geometry.mesh_io import load_mesh
from sdfsim.geometry.solidify import solidify
from sdfsim.sdf.fit import FIT_VERSION, Recipe
from sdfsim.sdf.fit.certificate import EXACT
from sdfsim.sdf.fit.train import RECIPES
from sdfsim.sdf.grid import sample_grid
from sdfsim.sdf.mesh_sdf import MeshSdf
from sdfsim.sdf.mlp import MlpSdf
from sdfsim.shape.make import fit_mesh
from sdfsim.shape.shape import load_shape

WIDTHS, BUDGETS = (32, 128), (5.0, 10.0, 20.0)  # s
GRID, POINTS, REPEATS, CHUNK = 64, 250_000, 5, 16_384
ERRORS = tuple(EXACT)


def fit(file: Path, folder: Path, recipe: Recipe, budget: float, width: int | None = None) -> dict:
    """Fit a mesh and keep the shape; returns the errors of its certificate, and the seconds of the fit."""
    plan = replace(RECIPES[recipe], width=width or RECIPES[recipe].width)
    began = time.monotonic()
    with patch.dict(RECIPES, {recipe: plan}):
        shape = fit_mesh(load_mesh(file), name=file.parent.name, recipe=recipe, budget=budget)
    shape.save(folder)
    found = {name: shape.certificate[name] for name in (*ERRORS, "steps")}
    missed = shape.certificate["reason"] or shape.certificate["caveat"]
    return found | {"seconds": time.monotonic() - began, "broken": missed}


def queries(file: Path, default: Path, paper: Path) -> dict:
    """Seconds for value and gradient at a million points, by representation; and the bytes of each."""
    sdf, published, mesh = load_shape(default).sdf, load_shape(paper).sdf, solidify(load_mesh(file)).surface
    grid, exact = sample_grid(sdf, sdf.bounds, GRID), MeshSdf(mesh)
    assert isinstance(sdf, MlpSdf) and isinstance(published, MlpSdf)
    metres = np.random.default_rng(0).uniform(sdf.bounds[0], sdf.bounds[1], (POINTS, 3))
    points = torch.from_numpy(metres).float()
    layers: list[torch.nn.Module] = []
    for weight, bias in zip(published.weights, published.biases, strict=True):
        linear = torch.nn.Linear(weight.shape[1], weight.shape[0])
        linear.weight.data, linear.bias.data = weight.float(), bias.float()
        layers += [linear, torch.nn.ReLU()]
    network = torch.nn.Sequential(*layers[:-1]).requires_grad_(False)

    def autograd() -> None:
        for part in points.split(CHUNK):
            asked = part.detach().requires_grad_()
            torch.autograd.grad(network(asked).sum(), asked)

    def weights(of: MlpSdf) -> int:
        return sum(4 * tensor.numel() for tensor in (*of.weights, *of.biases))

    calls: dict[str, tuple[Callable[[], object], int]] = {
        "our network": (lambda: sdf(points), weights(sdf)),
        "paper's network by autograd": (autograd, weights(published)),
        "paper's network by our sweeps": (lambda: published(points), weights(published)),
        f"voxel grid {GRID}^3": (lambda: grid(points), 4 * GRID**3),
        "exact mesh distance": (lambda: exact(metres), 12 * (len(mesh.vertices) + len(mesh.faces))),
    }

    def seconds(call: Callable[[], object]) -> float:
        began = time.perf_counter()
        call()
        return time.perf_counter() - began

    taken = np.median(in_turn([partial(seconds, call) for call, _ in calls.values()], REPEATS), axis=0)
    return {
        name: {"seconds": 1e6 / POINTS * float(took), "bytes": size}
        for (name, (_, size)), took in zip(calls.items(), taken, strict=True)
    }


def main(meshes: Path, *, out: Out, seconds: float = 60.0) -> None:
    files = {file.parent.name: file for file in sorted(public_folder(meshes).glob("*/visual_geometry.obj"))}
    if not files:
        raise SdfsimError(f"{meshes}: no NAME/visual_geometry.obj")
    first = next(iter(files))
    methods = {"ours": ("default", seconds), "paper's recipe": ("paper", seconds)}
    methods |= {f"ours, {width} wide": ("default", seconds, width) for width in WIDTHS}
    methods |= {f"ours, {budget:g} s": ("default", budget) for budget in BUDGETS}
    jobs = []
    for name, file in files.items():
        for method, plan in methods.items():
            content = [FIT_VERSION, load_mesh(file), plan, RECIPES[plan[0]], machine()]
            jobs.append(Job(name, method, content, fit, (file, out / "shapes" / method / name, *plan)))
    fits = measure(jobs, out / "results", on_progress=progress)
    fitted = [out / "shapes" / method / first for method in ("ours", "paper's recipe")]
    asked = Job(first, "queries", [jobs[0].content], queries, (files[first], *fitted))
    timed = measure([asked], out / "results", on_progress=progress)[first, "queries"]
    panels = []
    for key in ("error_within_0.01", "error_in_box"):
        ours = [*(f"ours, {b:g} s" for b in BUDGETS), "ours"]
        lines = [line(name, [fits[name, method] for method in ours], "seconds", key) for name in files]
        panels.append(Panel(key.replace("_", " "), "seconds", "of the largest extent", lines, "xy", EXACT[key]))
    draw(panels, out / "sdf.png")
    command = "python -m benchmarks sdf MESHES -o DIR"
    rows = [(*key, *map(found.get, (*ERRORS, "steps", "seconds")), why_failed(found)) for key, found in fits.items()]
    times = [(name, found["seconds"], found["bytes"]) for name, found in timed.items()]
    write_record(
        "sdf_fits", command, "Errors relative to the largest extent, and what a fit missed of its certificate.",
        ("shape", "fit", *ERRORS, "updates", "s", "missed"), rows,
    )  # fmt: skip
    write_record(
        "sdf_queries", command, f"Value and gradient at points around {first}, medians of {REPEATS} alternating runs.",
        ("", "s per million points", "bytes"), times,
    )  # fmt: skip
