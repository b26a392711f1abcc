"""What is put on a floor comes to rest: fitted surfaces, whose faces are not as flat as those of a mesh."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sdfsim

SHAPES = Path(__file__).resolve().parents[2] / "samples" / "shapes"


@pytest.mark.parametrize(
    ("name", "quat"), [("ring", (-0.082, 0.873, -0.425, 0.225)), ("bowl", (-0.446, -0.802, -0.395, 0.026))]
)
def test_fitted_surfaces_come_to_rest(name, quat):
    """Bodies of 20 cm that fall by 2 cm: they went on rocking at 0.01 rad/s for as long as one looked, since points
    far out that did not touch yet took the places of points that bore."""
    shape = sdfsim.load_shape(SHAPES / name)
    corners = shape.mesh.vertices
    scale = 0.2 / float(np.ptp(corners, axis=0).max())
    up = 0.02 - scale * float(Rotation.from_quat(quat).apply(corners)[:, 2].min())
    scene = sdfsim.Scene(duration=6.0, effects={"sleep": "off"}).add("floor", plane={}, friction=0.8, restitution=0.4)
    scene.add("it", asset=str(SHAPES / name), scale=scale, position=(0.0, 0.0, up), quat_xyzw=quat)
    rollout = sdfsim.Simulator(scene).run()
    late = rollout.time > 4.0
    assert np.linalg.norm(rollout.angular_velocity[late, 1], axis=1).mean() < 2e-3
    assert np.linalg.norm(np.ptp(rollout.position[late, 1], axis=0)) < 2e-5
