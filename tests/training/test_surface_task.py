"""The *sdf-sim* network's batches: inputs as the simulator gives them, noise that does not depend on who draws it."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.data.batching import merged, roll_out, scene_of
from sdfsim.data.dataset import Trajectory, load_shapes
from sdfsim.physics.bodies import Units
from sdfsim.simulate.simulator import Simulator
from sdfsim.training.contact_frames import Disturbed, contact_frames
from sdfsim.training.presets import PRESETS
from sdfsim.training.surface_task import SurfaceTask
from tests.helpers.recordings import bouncing, slab_data, sliding
from tests.helpers.scenes import random_model

CPU = torch.device("cpu")
SDF_SIM = PRESETS["sdf-sim"]


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
