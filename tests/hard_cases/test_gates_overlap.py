"""Row 11: bodies that start inside each other part, from coincident centres too, and nothing explodes."""

import numpy as np
import pytest

from sdfsim.simulate.simulator import Simulator
from tests.hard_cases import gates

SHAPES = {"ball": gates.BALL, "cube": gates.CUBE}
EXIT = 3.0  # m/s, for bodies of about a metre


@pytest.mark.parametrize("offset", [0.0, 0.5], ids=["coincident", "50 %"])
@pytest.mark.parametrize("shape", SHAPES)
def test_two_bodies_part(every_model, shape, offset):
    scene = gates.placed(SHAPES[shape], [(0, 0, 0), (0.8 * offset, 0.6 * offset, 0)])
    rollout = Simulator(scene, every_model).run(seconds=1.3)
    gates.assert_sound(rollout)
    away = np.linalg.norm(rollout.position[:, 1] - rollout.position[:, 0], axis=-1)
    assert away[-1] > offset + 0.1  # how far is a quality of the model: cubes half in each other end at 0.64 m
    assert np.linalg.norm(rollout.velocity, axis=-1).max() < EXIT
    # Equal and opposite: their common centre stays.
    assert np.abs(rollout.position.mean(1) - rollout.position[0].mean(0)).max() < 1e-3


@pytest.mark.parametrize("shape", SHAPES)
def test_a_body_half_in_the_floor_comes_up(model, shape):
    rollout = Simulator(gates.placed(SHAPES[shape], [(0, 0, 0.0)], floor=True), model).run(seconds=1.3)
    gates.assert_sound(rollout)
    assert rollout.position[-1, 0, 2] > 0.2 and np.linalg.norm(rollout.velocity, axis=-1).max() < EXIT


def test_a_heap_of_overlapping_cubes_comes_apart_and_stays_together(model):
    """Without the limit on what contact may add in a step this ends, in the fourth step, with 6,000 rad/s."""
    rollout = Simulator(gates.heap(), model).run(steps=60)
    gates.assert_sound(rollout)
    assert np.linalg.norm(rollout.velocity, axis=-1).max() < 15.0 and np.abs(rollout.position).max() < 20.0
    assert rollout.position[-1, :27, 2].min() > 0.2  # the floor holds them
