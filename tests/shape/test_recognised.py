"""Convex and round forms are recognised in meshes, however their surface is divided."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh, convex_hull, joined
from sdfsim.shape.convex_pieces import ConvexPiece, hull
from sdfsim.shape.round_form import round_form

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


def pill(radius: float, height: float) -> Mesh:
    """Sixteen meridians."""
    tilts, up = np.linspace(0, np.pi / 2, 9), 0.5 * height - radius
    upper = [(radius * np.cos(t), radius * np.sin(t) + up) for t in tilts[:-1]]
    lower = [(r, -z) for r, z in reversed(upper)]
    return primitives.revolve(np.array([(0.0, -0.5 * height), *lower, *upper, (0.0, 0.5 * height)]), 16)


ROUND = {
    "ball": (primitives.sphere(0.3, 2), "sphere", {"radius": 0.3}),
    "wheel": (primitives.cylinder(0.3, 0.1, 32), "cylinder", {"radius": 0.3, "height": 0.1}),
    "rod": (primitives.cylinder(0.01, 1.0, 12), "cylinder", {"radius": 0.01, "height": 1.0}),
    # all its moments of inertia are equal
    "can": (primitives.cylinder(0.1, 0.1 * np.sqrt(3.0), 256), "cylinder", {"radius": 0.1, "height": 0.1 * 3**0.5}),
    "pill": (pill(0.1, 0.5), "capsule", {"radius": 0.1, "height": 0.5}),
    "cone": (primitives.cone(0.2, 0.5, 24), "cone", {"radius": 0.2, "height": 0.5}),
    "hat": (primitives.cone(0.5, 0.1, 24), "cone", {"radius": 0.5, "height": 0.1}),
    "ring": (primitives.torus(0.3, 0.1), "torus", {"radius": 0.3, "tube": 0.1}),
}


@pytest.mark.parametrize("name", ROUND)
@pytest.mark.parametrize("seed", [None, 0, 1])
def test_round_meshes_are_recognised_wherever_they_are(name: str, seed: int | None) -> None:
    mesh, kind, sizes = ROUND[name]
    turn, shift = Rotation.identity(), np.zeros(3)
    if seed is not None:
        turn, shift = Rotation.random(random_state=seed), np.random.default_rng(seed).normal(size=3)
    scale = 1.0 if seed is None else 10.0 ** (3 * seed - 2)
    vertices = scale * (turn.apply(mesh.vertices) + shift)
    found = round_form(Mesh(vertices.astype(np.float32).astype(float), mesh.faces))
    assert found is not None and found.kind == kind
    assert found.sizes == pytest.approx({key: scale * value for key, value in sizes.items()}, rel=1e-3)
    np.testing.assert_allclose(found.pose[:3, 3], scale * shift, atol=1e-3 * scale)
    if kind != "sphere":
        axis = turn.apply([0, 0, 1]) @ found.pose[:3, 2]
        assert (axis if kind == "cone" else abs(axis)) == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose(found.pose[:3, :3] @ found.pose[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(found.pose) == pytest.approx(1.0)


def dented() -> Mesh:
    mesh = primitives.cylinder(0.1, 0.3, 32)
    vertices = mesh.vertices.copy()
    vertices[np.argmax(vertices[:, 0])] *= (0.97, 1, 1)
    return Mesh(vertices, mesh.faces)


BALL = primitives.sphere(0.3, 3)
OTHERS = {
    "box": primitives.box(),
    "nut": primitives.cylinder(0.1, 0.1, 6),  # its vertices are on a cylinder
    "octagon": primitives.cylinder(0.1, 0.1, 8),
    "coarse ball": primitives.sphere(0.3, 1),
    "egg": Mesh(BALL.vertices * (1, 1, 1.02), BALL.faces),
    "half ball": convex_hull(BALL.vertices[BALL.vertices[:, 2] >= -1e-9]),
    "frustum": primitives.revolve(np.array([[0, 0], [0.2, 0], [0.19, 0.3], [0, 0.3]]), 32),
    "chamfered": primitives.revolve(np.array([[0, 0], [0.19, 0], [0.2, 0.01], [0.2, 0.3], [0, 0.3]]), 32),
    "tapered": primitives.revolve(np.array([[0, 0], [0.2, 0], [0.05, 0.3], [0.0, 0.5]]), 32),
    "pipe": primitives.tube(0.2, 0.15, 0.4),
    "dented": dented(),
    "flat ring": primitives.tube(0.2, 0.1, 0.05),
    "bowl": primitives.bowl(),
    "gear": primitives.gear(),
    "half a ring": convex_hull(primitives.torus(0.3, 0.1).vertices),
    "two balls": joined([BALL, Mesh(BALL.vertices + 2, BALL.faces)]),
    "open": Mesh(primitives.cylinder().vertices, primitives.cylinder().faces[:-1]),
}  # fmt: skip


@pytest.mark.parametrize("name", OTHERS)
def test_other_meshes_are_not_round(name: str) -> None:
    assert round_form(OTHERS[name]) is None
