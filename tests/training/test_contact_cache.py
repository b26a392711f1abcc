"""Contact frames of recordings of any step are told in the one that networks know."""

from dataclasses import replace

import numpy as np
import pytest

from sdfsim.errors import SdfsimError
from sdfsim.training.contact_cache import STEP, in_steps_of, inner_steps
from tests.recordings import balls


@pytest.mark.parametrize("dt", [1 / 60, 0.02, 0.04])
def test_another_step_is_another_size_in_the_same_gravity(dt):
    time = np.arange(20) * dt
    position = np.zeros((20, 1, 3))
    position[:, 0, 2] = 3.0 + 2.0 * time - 5.0 * time**2
    velocity = np.gradient(position, dt, axis=0)
    flight = balls(position, velocity=velocity, angular_velocity=np.ones_like(velocity), dt=dt)
    told = in_steps_of(flight, STEP)
    fall = np.diff(told.position[:, 0, 2], n=2)
    np.testing.assert_allclose(fall, -10.0 * STEP**2, rtol=1e-9)
    np.testing.assert_allclose(told.velocity[1:-1], np.gradient(told.position, STEP, axis=0)[1:-1], atol=1e-9)
    # What turns and how far a body is from its own size away are the same.
    np.testing.assert_allclose(told.angular_velocity * told.dt, flight.angular_velocity * flight.dt)
    np.testing.assert_allclose(told.position / told.scale[0], flight.position / flight.scale[0])
    np.testing.assert_allclose(told.inertia / told.scale[0] ** 2, flight.inertia / flight.scale[0] ** 2)
    np.testing.assert_allclose(told.velocity / told.scale[0] ** 0.5, flight.velocity / flight.scale[0] ** 0.5)
    assert told.dt == STEP and np.array_equal(told.gravity, flight.gravity)


def test_the_engines_inner_steps_are_counted():
    assert inner_steps(0.02, 0.004) == 5
    assert inner_steps(1 / 60, 1 / 240) == 4
    assert inner_steps(0.1, 0.0) == 5  # not told
    with pytest.raises(SdfsimError, match="hold 20 inner"):
        inner_steps(0.08, 0.004)


def test_errors_at_a_frame_are_those_of_that_frame_alone():
    from sdfsim.evaluation.evaluate import errors

    truth = balls(np.zeros((31, 2, 3)))
    other = np.zeros((31, 2, 3))
    other[25, 0, 0], other[10, 1, 0] = 0.3, 7.0
    found = errors([replace(truth, position=other), truth], [truth, truth])["25"]
    assert found["at_frame"]["translation_rmse"] == pytest.approx(0.5 * 0.3 / 2**0.5)
    assert found["translation_rmse"] == pytest.approx(((0.3**2 + 7.0**2) / (25 * 4)) ** 0.5)
    assert found["at_frame"]["rotation_error"] == 0.0
