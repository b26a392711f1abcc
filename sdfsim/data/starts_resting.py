"""Starts at or near rest: bodies flat on the floor or on each other."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from sdfsim.data.pybullet_sim import Teacher, TeacherBody
from sdfsim.data.shape_assets import ShapeSource
from sdfsim.dynamics.ranges import DEEPEST

STARTS = ("still", "dropped", "nudged", "pressed")
GAP = 2.5e-3  # m, under a body that is put down: around the engine's convex pieces are 1 mm, so 2 mm between two
DROP = 0.1  # m, at most, under one that is dropped
NUDGE = 0.3  # m/s, at most, along x and along y
PRESSED = 0.5 * DEEPEST  # of its extent: how far at most a body is moved into what is around it, along each axis
FIELD = 3.0  # m, half the side of the square of floor that is used
STACKED = 0.5  # part of the bodies that go on top of the one before
STEADY = 0.03  # least distance of the centre of mass from the rim of the face it stands on, over the largest extent


def at_rest(
    teacher: Teacher, rng: np.random.Generator, bodies: list[tuple[ShapeSource, TeacherBody]], start: str, tries: int
) -> bool:
    """Put bodies down: all at rest, all dropped from `DROP` at most, all given a nudge, or pressed into one another.

    Only the last overlap; from them is learned how bodies part.

    Args:
        teacher: the world; the bodies come after those that it has.
        rng: what is drawn from.
        bodies: shapes of largest extent 1 m at scale 1, and their bodies.
        start: one of `STARTS`.
        tries: places for one body.

    Returns:
        False when one found no room.
    """
    below, top = np.zeros(2), 0.0
    placed = []
    for number, (source, body) in enumerate(bodies):
        index = teacher.add(body)
        for _ in range(tries):
            stacked = number > 0 and rng.random() < STACKED
            place = below + rng.uniform(-0.1, 0.1, 2) * body.scale if stacked else rng.uniform(-FIELD, FIELD, 2)
            gap = rng.uniform(GAP, DROP) if start == "dropped" else GAP
            rotation = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)) * standing(source.vertices, rng)
            position, high = upright(source, body, place, (top if stacked else 0.0) + gap, rotation)
            teacher.place(index, position, rotation.as_quat())
            if not teacher.overlaps(index):
                break
        else:
            return False
        placed.append((index, position, rotation.as_quat()))
        below, top = position[:2], high
        if start == "nudged":
            teacher.push(index, np.array([*rng.uniform(-NUDGE, NUDGE, 2), 0.0]), np.zeros(3))
    if start == "pressed":
        for (_, body), (index, position, quat) in zip(bodies, placed, strict=True):
            teacher.place(index, position + rng.uniform(-PRESSED, PRESSED, 3) * body.scale, quat)
    return True


def upright(
    source: ShapeSource, body: TeacherBody, place: np.ndarray, height: float, rotation: Rotation
) -> tuple[np.ndarray, float]:
    """Where [3] m the centre of mass is when the lowest point is at `height` m over `place` [2] m; and the top, m."""
    heights = body.scale * rotation.apply(source.vertices)[:, 2]
    position = np.array([*place, height - heights.min()])
    return position, float(position[2] + heights.max())


def standing(vertices: np.ndarray, rng: np.random.Generator) -> Rotation:
    """A rotation in which a shape of `vertices` [V, 3] about its centre of mass stands flat.

    It stands on a random one of its steady faces; any rotation where it has none.
    """
    faces = steady_faces(vertices)
    if len(faces) == 0:
        return Rotation.random(rng=rng)
    return Rotation.align_vectors([[0.0, 0.0, -1.0]], faces[rng.integers(len(faces))][None])[0]


def steady_faces(vertices: np.ndarray) -> np.ndarray:
    """Outward unit normals [K, 3] of the faces of the convex hull on which a body stands without tipping over.

    Args:
        vertices: [V, 3] about the centre of mass.
    """
    hull = ConvexHull(vertices)
    extent = float(np.ptp(vertices, axis=0).max())
    corners = vertices[hull.vertices]
    # Triangles of one face differ by rounding.
    _, first = np.unique(hull.equations.round(3), axis=0, return_index=True)
    steady = [plane[:3] for plane in hull.equations[first] if _margin(corners, plane, extent) >= STEADY * extent]
    return np.array(steady).reshape(-1, 3)


def _margin(corners: np.ndarray, plane: np.ndarray, extent: float) -> float:
    """How far within the face on `plane` [4] (normal, offset) the origin's foot is; negative outside, -inf: no face."""
    normal, offset = plane[:3], plane[3]
    face = corners[np.abs(corners @ normal + offset) < 1e-3 * extent]
    axes = np.linalg.svd(normal[None])[2][1:]
    try:
        rim = ConvexHull(face @ axes.T)
    except (QhullError, ValueError):
        return -np.inf
    return float(-rim.equations[:, 2].max())
