"""The reported errors against numbers that can be worked out by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim.learning.metrics import interval, rotation_error, translation_rmse


def test_translation_rmse_of_a_constant_offset_is_its_length():
    truth = np.random.default_rng(0).normal(size=(7, 3, 3))
    assert translation_rmse(truth + np.array([3.0, 4.0, 0.0]), truth) == pytest.approx(5.0)


def test_rotation_error_is_the_mean_angle_and_ignores_the_quaternions_sign():
    truth = Rotation.random(12, random_state=0)
    turn = Rotation.from_rotvec(np.repeat([[0.0, 0.0, np.radians(10)], [np.radians(30), 0.0, 0.0]], 6, axis=0))
    quat = (truth * turn).as_quat().reshape(6, 2, 4)
    assert rotation_error(-quat, truth.as_quat().reshape(6, 2, 4)) == pytest.approx(20.0)


def test_interval_covers_the_mean_and_shrinks_with_more_data():
    values = np.random.default_rng(1).normal(2.0, 1.0, size=400)
    low, high = interval(values)
    assert low < values.mean() < high
    few = interval(values[:25])
    assert high - low < 0.5 * (few[1] - few[0])
