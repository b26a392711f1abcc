"""Quaternions against scipy's rotations, an independent implementation."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from sdfsim.physics import pose

RNG = np.random.default_rng(0)
A, B = Rotation.random(50, random_state=1), Rotation.random(50, random_state=2)


def quat(rotation: Rotation) -> torch.Tensor:
    return torch.from_numpy(rotation.as_quat())


def same(got: torch.Tensor, rotation: Rotation) -> None:
    angle = (Rotation.from_quat(got.numpy()) * rotation.inv()).magnitude()
    assert angle.max() < 1e-12


def test_product_inverse_and_matrix():
    same(pose.multiply(quat(A), quat(B)), A * B)
    same(pose.conjugate(quat(A)), A.inv())
    np.testing.assert_allclose(pose.to_matrix(quat(A)).numpy(), A.as_matrix(), atol=1e-14)


def test_rotating_vectors():
    v = RNG.normal(size=(50, 3))
    np.testing.assert_allclose(pose.rotate(quat(A), torch.from_numpy(v)).numpy(), A.apply(v), atol=1e-13)


def test_rotation_vectors_round_trip_from_tiny_to_large():
    for size in (0.0, 1e-14, 1e-8, 1e-3, 1.0, 3.1):
        vector = RNG.normal(size=(20, 3))
        vector *= size / np.linalg.norm(vector, axis=1, keepdims=True)
        back = pose.to_rotvec(pose.from_rotvec(torch.from_numpy(vector))).numpy()
        np.testing.assert_allclose(back, vector, rtol=1e-7, atol=1e-20)
