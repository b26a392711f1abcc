"""Quaternions against scipy's rotations, an independent implementation: those in NumPy, and those in torch."""

from types import ModuleType

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sdfsim.learned import pose as in_torch
from sdfsim.physics import pose as in_numpy

A, B = Rotation.random(50, random_state=1), Rotation.random(50, random_state=2)


class Functions:
    """The functions of a module, called with NumPy arrays and answering with them, whatever it works on."""

    def __init__(self, module: ModuleType) -> None:
        self.module = module

    def __getattr__(self, name: str):
        function = getattr(self.module, name)
        if self.module is in_numpy:
            return function
        return lambda *arrays: function(*map(torch.tensor, arrays)).numpy()


@pytest.fixture(params=[in_numpy, in_torch], ids=["numpy", "torch"])
def pose(request) -> Functions:
    return Functions(request.param)


def same(got: np.ndarray, rotation: Rotation) -> None:
    assert got.dtype == np.float64
    angle = (Rotation.from_quat(got) * rotation.inv()).magnitude()
    assert angle.max() < 1e-12


def test_product_inverse_and_matrix(pose):
    same(pose.multiply(A.as_quat(), B.as_quat()), A * B)
    same(pose.conjugate(A.as_quat()), A.inv())
    np.testing.assert_allclose(pose.to_matrix(A.as_quat()), A.as_matrix(), atol=1e-14)


def test_what_is_long_is_made_a_unit():
    long = A.as_quat() * np.random.default_rng(1).uniform(0.1, 10.0, (50, 1))
    np.testing.assert_allclose(in_numpy.normalise(long), A.as_quat(), atol=1e-15)


def test_rotating_vectors(pose):
    v = np.random.default_rng(0).normal(size=(50, 3))
    np.testing.assert_allclose(pose.rotate(A.as_quat(), v), A.apply(v), atol=1e-13)


def test_rotation_vectors_round_trip_from_tiny_to_large(pose):
    rng = np.random.default_rng(0)
    for size in (0.0, 1e-14, 1e-8, 1e-3, 1.0, 3.1):
        vector = rng.normal(size=(20, 3))
        vector *= size / np.linalg.norm(vector, axis=1, keepdims=True)
        turn = in_numpy.from_rotvec(vector)
        same(turn, Rotation.from_rotvec(vector))
        np.testing.assert_allclose(pose.to_rotvec(turn), vector, rtol=1e-7, atol=1e-20)
        # Of the two quaternions of a rotation either tells the shorter way.
        np.testing.assert_allclose(pose.to_rotvec(-turn), vector, rtol=1e-7, atol=1e-20)


def test_a_quaternion_of_a_matrix():
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3))
    for rotation in (A, half_turns, Rotation.identity(2)):
        same(in_numpy.from_matrix(rotation.as_matrix()), rotation)
