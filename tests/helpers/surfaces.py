"""Surfaces and cameras around them."""

import numpy as np

from pipeline.cameras import View
from sdfsim.geometry.mesh import Mesh


def cube(size: float = 1.0, center=(0.0, 0, 0)) -> Mesh:
    import trimesh

    made = trimesh.creation.box((size, size, size))
    made = made.subdivide().subdivide().subdivide()
    return Mesh(np.asarray(made.vertices) + center, np.asarray(made.faces, np.int64))


def look_at(eye, target=(0.0, 0, 0), up=(0.0, 0, 1), *, name="a", size=(640, 480), focal=600.0) -> View:
    forward = np.asarray(target, float) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return View(name, name, *size, focal, size[0] / 2, size[1] / 2, 0.0, rotation, -rotation @ np.asarray(eye, float))


def ring(count: int = 12, height: float = 1.0, radius: float = 3.0) -> list[View]:
    angles = np.arange(count) * 2 * np.pi / count
    return [look_at(np.array([radius * np.cos(a), radius * np.sin(a), height])) for a in angles]


def scenery() -> Mesh:
    """A floor of 2 m with a block of 0.4 m on it."""
    import trimesh

    floor = trimesh.creation.box((2, 2, 0.02)).subdivide().subdivide().subdivide()
    floor.apply_translation((0, 0, -0.01))
    block = trimesh.creation.box((0.6, 0.6, 0.4)).subdivide().subdivide()
    block.apply_translation((0.1, 0, 0.2))
    both = trimesh.util.concatenate([floor, block])
    return Mesh(np.asarray(both.vertices, float), np.asarray(both.faces, np.int64))


def plate(cells: int, z: float = 0.0, half: float = 0.5) -> Mesh:
    """A level square in `cells` by `cells` cells, facing up."""
    line = np.linspace(-half, half, cells + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    faces = np.concatenate([corner[:, None] + [0, cells + 1, cells + 2], corner[:, None] + [0, cells + 2, 1]])
    return Mesh(np.stack([x, y, np.full_like(x, z)], -1).reshape(-1, 3), faces)


TABLE = (0.5, 0.35, 0.05)  # half sides of the top and half its thickness

TOP = 0.1  # height of the table's upper side

WALL = 0.035


def box(points: np.ndarray, center, half) -> np.ndarray:
    q = np.abs(points - np.asarray(center)) - np.asarray(half)
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


def cup(points: np.ndarray, at=(0.1, -0.05), radius: float = 0.12, height: float = 0.3) -> np.ndarray:
    """An open vessel that stands on the table, its inside as deep as its wall allows."""
    p = points - [*at, TOP]
    r = np.hypot(p[:, 0], p[:, 1])

    def cylinder(low: float, high: float, outer: float) -> np.ndarray:
        return np.maximum(r - outer, np.maximum(low - p[:, 2], p[:, 2] - high))

    return np.maximum(cylinder(0, height, radius), -cylinder(WALL, height + 1, radius - WALL))


def table(points: np.ndarray) -> np.ndarray:
    top = box(points, (0, 0, TOP - TABLE[2]), TABLE)
    legs = [box(points, (x, y, -0.25), (0.05, 0.05, 0.3)) for x in (-0.4, 0.4) for y in (-0.25, 0.25)]
    return np.minimum.reduce([top, *legs, points[:, 2] + 0.5])


def both(points: np.ndarray) -> np.ndarray:
    return np.minimum(table(points), cup(points))
