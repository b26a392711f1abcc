"""Grids of bricks: as exact as they say, thin walls included, and kept between runs."""

import numpy as np
import pytest

from sdfsim.dynamics.kernels.distance import GRID, distance
from sdfsim.dynamics.solver import _geometry, compiled_shapes
from sdfsim.shape import baked_grid as module
from sdfsim.shape.baked_grid import bake, baked, wall_thickness
from sdfsim.shape.shape import analytic_shape, with_sdf
from sdfsim.shape.surface_nodes import surface_of


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


def two_halves() -> list[np.ndarray]:
    """A bar of two convex pieces with a step between them."""
    corners = analytic_shape("box", size=(1.0, 0.4, 0.4)).mesh.vertices
    aside = np.array([0.5, 0.0, 0.0])
    return [corners - aside, corners * np.array([1.0, 0.5, 0.5]) + aside]


@pytest.mark.parametrize(("wall", "told"), [(0.002, True), (0.03, False)])
def test_walls_that_no_grid_sees_are_told(wall, told, caplog):
    rod = with_sdf(analytic_shape("box", size=(1.0, 0.03, wall)), "mesh")
    _geometry(rod.sdf, rod.nodes, ())
    assert ("things may pass through" in caplog.text) is told


def test_where_pieces_are_known_the_grid_is_of_these():
    pieces = two_halves()
    bar = with_sdf(analytic_shape("box", size=(2.0, 0.4, 0.4)), "mesh")
    grid = bake(bar.sdf, bar.nodes, pieces)
    above = np.array([[-0.5, 0.0, 0.21], [0.5, 0.0, 0.11], [0.5, 0.0, 0.15]])
    np.testing.assert_allclose(module.interpolated(grid, above), [0.01, 0.01, 0.05], atol=2 * grid.error)


def test_what_is_known_of_a_shape_with_pieces_is_not_taken_for_one_without():
    bar, pieces = with_sdf(analytic_shape("box", size=(2.0, 0.4, 0.4)), "mesh"), tuple(two_halves())
    above = np.array([[0.5, 0.0, 0.15]])
    for known, want in ((pieces, 0.05), ((), -0.05), (pieces, 0.05)):
        grid = _geometry(bar.sdf, bar.nodes, known).grid
        np.testing.assert_allclose(module.interpolated(grid, above), [want], atol=2 * grid.error)


def test_the_surface_of_pieces_has_a_patch_for_each():
    pieces = two_halves()
    bar = with_sdf(analytic_shape("box", size=(2.0, 0.4, 0.4)), "mesh")
    nodes = np.array([[-0.9, 0.0, 0.25], [0.4, 0.02, 0.08]])  # beside the surface, as those of a fitted SDF are
    surface = surface_of(bar.sdf, nodes, pieces)
    vertices = surface.nodes[:-2]
    assert {tuple(v) for v in vertices.round(9)} == {tuple(v) for v in np.concatenate(pieces).round(9)}
    np.testing.assert_allclose(surface.nodes[-2:], [[-0.9, 0.0, 0.2], [0.4, 0.02, 0.1]], atol=1e-6)
    np.testing.assert_array_equal(surface.patch, [0] * 8 + [1] * 8 + [0, 1])
    assert surface.nearest is not None
    at = np.round((np.array([[-0.8, 0.0, 0.2], [0.8, 0.0, 0.2]]) - surface.low) / surface.cell).astype(int)
    assert [int(surface.nearest[tuple(k)]) for k in at] == [0, 1]


def test_a_grid_is_kept(block, tmp_path, monkeypatch):
    first = baked(block.sdf, block.nodes, cache_dir=tmp_path)
    monkeypatch.setattr(module, "bake", lambda *_: pytest.fail("baked again"))
    again = baked(block.sdf, block.nodes, cache_dir=tmp_path)
    np.testing.assert_array_equal(first.fine, again.fine)
    assert again.error == first.error


@pytest.mark.parametrize("kind", ["sphere", "box", "capsule", "cylinder", "mesh"])
def test_the_compiled_distance_is_that_of_the_shape(kind, block):
    import torch

    from sdfsim.dynamics.bodies import Units, from_scene
    from sdfsim.scene.scene import Scene
    from tests.dynamics.test_laws import body

    shape = {
        "sphere": lambda: analytic_shape("sphere", radius=0.4),
        "box": lambda: analytic_shape("box", size=(1.0, 0.6, 0.2)),
        "capsule": lambda: analytic_shape("capsule", radius=0.2, height=1.0),
        "cylinder": lambda: analytic_shape("cylinder", radius=0.3, height=0.8),
        "mesh": lambda: block,
    }[kind]()
    scene = Scene((shape,), (body("a", 0, [0, 0, 0]),), np.zeros(3), 1.0)
    shapes = compiled_shapes(from_scene(scene, Units(1.0, 1.0, 1.0), torch.device("cpu"))[0])
    slack = bake(block.sdf, block.nodes).error if shapes.table[0, 0] == GRID else 1e-12
    points = np.random.default_rng(1).uniform(-1.02, 1.02, (500, 3)) * shape.sdf.bounds[1]
    for p, exact, normal in zip(points, *shape.sdf(points), strict=True):
        d, n = distance(shapes.table, shapes.brick, shapes.sample, 0, tuple(p))
        assert abs(d - exact) <= (slack if abs(exact) < 0.01 or kind != "mesh" else 0.06)
        if kind != "mesh":
            np.testing.assert_allclose(n, normal, atol=1e-9)
