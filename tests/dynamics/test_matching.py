"""Shape matching recovers the motion that made the points."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sdfsim.dynamics.matching import match_shapes


@pytest.mark.parametrize("flatten", [1.0, 0.0], ids=["solid", "coplanar"])
def test_rigid_motion_is_recovered(flatten):
    rng = np.random.default_rng(3)
    rest = rng.normal(size=(60, 3)) * [1.0, 1.0, flatten]
    owner = np.repeat([0, 1, 2], 20)
    turns, shift = Rotation.random(3, random_state=4), rng.normal(size=(3, 3))
    moved = np.concatenate([turns[k].apply(rest[owner == k]) + shift[k] for k in range(3)])
    position, quat = match_shapes(torch.from_numpy(rest), torch.from_numpy(moved), torch.from_numpy(owner), 3)
    np.testing.assert_allclose(position.numpy(), shift, atol=1e-12)
    assert (Rotation.from_quat(quat.numpy()) * turns.inv()).magnitude().max() < 1e-7


def test_noisy_reflection_still_gives_a_rotation():
    rng = np.random.default_rng(5)
    rest = torch.from_numpy(rng.normal(size=(30, 3)))
    mirrored = rest * torch.tensor([-1.0, 1.0, 1.0])
    _, quat = match_shapes(rest, mirrored, torch.zeros(30, dtype=torch.int64), 1)
    assert np.linalg.det(Rotation.from_quat(quat.numpy()).as_matrix()[0]) == pytest.approx(1.0)
