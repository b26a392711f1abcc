"""Shapes whose distances are made anew for a study: once, and kept by what they are made from."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.shape.distance import DistanceOracle
from sdfsim.shape.fit import PLANS, train
from sdfsim.shape.mlp_sdf import MlpSdf
from sdfsim.shape.sdf import GridSdf, MeshSdf, Sdf, sample_grid
from sdfsim.shape.shape import RECORD_FILE, Shape, load_shape

FIT_SECONDS = 60.0  # at most, for a network of another width


def digest_of(shape: Shape) -> str:
    """Changes with a shape's distances, nodes, mesh and mass properties."""
    told = hashlib.sha256(repr((type(shape.sdf).__name__, shape.volume, shape.mesh.digest())).encode())
    arrays: list[Any] = [shape.nodes, shape.com, shape.inertia, shape.sdf.bounds]
    if isinstance(shape.sdf, MlpSdf):
        arrays += [tensor.cpu() for tensor in (*shape.sdf.weights, *shape.sdf.biases)]
    elif isinstance(shape.sdf, GridSdf):
        arrays.append(shape.sdf.values.cpu())
    elif isinstance(shape.sdf, MeshSdf):
        told.update(shape.sdf.mesh.digest().encode())
    for array in arrays:
        told.update(np.ascontiguousarray(array).tobytes())
    return told.hexdigest()[:16]


def sampled(shape: Shape, resolution: int, scratch: Path) -> Shape:
    """A shape whose network's distances are sampled on a grid, once, and kept; `source` says how long it took."""

    def make() -> tuple[Sdf, dict]:
        began = time.process_time()
        grid = sample_grid(shape.sdf, shape.sdf.bounds, resolution)
        took = time.process_time() - began + float(shape.certificate.get("seconds") or 0.0)
        return grid, {"sdf": "grid", "resolution": resolution, "fitted_s": took}

    return _kept(shape, scratch / f"grid-{resolution}" / f"{shape.name}-{digest_of(shape)}", make)


def refitted(shape: Shape, width: int, oracle: DistanceOracle, scratch: Path) -> Shape:
    """A shape whose network is of another width, fitted once to `oracle` in `FIT_SECONDS` at most, and kept.

    Its `source` says how long that took.
    """

    def make() -> tuple[Sdf, dict]:
        began = time.process_time()
        plan = replace(PLANS["default"], width=width)
        sdf, _ = train([oracle], plan, budget=FIT_SECONDS, seed=0, tell=lambda fraction, message: None)[0]
        return sdf, {"width": width, "fitted_s": time.process_time() - began}

    made_from = hashlib.sha256(f"{digest_of(shape)} {oracle.surface.digest()}".encode()).hexdigest()[:16]
    return _kept(shape, scratch / f"width-{width}" / f"{shape.name}-{made_from}", make)


def _kept(shape: Shape, folder: Path, make: Callable[[], tuple[Sdf, dict]]) -> Shape:
    """The shape with other distances and a note in its source, from `folder` if it is complete there."""
    if (folder / RECORD_FILE).exists():  # written last
        return load_shape(folder)
    sdf, note = make()
    made = replace(shape, sdf=sdf, certificate={}, source=shape.source | note)
    made.save(folder)
    return made
