"""Parts 4 and 5: what a shape takes in memory, and what a query takes in time, by the way it is represented."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from benchmarks.sdf_parts.recipes import weight_bytes
from benchmarks.sdf_parts.study import Study, interleaved, say
from benchmarks.sdf_parts.tables import number, table
from sdfsim.shape.far_field import BOX
from sdfsim.shape.fit import PLANS
from sdfsim.shape.mesh import normal_frame, sample_surface
from sdfsim.shape.sdf import MeshSdf, sample_grid

GRIDS = (32, 64, 128)
SHAPE = ("suzanne",)
CHUNKS = (1024, 4096, 16_384, 65_536)
SAMPLES = 100_000
RESOLUTION = 64
REPEATS = 5
AT_ONCE = "autograd all"


def measure_bytes(study: Study) -> None:
    """Count what the mesh of each shape takes; networks and grids take the same for every shape."""
    for name in study.names():
        if name not in study.section("meshes"):
            surface = study.oracle(name).surface
            study.keep({"vertices": len(surface.vertices), "faces": len(surface.faces)}, "meshes", name)


def tables_of_bytes(study: Study) -> str:
    """Bytes by representation."""
    counts = study.results.get("meshes", {})
    if not counts:
        return ""
    shared = [(f"network {plan.width} x {plan.layers}, {key} recipe", weight_bytes(plan.width, plan.layers))
              for key, plan in PLANS.items()]  # fmt: skip
    shared += [(f"voxel grid, {side}³", 4 * side**3) for side in GRIDS]
    ours = shared[0][1]
    rows = [[what, "", f"{size:,}", number(size / ours)] for what, size in shared]
    for name in [name for name in study.meshes if name in counts]:
        size = 12 * (counts[name]["vertices"] + counts[name]["faces"])
        rows.append([f"mesh of {name}", f"{counts[name]['faces']:,}", f"{size:,}", number(size / ours)])
    return table(["any shape, or its mesh (float32, int32)", "faces", "bytes", "of our network"], rows)


def measure_queries(study: Study) -> None:
    """Time value and gradient of one shape in every representation, with one thread and with all."""
    names = study.names(SHAPE)
    for threads in sorted({1, study.threads}):
        if not names or str(threads) in study.section("queries"):
            continue
        say(f"timing queries with {threads} thread(s)")
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            took = interleaved(_calls(study, names[0], threads), REPEATS)
        finally:
            torch.set_num_threads(before)
        scale = 1e6 / study.points
        found: dict[str, Any] = {key: [scale * seconds for seconds in took[key]] for key in took}
        study.keep({"shape": names[0], "seconds": found}, "queries", str(threads))


def tables_of_queries(study: Study) -> str:
    """Seconds per million points, and how many times faster than the paper's network under autograd."""
    queries = study.results.get("queries", {})
    if not queries:
        return ""
    own = PLANS["default"]
    labels = {
        "network": f"our network {own.width} x {own.layers}",
        "autograd": "paper's 128 x 8 by autograd, best chunk",
        AT_ONCE: "paper's 128 x 8 by autograd, all points at once",
        "paper": "paper's 128 x 8 by our sweeps",
        "grid": f"voxel grid {RESOLUTION}³, trilinear",
        "mesh": "exact mesh distance (bounding-volume hierarchy)",
        "tree": f"KD-tree of {SAMPLES // 1000},000 surface samples (unsigned)",
    }
    head, rows = ["value and gradient"], [[label] for label in labels.values()]
    notes = []
    for threads, entry in sorted(queries.items(), key=lambda item: int(item[0])):
        took = entry["seconds"]
        best = min((f"autograd {chunk}" for chunk in CHUNKS), key=lambda key: float(np.median(took[key])))
        plural = "s" if int(threads) > 1 else ""
        head += [f"{threads} thread{plural}, s per million (range)", "speed, autograd in chunks = 1", "at once = 1"]
        notes.append(f"{best.split()[1]} points with {threads} thread{plural}")
        for row, key in zip(rows, labels, strict=True):
            times = took[best if key == "autograd" else key]
            middle = float(np.median(times))
            row.append(f"{number(middle)} ({number(min(times))} to {number(max(times))})")
            row += [number(float(np.median(took[base])) / middle) for base in (best, AT_ONCE)]
    shape = next(iter(queries.values()))["shape"]
    text = (
        f"{study.points:,} points around {shape}, half of them uniform in its box, half within some hundredths of its "
        f"surface; median of {REPEATS} interleaved runs. Best chunk for autograd: {' and '.join(notes)}."
    )
    return text + "\n\n" + table(head, rows)


def _calls(study: Study, name: str, threads: int) -> dict[str, Callable[[], object]]:
    """What is timed, each a query of all points for value and gradient."""
    from scipy.spatial import cKDTree

    oracle = study.oracle(name)
    frame = normal_frame(oracle.bounds)
    rng = np.random.default_rng(0)
    near = frame.inward(sample_surface(oracle.surface, study.points // 2, rng)[0])
    near = np.clip(near + rng.normal(0.0, 0.03, near.shape), -BOX, BOX)
    local = np.concatenate([near, rng.uniform(-BOX, BOX, (study.points - len(near), 3))])
    # In no order: neighbours in space would be neighbours in the caches of trees.
    local = rng.permutation(local)
    metres = frame.outward(local)
    points, normalised = torch.from_numpy(metres).float(), torch.from_numpy(local).float()

    ours, paper = study.fitted("default", name).sdf, study.fitted("paper", name).sdf
    grid = sample_grid(oracle, oracle.bounds, RESOLUTION)
    exact = MeshSdf(oracle.surface)
    with _omp_threads(threads):
        exact(metres[:10])  # Builds the hierarchy, which takes the number of threads from the environment.
    samples = sample_surface(oracle.surface, SAMPLES, rng)[0]
    tree = cKDTree(samples)
    network = _as_module(paper.weights, paper.biases)

    def autograd(chunk: int) -> Callable[[], object]:
        def call() -> list[tuple[torch.Tensor, torch.Tensor]]:
            answers = []
            for part in normalised.split(chunk):
                asked = part.detach().requires_grad_()
                value = network(asked)
                answers.append((value.detach(), torch.autograd.grad(value.sum(), asked)[0]))
            return answers

        return call

    def by_tree() -> tuple[np.ndarray, np.ndarray]:
        distance, index = tree.query(metres, workers=threads)
        return distance, (metres - samples[index]) / np.maximum(distance, 1e-12)[:, None]

    return {
        "network": lambda: ours(points),
        **{f"autograd {chunk}": autograd(chunk) for chunk in CHUNKS},
        AT_ONCE: autograd(study.points),
        "paper": lambda: paper(points),
        "grid": lambda: grid(points),
        "mesh": lambda: exact(metres),
        "tree": by_tree,
    }


def _as_module(weights: tuple[torch.Tensor, ...], biases: tuple[torch.Tensor, ...]) -> torch.nn.Sequential:
    """A ReLU network for autograd; its parameters ask for no gradients, which would only cost time."""
    layers: list[torch.nn.Module] = []
    for weight, bias in zip(weights, biases, strict=True):
        linear = torch.nn.Linear(weight.shape[1], weight.shape[0])
        linear.weight.data.copy_(weight)
        linear.bias.data.copy_(bias)
        layers += [linear, torch.nn.ReLU()]
    return torch.nn.Sequential(*layers[:-1]).requires_grad_(False)


@contextmanager
def _omp_threads(count: int) -> Iterator[None]:
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = str(count)
    try:
        yield
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before
