"""What is reported against numbers that can be worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim.evaluation.metrics import compared, energy, energy_gain, resting, speeds, survival
from tests.helpers.recordings import balls


def test_translation_rmse_of_a_constant_offset_is_its_length():
    truth = balls(np.random.default_rng(0).normal(size=(7, 3, 3)))
    moved = replace(truth, position=truth.position + np.array([3.0, 4.0, 0.0]))
    assert compared(moved, truth, slice(None))[0] == pytest.approx(5.0)


def test_rotation_error_is_the_mean_angle_and_ignores_the_quaternions_sign():
    truth = Rotation.random(12, rng=np.random.default_rng(0))
    turn = Rotation.from_rotvec(np.repeat([[0.0, 0.0, np.radians(10)], [np.radians(30), 0.0, 0.0]], 6, axis=0))
    recorded, turned = (
        balls(np.zeros((6, 2, 3)), orientation=sign * turns.as_quat().reshape(6, 2, 4))
        for sign, turns in ((1.0, truth), (-1.0, truth * turn))
    )
    assert compared(turned, recorded, slice(None))[1] == pytest.approx(20.0)


def flight(seconds: float = 1.0, **fields):
    """A ball thrown from 20 m along an exact parabola, spinning."""
    time = np.arange(0.0, seconds, 0.02)[:, None, None]
    start, gravity = np.array([1.0, 2.0, -3.0]), np.array([0.0, 0.0, -10.0])
    position = np.array([0.0, 0.0, 20.0]) + start * time + 0.5 * gravity * time**2
    spin = np.tile([1.0, -2.0, 3.0], (len(time), 1, 1))
    return balls(position, velocity=start + gravity * time, angular_velocity=spin, **fields)


def test_the_energy_of_a_flying_body_is_constant_and_is_what_it_should_be():
    course = energy(flight(mass=np.array([2.0])))
    np.testing.assert_allclose(course, 0.5 * 2.0 * 14.0 + 0.5 * 0.1 * 14.0 + 2.0 * 10.0 * 20.0, rtol=1e-12)
    assert energy_gain([flight()])["worst"] == pytest.approx(0.0, abs=1e-12)


def test_spin_is_taken_about_the_bodys_own_axes():
    quarter = Rotation.from_euler("x", 90, degrees=True).as_quat()  # the body's z axis becomes the world's -y axis
    turned = balls(np.zeros((2, 1, 3)), orientation=np.tile(quarter, (2, 1, 1)), inertia=np.array([[1.0, 2.0, 3.0]]))
    turned = replace(turned, angular_velocity=np.tile([0.0, 4.0, 0.0], (2, 1, 1)))
    np.testing.assert_allclose(energy(turned), 0.5 * 3.0 * 16.0)


def test_a_springs_push_is_the_gain_and_scenery_has_no_part_in_it():
    """1 kg at rest 2 m up has 20 J; 3 m/s more are 4.5 J. The static body is heavy, and would drown that."""
    still = balls(np.tile([[0.0, 0.0, 2.0], [5.0, 0.0, 3.0]], (6, 1, 1)), static=np.array([False, True]))
    still = replace(still, mass=np.array([1.0, 1e6]))
    velocity = still.velocity.copy()
    velocity[3:, 0] = [3.0, 0.0, 0.0]
    velocity[5, 0] = 0.0
    found = energy_gain([replace(still, velocity=velocity), still, replace(still, position=0.0 * still.position)])
    assert found == {"mean": pytest.approx(4.5 / 40.0), "worst": pytest.approx(4.5 / 20.0)}
    assert energy_gain([replace(still, position=0.0 * still.position)]) == {"mean": None, "worst": None}


def test_what_rests_is_reported_by_displacement_in_the_last_steps():
    """Ball 0 creeps at 0.02 m/s, 1 stops only in the end, 2 is scenery; recorded velocities say nothing of it."""
    step = np.zeros((30, 3, 3))
    step[:, 0, 0] = 0.02 * 0.02
    step[:-5, 1, 1] = 0.1 * 0.02
    motion = balls(np.cumsum(step, axis=0), static=np.array([False, False, True]))
    np.testing.assert_allclose(speeds(motion)[:, 0], 0.02)
    assert speeds(motion).shape == (10, 3) and resting(motion).tolist() == [True, False, False]


def test_survivors_are_those_that_have_never_left():
    """Three of four leave 0.25 m, at frames 2, 4 and 6; one of them comes back, and stays lost."""
    truth, error = balls(np.zeros((8, 4, 3))), np.zeros((8, 4, 3))
    error[2, 0, 0], error[4:, 1, 1], error[6:, 2, 2] = 0.3, 0.25, 0.4
    found = survival([balls(error)], [truth])
    assert found == {"0.1": pytest.approx(0.12), "0.25": pytest.approx(0.12), "0.5": None}
