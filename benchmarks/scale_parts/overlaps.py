"""How deep spheres in a bowl are in each other, in closed form."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from sdfsim.scene.scene import Scene

WALL = 0.12  # of the bowl primitive, relative to its outer radius
TOUCH = 0.01  # of a diameter


def overlaps(scene: Scene, place: np.ndarray) -> np.ndarray:
    """[P] m, how deep every contact is: of two spheres, or of a sphere with the bowl's inside or the floor.

    In contact is what is nearer than `TOUCH` of a diameter; what does not overlap is 0 deep.

    Args:
        scene: one bowl, and spheres of one size.
        place: [N, 3] m of the spheres.
    """
    bowl = next(b for b in scene.bodies if b.name == "bowl")
    diameter = next(b for b in scene.bodies if b.motion == "dynamic").scale
    away = place - bowl.position
    length, height = np.linalg.norm(away, axis=-1), away[:, 2]
    inside = (length < 0.5 * bowl.scale) & (height < 0)
    wall = (length + 0.5 * diameter - 0.5 * bowl.scale * (1 - WALL))[inside]
    floor = 0.5 * diameter - place[:, 2]
    pairs = cKDTree(place).query_pairs((1 + TOUCH) * diameter, output_type="ndarray")
    between = diameter - np.linalg.norm(place[pairs[:, 0]] - place[pairs[:, 1]], axis=1)
    deep = np.concatenate([wall, floor, between])
    return np.maximum(deep[deep > -TOUCH * diameter], 0.0)


def depth(scene: Scene, positions: np.ndarray) -> np.ndarray:
    """[T] m, the deepest of `overlaps` in each frame of `positions` [T, N, 3] m."""
    return np.array([overlaps(scene, place).max(initial=0.0) for place in positions])
