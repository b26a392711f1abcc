"""Fast bodies and thin ones: where a step is longer than a body is thick, what comes fast may pass through it."""

from __future__ import annotations

import numpy as np

from sdfsim.scene.pairs import contact_groups
from sdfsim.scene.types import Scene
from sdfsim.shape.sdf import PlaneSdf
from sdfsim.shape.shape import Shape

POINTS = 4096  # looked at for the place of a shape that is deepest inside


def thickness(shape: Shape) -> float:
    """m at scale 1: diameter of the largest ball found inside a shape, at most its least extent; a plane has no end.

    Of a solid with thick and thin parts it is that of the thick ones.
    """
    if isinstance(shape.sdf, PlaneSdf):
        return float("inf")
    low, high = shape.sdf.bounds
    points = np.random.default_rng(0).uniform(low, high, (POINTS, 3))
    deepest = -float(np.min(shape.sdf(points)[0]))
    least = float((high - low).min())
    return min(least, 2 * deepest) if deepest > 0 else least


def may_pass_through(scene: Scene, dt: float) -> list[str]:
    """One line for every shape that something may come upon so fast that it moves by more than its thickness a step.

    Counted are the speeds of both at the start, and what a fall from the one's height until it touches the other adds.

    Args:
        scene: what is to be simulated.
        dt: s, a step.
    """
    bodies = scene.bodies
    place, velocity = (np.array([getattr(b, name) for b in bodies]) for name in ("position", "velocity"))
    thick = {k: thickness(scene.shapes[k]) for k in {b.shape for b in bodies}}
    thickest = np.array([thick[b.shape] * b.scale for b in bodies])
    reach = np.array([0.5 * float(np.ptp(scene.shapes[b.shape].sdf.bounds, axis=0).min()) * b.scale for b in bodies])
    ends = np.isfinite(thickest)
    strength = float(np.linalg.norm(scene.gravity)) or 1.0
    group, allowed = contact_groups(bodies)
    worst: dict[int, tuple[float, str]] = {}
    for k, body in enumerate(bodies):
        if body.motion != "dynamic":
            continue
        deep = np.maximum(0.0, (place - body.position) @ scene.gravity / strength - reach - reach[k])
        speed = np.sqrt(np.square(velocity - body.velocity).sum(1) + 2.0 * strength * np.where(ends, deep, 0.0))
        over = np.where(allowed[group[k], group], speed * dt / thickest, 0.0)
        over[k] = 0.0
        for other in np.flatnonzero(over > 1.0):
            line = (
                f"{bodies[other].name!r} is {thickest[other]:.3g} m thick, and {body.name!r} may come at "
                f"{speed[other]:.3g} m/s, {speed[other] * dt:.3g} m a step"
            )
            worst[bodies[other].shape] = max(worst.get(bodies[other].shape, (0.0, "")), (float(over[other]), line))
    return [line for _, line in worst.values()]
