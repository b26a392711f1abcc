"""Mesh -> SDF network, with a certificate from held-out points."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
import torch

from sdfsim.errors import SdfsimError
from sdfsim.shape import fit
from sdfsim.shape.distance import DistanceOracle, MeshDistance, PiecesDistance
from sdfsim.shape.fit import PLANS
from sdfsim.shape.fit_metrics import certify
from sdfsim.shape.mass import mass_properties, mass_properties_of_sdf
from sdfsim.shape.mesh import Mesh, clean, is_closed
from sdfsim.shape.mlp_sdf import MlpSdf
from sdfsim.shape.sdf import Sdf, accepts_numpy
from sdfsim.shape.shape import Shape
from sdfsim.shape.surface_nodes import DEFAULT_COUNT, edge_nodes, hull_nodes, sample_nodes, thin
from sdfsim.shape.watertight import solidify

Recipe = Literal["quick", "default", "paper"]
Progress = Callable[[float, str], None]
Oracle = TypeVar("Oracle", bound=DistanceOracle)

# Of the nodes of convex pieces: the pieces' vertices are at most this part, with points on their edges at most that.
OWN_SHARE, EDGE_SHARE = 0.6, 0.85
# Between points on the edges of convex pieces, relative to the size of the whole.
EDGE_SPACING = 0.06

# Changes whenever the same mesh would come out differently; part of every cache key.
FIT_VERSION = 6


def fit_mesh(
    mesh: Mesh | MeshDistance,
    *,
    name: str,
    recipe: Recipe = "default",
    budget: float | None = None,
    seed: int = 0,
    nodes: int = DEFAULT_COUNT,
    cap: bool = False,
    thicken: float | None = None,
    on_progress: Progress | None = None,
    checkpoint: str | Path | None = None,
    device: torch.device | str = "cpu",
) -> Shape:
    """Fit the compact SDF network to the solid that a triangle mesh bounds (see `solidify`).

    The result depends on the mesh, the recipe and the seed only (up to rounding, which the number of threads and the
    device change), unless the budget cuts the training short.

    Args:
        mesh: metres; or its distance oracle, when there is one already.
        name: of the shape.
        recipe: "default" (waves, 64 wide, SOAP, seconds), "quick" (the same in 2,000 steps at most, not 5,000) or
            "paper" (ReLU, 128 wide, Adam 1e-5, 400k steps).
        budget: seconds of training at most; the schedule is shortened to fit.
        seed: of sampling and initialisation.
        nodes: surface nodes at most.
        cap: close openings of any size.
        thicken: m; the solid is all within half of this distance from the mesh instead.
        on_progress: called with (fraction done, message).
        checkpoint: a file to resume from when it exists and belongs to the same fit, and to write on the way; to be
            removed by the caller once the shape is safe.
        device: to train on.

    Returns:
        Shape whose `certificate` tells the errors and whether it is usable (`passed`); what was done to the mesh is
        in `source["notes"]`.

    Raises:
        SdfsimError: the mesh cannot be used, or bounds no solid.
    """
    if isinstance(mesh, Mesh):
        mesh = MeshDistance(solidify(mesh, name=name, cap=cap, thicken=thicken))
    return fit_solids(
        {name: mesh},
        recipe=recipe,
        budget=budget,
        seed=seed,
        nodes=nodes,
        on_progress=on_progress,
        checkpoint=checkpoint,
        device=device,
    )[0]


def fit_solids(
    solids: dict[str, MeshDistance],
    *,
    recipe: Recipe = "default",
    budget: float | None = None,
    seed: int = 0,
    nodes: int = DEFAULT_COUNT,
    on_progress: Progress | None = None,
    checkpoint: str | Path | None = None,
    device: torch.device | str = "cpu",
) -> list[Shape]:
    """Fit several solids side by side in one batched optimiser, which is what a GPU is good at.

    Args:
        solids: by name, from `MeshDistance(solidify(mesh))`.
        budget: seconds of training for all of them.
        recipe, seed, nodes, on_progress, checkpoint, device: as for `fit_mesh`; the checkpoint for a single solid only.

    Returns:
        Shapes in the order of `solids`, as `fit_mesh` gives them.
    """

    def pick(sdf: Sdf, oracle: MeshDistance) -> np.ndarray:
        return surface_nodes(sdf, oracle.surface, nodes)

    oracles = list(solids.values())
    shapes = []
    fitted = _train(oracles, recipe, budget, seed, pick, on_progress, checkpoint, device)
    for (name, oracle), (sdf, points, certificate) in zip(solids.items(), fitted, strict=True):
        solid = oracle.solid
        source = _source("mesh", recipe, [solid.surface]) | ({"notes": list(solid.notes)} if solid.notes else {})
        shapes.append(Shape(name, solid.surface, sdf, points, *solid.mass_properties(), certificate, source))
    return shapes


def surface_nodes(sdf: Sdf, surface: Mesh, count: int) -> np.ndarray:
    """Nodes for contact, at most `count` [K, 3] m: first corners of the convex hull, then points all over `sdf`."""
    corners = thin(surface.vertices[_outer(surface.vertices)], count // 3)
    return thin(sample_nodes(sdf), count, keep=corners)


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
    with a flat floor is exact only there; then points along their sharp edges, then points all over the surface.

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
    size = float(np.ptp(oracle.bounds, axis=0).max())
    vertices = np.concatenate([piece.vertices for piece in pieces])
    edges = np.concatenate([edge_nodes(piece.vertices, EDGE_SPACING * size) for piece in pieces])

    def bare(points: np.ndarray) -> np.ndarray:
        _, first = np.unique(np.round(points / (1e-4 * size)), axis=0, return_index=True)
        points = points[np.sort(first)]
        # Measured from the boundary of the union: a point on the seam of two pieces is deep in neither.
        return points[oracle(points).distance >= -1e-3 * size]

    vertices, edges = bare(vertices), bare(edges)

    def pick(sdf: Sdf, oracle: PiecesDistance) -> np.ndarray:
        own = hull_nodes(vertices, round(OWN_SHARE * nodes))
        return thin(sample_nodes(sdf), nodes, keep=thin(edges, round(EDGE_SHARE * nodes), keep=own))

    sdf, points, certificate = _train([oracle], recipe, budget, seed, pick, on_progress, checkpoint, "cpu")[0]
    single = len(pieces) == 1 and is_closed(pieces[0])
    volume, com, inertia = mass_properties(pieces[0]) if single else mass_properties_of_sdf(_OracleSdf(oracle))
    mesh = display if display is not None else clean(oracle.surface, name=name)
    source = _source("pieces", recipe, pieces)
    hulls = tuple(piece.vertices for piece in pieces)
    return Shape(name, mesh, sdf, points, volume, com, inertia, certificate, source, hulls)


def _train(
    oracles: Sequence[Oracle],
    recipe: Recipe,
    budget: float | None,
    seed: int,
    pick: Callable[[Sdf, Oracle], np.ndarray],
    on_progress: Progress | None,
    checkpoint: str | Path | None,
    device: torch.device | str,
) -> list[tuple[MlpSdf, np.ndarray, dict]]:
    """Per oracle the network, nodes [K, 3] m as `pick` takes them from it, and the certificate."""
    if budget is not None and not budget > 0:
        raise SdfsimError(f"the budget of a fit must be > 0 seconds (got {budget})")
    started = time.monotonic()
    tell = on_progress or (lambda fraction, message: None)
    fitted = training.train(
        oracles,
        PLANS[recipe],
        budget=budget,
        seed=seed,
        tell=tell,
        checkpoint=Path(checkpoint) if checkpoint else None,
        device=torch.device(device),
    )
    trained = time.monotonic() - started
    results = []
    for done, (oracle, (sdf, steps)) in enumerate(zip(oracles, fitted, strict=True), start=1):
        tell(0.98 + 0.02 * (done - 1) / len(oracles), "measuring")
        measuring = time.monotonic()
        nodes = pick(sdf, oracle)
        certificate = certify(sdf, oracle, nodes=nodes)
        # Its share of the training that it had with others, and its own measuring.
        seconds = trained / len(oracles) + time.monotonic() - measuring
        certificate.update(recipe=recipe, seed=seed, steps=steps, seconds=round(seconds, 2))
        but = certificate["reason"] or certificate["caveat"]
        told = f"fitted, but {but}" if but else "fitted"
        tell(0.98 + 0.02 * done / len(oracles), told)
        results.append((sdf, nodes, certificate))
    return results


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
