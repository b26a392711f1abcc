"""Hulls with flat faces, against Euler's formula and closed forms."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from sdfsim.geometry import primitives
from sdfsim.shape.convex_pieces import ConvexPiece, hull

RING = 2 * np.pi * np.arange(40) / 40
PRISM = np.concatenate([np.column_stack([np.cos(RING), np.sin(RING), np.full(40, z)]) for z in (-0.1, 0.1)])
TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])


def turned(points: np.ndarray, noise: float = 0.0) -> np.ndarray:
    """Points in an orientation in which no face is parallel to an axis, and moved by up to `noise`."""
    draw = np.random.default_rng(3)
    return Rotation.from_rotvec([0.3, -0.7, 0.4]).apply(points) + draw.uniform(-noise, noise, points.shape)


def check(piece: ConvexPiece, vertices: np.ndarray) -> None:
    """What holds for every hull."""
    size = np.ptp(vertices, axis=0).max()
    edges = {(int(a), int(b)) for loop in piece.loops for a, b in zip(loop, np.roll(loop, -1), strict=True)}
    assert edges == {(b, a) for a, b in edges}  # closed: each edge runs both ways, in two faces
    assert len(piece.vertices) - len(edges) // 2 + len(piece.loops) == 2
    for normal, loop in zip(piece.normals, piece.loops, strict=True):
        corner = piece.vertices[loop]
        assert np.ptp(corner @ normal) < 1e-6 * size
        assert (vertices @ normal).max() < (corner @ normal).min() + 1e-6 * size
        area = 0.5 * np.cross(corner, np.roll(corner, -1, axis=0)).sum(0)
        assert area @ normal == pytest.approx(np.linalg.norm(area), rel=1e-6)  # counter-clockwise from outside
    for v, (beside, around) in enumerate(zip(piece.beside, piece.around, strict=True)):
        assert {b for a, b in edges if a == v} <= set(beside.tolist())
        assert set(around.tolist()) == {f for f, loop in enumerate(piece.loops) if v in loop}
    assert np.linalg.norm(vertices - piece.ball[:3], axis=1).max() <= piece.ball[3] * (1 + 1e-12)


def test_boxes_have_six_faces_however_their_surface_is_divided():
    box = primitives.box((3.0, 2.0, 0.5)).vertices
    inside = np.random.default_rng(0).uniform(-1, 1, (500, 3)) * [1.5, 1.0, 0.25]
    inside[np.arange(500), np.arange(500) % 3] = np.array([1.5, 1.0, 0.25])[np.arange(500) % 3]
    for vertices in (box, np.concatenate([inside, box])):
        piece = hull(turned(vertices))
        check(piece, turned(vertices))
        assert len(piece.vertices) == 8
        assert sorted(map(len, piece.loops)) == [4] * 6
        assert piece.thickness == pytest.approx(0.5)


def test_faces_that_noise_has_split_are_one_face():
    piece = hull(turned(PRISM, noise=1e-9))
    assert sorted(map(len, piece.loops)) == [4] * 40 + [40] * 2
    check(piece, turned(PRISM, noise=1e-9))


def test_thickness_is_that_between_a_face_and_what_is_opposite():
    piece = hull(turned(TETRAHEDRON))
    check(piece, turned(TETRAHEDRON))
    assert piece.thickness == pytest.approx(4 / np.sqrt(3))
    many = hull(turned(primitives.sphere(0.5, 5).vertices))
    assert 0.99 < many.thickness < 1.0


@pytest.mark.parametrize("seed", range(5))
def test_random_hulls(seed):
    points = np.random.default_rng(seed).normal(size=(10**seed // 4 + 8, 3)) * [1.0, 0.5, 0.1]
    piece = hull(points)
    check(piece, points)
    assert len(piece.loops) == len(ConvexHull(points).simplices)  # triangles in general position
