"""Shapes of a scene by every kind of SDF: alike in contacts and in motion."""

from dataclasses import replace

import numpy as np
import pytest

import sdfsim
from sdfsim import SceneError, Simulator
from sdfsim.geometry.mesh_io import wavefront, write_ply
from sdfsim.geometry.primitives import box
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Scene
from sdfsim.sdf.closed_forms import BoxSdf
from sdfsim.sdf.grid import GridSdf
from sdfsim.sdf.mesh_sdf import MeshSdf
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import with_sdf
from tests.helpers.scene_files import problems_of

CRATE = {
    "box": "{box: {size: [0.4, 0.4, 0.4]}}",
    "grid": "{primitive: {name: box, size: 0.4}, sdf: grid, resolution: 64}",
    "asset": "{asset: crate, sdf: grid}",
    "file": "{mesh: crate.ply, units: cm, sdf: mesh}",
}


def falling_ball(crate: str) -> str:
    return f"""version: 1
shapes:
  crate: {crate}
  ball: {{sphere: {{radius: 0.1}}}}
bodies:
  - {{name: floor, plane: {{}}}}
  - {{name: crate, shape: crate, position: [0, 0, 0.2], mass: 1}}
  - {{name: ball, shape: ball, position: [0.03, 0.02, 0.52], velocity: [0, 0, -1], mass: 0.5}}
"""


@pytest.fixture
def no_fit(monkeypatch):
    monkeypatch.setattr("sdfsim.shape.make.fit_mesh", lambda *args, **kwargs: pytest.fail("fitted"))


def heights(scene: Scene) -> np.ndarray:
    """[15, 3, 3] m: where the bodies are, step by step."""
    simulator = Simulator(scene, model="solver")
    return np.stack([np.asarray(state.position) for state in simulator.steps(15)])


def test_a_ball_bounces_alike_off_a_box_a_grid_and_a_mesh(load, tmp_path, no_fit):
    crate = analytic_shape("box", size=(0.4, 0.4, 0.4))
    crate.save(tmp_path / "crate")
    larger = replace(crate.mesh, vertices=100 * crate.mesh.vertices)
    (tmp_path / "crate.ply").write_bytes(write_ply(larger))
    scenes = {key: load(falling_ball(shape)) for key, shape in CRATE.items()}
    kinds = {key: type(scene.shapes[1].sdf) for key, scene in scenes.items()}
    assert kinds == {"box": BoxSdf, "grid": GridSdf, "asset": GridSdf, "file": MeshSdf}
    assert all(scene.missed == () for scene in scenes.values())
    expected = heights(scenes["box"])
    # Without the crate it would be half a metre lower by now.
    assert 0.49 < expected[-1, 2, 2] < 0.51
    # Samples round corners off by 0.4 mm, and the impact falls into one inner step or the next.
    for key, scene in scenes.items():
        np.testing.assert_allclose(heights(scene), expected, atol=0.02, err_msg=key)


def test_an_asset_keeps_its_own_sdf_unless_reported_and_cannot_grow_a_network(load, tmp_path):
    with_sdf(analytic_shape("box", size=(0.4, 0.4, 0.4)), "mesh").save(tmp_path / "crate")
    assert isinstance(load(falling_ball("{asset: crate}")).shapes[1].sdf, MeshSdf)
    (fault,) = problems_of(load, falling_ball("{asset: crate, sdf: mlp}"))
    assert fault == "scene.yaml:3: shapes.crate.asset: box: the shape has no SDF network (fit its mesh)"


def test_a_shape_of_parts_has_their_mass_and_rests_on_them(tmp_path):
    """A dumbbell of a bar and two boxes, with a lamp that is only shown; its box alone would tip over."""
    (tmp_path / "lamp.obj").write_text(wavefront([box((0.1, 0.1, 0.1))]))
    scene = sdfsim.Scene(duration=1.0, model="solver").add("floor", plane={}, restitution=0)
    parts = [
        {"box": {"size": (0.2, 0.2, 0.2)}, "position": (0.4, 0, 0), "color": (200, 0, 0)},
        {"box": {"size": (0.2, 0.2, 0.2)}, "position": (-0.4, 0, 0)},
        {"box": {"size": (0.6, 0.1, 0.1)}, "euler_xyz_deg": (0, 0, 0)},
        {"mesh": str(tmp_path / "lamp.obj"), "scale": 2.0, "position": (0, 0, 0.3), "use": "shown"},
        {"sphere": {"radius": 0.05}, "position": (0, 0, 0.05), "use": "touch"},
    ]
    scene.add("bell", parts=parts, position=(0, 0, 0.1), restitution=0, density=100)
    loaded = load_scene(scene.save(tmp_path / "scene.yaml"), allow_outside=True)
    shape, mass = loaded.shapes[1], loaded.bodies[1].mass
    # The bar is 0.6 m between the boxes; half of the sphere is above it.
    assert mass == pytest.approx(100 * (2 * 0.2**3 + 0.6 * 0.01 + 2 / 3 * np.pi * 0.05**3), rel=0.01)
    assert shape.skin is not None and shape.skin.vertices[:, 2].max() == pytest.approx(0.4)
    assert shape.mesh.vertices[:, 2].max() == pytest.approx(0.1, abs=1e-3)
    rollout = sdfsim.Simulator(loaded).run()
    assert rollout.position[-1, 1] == pytest.approx(rollout.position[0, 1], abs=2e-4)
    again = sdfsim.Scene.read(tmp_path / "scene.yaml", allow_outside=True).load()
    assert again.bodies[1].mass == pytest.approx(mass)


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        ([{"box": {"size": (1, 1, 1)}, "scale": 2}], "parts[0].scale: is for a mesh only"),
        ([{"box": {"size": (1, 1, 1)}, "use": "shown"}], "parts: one part must not be use: shown"),
        ([{"position": (0, 0, 1)}], "parts[0]: one of mesh, sphere, capsule, cylinder, box is required"),
        ([{"capsule": {"radius": 1, "height": 1}}], "parts[0].capsule.height: must be above twice the radius"),
        ([{"mesh": "none.obj"}], "parts[0].mesh: no such file"),
    ],
)
def test_parts_that_make_no_shape_are_told(parts, told):
    with pytest.raises(SceneError) as caught:
        sdfsim.Scene().add("a", parts=parts)
    assert any(told in problem for problem in caught.value.problems)
