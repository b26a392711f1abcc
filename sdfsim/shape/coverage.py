"""How well a surface is met: by the nodes that stand for it, and by the zero level of a fitted SDF."""

from __future__ import annotations

import math

import numpy as np

from sdfsim.shape.bvh import ClosestPoint
from sdfsim.shape.distance import DistanceOracle, MeshDistance
from sdfsim.shape.far_field import BOX
from sdfsim.shape.mesh import Frame, Mesh, normal_frame, sample_surface, signed_volume
from sdfsim.shape.sdf import Sdf
from sdfsim.shape.surface_nodes import project

# Lengths are relative to the shape's largest extent.
FAR_FROM_A_NODE = 0.1
# The zero level is looked for on this many cells a side, halved REFINEMENTS times where it passes.
CELLS = 24
REFINEMENTS = 2
# A component counts as stray when most of it is farther than this from the surface.
STRAY_FROM = 0.01
# A sample is exposed when this far along its normal is outside; a zero crossing shows within as much to both sides.
STEP = 5e-4


def coverage(nodes: np.ndarray, surface: DistanceOracle | Mesh, *, points: int = 20_000, seed: int = 1) -> dict:
    """How evenly nodes stand for a surface, by straight distances from surface samples to their nearest node.

    Args:
        nodes: [K, 3] m.
        surface: the true surface, in the same frame: its oracle (which also knows what is hidden inside) or a mesh.
        points: samples, spread by area.
        seed: of the samples.

    Returns:
        JSON-ready dict, lengths relative to the largest extent: `count` of nodes, `per_area` (nodes per unit of
        normalised area), `largest_hole` and `mean_gap` (largest and mean distance to the nearest node), `uncovered`
        (fraction of the surface farther than 0.1 from every node) and `off_surface` (the largest distance of a node
        from the surface). Without nodes the distances are None.

    Raises:
        SdfsimError: the surface has no faces or no extent.
    """
    from scipy.spatial import KDTree

    oracle = MeshDistance(surface) if isinstance(surface, Mesh) else surface
    frame = normal_frame(oracle.bounds)
    corners = frame.inward(oracle.surface.vertices)[oracle.surface.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    result = {"count": len(nodes), "per_area": float(len(nodes) / area)}
    if len(nodes) == 0:
        return result | {"largest_hole": None, "mean_gap": None, "uncovered": 1.0, "off_surface": None}
    samples = frame.inward(bare_samples(oracle, points, np.random.default_rng([seed, 0xC0E4]))[0])
    gap = KDTree(frame.inward(nodes)).query(samples)[0]
    return result | {
        "largest_hole": float(gap.max()),
        "mean_gap": float(gap.mean()),
        "uncovered": float((gap > FAR_FROM_A_NODE).mean()),
        "off_surface": float(np.abs(oracle(nodes).distance).max() / frame.scale),
    }


def outward_samples(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """`sample_surface`, with the normals of a closed mesh pointing out also when its faces are inside out."""
    points, normal = sample_surface(mesh, count, rng)
    return points, -normal if signed_volume(mesh) < 0 else normal


def bare_samples(oracle: DistanceOracle, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """At most `count` points [P, 3] m of a surface spread by area and their normals [P, 3], without hidden ones.

    Overlapping parts hide faces, and so do the seams between convex pieces; of an open mesh nothing is left out.
    """
    points, normal = outward_samples(oracle.surface, count, rng)
    if not oracle.closed:
        return points, normal
    outside = oracle(points + STEP * normal_frame(oracle.bounds).scale * normal).distance > 0
    return (points[outside], normal[outside]) if outside.any() else (points, normal)


def hausdorff(sdf: Sdf, oracle: DistanceOracle, *, points: int = 10_000, seed: int = 1) -> dict:
    """Distances between the zero level of an SDF and the true surface, both ways.

    The level is found by marching cubes on [-0.7, 0.7]^3 of the normalised frame with cells of 0.015, its vertices
    moved onto it by a projection step. That grid is too coarse at edges and thin walls, so surface samples are
    also projected onto the level themselves, and count where the SDF does change its sign there.

    Args:
        sdf: metres.
        oracle: the truth, in the same frame.
        points: samples of the true surface.
        seed: of the samples.

    Returns:
        dict of lengths relative to the largest extent: `hausdorff`, the larger of `hausdorff_from_mesh` (a point of
        the surface, to the level) and `hausdorff_from_level` (the other way; where a mesh has holes the level that
        closes them counts); `stray_extent`, the largest extent of a component of the level most of which is
        farther than 0.01 from the surface, other than the largest component (0.0: there is none); `hausdorff_p99`,
        the larger way for the nearest 99 % of the samples, which a narrow crevice that the fit fills does not show
        in. Distances are infinite when the SDF has no zero level.
    """
    frame = normal_frame(oracle.bounds)
    samples, normal = bare_samples(oracle, points, np.random.default_rng([seed, 0x4A05]))
    feet, met = _onto_level(sdf, samples, normal, frame)
    to_level = np.where(met, np.linalg.norm(feet - samples, axis=1), np.inf)
    to_mesh = np.abs(oracle(feet[met]).distance)
    level = zero_level(sdf, frame)
    stray = 0.0
    if len(level.faces):
        nearest = ClosestPoint(level)(samples)[0]
        to_level = np.minimum(to_level, np.linalg.norm(nearest - samples, axis=1))
        off = np.abs(oracle(level.vertices).distance)
        stray = _stray_extent(level, off / frame.scale) / frame.scale
        to_mesh = np.concatenate([to_mesh, off])
    if len(to_mesh) == 0:
        to_mesh = np.array([math.inf])
    ways = {
        "hausdorff_from_mesh": float(to_level.max() / frame.scale),
        "hausdorff_from_level": float(to_mesh.max() / frame.scale),
    }
    # Without interpolation, for infinite distances have no differences.
    usual = max(float(np.quantile(way, 0.99, method="lower") / frame.scale) for way in (to_level, to_mesh))
    return {"hausdorff": max(ways.values()), **ways, "hausdorff_p99": usual, "stray_extent": stray}


def zero_level(sdf: Sdf, frame: Frame) -> Mesh:
    """The zero level within [-0.7, 0.7]^3 of a normalised frame, as triangles in metres (none: no sign change).

    Values far from the level are interpolated from a coarser grid: an SDF that climbs no faster than 1.5 has no
    level there.
    """
    from skimage.measure import marching_cubes

    cells = CELLS
    field = _values(sdf, frame, np.indices((cells + 1,) * 3).reshape(3, -1).T, cells).reshape((cells + 1,) * 3)
    for _ in range(REFINEMENTS):
        reach = 1.3 * 2 * BOX / cells
        for axis in range(3):
            field = np.moveaxis(field, axis, 0)
            finer = np.empty((2 * cells + 1, *field.shape[1:]))
            finer[::2], finer[1::2] = field, 0.5 * (field[1:] + field[:-1])
            field = np.moveaxis(finer, 0, axis)
        cells *= 2
        near = np.argwhere(np.abs(field) <= reach)
        near = near[(near % 2).any(1)]
        field[tuple(near.T)] = _values(sdf, frame, near, cells)
    if not field.min() < 0 < field.max():
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    cell = 2 * BOX / cells
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(cell,) * 3)
    vertices = frame.outward(vertices.astype(np.float64) - BOX)
    moved = project(sdf, vertices, steps=1)
    # Across a jump of the SDF its slope says nothing about where the level is.
    better = np.linalg.norm(moved - vertices, axis=1) <= cell * frame.scale
    better &= np.abs(sdf(moved)[0]) <= np.abs(sdf(vertices)[0])
    return Mesh(np.where(better[:, None], moved, vertices), faces.astype(np.int64))


def _values(sdf: Sdf, frame: Frame, index: np.ndarray, cells: int) -> np.ndarray:
    """Normalised values [P] at the grid points `index` [P, 3] of a grid with `cells` a side over the box."""
    return np.asarray(sdf(frame.outward(index * (2 * BOX / cells) - BOX))[0]) / frame.scale


def _onto_level(sdf: Sdf, points: np.ndarray, normal: np.ndarray, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Surface points [P, 3] m projected onto the level, and whether they arrived [P] where the sign really changes.

    An unsigned fit of a thin wall has a zero but no change of sign. It is looked for along the true `normal` [P, 3]:
    at the level itself the gradient of a distance may be anything.
    """
    feet = project(sdf, points)
    step = STEP * frame.scale * normal
    crossed = np.asarray(sdf(feet + step)[0]) * np.asarray(sdf(feet - step)[0]) < 0
    return feet, crossed & (np.abs(sdf(feet)[0]) <= 0.2 * STEP * frame.scale)


def _stray_extent(level: Mesh, off: np.ndarray) -> float:
    """Largest extent, m, of a stray component; `off` [V] is each vertex' normalised distance from the surface."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(level.vertices)
    ends = np.concatenate([level.faces[:, [0, 1]], level.faces[:, [1, 2]]])
    number, label = connected_components(coo_matrix((np.ones(len(ends)), tuple(ends.T)), shape=(count, count)))
    if number == 1:
        return 0.0
    low, high = np.full((number, 3), np.inf), np.full((number, 3), -np.inf)
    np.minimum.at(low, label, level.vertices)
    np.maximum.at(high, label, level.vertices)
    extent = (high - low).max(1)
    away = np.bincount(label, off > STRAY_FROM, number) > 0.5 * np.bincount(label, minlength=number)
    # A level that is off as a whole is a poor fit, not a stray.
    away[extent.argmax()] = False
    return float(extent[away].max(initial=0.0))
