"""Contact frames: told in the step that networks know, with disturbed starts beside the recorded ones."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.data.batching import merged
from sdfsim.data.dataset import Trajectory
from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Units
from sdfsim.errors import SdfsimError
from sdfsim.shape.shape import analytic_shape
from sdfsim.training.contact_cache import STEP, Solved, _disturbed, contact_frames, inner_steps
from tests.recordings import balls, bouncing

ONCE = Solved(draws=1)


def dataset(folder, *trajectories: Trajectory):
    """A dataset of balls with nothing but these to train on."""
    analytic_shape("sphere", radius=0.5, name="ball").save(folder / "shapes" / "ball")
    (folder / "train").mkdir()
    for k, t in enumerate(trajectories):
        t.save(folder / "train" / f"{k}.npz")
    (folder / "dataset.json").write_text('{"recipe": "balls", "seed": 0}')
    return folder


@pytest.mark.parametrize(("dt", "stride"), [(1 / 60, 1), (0.02, 1), (0.04, 1), (0.02, 2)])
def test_another_step_is_another_size_in_the_same_gravity(tmp_path, dt, stride):
    recorded = replace(bouncing(0), dt=dt)
    frames = contact_frames(dataset(tmp_path, recorded), "train", replace(ONCE, stride=stride))
    time = dt * stride / STEP
    length = time**2
    assert len(frames) > 3 and frames.dt == STEP and np.array_equal(frames.gravity, recorded.gravity)
    np.testing.assert_allclose(frames.size, 1.0 / length, rtol=1e-6)
    ratio = (recorded.inertia / recorded.mass[:, None])[np.arange(len(frames.mass)) % 2]  # masses are relative
    np.testing.assert_allclose(frames.inertia / frames.mass[:, None], ratio / length**2, rtol=1e-6)
    now = recorded.velocity[:-stride:stride].reshape(-1, 3) * time / length
    gone = (recorded.position[stride::stride] - recorded.position[:-stride:stride]).reshape(-1, 3)
    for velocity, moved in zip(frames.velocity, frames.moved, strict=True):
        k = np.abs(now - velocity).max(1).argmin()
        np.testing.assert_allclose(velocity, now[k], atol=1e-5)
        np.testing.assert_allclose(moved * STEP * length, gone[k], atol=1e-5)


def test_a_disturbed_start_still_leads_to_the_recorded_end(tmp_path):
    frames = contact_frames(dataset(tmp_path, bouncing(0)), "train", Solved(draws=2, shift=1e-3, speed=0.0))
    exact = frames.end_velocity[: len(frames.end_velocity) // 2]
    found = 0
    for k in range(len(exact), len(frames.end_velocity)):
        same = np.abs(exact - frames.end_velocity[k]).max(1) < 1e-7
        if same.sum() == 1:
            j = int(same.argmax())
            shift = (frames.moved[j] - frames.moved[k]) * STEP  # it has to go so much less
            assert np.linalg.norm(shift) < 6e-3
            found += np.linalg.norm(shift) > 2e-5
    assert found > 5


def test_every_body_is_disturbed_by_a_part_of_the_noise_from_the_least_to_all():
    count, how = 4000, Solved(shift=1.0, speed=10.0, least=0.01)
    shapes = {"ball": analytic_shape("sphere", radius=0.5)}
    start = balls(np.zeros((1, count, 3)) + 3.0 * np.arange(count)[None, :, None])
    bodies, state = merged([start], [0], shapes, Units(1.0, 1.0, 1.0), torch.device("cpu"))
    moved = _disturbed(bodies, state, how, np.random.default_rng(0))
    shift = moved.position - state.position
    assert not shift[-1].any() and not moved.velocity[-1].any()  # the floor's
    draws = torch.cat([shift, (moved.velocity - state.velocity) / 10.0], -1)[:-1]
    size = draws.square().mean(-1).sqrt().numpy()
    # The logarithm of a part is uniform, so of 4,000 a quarter is in each fourth of its range, but for chi^2 of draws.
    share = np.histogram(np.log(size) / np.log(how.least), bins=[-1.0, 0.25, 0.5, 0.75, 2.0])[0] / count
    np.testing.assert_allclose(share, 0.25, atol=0.05)
    # Turns move the surface, half a metre away, by as much.
    turned = pose.to_rotvec(pose.multiply(moved.orientation, pose.conjugate(state.orientation)))[:-1]
    assert 0.5 < float((0.5 * turned).abs().median() / shift[:-1].abs().median()) < 1.5


def test_a_folder_with_nothing_but_its_frames_can_be_trained_on(tmp_path):
    made = contact_frames(dataset(tmp_path / "all", bouncing(0)), "train", ONCE)
    (tmp_path / "bare").mkdir()
    (tmp_path / "all" / "frames").rename(tmp_path / "bare" / "frames")
    assert contact_frames(tmp_path / "bare", "train", ONCE).digest() == made.digest()


def test_the_engines_inner_steps_are_counted():
    assert inner_steps(0.02, 0.004) == 5
    assert inner_steps(1 / 60, 1 / 240) == 4
    assert inner_steps(0.1, 0.0) == 5  # not told
    with pytest.raises(SdfsimError, match="hold 20 inner"):
        inner_steps(0.08, 0.004)


def test_errors_at_a_frame_are_those_of_that_frame_alone():
    from sdfsim.evaluation.metrics import errors

    truth = balls(np.zeros((26, 2, 3)))
    other = np.zeros((26, 2, 3))
    other[25, 0, 0], other[10, 1, 0] = 0.3, 7.0
    found = errors([replace(truth, position=other), truth], [truth, truth])["25"]
    assert found["at_frame"]["translation_rmse"] == pytest.approx(0.5 * 0.3 / 2**0.5)
    assert found["translation_rmse"] == pytest.approx(((0.3**2 + 7.0**2) / (25 * 4)) ** 0.5)
    assert found["at_frame"]["rotation_error"] == 0.0
