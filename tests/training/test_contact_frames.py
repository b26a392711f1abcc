"""Contact frames: told in the step that networks know, with disturbed starts beside the recorded ones."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.data.dataset import Trajectory
from sdfsim.shape.make import analytic_shape
from sdfsim.training.contact_frames import STEP, Disturbed, contact_frames, join_frames
from sdfsim.training.impulse_task import ImpulseTask
from tests.helpers.recordings import bouncing, slab_data, sliding

ONCE = Disturbed(draws=1)


def dataset(folder, *trajectories: Trajectory):
    """A dataset of balls with nothing but these to train on."""
    analytic_shape("sphere", radius=0.5, name="ball").save(folder / "shapes" / "ball")
    (folder / "train").mkdir()
    for k, t in enumerate(trajectories):
        t.save(folder / "train" / f"{k}.npz")
    (folder / "dataset.json").write_text('{"recipe": "balls", "seed": 0}')
    return folder


@pytest.mark.parametrize("dt", [1 / 60, 0.02, 0.04])
def test_another_step_is_another_size_in_the_same_gravity(tmp_path, dt):
    recorded = replace(bouncing(0), dt=dt)
    frames = contact_frames(dataset(tmp_path, recorded), "train", ONCE)
    time = dt / STEP
    length = time**2
    assert len(frames) > 3 and np.array_equal(frames.gravity, recorded.gravity)
    np.testing.assert_allclose(frames.size, 1.0 / length, rtol=1e-6)
    ratio = (recorded.inertia / recorded.mass[:, None])[np.arange(len(frames.mass)) % 2]  # masses are relative
    turning = frames.bodies["inverse_inertia"].diagonal(axis1=1, axis2=2)
    np.testing.assert_allclose(frames.bodies["inverse_mass"][:, None] / turning, ratio / length**2, rtol=1e-6)
    now = recorded.velocity[:-1].reshape(-1, 3) * time / length
    gone = np.diff(recorded.position, axis=0).reshape(-1, 3)
    for velocity, moved in zip(frames.bodies["velocity"], frames.truth["mean_velocity"], strict=True):
        k = np.abs(now - velocity).max(1).argmin()
        np.testing.assert_allclose(velocity, now[k], atol=1e-5)
        np.testing.assert_allclose(moved * STEP * length, gone[k], atol=1e-5)


def test_a_disturbed_start_still_leads_to_the_recorded_end(tmp_path):
    frames = contact_frames(dataset(tmp_path, bouncing(0)), "train", Disturbed(draws=2, shift=1e-3, speed=0.0))
    ended, moved = (frames.truth[name] for name in ("velocity", "mean_velocity"))
    exact = ended[: len(ended) // 2]
    found = 0
    for k in range(len(exact), len(ended)):
        same = np.abs(exact - ended[k]).max(1) < 1e-7
        if same.sum() == 1:
            j = int(same.argmax())
            shift = (moved[j] - moved[k]) * STEP  # it has to go so much less
            assert np.linalg.norm(shift) < 6e-3
            found += np.linalg.norm(shift) > 2e-5
    assert found > 5


@pytest.mark.parametrize("floor", [(0.05, 0.2), (0.2, 0.7)])
def test_frames_and_ranges_are_those_of_the_floor_of_dataset_json(tmp_path, floor):
    told = {"engine": "mine", "floor": {"friction": floor[0], "restitution": floor[1]}}
    frames = contact_frames(slab_data(tmp_path, "train", sliding(floor[0]), told), "train", ONCE)
    assert len(frames) == 39
    slower = frames.bodies["velocity"][:, 0] - frames.truth["velocity"][:, 0]
    np.testing.assert_allclose(slower, 10.0 * floor[0] * 0.02, rtol=1e-3)
    task = ImpulseTask(frames)
    graph = task.batch(np.arange(5)).graph
    torch.testing.assert_close(graph.friction, torch.full_like(graph.friction, floor[0]))
    torch.testing.assert_close(graph.restitution, torch.full_like(graph.restitution, floor[1]))
    for name, own in zip(("friction", "restitution"), floor, strict=True):  # the slab's are 1
        assert task.ranges()[name] == pytest.approx([own, 1.0])


def test_sets_of_several_floors_keep_each_its_own(tmp_path):
    sets = []
    for name, friction in (("ice", 0.02), ("rubber", 0.9)):
        (tmp_path / name).mkdir()
        told = {"engine": "mine", "floor": {"friction": friction, "restitution": 0.3}}
        sets.append(contact_frames(slab_data(tmp_path / name, "train", sliding(friction), told), "train", ONCE))
    whole = join_frames(sets)
    task = ImpulseTask(whole)
    picked = np.array([3, len(sets[0]) + 2])
    edges = np.diff(whole.edge_start)[picked]
    found = task.batch(picked).graph.friction.numpy()
    np.testing.assert_allclose(found, np.repeat([0.02, 0.9], edges))
    assert task.ranges()["friction"] == pytest.approx([0.02, 1.0])


def test_frames_are_made_anew_when_the_floor_is_another_one(tmp_path):
    data = slab_data(tmp_path, "train", sliding(0.2), {"engine": "mine", "floor": {"friction": 0.2, "restitution": 0}})
    one = contact_frames(data, "train", ONCE)
    (data / "dataset.json").write_text('{"engine": "mine", "floor": {"friction": 0.4, "restitution": 0}}')
    assert contact_frames(data, "train", ONCE).digest() != one.digest()
