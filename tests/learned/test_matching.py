"""Shape matching recovers the motion that made the points, and is a rotation whatever the points are."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sdfsim.learned.surfaces import match_shapes
from sdfsim.physics.pose import to_matrix

UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


def matched(rest, moved, start=UPRIGHT, owner=None, dtype=torch.float64) -> tuple[np.ndarray, np.ndarray]:
    """Poses of the bodies that `start` [N, 4] or [4] is of."""
    start = np.atleast_2d(start)
    owner = np.zeros(len(rest), dtype=np.int64) if owner is None else owner
    arrays = (torch.tensor(rest, dtype=dtype), torch.tensor(moved, dtype=dtype), torch.from_numpy(owner))
    position, orientation = match_shapes(*arrays, torch.tensor(start, dtype=dtype))
    return position.double().numpy(), orientation.double().numpy()


def apart(one: np.ndarray, other: Rotation) -> float:
    return float((Rotation.from_quat(one) * other.inv()).magnitude().max())


@pytest.mark.parametrize(("dtype", "exact"), [(torch.float64, 1e-7), (torch.float32, 2e-5)], ids=["double", "single"])
@pytest.mark.parametrize(
    "flatten", [[1, 1, 1], [1, 1, 0], [1, 1, 1e-3], [1, 1e-2, 1e-2], [0, 1, 1]], ids=lambda f: "x".join(map(str, f))
)
def test_rigid_motion_is_recovered(flatten, dtype, exact):
    rng = np.random.default_rng(3)
    rest = rng.normal(size=(60, 3)) * flatten
    owner = np.repeat([0, 1, 2], 20)
    turns, shift = Rotation.random(3, random_state=4), rng.normal(size=(3, 3))
    moved = np.concatenate([turns[k].apply(rest[owner == k]) + shift[k] for k in range(3)])
    position, quat = matched(rest, moved, np.tile(UPRIGHT, (3, 1)), owner, dtype)
    np.testing.assert_allclose(position, shift, atol=exact)
    # Single precision sees the turn about a needle's line in its thickness alone.
    assert apart(quat, turns) < exact / min(f for f in flatten if f)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0, 1, 2, 3]), st.sampled_from([1e-6, 1.0, 1e6]))
def test_no_turn_fits_better_and_it_is_never_a_reflection(seed, rank, size):
    """Against any target, noise included: a proper rotation, and as good as the best of the singular values."""
    rng = np.random.default_rng(seed)
    rest = size * rng.normal(size=(9, 3)) * (np.arange(3) < rank)
    moved = rng.normal(size=(9, 3)) * size
    _, quat = matched(rest, moved)
    turn = to_matrix(quat)[0]
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    spread = (moved - moved.mean(0)).T @ (rest - rest.mean(0))
    u, s, vt = np.linalg.svd(spread)
    best = s[0] + s[1] + np.sign(np.linalg.det(u @ vt)) * s[2]
    assert np.trace(turn.T @ spread) == pytest.approx(best, rel=1e-9, abs=1e-9 * s.sum() + 1e-300)


def test_a_mirror_image_still_gives_a_rotation():
    rest = np.random.default_rng(5).normal(size=(30, 3))
    _, quat = matched(rest, rest * [-1.0, 1.0, 1.0])
    assert np.linalg.det(Rotation.from_quat(quat).as_matrix()[0]) == pytest.approx(1.0)


@pytest.mark.parametrize("nodes", [1, 5], ids=["one node", "collinear"])
def test_a_turn_that_the_nodes_leave_open_stays_as_it_was(nodes):
    rest = np.linspace(0, 1, nodes)[:, None] * [1.0, 2.0, -0.5]
    before = Rotation.random(random_state=1)
    position, quat = matched(rest, before.apply(rest) + 3.0, before.as_quat())
    assert apart(quat, before) < 1e-3
    np.testing.assert_allclose(position[0], 3.0, atol=1e-2)
    # Swung by a little, a line takes the shortest way: no twist about itself.
    swing = Rotation.from_rotvec([0.0, 0.02, 0.08])
    _, quat = matched(rest, (swing * before).apply(rest), before.as_quat())
    line = before.apply(rest[-1])
    twist = (Rotation.from_quat(quat[0]) * before.inv()).as_rotvec() @ line / max(np.linalg.norm(line), 1e-9)
    assert abs(twist) < 1e-3


def test_staying_does_not_pull_on_a_needle():
    """What keeps open turns from spinning must not be felt where the nodes decide, however little they are spread."""
    rest = np.random.default_rng(2).normal(size=(40, 3)) * [1.0, 1e-3, 1e-3]
    twist = Rotation.from_rotvec([0.5, 0.0, 0.0])
    _, quat = matched(rest, twist.apply(rest))
    assert apart(quat, twist) < 1e-5


def test_a_node_that_is_not_finite_spoils_its_own_body_only():
    rest = np.random.default_rng(5).normal(size=(20, 3))
    moved = rest.copy()
    moved[3, 1] = np.nan
    position, quat = matched(rest, moved, np.tile(UPRIGHT, (2, 1)), np.repeat([0, 1], 10))
    assert np.isnan(quat[0]).all() and np.isnan(position[0]).any()
    assert apart(quat[1:], Rotation.identity(1)) < 1e-7
