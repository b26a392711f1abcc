"""Round meshes with `round: auto`."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import wavefront
from sdfsim.scene.builder import SceneBuilder, loaded
from sdfsim.sdf.closed_forms import CylinderSdf
from sdfsim.simulate.simulator import Simulator

TURN, SHIFT = Rotation.from_euler("xyz", [90, 20, 0], degrees=True), np.array([0.02, 0.03, -0.01])


@pytest.fixture
def wheel(tmp_path):
    mesh = primitives.cylinder(0.1, 0.05, 32)
    file = tmp_path / "wheel.obj"
    file.write_text(wavefront([Mesh(TURN.apply(mesh.vertices) + SHIFT, mesh.faces)]))
    return file


def corners(scene, name: str, time: float | None = None) -> np.ndarray:
    """What is shown of a body, in the world."""
    body = scene.bodies[[b.name for b in scene.bodies].index(name)]
    turn, place = Rotation.from_quat(body.quat_xyzw), body.position
    if body.path is not None:
        turn, place = Rotation.from_quat(body.path.quat_xyzw[1]), body.path.position[1]
    return turn.apply(body.scale * scene.shapes[body.shape].shown.vertices) + place


def test_a_round_mesh_stays_where_it_is_placed(wheel) -> None:
    scenes = []
    for how in ("off", "auto"):
        made = SceneBuilder()
        pose = {"position": (0.1, 0.2, 1.0), "euler_xyz_deg": (10, 20, 30)}
        made.add("one", mesh=wheel, round=how, **pose, scale=2.0, count=2, arrange={"grid": (1, 1, 2), "spacing": 1})
        path = [{"time": 0, **pose}, {"time": 1, "position": (3, 2, 1), "euler_xyz_deg": (40, 0, 0)}]
        made.add("led", mesh=wheel, round=how, motion="kinematic", path=path)
        made.frame("hub", "one[1]", position=(0.1, 0, 0), euler_xyz_deg=(0, 0, 90))
        made.keyframe("up", bodies={"one[0]": {"position": (0, 0, 5), "euler_xyz_deg": (0, 90, 0)}})
        scenes.append(loaded(made))
    plain, exact = scenes
    assert isinstance(exact.shapes[0].sdf, CylinderSdf) and not isinstance(plain.shapes[0].sdf, CylinderSdf)
    assert "is a cylinder up to its facets (radius 0.1 m, height 0.05 m)" in exact.notes[0]
    for name in ("one[0]", "one[1]", "led"):
        one, other = corners(plain, name), corners(exact, name)
        order = [np.lexsort(np.round(places, 6).T) for places in (one, other)]
        np.testing.assert_allclose(one[order[0]], other[order[1]], atol=1e-6)
    masses = [[body.mass for body in scene.bodies] for scene in scenes]
    np.testing.assert_allclose(*masses, rtol=0.01)
    simulators = [Simulator(scene) for scene in scenes]
    hubs = [simulator.frame("hub") for simulator in simulators]
    np.testing.assert_allclose(hubs[0].position, hubs[1].position, atol=1e-9)
    np.testing.assert_allclose(np.abs(hubs[0].quat_xyzw @ hubs[1].quat_xyzw), 1.0, atol=1e-9)
    for simulator in simulators:
        simulator.reset(keyframe="up")
    mesh = simulators[1].frame("one[0]")  # that of the mesh
    assert mesh.position == pytest.approx((0, 0, 5), abs=1e-9)
    np.testing.assert_allclose(mesh.quat_xyzw, simulators[0]["one[0]"].quat_xyzw, atol=1e-9)


def test_a_round_mesh_may_be_hollow(wheel) -> None:
    """A tube with ends of 4 mm, whose mass is that of its wall."""
    scene = loaded(SceneBuilder().add("can", mesh=wheel, round="auto", wall=0.004, density=1000))
    assert scene.bodies[0].mass == pytest.approx(1000 * np.pi * (0.1**2 * 0.05 - 0.096**2 * 0.042), rel=0.01)


def test_what_is_not_round_says_so(tmp_path) -> None:
    (tmp_path / "box.obj").write_text(wavefront([primitives.box()]))
    scene = loaded(SceneBuilder().add("box", mesh=tmp_path / "box.obj", round="auto"))
    assert "no round solid: it collides as it is" in scene.notes[0]
