"""How good a fitted SDF is, measured on points that it was not fitted to."""

from __future__ import annotations

import math

import numpy as np

from sdfsim.shape.distance import DistanceOracle
from sdfsim.shape.mesh import normal_frame, sample_surface
from sdfsim.shape.mlp import BOX
from sdfsim.shape.sdf import Sdf

# Lengths as a fraction of the shape's largest extent. Each limit: key, worst allowed, what a miss usually means.
LIMITS: tuple[tuple[str, float, str], ...] = (
    ("error_within_0.01", 1.5e-3, "thin walls or fine detail"),
    ("error_within_0.1", 3.0e-3, "fine detail, or a surface whose inside is not clear"),
    ("error_in_box", 1.0e-2, "a surface whose inside is not clear"),
    ("gradient_within_0.1", 1.5e-2, "fine detail"),
    ("projected_from_0.01", 2.0e-3, "thin walls or fine detail"),
    ("sign_errors", 1.0e-2, "an open mesh, or thin walls"),
)
SIGN_FROM = 0.002


def certify(sdf: Sdf, oracle: DistanceOracle, *, points: int = 10_000, seed: int = 1) -> dict:
    """Errors of `sdf` on held-out points near the surface and in the fitted box.

    Args:
        sdf: metres.
        oracle: the truth, in the same frame.
        points: how many of each of the three kinds (within 0.01, within 0.1, box [-0.7, 0.7]^3).
        seed: of the points.

    Returns:
        JSON-ready dict (None: could not be measured), lengths relative to the largest extent: mean absolute errors
        `error_within_0.01`, `error_within_0.1` and `error_in_box`; `gradient_within_0.1`, the median cosine distance
        (1 - cosine) of the gradient from the true direction; `projected_from_0.01` and `projected_from_0.1`, mean
        distance from the surface of x - f grad f / |grad f|^2; `sign_errors`, the fraction of points farther than 0.002
        whose sign is wrong; `passed`, and a `reason` when not.
    """
    # A stream of its own, so that no seed of the fit draws these points.
    rng = np.random.default_rng([seed, 0xCE47])
    frame = normal_frame(oracle.bounds)
    result: dict = {}
    wrong, signed = 0, 0
    for key, width, limit in (("within_0.01", 0.006, 0.01), ("within_0.1", 0.06, 0.1), ("in_box", 0.0, math.inf)):
        if width:
            local = frame.inward(sample_surface(oracle.surface, points, rng)[0])
            local = np.clip(local + rng.normal(0.0, width, local.shape), -BOX, BOX)
        else:
            local = rng.uniform(-BOX, BOX, (points, 3))
        metres = frame.outward(local)
        truth = oracle(metres)
        usable = np.abs(truth.distance) <= limit * frame.scale
        if not oracle.closed:
            usable &= truth.trusted
        metres, true = metres[usable], truth.distance[usable] / frame.scale
        distance, gradient = (np.asarray(part) for part in sdf(metres))
        value = distance / frame.scale
        result[f"error_{key}"] = float(np.abs(value - true).mean())
        clear = np.abs(true) > SIGN_FROM
        wrong += int((value[clear] * true[clear] <= 0).sum())
        signed += int(clear.sum())
        if width:
            squared = np.maximum(np.square(gradient).sum(1, keepdims=True), 1e-6)
            foot = oracle(metres - distance[:, None] * gradient / squared)
            result[f"projected_from_{limit:g}"] = float(np.abs(foot.distance).mean() / frame.scale)
        if limit == 0.1:
            direction = (metres - truth.closest[usable])[clear] / (true[clear, None] * frame.scale)
            cosine = (direction * gradient[clear]).sum(1) / np.sqrt(squared[clear, 0])
            result["gradient_within_0.1"] = float(np.median(1.0 - cosine))
    result["sign_errors"] = wrong / max(signed, 1)
    result.update(verdict(result))
    # None for what could not be measured: JSON has no NaN.
    unknown = [key for key, value in result.items() if isinstance(value, float) and not math.isfinite(value)]
    return result | dict.fromkeys(unknown)


def verdict(errors: dict) -> dict:
    """`passed`, and in `reason` the first limit that was missed."""
    for key, limit, cause in LIMITS:
        # Written so that NaN misses too.
        if not errors[key] <= limit:
            return {"passed": False, "reason": f"{key} is {errors[key]:.2g}, allowed {limit:.2g}: {cause}"}
    return {"passed": True, "reason": ""}
