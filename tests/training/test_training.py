"""Training on a handful of recorded steps: it learns, it resumes to the bit, it leaves no pickle; what its batches
and contact frames hold."""

import shutil
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.data.batching import merged, roll_out, scene_of
from sdfsim.data.dataset import Trajectory, load_shapes
from sdfsim.learned.contact_graph import OF_BODIES, OF_EDGES, REST_SPEED
from sdfsim.learned.impulse import Velocities
from sdfsim.learned.inference import step_graph
from sdfsim.learned.model import load_model
from sdfsim.physics.bodies import Units
from sdfsim.physics.free_flight import fly
from sdfsim.physics.options import Options
from sdfsim.physics.solver.prepare import Compiled, points_near
from sdfsim.simulate.simulator import Simulator
from sdfsim.training import train as train_module
from sdfsim.training.batches import moved
from sdfsim.training.contact_frames import STEP, Disturbed, contact_frames, join_frames
from sdfsim.training.impulse_task import ImpulseTask
from sdfsim.training.presets import PRESETS
from sdfsim.training.run import Run, held_out_loss
from sdfsim.training.surface_task import SurfaceTask
from sdfsim.training.train import train
from tests.helpers.recordings import BALL, BALLS, bouncing, slab_data, sliding, write_dataset
from tests.helpers.scenes import in_torch, random_model

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


def test_frames_of_another_gravity_cannot_be_joined(ball_data):
    frames = contact_frames(ball_data, "train", ONCE)
    with pytest.raises(SdfsimError, match="gravity"):
        join_frames([frames, replace(frames, gravity=0.5 * frames.gravity)])


@pytest.mark.parametrize("steps", [0, -5])
def test_steps_that_are_none_are_refused(ball_data, presets, tmp_path, steps):
    with pytest.raises(SdfsimError, match=r"^steps: .*\b1\b"):
        train(ball_data, tmp_path / "run", preset="tiny", steps=steps)


@pytest.fixture
def pair(ball_data):
    """Two trajectories that start on the floor, the bodies of one seventy times as heavy; and the shapes."""
    one, two = (Trajectory.load(ball_data / "train" / f"{k}.npz") for k in range(2))
    one, two = (replace(t, position=t.position - [0, 0, t.position[0, :, 2].min() - 0.5]) for t in (one, two))
    return [one, replace(two, mass=70 * two.mass, inertia=70 * two.inertia)], load_shapes(ball_data, {"ball"})


@pytest.mark.parametrize(("kind", "free_flight"), [("sdf-sim", "learned"), ("sdf-sim", "exact"), ("impulse", "exact")])
def test_the_first_step_of_an_evaluation_is_the_simulators(pair, kind, free_flight):
    """Also of scenes whose bodies weigh differently: neither knows what a kilogram is."""
    group, shapes = pair
    model = random_model(kind)
    for t in group:
        (motion,) = roll_out(model, [t], shapes, 1, free_flight)
        (flown,) = roll_out(model, [t], shapes, 1, contact=False)
        assert np.abs(motion.position - flown.position).max() > 1e-4
        simulator = Simulator(scene_of([t], [0], shapes)[0], model, dt=t.dt, free_flight=free_flight)
        (state,) = simulator.steps(1)
        np.testing.assert_allclose(motion.position[1], state.position[:-1], rtol=0, atol=1e-6)
        np.testing.assert_allclose(motion.velocity[1], state.velocity[:-1], rtol=0, atol=1e-4)


def test_training_sees_masses_relative_to_the_scenes_mean(pair, ball_data):
    group, shapes = pair
    bodies, _ = merged(group, [0, 0], shapes, Units(1.0, 1.0, 1.0))
    # 2 and 1 kg, and 140 and 70 kg: around 1.5 and 105.
    assert bodies.inverse_mass.tolist() == pytest.approx([0.75, 1.5, 0.75, 1.5, 0.0])
    radii = (bodies.inertia[:4, 0, 0] / bodies.mass[:4]).tolist()
    assert radii == pytest.approx([0.05, 0.1, 0.05, 0.1])
    task = SurfaceTask(ball_data, "train", SDF_SIM)
    task.trajectories = group
    seen = task.draw(np.random.default_rng(0), 8).graph.nodes["body"][:, 9]
    assert sorted(set(seen.tolist())) == pytest.approx([0.0, 0.75, 1.5])


def test_bodies_alone_that_never_move_have_no_mean_mass(pair):
    group, shapes = pair
    still = replace(group[0], static=np.ones(2, dtype=bool), mass=np.zeros(2))
    bodies, _ = merged([still], [0], shapes, Units(1.0, 1.0, 1.0))
    assert bodies.mass.tolist() == [0.0, 0.0, 0.0]


def test_the_mass_ratio_is_that_within_a_scene(pair, ball_data):
    task = SurfaceTask(ball_data, "train", SDF_SIM)
    task.trajectories = pair[0]
    assert task.ranges()["mass_ratio"] == [1.0, pytest.approx(2.0)]


def test_noise_is_on_what_is_seen_when_training(ball_data):
    exact, noisy = (
        SurfaceTask(ball_data, "train", SDF_SIM, noisy=noisy).draw(np.random.default_rng(3), 8).graph.nodes["node"]
        for noisy in (False, True)
    )
    assert exact.shape == noisy.shape and not torch.equal(exact, noisy)


def test_noise_walks_by_the_given_size(ball_data):
    """The last of three poses is off by it, the first by a third of the variance; the recorded target is not."""
    task = SurfaceTask(ball_data, "train", SDF_SIM, noisy=True)
    picked = [task.trajectories[k % 6] for k in range(2000)]
    noise = task._noise(picked, np.random.default_rng(0))
    assert noise is not None and noise.shape == (3, 2, 4001, 3)
    size = noise[:, 0].cumsum(0).std((1, 2)).tolist()
    assert size == pytest.approx([0.003 * (k / 3) ** 0.5 for k in (1, 2, 3)], rel=0.03)


def test_ranges_are_of_what_moves(pair, ball_data):
    """Scenery is as large as it likes, and does not set the model's unit of length."""
    (one, _), _ = pair
    task = SurfaceTask(ball_data, "train", SDF_SIM)
    task.trajectories = [one]
    known = task.ranges()
    scenery = {"static": np.array([False, True]), "scale": np.array([1.0, 9.0]), "mass": np.array([2.0, 0.0])}
    task.trajectories = [one, replace(one, **scenery, velocity=one.velocity * [[[1.0], [9.0]]])]
    assert task.ranges()["size"] == known["size"] and task.ranges()["speed"][1] < 2 * known["speed"][1]


def test_trajectories_of_different_steps_are_not_trained_on_together(ball_data, tmp_path):
    shutil.copytree(ball_data, tmp_path / "data")
    for other in ({"dt": 0.01}, {"gravity": np.array([0.0, 0.0, -5.0])}):
        replace(bouncing(3), **other).save(tmp_path / "data" / "train" / "9.npz")
        for read in (
            lambda data: SurfaceTask(data, "train", SDF_SIM),
            lambda data: contact_frames(data, "train", Disturbed()),
        ):
            with pytest.raises(SdfsimError, match=r"train: .*\bstep\b.*\bgravity\b"):
                read(tmp_path / "data")


def test_the_floor_of_a_batch_is_that_of_dataset_json(tmp_path):
    told = {"engine": "mine", "floor": {"friction": 0.7, "restitution": 0.1}}
    data = slab_data(tmp_path, "train", sliding(0.7), told)
    task = SurfaceTask(data, "train", SDF_SIM)
    bodies, _, _ = task.scenes(np.random.default_rng(0), 2)
    assert (float(bodies.friction[-1]), float(bodies.restitution[-1])) == (0.7, 0.1)
    assert task.ranges()["friction"] == pytest.approx([0.7, 1.0])
    before = task.digest()
    (data / "dataset.json").write_text('{"engine": "mine"}')
    other = SurfaceTask(data, "train", SDF_SIM)
    assert float(other.scenes(np.random.default_rng(0), 2)[0].friction[-1]) == 0.3 and other.digest() != before


def tensors(value):
    """All tensors in a batch, in order."""
    if isinstance(value, torch.Tensor):
        return [value]
    if isinstance(value, dict):
        return [found for name in sorted(value) for found in tensors(value[name])]
    if hasattr(value, "__dataclass_fields__"):
        return [found for field in fields(value) for found in tensors(getattr(value, field.name))]
    return []


def test_a_batch_moves_with_all_its_parts(ball_data):
    batch = SurfaceTask(ball_data, "train", PRESETS["sdf-sim"]).draw(np.random.default_rng(0), 2)
    there = moved(batch, torch.device("meta"))
    assert [t.shape for t in tensors(there)] == [t.shape for t in tensors(batch)]
    assert all(t.device.type == "meta" for t in tensors(there))


@pytest.mark.parametrize("preset", ["tiny", "tiny-sdf-sim"])
def test_a_run_does_not_go_on_with_other_data(ball_data, presets, preset, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(ball_data, other, ignore=shutil.ignore_patterns("frames"))
    bouncing(55).save(other / "train" / "3.npz")
    train(ball_data, tmp_path / "run", preset=preset, steps=2)
    before = (tmp_path / "run" / "checkpoint.npz").read_bytes()
    with pytest.raises(SdfsimError, match=r"\bdata\b"):
        train(other, tmp_path / "run", preset=preset, steps=2, resume=True)
    assert (tmp_path / "run" / "checkpoint.npz").read_bytes() == before
    shutil.copytree(ball_data, tmp_path / "copy")
    assert train(tmp_path / "copy", tmp_path / "run", preset=preset, steps=2, resume=True)["steps"] == 2


def dataset(folder, *trajectories: Trajectory):
    """A dataset of balls with nothing but these to train on."""
    return write_dataset(folder, BALL, {"train": [*trajectories]}, BALLS)


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
    for velocity, went in zip(frames.bodies["velocity"], frames.truth["mean_velocity"], strict=True):
        k = np.abs(now - velocity).max(1).argmin()
        np.testing.assert_allclose(velocity, now[k], atol=1e-5)
        np.testing.assert_allclose(went * STEP * length, gone[k], atol=1e-5)


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
