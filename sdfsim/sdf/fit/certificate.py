"""The quality of a fitted SDF on held-out points, and how well nodes cover a surface."""

import math
from typing import Any

import numpy as np

from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, normal_frame, sample_surface
from sdfsim.sdf.far_field import BOX
from sdfsim.sdf.grid import GridSdf
from sdfsim.sdf.reference import DistanceOracle
from sdfsim.sdf.sdf import Sdf

# Lengths are fractions of the shape's largest extent. EXACT is what good fits of clean meshes reach.
EXACT = {
    "error_within_0.01": 1.0e-3,
    "error_within_0.1": 1.5e-3,
    "error_in_box": 5.0e-3,
    "gradient_within_0.1": 3.0e-3,
    "projected_from_0.01": 1.0e-3,
    "projected_from_0.1": 3.0e-3,
    "sign_errors": 1.0e-3,
    "walls_lost": 1.0e-3,
}
# With larger errors bodies rest at a height that is wrong by 5 % of their size, creep, or rebound from a straight hit
# more than 6 degrees aside (docs/objects.md). Distances farther away only decide where to search for contacts, and only
# 0.8 of such a distance is trusted.
USABLE = {
    "error_within_0.01": 3.2e-3,
    "error_in_box": 2.0e-2,
    "gradient_within_0.1": 2.2e-2,
    "projected_from_0.01": 3.2e-3,
    "sign_errors": 3.7e-2,
    "walls_lost": 3.7e-2,
}
SIGN_FROM = 0.002
WALL_FROM = 1e-5  # thinner walls do not count
# Least depth of the middle of a wall, as a part of half its thickness, if the angle between its sides is at most 26
# degrees.
PARALLEL = 0.9
FAR_FROM = 0.1
FAR_HALF = 2.0  # half extent of the cube in which the far field is tested
FAR_FROM_A_NODE = 0.1
EXPOSED_STEP = 5e-4  # a surface sample is hidden if the point this far along its normal is inside


def certify(sdf: Sdf, oracle: DistanceOracle, *, nodes: np.ndarray | None = None, points: int = 10_000) -> dict:
    """Errors of `sdf` on held-out points near the surface, in the fitted box and beyond it, ready for JSON. Lengths are
    relative to the largest extent. None: could not be measured, for example because an open mesh leaves the sign in
    doubt.

    Points within 0.01 and within 0.1 are spread over the surface by area and moved by normal noise of 0.006 and 0.06;
    those of the box are uniform in [-0.7, 0.7]^3 of the normalised frame.

    Mean absolute errors `error_within_0.01`, `error_within_0.1` and `error_in_box`; `gradient_within_0.1`, the median
    cosine distance (1 - cosine) of the gradient from the true direction; `projected_from_0.01` and
    `projected_from_0.1`, mean distance from the surface of x - f grad f / |grad f|^2; `sign_errors`, the fraction of
    points farther than 0.002 whose sign is wrong; `walls_lost` (see there); `far_field_ratio`, the largest f / true
    distance farther than 0.1, out to [-2, 2]^3 (a step as long as f goes through the surface where it is above 1);
    `coverage` of the nodes [K, 3] m, if there are any; and the result of `verdict`.
    """
    # Its own random stream, so that no seed of the fit draws these points.
    rng = np.random.default_rng([1, 0xCE47])
    frame = normal_frame(oracle.bounds)

    def evaluate(local: np.ndarray) -> tuple[np.ndarray, ...]:
        """For normalised points whose sign is known: the points in metres, true distance, distance by the SDF, nearest
        surface point and gradient."""
        metres = frame.outward(local)
        truth = oracle(metres)
        usable = truth.trusted | oracle.closed
        value, gradient = (np.asarray(part) for part in sdf(metres[usable]))
        true = truth.distance[usable]
        return metres[usable], true / frame.scale, value / frame.scale, truth.closest[usable], gradient

    def mean(values: np.ndarray) -> float:
        return float(values.mean()) if len(values) else math.nan

    result: dict[str, Any] = {}
    counted, far = [], []
    for key, width, limit in (("within_0.01", 0.006, 0.01), ("within_0.1", 0.06, 0.1), ("in_box", 0.0, math.inf)):
        if width:
            local = frame.inward(sample_surface(oracle.surface, points, rng)[0])
            local = np.clip(local + rng.normal(0.0, width, local.shape), -BOX, BOX)
        else:
            local = rng.uniform(-BOX, BOX, (points, 3))
        found = evaluate(local)
        far.append(found[1:3])
        # Points beyond the limit of their kind do not count.
        metres, true, value, closest, gradient = (part[np.abs(found[1]) <= limit] for part in found)
        counted.append((true, value))
        result[f"error_{key}"] = mean(np.abs(value - true))
        squared = np.maximum(np.square(gradient).sum(1), 1e-6)
        if width:
            foot = oracle(metres - (frame.scale * value / squared)[:, None] * gradient)
            result[f"projected_from_{limit:g}"] = mean(np.abs(foot.distance)) / frame.scale
        if limit == 0.1:
            clear = np.abs(true) > SIGN_FROM
            away = (metres - closest)[clear] / (frame.scale * true[clear])[:, None]
            turned = 1.0 - (away * gradient[clear]).sum(1) / np.sqrt(squared[clear])
            result["gradient_within_0.1"] = float(np.median(turned)) if clear.any() else math.nan
    true, value = (np.concatenate(parts) for parts in zip(*counted, strict=True))
    result["sign_errors"] = mean((value * true <= 0)[np.abs(true) > SIGN_FROM])
    result["walls_lost"] = walls_lost(sdf, oracle)
    far.append(evaluate(FAR_HALF * rng.uniform(-1, 1, (points, 3)))[1:3])
    true, value = (np.concatenate(parts) for parts in zip(*far, strict=True))
    ratio = (value / np.where(true == 0, np.nan, true))[np.abs(true) > FAR_FROM]
    result["far_field_ratio"] = float(ratio.max()) if len(ratio) else math.nan
    if nodes is not None:
        result["coverage"] = coverage(nodes, oracle)
    result.update(verdict(result))
    # None for values that could not be measured: JSON has no NaN.
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in result.items()}


def walls_lost(sdf: Sdf, oracle: DistanceOracle, *, points: int = 4000) -> float:
    """The part of the surface, by area, behind which the solid is missing: the middle of the wall there is not inside.
    `sign_errors`, which counts from a fixed distance on, misses thinner walls.

    The middle is first halfway between a surface sample and the point where a straight line inwards leaves the solid;
    then, twice, halfway between the nearest surface point and the point opposite. Edges, where walls end, do not count.
    NaN if no middle is known to be inside.
    """
    frame = normal_frame(oracle.bounds)
    samples, inwards = sample_surface(oracle.surface, points, np.random.default_rng([1, 0x3A11]))
    foot, inwards = frame.inward(samples), -inwards
    caster = Caster(Mesh(frame.inward(oracle.surface.vertices), oracle.surface.faces))
    for _ in range(3):
        across = caster.hits(foot + WALL_FROM * inwards, inwards)[0] + WALL_FROM
        through = np.isfinite(across)
        foot, inwards, half = foot[through], inwards[through], 0.5 * across[through]
        middle = foot + half[:, None] * inwards
        truth = oracle(frame.outward(middle))
        inside = (truth.distance < 0) & (truth.trusted | oracle.closed)
        if not inside.any():
            return math.nan
        middle, half, depth = middle[inside], half[inside], -truth.distance[inside] / frame.scale
        foot = frame.inward(truth.closest[inside])
        inwards = (middle - foot) / depth[:, None]
    lost = np.asarray(sdf(frame.outward(middle))[0]) >= 0
    return float(np.mean(lost & (depth >= PARALLEL * half)))


def certify_grid(grid: GridSdf, oracle: DistanceOracle) -> dict:
    """The certificate of a grid of exact samples: `walls_lost`, and, as in `verdict`, whether it is too large. A grid
    can miss walls that are thinner than its cells."""
    lost, limit = walls_lost(grid, oracle), USABLE["walls_lost"]
    cell = 2 * BOX * grid.frame.scale / (grid.resolution - 1)
    advice = f"its cells are {cell:.2g} m: take a higher resolution, or sdf: mesh"
    reason = "" if lost <= limit else f"walls_lost is {lost:.2g}, allowed {limit:.2g} ({advice})"
    return {"walls_lost": None if math.isnan(lost) else lost, "passed": not reason, "reason": reason, "caveat": ""}


def verdict(errors: dict) -> dict:
    """Whether a simulation can use a field with these errors: `passed`; `reason`, the first limit of `USABLE` that it
    misses; and `caveat`, the first limit of `EXACT` that a usable field misses."""

    def missed(limits: dict[str, float], word: str) -> str:
        # Written so that NaN counts as a miss.
        found = (f"{k} is {errors[k]:.2g}, {word} {limit:.2g}" for k, limit in limits.items() if not errors[k] <= limit)
        return next(found, "")

    reason = missed(USABLE, "allowed")
    return {"passed": not reason, "reason": reason, "caveat": "" if reason else missed(EXACT, "exact fits have")}


def coverage(nodes: np.ndarray, oracle: DistanceOracle) -> dict:
    """How evenly nodes [K, 3] m cover a surface, ready for JSON, relative to the largest extent: the `count` of nodes,
    `largest_hole` (largest distance from a surface sample to the nearest node), `uncovered` (fraction of the surface
    farther than 0.1 from every node) and `off_surface` (largest distance of a node from the surface)."""
    from scipy.spatial import KDTree

    frame = normal_frame(oracle.bounds)
    if len(nodes) == 0:
        return {"count": 0, "largest_hole": None, "uncovered": 1.0, "off_surface": None}
    samples, normal = sample_surface(oracle.surface, 20_000, np.random.default_rng([1, 0xC0E4]))
    if oracle.closed:  # overlapping parts and the seams between convex pieces hide faces
        outside = oracle(samples + EXPOSED_STEP * frame.scale * normal).distance > 0
        samples = samples[outside] if outside.any() else samples
    gap = KDTree(frame.inward(nodes)).query(frame.inward(samples))[0]
    return {
        "count": len(nodes),
        "largest_hole": float(gap.max()),
        "uncovered": float((gap > FAR_FROM_A_NODE).mean()),
        "off_surface": float(np.abs(oracle(nodes).distance).max() / frame.scale),
    }
