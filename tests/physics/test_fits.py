"""Fits: what has a little play falls freely."""

import numpy as np
import pytest

from sdfsim import Scene, Simulator

G = 9.81


@pytest.fixture
def tube(tmp_path):
    """A tube of 96 facets whose walls are two and a half cells of its grid: its bore is 49.97 mm from the axis."""
    file = tmp_path / "tube.obj"
    import trimesh

    trimesh.creation.annulus(0.05, 0.06, height=0.5, sections=96).export(file)
    return file


@pytest.mark.parametrize("sdf", ["mesh", "grid"])
@pytest.mark.parametrize("radius", [0.0495, 0.049, 0.04])
@pytest.mark.parametrize("scale", [0.1, 1.0, 100.0])
def test_a_ball_falls_through_a_tube_that_it_fits(tube, sdf, radius, scale):
    scene = Scene()
    scene.add("tube", mesh=tube, sdf=sdf, scale=scale, motion="static", friction=0, restitution=0)
    scene.add("ball", sphere={"radius": scale * radius}, position=(0, 0, 0.15 * scale), friction=0, restitution=0)
    ran = Simulator(scene).run(seconds=0.2 * np.sqrt(scale))
    fallen = 0.5 * G * ran.time[-1] ** 2
    assert 0.15 * scale - ran.position[-1, 1, 2] == pytest.approx(fallen, rel=0.01)


def test_nodes_between_others_lie_on_the_surface(tube):
    """Within a twentieth of a cell, but for what is next to an edge, which the grid rounds off."""
    scene = Scene()
    scene.add("tube", mesh=tube, sdf="mesh", motion="static")
    node = scene.load().shapes[0].contact.surface.node
    radius = np.hypot(node[:, 0], node[:, 1])[np.abs(node[:, 2]) < 0.24]
    away = np.minimum(np.abs(radius - 0.05), np.abs(radius - 0.06))
    assert len(radius) > 500
    assert away.max() < 2e-4
