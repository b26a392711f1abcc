"""How good a fitted SDF is on points that it was not fitted to, and how well nodes stand for a surface."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sdfsim.shape.distance import DistanceOracle, MeshDistance
from sdfsim.shape.far_field import BOX
from sdfsim.shape.mesh import Frame, Mesh, normal_frame, sample_surface, signed_volume
from sdfsim.shape.sdf import Sdf

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
# A wall counts as thin below this, and thin walls explain a miss when this much of the surface has them.
THIN = 0.02
THIN_SHARE = 0.02


FAR_FROM_A_NODE = 0.1
# A surface sample is hidden where this far along its normal is inside.
EXPOSED_STEP = 5e-4


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

    def within(self, limit: float) -> _Measured:
        """Those no farther than `limit` from the surface."""
        return _Measured(*(part[np.abs(self.true) <= limit] for part in self))


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

        `coverage` of the nodes as in `coverage`, if there are any; and `passed`, `reason` and `caveat` of `verdict`.
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
        got = got.within(limit)
        result[f"error_{key}"] = _mean(np.abs(got.value - got.true))
        if width:
            result[f"projected_from_{limit:g}"] = _mean(got.projected)
        if limit == 0.1:
            clear = got.turned[np.abs(got.true) > SIGN_FROM]
            result["gradient_within_0.1"] = float(np.median(clear)) if len(clear) else math.nan
            result["gradient_norm"] = np.quantile(got.norm, (0.01, 0.99)).tolist() if len(got.norm) else None
    near, wide, box = measured
    # The three kinds as they are defined: what lies beyond a kind's limit does not count.
    counted = _join([near.within(0.01), wide.within(0.1), box])
    result["sign_errors"] = _mean((counted.value * counted.true <= 0)[np.abs(counted.true) > SIGN_FROM])
    result["far_field_ratio"] = _far_field_ratio(sdf, oracle, frame, _join(measured), rng.uniform(-1, 1, (points, 3)))
    if nodes is not None:
        result["coverage"] = coverage(nodes, oracle, seed=seed)
    result.update(verdict(result))
    for told in ("reason", "caveat"):
        if result[told]:
            result[told] += f": {cause(oracle, seed=seed)}"
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


def cause(oracle: DistanceOracle, *, seed: int = 1) -> str:
    """What about a geometry makes it hard to fit, as far as it can be measured: holes, thin walls, else its detail."""
    if not oracle.closed:
        return "open mesh, so its inside is not clear"
    share = thin_share(oracle, seed=seed)
    if share >= THIN_SHARE:
        return f"thin walls ({100 * share:.0f} % of the surface is thinner than {THIN:g})"
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
