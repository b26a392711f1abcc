import numpy as np
import pytest
from scipy.spatial import KDTree

from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh, joined, sample_surface
from sdfsim.geometry.solidify import solidify
from sdfsim.sdf.closed_forms import BoxSdf, SphereSdf
from sdfsim.sdf.mesh_sdf import MeshSdf
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
