"""Training on a handful of recorded steps: it learns, it resumes to the bit, it leaves no pickle."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.data.batching import merged
from sdfsim.dynamics.bodies import Units
from sdfsim.dynamics.contacts import find_contacts
from sdfsim.dynamics.graph import REST_SPEED
from sdfsim.dynamics.impulse import Velocities
from sdfsim.dynamics.model import load_model
from sdfsim.dynamics.step import Rules, contact_graph, fly
from sdfsim.errors import SdfsimError
from sdfsim.evaluation.evaluate import evaluate
from sdfsim.training import contact_cache, validation
from sdfsim.training import train as train_module
from sdfsim.training.contact_cache import contact_frames, join_frames
from sdfsim.training.distributed import ALONE
from sdfsim.training.impulse_task import ImpulseTask, Noise
from sdfsim.training.paper_task import PaperTask
from sdfsim.training.run import Run, held_out_loss
from sdfsim.training.train import train

CPU = torch.device("cpu")


def test_cached_frames_equal_the_simulators_own_graph(ball_data):
    """A batch drawn from the cache is the graph that a step would build from the recorded state."""
    from sdfsim.data.dataset import Trajectory, load_shapes

    cached = contact_frames(ball_data, "train", 0.1)
    first = Trajectory.load(ball_data / "train" / "0.npz")
    shapes = load_shapes(ball_data, {"ball"})
    bodies, _ = merged([first], [0], shapes, Units(1.0, 1.0, 1.0), CPU)
    rules = Rules(gravity=torch.tensor(first.gravity), dt=first.dt)
    found = []
    for frame in range(len(first.position) - 1):
        _, state = merged([first], [frame], shapes, Units(1.0, 1.0, 1.0), CPU)
        contacts = find_contacts(bodies, state, rules.gravity, 0.1, first.dt, thin=True, rounded=False)
        if len(contacts):
            found.append(contact_graph(bodies, state, fly(bodies, state, rules), contacts, rules)[1])
    task = ImpulseTask(cached, CPU, None)
    for k, graph in enumerate(found):
        batch = task.batch(np.array([k])).graph
        torch.testing.assert_close(batch.gap.sort()[0], graph.gap.sort()[0], rtol=0, atol=1e-5)
        torch.testing.assert_close(batch.arm_first.sum(0), graph.arm_first.sum(0), rtol=0, atol=1e-4)
        torch.testing.assert_close(batch.friction.sum(), graph.friction.sum())
        torch.testing.assert_close(
            batch.mean_velocity[batch.first].sum(0), graph.mean_velocity[graph.first].sum(0), rtol=0, atol=1e-4
        )


def test_perfect_predictions_have_no_loss_and_free_flight_has(ball_data):
    task = ImpulseTask(contact_frames(ball_data, "validation", 0.1), CPU, None)
    batch = task.draw(np.random.default_rng(0), 8)
    assert float(task.loss(lambda graph, mirrored: batch.truth, batch)) == 0.0

    def flying(g, mirrored):
        return Velocities(g.free_velocity, g.free_angular, g.mean_velocity, g.mean_angular)

    assert float(task.loss(flying, batch)) > 0.1 * REST_SPEED


def test_noise_moves_gaps_by_the_normal_displacement_and_corrects_the_target(ball_data):
    """The recorded end pose is reached from the disturbed pose: shift + mean velocity * dt is what it was."""
    frames = contact_frames(ball_data, "train", 0.1)
    exact, noisy = (ImpulseTask(frames, CPU, n) for n in (None, Noise(shift=1e-3, speed=0.0)))
    picked = np.arange(6)
    a, b = exact.batch(picked), noisy.batch(picked, noisy.noise_for(picked, np.random.default_rng(0), ALONE))
    shift = (a.truth.mean_velocity - b.truth.mean_velocity) * a.graph.dt
    turn = (a.truth.mean_angular - b.truth.mean_angular) * a.graph.dt
    moved = shift[a.graph.first] + torch.linalg.cross(turn[a.graph.first], a.graph.arm_first)
    floor = a.graph.second == len(a.size) - 1
    expected = (moved * a.graph.normal).sum(-1)[floor]
    torch.testing.assert_close((b.graph.gap - a.graph.gap)[floor], expected, rtol=1e-3, atol=1e-7)
    assert shift.abs().max() > 1e-4


def test_every_frame_is_disturbed_by_a_part_of_the_noise_from_the_least_to_all(ball_data):
    frames = contact_frames(ball_data, "train", 0.1)
    noise = Noise(shift=1.0, speed=10.0, least=0.01)
    picked = np.arange(4000) % len(frames)
    drawn = ImpulseTask(frames, CPU, noise).noise_for(picked, np.random.default_rng(0), ALONE)
    counts = np.diff(frames.body_start)[picked]
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    draws = np.concatenate([drawn.shift.numpy()[:-1], drawn.push.numpy()[:-1] / 10.0], axis=1)
    size = np.sqrt(np.add.reduceat(np.square(draws).mean(1), starts) / counts)
    # The logarithm of a part is uniform, so of 4,000 a quarter is in each fourth of its range, but for chi^2 of draws.
    share = np.histogram(np.log(size) / np.log(0.01), bins=[-1.0, 0.25, 0.5, 0.75, 2.0])[0] / len(picked)
    np.testing.assert_allclose(share, 0.25, atol=0.05)


@pytest.mark.parametrize("preset", ["tiny", "tiny-paper"])
def test_it_learns_and_the_model_file_gives_the_same_network(ball_data, presets, preset, tmp_path):
    place = tmp_path / "run"
    plan = train_module.PRESETS[preset]
    task, held_out = train_module._tasks(plan, [ball_data], CPU, lambda f, m: None)
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


def test_with_products_in_bfloat16_it_learns_nearly_the_same(ball_data, presets, tmp_path):
    start, exact, rough = (
        train(ball_data, tmp_path / f"{preset}{steps}", preset=preset, steps=steps)["held_out_loss"]
        for preset, steps in (("tiny", 1), ("tiny", 150), ("tiny-bf16", 150))
    )
    assert exact < 0.8 * start and exact != rough == pytest.approx(exact, rel=0.1)


def test_a_checkpoint_of_another_run_is_refused(ball_data, presets, tmp_path):
    train(ball_data, tmp_path, preset="tiny", steps=5)
    with pytest.raises(SdfsimError, match="another preset, seed or number of steps"):
        train(ball_data, tmp_path, preset="tiny", steps=6, resume=True)


def test_paper_targets_lead_exactly_to_the_recorded_pose(ball_data):
    """Advancing by the target acceleration lands on the next recorded frame, noise or not."""
    from sdfsim.data.dataset import Trajectory, load_shapes
    from sdfsim.dynamics.surfaces import advance, target_acceleration

    t = Trajectory.load(ball_data / "train" / "0.npz")
    bodies, state = merged([t], [5], load_shapes(ball_data, {"ball"}), Units(1.0, 1.0, 1.0), CPU)

    def pose_at(k):
        _, s = merged([t], [k], load_shapes(ball_data, {"ball"}), Units(1.0, 1.0, 1.0), CPU)
        return s.position, s.orientation

    before, after = [pose_at(k) for k in (3, 4)], pose_at(6)
    shifted = before[1][0] + 0.01
    state = replace(
        state,
        earlier_position=torch.stack([before[0][0], shifted]),
        earlier_orientation=torch.stack([before[0][1], before[1][1]]),
    )
    landed = advance(bodies, state, target_acceleration(bodies, state, *after), t.dt)
    torch.testing.assert_close(landed.position, after[0], rtol=0, atol=1e-12)
    assert PaperTask(ball_data, "train", 0.1, CPU, 0.003).dt == t.dt


def test_an_unreadable_frame_cache_is_named(ball_data):
    contact_frames(ball_data, "validation", 0.1)
    cached = next((ball_data / "frames").glob("validation-*.npz"))
    content = cached.read_bytes()
    cached.write_bytes(content[:100])
    with pytest.raises(SdfsimError, match="contact frames"):
        contact_cache.contact_frames(ball_data, "validation", 0.1)
    cached.write_bytes(content)


def test_joined_frames_are_the_frames_of_both(ball_data):
    one, two = (contact_frames(ball_data, split, 0.1) for split in ("train", "validation"))
    joined = join_frames([one, two])
    assert len(joined) == len(one) + len(two)
    task, alone = ImpulseTask(joined, CPU, None), ImpulseTask(two, CPU, None)
    for k in (0, len(two) - 1):
        ours, theirs = task.batch(np.array([len(one) + k])), alone.batch(np.array([k]))
        for name in ("velocity", "gap", "arm_second", "first"):
            torch.testing.assert_close(getattr(ours.graph, name), getattr(theirs.graph, name), rtol=0, atol=0)


def test_frames_of_another_step_cannot_be_joined(ball_data):
    frames = contact_frames(ball_data, "train", 0.1)
    with pytest.raises(SdfsimError, match="share step and gravity"):
        join_frames([frames, replace(frames, dt=0.01)])


def test_the_log_tells_rollouts_and_is_drawn(ball_data, presets, tmp_path):
    pytest.importorskip("matplotlib")
    train(ball_data, tmp_path / "run", preset="tiny", steps=20)
    entries = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert all(0 < e["rollout_m"] < 100 and 0 <= e["rollout_degrees"] <= 180 for e in entries)
    report = evaluate(ball_data, model=tmp_path / "run" / "model.safetensors", split="validation", errors_only=True)
    assert entries[-1]["rollout_m"] == pytest.approx(report["model"]["39"]["translation_rmse"], rel=1e-4)
    assert entries[-1]["rollout_degrees"] == pytest.approx(report["model"]["39"]["rotation_error"], rel=1e-4)
    with open(tmp_path / "run" / "log.jsonl", "a") as log:
        log.write('{"step": 21, "lo')  # a run that is still writing
    validation.draw(tmp_path / "run", tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes()[:4] == b"\x89PNG"


def test_curves_of_what_is_no_log_are_refused(tmp_path):
    pytest.importorskip("matplotlib")
    for text in (None, "nonsense\n", '{"step": 1}\n'):
        if text is not None:
            (tmp_path / "log.jsonl").write_text(text)
        with pytest.raises(SdfsimError, match="not the log of a training run"):
            validation.draw(tmp_path, tmp_path / "curves.png")
    assert not (tmp_path / "curves.png").exists()


@pytest.mark.parametrize("steps", [0, -5])
def test_steps_that_are_none_are_refused(ball_data, presets, tmp_path, steps):
    with pytest.raises(SdfsimError, match="steps: must be at least 1"):
        train(ball_data, tmp_path / "run", preset="tiny", steps=steps)
