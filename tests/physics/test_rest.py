"""What is put on a floor comes to rest: sampled surfaces, whose faces are not as flat as those of a mesh."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sdfsim

SHAPES = Path(__file__).resolve().parents[2] / "samples" / "shapes"


def late_motion(scene: sdfsim.Scene) -> tuple[float, float]:
    """Mean angular speed rad/s and way m of a scene's second body in the last third of 6 s."""
    rollout = sdfsim.Simulator(scene).run(6.0)
    late = rollout.time > 4.0
    angular = np.linalg.norm(rollout.angular_velocity[late, 1], axis=1).mean()
    return float(angular), float(np.linalg.norm(np.ptp(rollout.position[late, 1], axis=0)))


def floor() -> sdfsim.Scene:
    return sdfsim.Scene(effects={"sleep": "off"}).add("floor", plane={}, friction=0.8, restitution=0.4)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_ring_comes_to_rest(seed):
    """20 cm, from 2 cm above the floor: it went on by some 20 micrometres a second, since points far out that did not
    touch yet took the places of points that bore."""
    quat = Rotation.random(random_state=seed).as_quat()
    corners = sdfsim.load_shape(SHAPES / "ring").mesh.vertices
    scale = 0.2 / float(np.ptp(corners, axis=0).max())
    up = 0.02 - scale * float(Rotation.from_quat(quat).apply(corners)[:, 2].min())
    scene = floor().add("it", asset=str(SHAPES / "ring"), scale=scale, position=(0, 0, up), quat_xyzw=tuple(quat))
    angular, way = late_motion(scene)
    assert angular < 1e-4 and way < 1e-5
