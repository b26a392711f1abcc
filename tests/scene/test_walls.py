"""Hollow shapes: only their wall has mass."""

import numpy as np
import pytest

from sdfsim.physics.bodies import Units, from_scene
from sdfsim.scene.scene import Scene


def ball(radius: float) -> tuple[float, np.ndarray]:
    """Volume m^3 and inertia [3] m^5 of a solid one."""
    volume = 4 / 3 * np.pi * radius**3
    return volume, np.full(3, 0.4 * volume * radius**2)


def block(size) -> tuple[float, np.ndarray]:
    """The same of a block with sides of `size` [3] m."""
    squares = np.square(size)
    return np.prod(size), np.prod(size) / 12 * (squares.sum() - squares)


SIDES = np.array([0.2, 0.13, 0.31])
SHAPES = {
    "ball": ("sphere: {radius: 0.1}", lambda wall: ball(0.1 - wall)),
    "block": ("box: {size: [0.2, 0.13, 0.31]}", lambda wall: block(SIDES - 2 * wall)),
}


def scene_of(load, shape: str, scale: float = 1.0) -> Scene:
    body = f"{{name: it, shape: it, density: 500, scale: {scale}}}"
    return load(f"version: 1\nshapes:\n  it: {{{shape}}}\nbodies:\n  - {body}\n")


@pytest.mark.parametrize("scale", [1.0, 2.0])
@pytest.mark.parametrize("name", SHAPES)
def test_mass_and_inertia_are_those_of_what_is_left_around_the_hollow(load, name, scale):
    shape, inside = SHAPES[name]
    (volume, inertia), (hollow, missing) = inside(0.0), inside(0.004)
    scene = scene_of(load, f"{shape}, wall: 0.004", scale)
    assert scene.bodies[0].mass == pytest.approx(500 * (volume - hollow) * scale**3, rel=0.01)
    bodies, _ = from_scene(scene, Units(1.0, 1.0, 1.0))
    wanted = 500 * np.diag(inertia - missing) * scale**5
    np.testing.assert_allclose(bodies.inertia[0], wanted, rtol=0.01, atol=1e-3 * wanted.max())
    np.testing.assert_allclose(bodies.com[0], 0, atol=1e-6)


def test_a_wall_thicker_than_the_shape_makes_it_solid(load):
    solid, walled = (scene_of(load, f"sphere: {{radius: 0.1}}{more}") for more in ("", ", wall: 0.2"))
    assert walled.bodies[0].mass == pytest.approx(solid.bodies[0].mass, rel=1e-3)


def test_a_wall_changes_nothing_outside(load):
    solid, walled = (scene_of(load, f"sphere: {{radius: 0.1}}{more}").shapes[0] for more in ("", ", wall: 0.004"))
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (50, 3))
    np.testing.assert_array_equal(solid.sdf(points)[0], walled.sdf(points)[0])
    np.testing.assert_array_equal(solid.nodes, walled.nodes)
