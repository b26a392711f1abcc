"""Grids of bricks: as exact as they say, thin walls included, and kept between runs."""

import errno
from dataclasses import replace

import numpy as np
import pytest

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.mesh import Mesh, convex_hull, joined
from sdfsim.geometry.primitives import spiral
from sdfsim.physics.bodies import Units, from_scene
from sdfsim.physics.solver.distance import GRID, distances
from sdfsim.physics.solver.prepare import compiled_shapes
from sdfsim.physics.solver.surface_distance import KEYS
from sdfsim.scene.scene import Scene
from sdfsim.sdf import baked_grid as module
from sdfsim.sdf.baked_grid import BakedGrid, bake, baked, unseen_wall, wall_thickness
from sdfsim.sdf.mesh_sdf import MeshSdf
from sdfsim.shape import contact_geometry
from sdfsim.shape.contact_geometry import MOST_PATCHES, ContactGeometry, patches_of
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import with_sdf
from sdfsim.shape.surface_nodes import edge_nodes, project
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import make_body as body


@pytest.fixture(scope="module")
def block():
    return with_sdf(analytic_shape("box", size=(1.0, 0.6, 0.2)), "mesh")


def test_a_grid_is_as_exact_as_it_says(block):
    grid = bake(block.sdf, block.nodes)
    assert 0.0 < grid.error < grid.cell
    assert grid.cell == pytest.approx(1.0 / module.CELLS)
    points = np.random.default_rng(0).uniform([-0.5, -0.3, -0.1], [0.5, 0.3, 0.1], (2000, 3)) * 1.02
    exact = block.sdf(points)[0]
    near = np.abs(exact) < 2 * grid.cell
    assert np.abs(module.interpolated(grid, points[near]) - exact[near]).max() <= 1.1 * grid.error


@pytest.mark.parametrize("wall", [0.2, 0.05, 0.008])
def test_thin_walls_are_measured_and_get_finer_grids(wall):
    plate = with_sdf(analytic_shape("box", size=(1.0, 1.0, wall)), "mesh")
    assert wall_thickness(plate.sdf, plate.nodes) == pytest.approx(wall, rel=0.35)
    if wall < 0.01:
        assert bake(plate.sdf, plate.nodes).cell <= 0.5 * 1.4 * wall


NOTHING = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))


def two_halves() -> list[np.ndarray]:
    """A bar of two convex pieces with a step between them."""
    corners = analytic_shape("box", size=(1.0, 0.4, 0.4)).mesh.vertices
    aside = np.array([0.5, 0.0, 0.0])
    return [corners - aside, corners * np.array([1.0, 0.5, 0.5]) + aside]


@pytest.mark.parametrize(("wall", "told"), [(0.002, True), (0.03, False)])
def test_walls_that_no_grid_sees_are_reported(wall, told, caplog):
    rod, aside = analytic_shape("box", size=(1.0, 0.03, wall)), np.array([0.0, 0.2, 0.0])
    two = joined([rod.mesh, Mesh(rod.mesh.vertices + aside, rod.mesh.faces)])
    nodes = np.concatenate([rod.nodes, rod.nodes + aside])
    assert ContactGeometry(MeshSdf(two), nodes, (), NOTHING).grid is not None
    assert ("bodies may pass through" in caplog.text) is told and "--thicken" not in caplog.text


def test_the_grid_of_a_single_surface_need_not_hold_its_walls(caplog):
    """Where it is near, the triangles are asked."""
    rod = with_sdf(analytic_shape("box", size=(1.0, 0.03, 0.002)), "mesh")
    grid = ContactGeometry(rod.sdf, rod.nodes, (), NOTHING).grid
    assert grid is not None and grid.cell == pytest.approx(1.0 / module.CELLS)
    assert not caplog.text


CONVEX = {
    "tetrahedron": [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)],
    "octahedron": [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)],
    "wedge": [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (0, 0, 0.3), (0, 1, 0.3)],
    "pyramid": [(-1, -1, 0), (1, -1, 0), (-1, 1, 0), (1, 1, 0), (0, 0, 0.5)],
    "double cone": [(np.cos(a), np.sin(a), 0) for a in np.linspace(0, 6, 20)] + [(0, 0, 0.4), (0, 0, -0.4)],
    "spike": [(np.cos(a), np.sin(a), 0) for a in np.linspace(0, 6, 20)] + [(0, 0, 5.0)],
    "ball": spiral(300),
}


def finest(sdf: MeshSdf, nodes: np.ndarray) -> BakedGrid:
    """As fine a grid as there is, without its samples."""
    cell = float(np.ptp(sdf.bounds, axis=0).max()) / module.FINEST
    return BakedGrid(sdf.bounds[0], cell, *(np.zeros(0),) * 3, wall_thickness(sdf, nodes), 0.0)


@pytest.mark.parametrize("name", CONVEX)
def test_a_solid_that_comes_to_edges_has_no_thin_walls(name):
    """Also where its nodes are on its edges alone, where every solid is thin."""
    mesh = convex_hull(np.array(CONVEX[name], float))
    sdf, nodes = MeshSdf(mesh), np.concatenate([mesh.vertices, edge_nodes(mesh.vertices, 0.05)])
    assert unseen_wall(sdf, finest(sdf, nodes)) is None


@pytest.mark.parametrize("wall", [0.001, 0.003])
def test_a_hollow_solid_with_thin_walls_is_reported_of(wall):
    outer = analytic_shape("box", size=(1.0, 0.8, 0.6)).mesh
    inner = analytic_shape("box", size=(1.0 - 2 * wall, 0.8 - 2 * wall, 0.6 - 2 * wall)).mesh
    faces = np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)])
    sdf = MeshSdf(Mesh(np.concatenate([outer.vertices, inner.vertices]), faces))
    found = unseen_wall(sdf, finest(sdf, analytic_shape("box", size=(1.0, 0.8, 0.6)).nodes))
    assert found is not None and found <= 0.004


def test_what_is_known_of_a_shape_with_pieces_is_not_taken_for_one_without():
    bar, pieces = with_sdf(analytic_shape("box", size=(2.0, 0.4, 0.4)), "mesh"), tuple(two_halves())
    above = np.array([[0.5, 0.0, 0.15]])
    for known, want in ((pieces, 0.05), ((), -0.05), (pieces, 0.05)):
        grid = replace(bar, pieces=known).contact.grid
        np.testing.assert_allclose(module.interpolated(grid, above), [want], atol=2 * grid.error)


def test_the_balls_of_leaves_hold_the_whole_surface(block):
    """Each place on a fitted surface is in the ball of a leaf, and of a clump: what is far from all balls is far."""
    shape = with_sdf(block, "mesh")
    surface = ContactGeometry(shape.sdf, shape.nodes[::7], (), shape.mesh).surface
    assert surface.leaf_node[-1] == len(surface.node) and surface.clump_leaf[-1] == len(surface.leaf_ball)
    places = project(shape.sdf, np.random.default_rng(0).uniform(*shape.sdf.bounds, (20_000, 3)))
    for balls in (surface.leaf_ball, surface.clump_ball):
        away = np.linalg.norm(places[:, None] - balls[None, :, :3], axis=2) - balls[:, 3]
        assert away.min(1).max() <= 1e-9


def test_copies_and_processes_share_one_geometry(block, monkeypatch, tmp_path):
    """The surface comes from the disk the second time, as it was."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    shape = with_sdf(block, "mesh")
    first = ContactGeometry(shape.sdf, shape.nodes, (), shape.mesh).surface
    monkeypatch.setattr(contact_geometry, "in_leaves", None)
    again = ContactGeometry(shape.sdf, shape.nodes, (), shape.mesh).surface
    for name, values in vars(first).items():
        np.testing.assert_array_equal(getattr(again, name), values)


def test_a_grid_is_kept(block, tmp_path, monkeypatch):
    first = baked(block.sdf, block.nodes, cache_dir=tmp_path)
    monkeypatch.setattr(module, "bake", lambda *_: pytest.fail("baked again"))
    again = baked(block.sdf, block.nodes, cache_dir=tmp_path)
    np.testing.assert_array_equal(first.fine, again.fine)
    assert again.error == first.error


def test_a_grid_of_other_nodes_is_another_one(tmp_path):
    """Of a thick block with a thin fin: with nodes on the fin alone the grid has to be finer."""
    corners = np.array([[x, y, z] for x in (-1.0, 0.0) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    parts = convex_hull(corners), convex_hull(corners * [-1.0, 1.0, 0.02])
    pieces = tuple(part.vertices for part in parts)
    sdf = MeshSdf(Mesh(np.concatenate(pieces), np.concatenate([parts[0].faces, parts[1].faces + 8])))
    places = np.random.default_rng(0).uniform(-0.4, 0.4, (40, 2))
    middles = ((-0.5, 0.5), (0.5, 0.01))
    thick, thin = (np.column_stack([places + np.array([x, 0.0]), np.full(40, z)]) for x, z in middles)
    first = baked(sdf, thick, pieces, cache_dir=tmp_path)
    second = baked(sdf, thin, pieces, cache_dir=tmp_path)
    assert first.cell == pytest.approx(2.0 / 128) and second.cell < 0.6 * first.cell
    assert baked(sdf, thick, pieces, cache_dir=tmp_path).cell == first.cell
    # What rounding makes of the nodes of a body of another scale is the same.
    files = len(list(tmp_path.iterdir()))
    assert baked(sdf, (thin * 0.3 + 0.1 - 0.1) / 0.3, pieces, cache_dir=tmp_path).cell == second.cell
    assert len(list(tmp_path.iterdir())) == files == 2


def test_a_full_disk_costs_only_the_cache(block, tmp_path, monkeypatch, caplog):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(module, "CELLS", 16)
    monkeypatch.setattr(module, "FINEST", 16)
    monkeypatch.setattr(np, "savez", full)
    grid = baked(block.sdf, block.nodes, cache_dir=tmp_path)
    assert grid.cell > 0 and "cannot be cached" in caplog.text and list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    (tmp_path / "file").write_text("in the way of a folder")
    monkeypatch.setattr(module, "CELLS", 16)
    monkeypatch.setattr(module, "FINEST", 16)
    assert baked(block.sdf, block.nodes, cache_dir=tmp_path / "file" / "baked").cell == grid.cell


def test_bodies_of_any_scale_share_one_geometry(block):
    bodies = tuple(replace(body(str(k), 0, [k, 0, 0]), scale=scale) for k, scale in enumerate((1.0, 0.3, 7.0)))
    made = from_scene(Scene((block,), bodies, np.zeros(3), 1.0), Units(0.37, 1.0, 1.0))[0]
    assert made.contact == (block.contact,)


def test_more_pieces_than_contacts_can_tell_apart_are_refused(block):
    assert MOST_PATCHES == KEYS
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    shape = replace(
        block, name="comb", pieces=tuple(corner + np.array([2.0 * k, 0, 0]) for k in range(MOST_PATCHES + 1))
    )
    told = r"is made of 1,025 convex pieces \(at most 1,024\)"
    with pytest.raises(SdfsimError, match=f"^shape 'comb' {told}"):
        Simulator(Scene((shape,), (body("a", 0, [0, 0, 0]),), np.zeros(3), 1.0))
    with pytest.raises(SdfsimError, match=told):
        patches_of(block.sdf, block.nodes, shape.pieces)


@pytest.mark.parametrize("kind", ["sphere", "box", "capsule", "cylinder", "mesh"])
def test_the_compiled_distance_is_that_of_the_shape(kind, block):
    shape = {
        "sphere": lambda: analytic_shape("sphere", radius=0.4),
        "box": lambda: analytic_shape("box", size=(1.0, 0.6, 0.2)),
        "capsule": lambda: analytic_shape("capsule", radius=0.2, height=1.0),
        "cylinder": lambda: analytic_shape("cylinder", radius=0.3, height=0.8),
        "mesh": lambda: block,
    }[kind]()
    scene = Scene((shape,), (body("a", 0, [0, 0, 0]),), np.zeros(3), 1.0)
    shapes = compiled_shapes(from_scene(scene, Units(1.0, 1.0, 1.0))[0].contact)
    slack = bake(block.sdf, block.nodes).error if shapes.table[0, 0] == GRID else 1e-12
    points = np.random.default_rng(1).uniform(-1.02, 1.02, (500, 3)) * shape.sdf.bounds[1]
    exact, normals = shape.sdf(points)
    d, n = distances(shapes.table, shapes.brick, shapes.sample, 0, points)
    far = (np.abs(exact) >= 0.01) & (kind == "mesh")
    assert np.all(np.abs(d - exact) <= np.where(far, 0.06, slack))
    if kind != "mesh":
        np.testing.assert_allclose(n, normals, atol=1e-9)
