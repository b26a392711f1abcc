"""Finds where scenes are outside a model's training data: its predictions are then extrapolation, and are flagged."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from sdfsim.learned.model import Model
from sdfsim.physics.bodies import Units, largest_extent
from sdfsim.scene.scene import Scene

LABELS = {
    "size": "largest side of a body, m",
    "speed": "speed at the start, m/s",
    "mass_ratio": "heaviest to lightest body",
    "friction": "friction of two bodies, multiplied",
    "restitution": "restitution of two bodies, multiplied",
}
SLACK = 0.05  # relative: for rounding, and for fits that extend slightly beyond the solid


def outside_training(scenes: Sequence[Scene], model: Model, units: Units) -> list[str]:
    """One line for every quantity of `scenes` that is outside the ranges of `model`; empty if there are none.

    Sizes and speeds are compared in model units, so a small or slow scene is not outside because of that. Sizes of
    static bodies are not compared: only their surface near a contact matters.
    """
    if not model.ranges:
        return []
    found = [_values(scene, units) for scene in scenes]
    si = {"size": units.length, "speed": units.velocity}
    lines = []
    for name, label in LABELS.items():
        values = [value for some in found for value in some.get(name, [])]
        if not values or name not in model.ranges:
            continue
        low, high = model.ranges[name]
        slack = SLACK * (high - low)
        if min(values) < low - slack or max(values) > high + slack:
            unit = si.get(name, 1.0)
            lines.append(
                f"{label}: {min(values) * unit:.3g} to {max(values) * unit:.3g} here, "
                f"{model.name} was trained on {low * unit:.3g} to {high * unit:.3g}"
            )
    return lines


def _values(scene: Scene, units: Units) -> dict[str, list[float]]:
    """The values of each quantity of `LABELS` in a scene; none if no body is dynamic."""
    moving = [b for b in scene.bodies if b.motion == "dynamic"]
    if not moving:
        return {}
    return {
        "size": [largest_extent(scene.shapes[b.shape]) * b.scale / units.length for b in moving],
        "speed": [float(np.linalg.norm(b.velocity)) / units.velocity for b in moving],
        "mass_ratio": [max(b.mass for b in moving) / min(b.mass for b in moving)],
        "friction": _products(scene, "friction"),
        "restitution": _products(scene, "restitution"),
    }


def _products(scene: Scene, name: str) -> list[float]:
    """Products of a coefficient for pairs with a dynamic body, including the smallest and the largest of all."""
    moving, others = (
        sorted(getattr(b, name) for b in scene.bodies if (b.motion == "dynamic") == moves) for moves in (True, False)
    )
    # A product is extreme if both of its factors are; the two dynamic bodies of a pair must be different.
    ends = moving[:2] + moving[2:][-2:]
    return [a * b for a, b in combinations(ends, 2)] + [a * b for a in ends for b in (*others[:1], *others[-1:])]
