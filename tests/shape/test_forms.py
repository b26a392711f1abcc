"""Surface nodes of shapes, and convex and round forms that are recognised in meshes, however their surface is
divided."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull, KDTree
from scipy.spatial.transform import Rotation

from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh, convex_hull, joined, sample_surface
from sdfsim.geometry.solidify import solidify
from sdfsim.sdf.closed_forms import BoxSdf, SphereSdf
from sdfsim.sdf.mesh_sdf import MeshSdf
from sdfsim.shape.convex_pieces import ConvexPiece, hull
from sdfsim.shape.round_form import round_form
from sdfsim.shape.surface_nodes import edge_nodes, hull_nodes, sample_nodes, surface_nodes, thin


@pytest.mark.parametrize("scale", [0.01, 1.0, 300.0])
def test_nodes_lie_on_the_surface_and_cover_it(scale: float) -> None:
    sdf = SphereSdf(0.5 * scale)
    nodes = sample_nodes(sdf)
    assert np.abs(sdf(nodes)[0]).max() < 1e-6 * scale
    surface, _ = sample_surface(primitives.sphere(0.5 * scale, 4), 5000, np.random.default_rng(0))
    assert KDTree(nodes).query(surface)[0].max() < 0.06 * scale
    few = thin(nodes, 128)
    assert len(few) == 128
    # 128 even caps of a sphere have a radius near 0.09 of its diameter. Which nodes are kept hangs on rounding: those
    # moved by 1e-15 give 0.122 to 0.135.
    assert KDTree(few).query(surface)[0].max() < 0.14 * scale


def test_one_node_a_voxel_and_the_same_every_time() -> None:
    sdf = BoxSdf((0.5, 0.3, 0.2))
    nodes = sample_nodes(sdf)
    cells = np.round(nodes / 0.025).astype(int)
    assert len(np.unique(cells, axis=0)) == len(nodes)
    np.testing.assert_array_equal(nodes, sample_nodes(sdf))
    assert len(sample_nodes(sdf, grid=8)) < len(nodes)


def test_concave_sides_have_nodes_too() -> None:
    class Shell:
        bounds = np.array([[-0.5] * 3, [0.5] * 3])

        def __call__(self, points):
            length = np.linalg.norm(points, axis=1)
            side = np.where(length < 0.45, -1.0, 1.0)
            return np.abs(length - 0.45) - 0.05, side[:, None] * points / np.maximum(length, 1e-9)[:, None]

    radius = np.linalg.norm(sample_nodes(Shell()), axis=1)
    assert (np.abs(radius - 0.4) < 1e-6).sum() > 200
    assert (np.abs(radius - 0.5) < 1e-6).sum() > 200


def test_thinning_keeps_what_it_must_and_spreads_the_rest() -> None:
    rng = np.random.default_rng(0)
    points, keep = rng.random((2000, 3)), rng.random((10, 3))
    few = thin(points, 60, keep=keep)
    assert few.shape == (60, 3)
    np.testing.assert_array_equal(few[:10], keep)
    gaps = KDTree(few[10:]).query(few[10:], k=2)[0][:, 1]
    assert gaps.min() > 0.15
    np.testing.assert_array_equal(few, thin(points, 60, keep=keep))
    assert len(thin(points, 5, keep=keep)) == 5
    assert {tuple(p) for p in thin(keep, 5)} <= {tuple(p) for p in keep}
    assert len(thin(points[:3], 60)) == 3
    assert thin(np.zeros((0, 3)), 8).shape == (0, 3)
    assert len(thin(np.repeat(keep, 3, axis=0), 60)) == 10


def test_hull_vertices_come_before_those_in_hollows() -> None:
    corners = primitives.box().vertices
    hollow = 0.3 * corners
    nodes = hull_nodes(np.concatenate([hollow, corners]), 10)
    assert len(nodes) == 10
    assert {tuple(p) for p in nodes[:8]} == {tuple(p) for p in corners}


def test_edges_of_a_box_and_none_of_its_flat_diagonals() -> None:
    corners = primitives.box((1.0, 2.0, 3.0)).vertices
    points = edge_nodes(corners, 0.25)
    half = np.array([0.5, 1.0, 1.5])
    on = np.isclose(np.abs(points), half).sum(1)
    assert (on == 2).all()
    assert len(points) == 4 * (3 + 7 + 11)
    assert len(edge_nodes(corners, 5.0)) == 0
    assert len(edge_nodes(primitives.sphere().vertices, 0.01)) == 0


def test_nodes_reach_as_far_as_a_vase_does_in_every_direction() -> None:
    import trimesh

    height = np.linspace(0.0, 1.0, 121)
    radius = 0.2 + 0.13 * np.sin(np.pi * height) ** 2 + 0.05 * height**8  # a belly, a neck and a rim
    profile = np.stack([radius, height], 1)
    vase = trimesh.creation.revolve(np.concatenate([[[0.0, 0.0]], profile, [[0.0, 1.0]]]), sections=160)
    rng = np.random.default_rng(0)
    mesh = Mesh(vase.vertices + rng.normal(0.0, 0.003, vase.vertices.shape), vase.faces)  # rough, as one from photos
    nodes = surface_nodes(MeshSdf(mesh), mesh, 512)
    direction = rng.normal(size=(5000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    short = (direction @ mesh.vertices.T).max(1) - (direction @ nodes.T).max(1)
    assert short.max() < 0.006 and short.mean() < 0.0006


def test_nodes_of_boxes_that_cross_lie_on_their_union():
    long, wide = primitives.box((1.0, 0.2, 0.2)), primitives.box((0.2, 1.0, 0.3))
    solid = solidify(joined([long, wide])).surface
    nodes = surface_nodes(MeshSdf(solid), solid, 512)
    outside = [np.abs(nodes) - 0.5 * np.array(size) for size in ((1.0, 0.2, 0.2), (0.2, 1.0, 0.3))]
    off = np.abs(np.minimum(*(part.max(1) for part in outside)))
    # At the crease faces are cut to the width of `FINE` of the normalised solid.
    assert np.quantile(off, 0.95) < 1e-6 and off.max() < 0.005
    assert len(nodes) > 400


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
