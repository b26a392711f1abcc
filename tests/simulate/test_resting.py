"""What is dropped comes to rest and stays there: a fitted shape by the solve, and bodies by the network."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sdfsim
from sdfsim import Simulator, load_shape
from sdfsim.scene.scene import Scene
from sdfsim.shape.make import analytic_shape
from tests.helpers.scenes import make_body

SAMPLES = Path(__file__).resolve().parents[2] / "samples" / "shapes"
EARTH = np.array([0.0, 0.0, -9.81])
DROP = 0.1  # m, for bodies of a metre
SETTLED = 6.0  # s, after which they are to stay where they are for SECONDS
SECONDS = 5.0
SHAPES = {
    "box": lambda: analytic_shape("box", size=(1.0, 1.0, 1.0)),
    "can": lambda: load_shape(SAMPLES / "can"),
}


@pytest.mark.parametrize(
    ("model", "name"), [("solver", "can"), ("gnn", "box"), pytest.param("gnn", "can", marks=pytest.mark.slow)]
)
def test_what_falls_ten_centimetres_comes_to_rest_and_stays(model, name):
    shape = SHAPES[name]()
    size = np.ptp(shape.nodes, axis=0).max()
    lowest = (shape.nodes - shape.com)[:, 2].min()
    bodies = (make_body("floor", 0, [0, 0, 0], 0.0, motion="static"), make_body("it", 1, [0, 0, DROP * size - lowest]))
    scene = Scene((analytic_shape("plane"), shape), bodies, gravity=EARTH, duration=1.0)
    rollout = Simulator(scene, model).run(seconds=SETTLED + SECONDS)
    after = rollout.position[rollout.time >= SETTLED][:, 1]
    assert np.linalg.norm(after - after[0], axis=1).max() < 1e-12 * size


@pytest.mark.parametrize("seed", [0, 1])
def test_a_ring_comes_to_rest(seed):
    """20 cm, from 2 cm above the floor: it went on by some 20 micrometres a second, since points far out that did not
    touch yet took the places of points that bore."""
    quat = Rotation.random(random_state=seed).as_quat()
    corners = load_shape(SAMPLES / "ring").mesh.vertices
    scale = 0.2 / float(np.ptp(corners, axis=0).max())
    up = 0.02 - scale * float(Rotation.from_quat(quat).apply(corners)[:, 2].min())
    scene = sdfsim.Scene(effects={"sleep": "off"}).add("floor", plane={}, friction=0.8, restitution=0.4)
    scene.add("it", asset=str(SAMPLES / "ring"), scale=scale, position=(0, 0, up), quat_xyzw=tuple(quat))
    rollout = Simulator(scene).run(6.0)
    late = rollout.time > 4.0
    assert np.linalg.norm(rollout.angular_velocity[late, 1], axis=1).mean() < 1e-4  # rad/s
    assert np.linalg.norm(np.ptp(rollout.position[late, 1], axis=0)) < 1e-5
