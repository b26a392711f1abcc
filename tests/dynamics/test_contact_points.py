"""What a frame tells about its contacts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim import Simulator
from sdfsim.scene.scene import Scene
from sdfsim.shape.shape import analytic_shape
from tests.dynamics.conftest import make_body, random_model

RADIUS = 0.5


def ball_on_floor(height: float) -> Scene:
    turn = Rotation.from_rotvec([0.3, 1.1, -0.4]).as_quat()
    floor = make_body("floor", 1, [0, 0, 0], motion="static", mass=0.0)
    ball = make_body("ball", 0, [0, 0, height], quat_xyzw=turn, velocity=np.array([1.0, 0.0, -3.0]))
    shapes = analytic_shape("sphere", radius=RADIUS), analytic_shape("plane")
    return Scene(shapes, (floor, ball), gravity=np.array([0.0, 0.0, -9.81]), duration=1.0)


@pytest.mark.parametrize("kind", ["impulse", "paper"])
@pytest.mark.parametrize("height", [0.4, 0.49, 0.53])
def test_the_worst_penetration_is_that_of_the_deepest_contact_point(kind, height):
    rollout = Simulator(ball_on_floor(height), model=random_model(kind)).run(steps=4)
    assert rollout.contact_count[1] > 0
    for entry in range(5):
        found = rollout.frames(entry, entry + 1)
        depth = max(0.0, -found.contact_point[:, 2].min(initial=0.0))
        assert found.counters["worst_penetration"][0] == pytest.approx(depth, abs=1e-12)
    assert rollout.counters["worst_penetration"].max() > 0


def test_the_contact_of_a_ball_is_its_lowest_point_when_it_was_found_and_no_node():
    rollout = Simulator(ball_on_floor(0.51), model=random_model("impulse")).run(steps=1)
    before, after = (Rotation.from_quat(rollout.orientation[k, 1]) for k in range(2))
    (point,) = rollout.contact_point
    lowest = before.apply(after.inv().apply(point - rollout.position[1, 1]))
    np.testing.assert_allclose(lowest, [0.0, 0.0, -RADIUS], atol=2e-3 * RADIUS)
