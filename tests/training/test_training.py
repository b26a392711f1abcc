"""Training on a handful of recorded steps: it learns, it resumes to the bit, it leaves no pickle."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.data.batching import merged
from sdfsim.data.dataset import Trajectory, load_shapes
from sdfsim.learned.contact_graph import OF_BODIES, OF_EDGES, REST_SPEED
from sdfsim.learned.impulse import Velocities
from sdfsim.learned.inference import step_graph
from sdfsim.learned.model import load_model
from sdfsim.physics.bodies import Units
from sdfsim.physics.free_flight import fly
from sdfsim.physics.options import Options
from sdfsim.physics.solver.prepare import Compiled, points_near
from sdfsim.training import train as train_module
from sdfsim.training.contact_frames import Disturbed, contact_frames, join_frames
from sdfsim.training.impulse_task import ImpulseTask
from sdfsim.training.presets import PRESETS
from sdfsim.training.run import Run, held_out_loss
from sdfsim.training.surface_task import SurfaceTask
from sdfsim.training.train import train
from tests.helpers.scenes import in_torch

CPU = torch.device("cpu")
SDF_SIM = PRESETS["sdf-sim"]
ONCE = Disturbed(draws=1)


def test_cached_frames_equal_the_simulators_own_graph(ball_data, tmp_path):
    """A batch drawn from the cache is the graph that a step would build from the recorded state."""
    (tmp_path / "train").mkdir()
    for name in ("shapes", "train/0.npz"):
        (tmp_path / name).symlink_to(ball_data / name)
    task = ImpulseTask(contact_frames(tmp_path, "train", ONCE))
    first, shapes = Trajectory.load(ball_data / "train" / "0.npz"), load_shapes(ball_data, {"ball"})
    bodies, start = merged([first], [0], shapes, Units(1.0, 1.0, 1.0))
    options, scene, found = Options(first.gravity, first.dt), Compiled(bodies, start), []
    for frame in range(len(first.position) - 1):
        _, state = merged([first], [frame], shapes, Units(1.0, 1.0, 1.0))
        edges = points_near(scene, state, options)
        if len(edges[0]):
            free, rows = fly(bodies, state, options), np.arange(len(bodies))
            found.append(step_graph(bodies, state, free, edges, options, first.dt, rows))
    assert len(found) > 5
    for k, graph in enumerate(found):
        batch = task.batch(np.array([k])).graph
        for name in (*OF_BODIES[2:], *OF_EDGES):  # masses are relative to another body's
            ours, theirs = getattr(batch, name), getattr(graph, name)
            if name in OF_BODIES:
                ours, theirs = ours[batch.first], theirs[graph.first]
            torch.testing.assert_close(ours, theirs.float(), rtol=1e-5, atol=1e-5)


def test_perfect_predictions_have_no_loss_and_free_flight_has(ball_data):
    task = ImpulseTask(contact_frames(ball_data, "validation", ONCE))
    batch = task.draw(np.random.default_rng(0), 8)
    assert float(task.loss(lambda graph, mirrored: batch.truth, batch)) == 0.0

    def flying(g, mirrored):
        return Velocities(g.free_velocity, g.free_angular, g.mean_velocity, g.mean_angular)

    assert float(task.loss(flying, batch)) > 0.1 * REST_SPEED


@pytest.mark.parametrize("preset", ["tiny", "tiny-sdf-sim"])
def test_it_learns_and_the_model_file_gives_the_same_network(ball_data, presets, preset, tmp_path):
    place = tmp_path / "run"
    plan = train_module.PRESETS[preset]
    task, held_out = train_module._tasks(plan, [ball_data], lambda f, m: None)
    before = held_out_loss(Run(plan, task, plan.steps, 0, CPU), held_out, batches=2)
    report = train(ball_data, place, preset=preset)
    assert report["held_out_loss"] < 0.7 * before
    model = load_model(place / "model.safetensors")
    assert model.kind == plan.kind and model.dt == pytest.approx(0.02) and model.gravity == pytest.approx(10.0)
    assert model.ranges["restitution"][0] == pytest.approx(0.3 * 0.3)
    assert not list(place.glob("*.part")) and (place / "log.jsonl").exists()


def test_an_interrupted_run_resumes_to_the_bit(ball_data, presets, tmp_path, monkeypatch):
    train(ball_data, tmp_path / "whole", preset="tiny", steps=60)

    def interrupted(self):
        if self.step == 30:
            raise KeyboardInterrupt
        original(self)

    original = Run.advance
    monkeypatch.setattr(Run, "advance", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(ball_data, tmp_path / "halves", preset="tiny", steps=60)
    monkeypatch.setattr(Run, "advance", original)
    with pytest.raises(SdfsimError, match="exists"):
        train(ball_data, tmp_path / "halves", preset="tiny", steps=60)
    train(ball_data, tmp_path / "halves", preset="tiny", steps=60, resume=True)
    one, other = (load_model(tmp_path / k / "model.safetensors").network.state_dict() for k in ("whole", "halves"))
    assert all(torch.equal(one[k], other[k]) for k in one)


def test_a_checkpoint_of_another_run_is_refused(ball_data, presets, tmp_path):
    train(ball_data, tmp_path, preset="tiny", steps=5)
    with pytest.raises(SdfsimError, match=r"checkpoint\.npz .*\bpreset\b"):
        train(ball_data, tmp_path, preset="tiny", steps=6, resume=True)


def test_paper_targets_lead_exactly_to_the_recorded_pose(ball_data):
    """Advancing by the target acceleration lands on the next recorded frame, noise or not."""
    from sdfsim.learned.surfaces import advance, target_acceleration

    t = Trajectory.load(ball_data / "train" / "0.npz")
    bodies, state = merged([t], [5], load_shapes(ball_data, {"ball"}), Units(1.0, 1.0, 1.0))

    def pose_at(k):
        _, s = merged([t], [k], load_shapes(ball_data, {"ball"}), Units(1.0, 1.0, 1.0))
        return s.position, s.orientation

    before, after = [pose_at(k) for k in (3, 4)], pose_at(6)
    shifted = before[1][0] + 0.01
    state = replace(
        state,
        earlier_position=np.stack([before[0][0], shifted]),
        earlier_orientation=np.stack([before[0][1], before[1][1]]),
    )
    bodies, state = in_torch(bodies, state)
    landed = advance(bodies, state, target_acceleration(bodies, state, *map(torch.from_numpy, after)), t.dt)
    np.testing.assert_allclose(landed.position, after[0], rtol=0, atol=1e-12)
    assert SurfaceTask(ball_data, "train", SDF_SIM, noisy=True).dt == t.dt


def test_an_unreadable_frame_cache_is_named(ball_data):
    contact_frames(ball_data, "validation", ONCE)
    cached = next((ball_data / "frames").glob("validation-*.npz"))
    content = cached.read_bytes()
    cached.write_bytes(content[:100])
    with pytest.raises(SdfsimError, match="contact frames"):
        contact_frames(ball_data, "validation", ONCE)
    cached.write_bytes(content)


def test_joined_frames_are_the_frames_of_both(ball_data):
    one, two = (contact_frames(ball_data, split, ONCE) for split in ("train", "validation"))
    joined = join_frames([one, two])
    assert len(joined) == len(one) + len(two)
    task, alone = ImpulseTask(joined), ImpulseTask(two)
    for k in (0, len(two) - 1):
        ours, theirs = task.batch(np.array([len(one) + k])), alone.batch(np.array([k]))
        for name in ("velocity", "gap", "arm_second", "first"):
            torch.testing.assert_close(getattr(ours.graph, name), getattr(theirs.graph, name), rtol=0, atol=0)


def test_frames_of_another_gravity_cannot_be_joined(ball_data):
    frames = contact_frames(ball_data, "train", ONCE)
    with pytest.raises(SdfsimError, match="gravity"):
        join_frames([frames, replace(frames, gravity=0.5 * frames.gravity)])


@pytest.mark.parametrize("steps", [0, -5])
def test_steps_that_are_none_are_refused(ball_data, presets, tmp_path, steps):
    with pytest.raises(SdfsimError, match=r"^steps: .*\b1\b"):
        train(ball_data, tmp_path / "run", preset="tiny", steps=steps)
