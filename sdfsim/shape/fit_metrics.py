"""How good a fitted SDF is, measured on points that it was not fitted to."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from sdfsim.shape.bvh import ClosestPoint
from sdfsim.shape.distance import DistanceOracle, MeshDistance
from sdfsim.shape.far_field import BOX
from sdfsim.shape.mesh import Frame, Mesh, normal_frame, sample_surface, signed_volume
from sdfsim.shape.sdf import Sdf
from sdfsim.shape.surface_nodes import project

# Lengths are fractions of the shape's largest extent. EXACT is what good fits of clean meshes reach.
EXACT: tuple[tuple[str, float], ...] = (
    ("error_within_0.01", 1.0e-3),
    ("error_within_0.1", 1.5e-3),
    ("error_in_box", 5.0e-3),
    ("gradient_within_0.1", 3.0e-3),
    ("projected_from_0.01", 1.0e-3),
    ("projected_from_0.1", 3.0e-3),
    ("sign_errors", 1.0e-3),
)
# With larger errors than these bodies rest at another height than they should by 5 % of their size, creep, or leave a
# straight hit more than 6 degrees aside: benchmarks/usable_fields.py derives the limits. Distances farther away only
# decide where contacts are searched for, and 0.8 of them is trusted.
USABLE: tuple[tuple[str, float], ...] = (
    ("error_within_0.01", 3.2e-3),
    ("error_in_box", 2.0e-2),
    ("gradient_within_0.1", 2.2e-2),
    ("projected_from_0.01", 3.2e-3),
    ("sign_errors", 3.7e-2),
)
SIGN_FROM = 0.002
FAR_FROM = 0.1
# Half extent of the cube in which the far field is tested.
FAR_HALF = 2.0
# Signed distances between which the errors are also told apart, and how many points make a bin worth telling.
EDGES = (
    *(-0.3, -0.2, -0.1, -0.05, -0.02, -0.01, -0.005, -0.002, 0.0),
    *(0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7),
)
BIN_POINTS = 20
# A wall counts as thin below this, and thin walls explain a miss when this much of the surface has them. What is
# measured from 0.1 away also suffers from walls through whose middle, where the gradient turns over, it looks.
THIN = 0.02
THIN_FROM_AFAR = 0.1
THIN_SHARE = 0.02


class _Measured(NamedTuple):
    """An SDF against the truth at P points, lengths normalised.

    Attributes:
        true: [P] signed distance.
        value: [P] what the SDF says.
        turned: [P] 1 - cosine between its gradient and the direction from the surface; NaN closer than 1e-4.
        norm: [P] length of its gradient.
        projected: [P] distance from the surface of x - f grad f / |grad f|^2.
    """

    true: np.ndarray
    value: np.ndarray
    turned: np.ndarray
    norm: np.ndarray
    projected: np.ndarray

    def where(self, chosen: np.ndarray) -> _Measured:
        """The `chosen` [P] bool of the points."""
        return _Measured(*(part[chosen] for part in self))

    @property
    def error(self) -> np.ndarray:
        """[P] absolute error of the distance."""
        return np.abs(self.value - self.true)

    @property
    def wrong(self) -> np.ndarray:
        """[P] whether the sign is wrong."""
        return self.value * self.true <= 0


def certify(
    sdf: Sdf, oracle: DistanceOracle, *, nodes: np.ndarray | None = None, points: int = 10_000, seed: int = 1
) -> dict:
    """Errors of `sdf` on held-out points near the surface, in the fitted box and beyond it.

    Points within 0.01 and within 0.1 are spread over the surface by area and moved by normal noise of 0.006 and 0.06;
    those of the box are uniform in [-0.7, 0.7]^3 of the normalised frame. Where an open mesh leaves the sign in
    doubt nothing is measured.

    Args:
        sdf: metres; of any kind.
        oracle: the truth, in the same frame.
        nodes: [K, 3] m, surface nodes whose coverage is measured too.
        points: how many of each of the three kinds.
        seed: of the points.

    Returns:
        JSON-ready dict (None: could not be measured), lengths relative to the largest extent.

        Mean absolute errors `error_within_0.01`, `error_within_0.1` and `error_in_box`; `gradient_within_0.1`, the
        median cosine distance (1 - cosine) of the gradient from the true direction; `gradient_norm`, the 1 % and
        99 % quantiles of its length within 0.1; `projected_from_0.01` and `projected_from_0.1`, mean distance from
        the surface of x - f grad f / |grad f|^2; `sign_errors`, the fraction of points farther than 0.002 whose sign
        is wrong; `far_field_ratio`, the largest f / true distance farther than 0.1, out to [-2, 2]^3 (a step as
        long as f goes through the surface where it is above 1).

        `hausdorff`, `hausdorff_from_mesh`, `hausdorff_from_level`, `hausdorff_p99` and `stray_extent` as in
        `coverage.hausdorff`.

        `curve`, all by signed distance as in the supplementary figure of Rubanova et al. 2024: `distance` (B + 1 bin
        edges), and B values each of `count`, `error` and `error_p95`, `sign_errors` (fraction), `gradient_direction`
        (median 1 - cosine), `gradient_norm` (median) with `gradient_norm_p5` and `gradient_norm_p95`, and
        `projected` (mean); None in bins of fewer than 20 points.

        `coverage` of the nodes as in `coverage.coverage`, if there are any; and `passed`, `reason` and `caveat` of
        `verdict`.
    """
    # A stream of its own, so that no seed of the fit draws these points.
    rng = np.random.default_rng([seed, 0xCE47])
    frame = normal_frame(oracle.bounds)
    result: dict[str, Any] = {}
    measured = []
    for key, width, limit in (("within_0.01", 0.006, 0.01), ("within_0.1", 0.06, 0.1), ("in_box", 0.0, math.inf)):
        if width:
            local = frame.inward(sample_surface(oracle.surface, points, rng)[0])
            local = np.clip(local + rng.normal(0.0, width, local.shape), -BOX, BOX)
        else:
            local = rng.uniform(-BOX, BOX, (points, 3))
        got = _measure(sdf, oracle, frame, local)
        measured.append(got)
        got = got.where(np.abs(got.true) <= limit)
        result[f"error_{key}"] = _mean(got.error)
        if width:
            result[f"projected_from_{limit:g}"] = _mean(got.projected)
        if limit == 0.1:
            clear = got.turned[np.abs(got.true) > SIGN_FROM]
            result["gradient_within_0.1"] = float(np.median(clear)) if len(clear) else math.nan
            result["gradient_norm"] = np.quantile(got.norm, (0.01, 0.99)).tolist() if len(got.norm) else None
    near, wide, box = measured
    # The three kinds as they are defined: what lies beyond a kind's limit does not count.
    counted = _join([near.where(np.abs(near.true) <= 0.01), wide.where(np.abs(wide.true) <= 0.1), box])
    result["sign_errors"] = _mean(counted.wrong[np.abs(counted.true) > SIGN_FROM])
    everything = _join(measured)
    result["far_field_ratio"] = _far_field_ratio(sdf, oracle, frame, everything, rng.uniform(-1, 1, (points, 3)))
    result.update(hausdorff(sdf, oracle, points=points, seed=seed))
    result["curve"] = _curve(everything)
    if nodes is not None:
        result["coverage"] = coverage(nodes, oracle, seed=seed)
    result.update(verdict(result))
    for told in ("reason", "caveat"):
        if result[told]:
            from_afar = result[told].startswith("projected_from_0.1 ")
            result[told] += f": {cause(oracle, THIN_FROM_AFAR if from_afar else THIN, seed=seed)}"
    # None for what could not be measured: JSON has no NaN.
    unknown = [key for key, value in result.items() if isinstance(value, float) and not math.isfinite(value)]
    return result | dict.fromkeys(unknown)


def verdict(errors: dict) -> dict:
    """What a simulation can make of a field with such errors.

    Returns:
        `passed`: it is usable; `reason`: the first limit of `USABLE` that it misses, else empty; `caveat`: the first
        limit of `EXACT` that a usable field misses, else empty.
    """

    def missed(limits: tuple[tuple[str, float], ...]) -> tuple[str, float] | None:
        # Written so that NaN misses too.
        return next(((key, limit) for key, limit in limits if not errors[key] <= limit), None)

    if wrong := missed(USABLE):
        key, limit = wrong
        return {"passed": False, "reason": f"{key} is {errors[key]:.2g}, allowed {limit:.2g}", "caveat": ""}
    if rough := missed(EXACT):
        key, limit = rough
        return {"passed": True, "reason": "", "caveat": f"{key} is {errors[key]:.2g}, exact fits have {limit:.2g}"}
    return {"passed": True, "reason": "", "caveat": ""}


def cause(oracle: DistanceOracle, thin: float = THIN, *, seed: int = 1) -> str:
    """What about a geometry makes it hard to fit, as far as it can be measured: holes, thin walls, else its detail.

    Args:
        oracle: of the geometry.
        thin: walls below this fraction of the largest extent are to blame.
        seed: of the surface samples.
    """
    if not oracle.closed:
        return "open mesh, so its inside is not clear"
    share = thin_share(oracle, thin, seed=seed)
    if share >= THIN_SHARE:
        return f"thin walls ({100 * share:.0f} % of the surface is thinner than {thin:g})"
    return "fine detail, or too short a fit"


def thin_share(oracle: DistanceOracle, thin: float = THIN, *, points: int = 2000, seed: int = 1) -> float:
    """Fraction of a closed surface behind which the solid ends within `thin` of its largest extent.

    Measured along the inward normal of `points` samples; what is outside again after a step has been left through
    the opposite side. Gaps narrower than a quarter of `thin` may be stepped over.
    """
    scale = normal_frame(oracle.bounds).scale
    surface, normal = outward_samples(oracle.surface, points, np.random.default_rng([seed, 0x7417]))
    left = np.zeros(points, dtype=bool)
    for depth in np.linspace(thin, 0.0, 4, endpoint=False):
        left |= oracle(surface - depth * scale * normal).distance > 0
    return float(left.mean())


def _measure(sdf: Sdf, oracle: DistanceOracle, frame: Frame, local: np.ndarray) -> _Measured:
    """`sdf` against the truth at normalised points, but for those of an open mesh whose sign is not known."""
    metres = frame.outward(local)
    truth = oracle(metres)
    usable = truth.trusted if not oracle.closed else np.ones(len(local), dtype=bool)
    metres, true, closest = metres[usable], truth.distance[usable], truth.closest[usable]
    value, gradient = (np.asarray(part) for part in sdf(metres))
    squared = np.maximum(np.square(gradient).sum(1), 1e-6)
    foot = oracle(metres - (value / squared)[:, None] * gradient)
    # So close to the surface the direction from it is rounding.
    true_direction = (metres - closest) / np.where(np.abs(true) > 1e-4 * frame.scale, true, np.nan)[:, None]
    return _Measured(
        true=true / frame.scale,
        value=value / frame.scale,
        turned=1.0 - (true_direction * gradient).sum(1) / np.sqrt(squared),
        norm=np.linalg.norm(gradient, axis=1),
        projected=np.abs(foot.distance) / frame.scale,
    )


def _join(parts: list[_Measured]) -> _Measured:
    return _Measured(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else math.nan


def _far_field_ratio(sdf: Sdf, oracle: DistanceOracle, frame: Frame, inner: _Measured, cube: np.ndarray) -> float:
    """Largest f / true distance farther than 0.1, of points already measured and of `cube` [P, 3] in [-1, 1]^3."""
    metres = frame.outward(FAR_HALF * cube)
    truth = oracle(metres)
    true = np.concatenate([inner.true, truth.distance / frame.scale])
    value = np.concatenate([inner.value, np.asarray(sdf(metres)[0]) / frame.scale])
    trusted = np.concatenate([np.ones(len(inner.true), dtype=bool), truth.trusted | oracle.closed])
    far = trusted & (np.abs(true) > FAR_FROM)
    return float((value[far] / true[far]).max()) if far.any() else math.nan


def _curve(measured: _Measured) -> dict:
    """Errors by signed distance, for `certify`."""
    bins: list[dict] = []
    for low, high in pairwise(EDGES):
        part = measured.where((measured.true >= low) & (measured.true < high))
        turned = part.turned[np.isfinite(part.turned)]
        enough = len(part.true) >= BIN_POINTS
        least, middle, most = np.quantile(part.norm, (0.05, 0.5, 0.95)) if enough else (None, None, None)
        values = {
            "error": part.error.mean() if enough else None,
            "error_p95": np.quantile(part.error, 0.95) if enough else None,
            "sign_errors": part.wrong.mean() if enough else None,
            "gradient_direction": np.median(turned) if len(turned) >= BIN_POINTS else None,
            "gradient_norm": middle,
            "gradient_norm_p5": least,
            "gradient_norm_p95": most,
            "projected": part.projected.mean() if enough else None,
        }
        # Four digits are more than the samples are worth, and the curve is read by people too.
        rounded = {key: None if value is None else float(f"{value:.4g}") for key, value in values.items()}
        bins.append({"count": len(part.true), **rounded})
    return {"distance": list(EDGES), **{key: [entry[key] for entry in bins] for key in bins[0]}}


# Lengths are relative to the shape's largest extent.
FAR_FROM_A_NODE = 0.1
# The zero level is looked for on this many cells a side, halved REFINEMENTS times where it passes.
LEVEL_CELLS = 24
REFINEMENTS = 2
# A component counts as stray when most of it is farther than this from the surface.
STRAY_FROM = 0.01
# A sample is exposed when this far along its normal is outside; a zero crossing shows within as much to both sides.
EXPOSED_STEP = 5e-4


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
    outside = oracle(points + EXPOSED_STEP * normal_frame(oracle.bounds).scale * normal).distance > 0
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

    cells = LEVEL_CELLS
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
    step = EXPOSED_STEP * frame.scale * normal
    crossed = np.asarray(sdf(feet + step)[0]) * np.asarray(sdf(feet - step)[0]) < 0
    return feet, crossed & (np.abs(sdf(feet)[0]) <= 0.2 * EXPOSED_STEP * frame.scale)


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
