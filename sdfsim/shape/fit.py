"""Mesh -> SDF network, with a certificate from held-out points."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from sdfsim.errors import SdfsimError
from sdfsim.shape import training
from sdfsim.shape.asset import Shape
from sdfsim.shape.certificate import certify
from sdfsim.shape.distance import DistanceOracle, MeshDistance, PiecesDistance
from sdfsim.shape.mesh import Mesh, clean, is_closed, mass_properties, mass_properties_of_sdf
from sdfsim.shape.mlp import MlpSdf
from sdfsim.shape.nodes import DEFAULT_COUNT, hull_nodes, sample_nodes, thin
from sdfsim.shape.sdf import accepts_numpy

Recipe = Literal["default", "paper"]
Progress = Callable[[float, str], None]

# Changes whenever the same mesh would come out differently; part of every cache key.
FIT_VERSION = 2


def fit_mesh(
    mesh: Mesh | MeshDistance,
    *,
    name: str,
    recipe: Recipe = "default",
    budget: float | None = None,
    seed: int = 0,
    nodes: int = DEFAULT_COUNT,
    on_progress: Progress | None = None,
    checkpoint: str | Path | None = None,
) -> Shape:
    """Fit the compact SDF network to a triangle mesh.

    The result depends on the mesh, the recipe and the seed only, unless the budget cuts the training short.

    Args:
        mesh: metres; or its distance oracle, when there is one already.
        name: of the shape.
        recipe: "default" (sine, 64 wide, SOAP, seconds) or "paper" (ReLU, 128 wide, Adam 1e-5, 400k steps).
        budget: seconds of training at most; the default recipe then shortens its schedule to fit.
        seed: of sampling and initialisation.
        nodes: surface nodes at most.
        on_progress: called with (fraction done, message).
        checkpoint: a file to resume from when it exists and belongs to the same fit, and to write on the way.

    Returns:
        Shape whose `certificate` tells the errors and whether they are within the limits (`passed`).

    Raises:
        SdfsimError: the mesh cannot be used.
    """
    oracle = mesh if isinstance(mesh, MeshDistance) else MeshDistance(clean(mesh, name=name))
    solid = oracle.surface
    sdf, certificate = _train(oracle, recipe, budget, seed, on_progress, checkpoint)
    corners = thin(solid.vertices[_outer(solid.vertices)], nodes // 3)
    surface = thin(sample_nodes(sdf), nodes, keep=corners)
    # An open mesh encloses a volume only by what the fit makes of its holes.
    volume, com, inertia = mass_properties(solid) if is_closed(solid) else mass_properties_of_sdf(sdf)
    return Shape(name, solid, sdf, surface, volume, com, inertia, certificate, _source("mesh", recipe, [solid]))


def fit_pieces(
    pieces: list[Mesh],
    *,
    name: str,
    display: Mesh | None = None,
    recipe: Recipe = "default",
    budget: float | None = None,
    seed: int = 0,
    nodes: int = DEFAULT_COUNT,
    on_progress: Progress | None = None,
    checkpoint: str | Path | None = None,
) -> Shape:
    """Fit the compact SDF network to the union of convex pieces: the body that a rigid-body engine collides.

    Nodes are the pieces' own vertices first (without repetitions and those inside another piece), because contact
    between polyhedra is exact only there; where they are fewer than `nodes`, sampled ones follow.

    Args:
        pieces: convex closed meshes, metres (see `load_pieces`).
        display: the mesh to show; by default the boundary of the union.
        name, recipe, budget, seed, nodes, on_progress, checkpoint: as for `fit_mesh`.

    Returns:
        Shape; its mass properties are those of the union.

    Raises:
        SdfsimError: no pieces.
    """
    oracle = PiecesDistance(pieces)
    sdf, certificate = _train(oracle, recipe, budget, seed, on_progress, checkpoint)
    size = float(np.ptp(oracle.bounds, axis=0).max())
    vertices = np.concatenate([piece.vertices for piece in pieces])
    _, first = np.unique(np.round(vertices / (1e-4 * size)), axis=0, return_index=True)
    vertices = vertices[np.sort(first)]
    vertices = vertices[~oracle.inside(vertices, margin=1e-3 * size)]
    surface = thin(sample_nodes(sdf), nodes, keep=hull_nodes(vertices, nodes))
    single = len(pieces) == 1 and is_closed(pieces[0])
    volume, com, inertia = mass_properties(pieces[0]) if single else mass_properties_of_sdf(_OracleSdf(oracle))
    mesh = display if display is not None else clean(oracle.surface, name=name)
    return Shape(name, mesh, sdf, surface, volume, com, inertia, certificate, _source("pieces", recipe, pieces))


def _train(
    oracle: DistanceOracle,
    recipe: Recipe,
    budget: float | None,
    seed: int,
    on_progress: Progress | None,
    checkpoint: str | Path | None,
) -> tuple[MlpSdf, dict]:
    if budget is not None and not budget > 0:
        raise SdfsimError(f"the budget of a fit must be > 0 seconds (got {budget})")
    started = time.monotonic()
    tell = on_progress or (lambda fraction, message: None)
    plan = training.PLANS[recipe]
    sdf, steps = training.train(
        oracle, plan, budget=budget, seed=seed, tell=tell, checkpoint=Path(checkpoint) if checkpoint else None
    )
    tell(0.98, "measuring")
    certificate = certify(sdf, oracle)
    certificate.update(recipe=recipe, seed=seed, steps=steps, seconds=round(time.monotonic() - started, 2))
    tell(1.0, "fitted" if certificate["passed"] else f"fitted, but {certificate['reason']}")
    return sdf, certificate


def _outer(vertices: np.ndarray) -> np.ndarray:
    """Indices of the convex hull's vertices; all of them when the vertices lie in a plane."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return np.sort(ConvexHull(vertices).vertices)
    except QhullError:
        return np.arange(len(vertices))


def _source(kind: str, recipe: Recipe, meshes: list[Mesh]) -> dict:
    digest = hashlib.sha256()
    for mesh in meshes:
        digest.update(np.ascontiguousarray(mesh.vertices).tobytes())
        digest.update(np.ascontiguousarray(mesh.faces).tobytes())
    return {"kind": kind, "geometry_sha256": digest.hexdigest(), "recipe": recipe, "fit_version": FIT_VERSION}


@dataclass(frozen=True, eq=False)
class _OracleSdf:
    """Reference distances in the clothes of an Sdf, for integrals; its gradient is the direction to the surface."""

    oracle: DistanceOracle

    @property
    def bounds(self) -> np.ndarray:
        return self.oracle.bounds

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        truth = self.oracle(points.double().cpu().numpy())
        offset = points.double().cpu().numpy() - truth.closest
        direction = offset / np.where(np.abs(truth.distance) < 1e-12, 1e-12, truth.distance)[:, None]
        return torch.from_numpy(truth.distance).to(points), torch.from_numpy(direction).to(points)
