"""Training on recorded motions, judged by motions that are known in closed form."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

import cli
from sdfsim.apps.observed import load_recordings
from sdfsim.base.errors import SdfsimError
from sdfsim.learned.impulse import ImpulseNetwork
from sdfsim.learned.model import load_model
from sdfsim.scene.load import load_scene
from sdfsim.simulate.simulator import Simulator
from sdfsim.training.motion_task import LOST, MotionTask
from sdfsim.training.presets import PRESETS
from sdfsim.training.run import Run
from sdfsim.training.train import train

SCENE = """version: 1
gravity: [0, 0, -10]
duration: 1
shapes: {ball: {sphere: {radius: 0.5}}}
bodies:
  - {name: floor, plane: {}, friction: 1, restitution: 1}
  - {name: ball, shape: ball, position: [0, 0, 1], mass: 1, friction: 0, restitution: 0.3}
"""
DT, REBOUND = 0.02, 0.8


@pytest.fixture
def bounces(tmp_path) -> tuple[Path, Path]:
    """A folder with twelve recordings of a frictionless ball of radius 0.5 m that bounces off z = 0 with a restitution
    of 0.8, in closed form; and a scene that says 0.3."""
    rng, folder = np.random.default_rng(0), tmp_path / "bounces"
    folder.mkdir()
    time = DT * np.arange(60)
    for k in range(12):
        level, speed, height = rng.uniform(-1, 1, 2), rng.uniform(-1, 0), rng.uniform(0.2, 0.8)
        hit = (speed + np.sqrt(speed**2 + 20 * height)) / 10
        up = REBOUND * (10 * hit - speed)
        after = time - hit
        z = np.where(after < 0, height + speed * time - 5 * time**2, up * after - 5 * after**2)
        kept = (after < 0) | (z > 0) | (after < 0.1)  # up to the second impact
        count = int(np.argmin(kept)) or len(time)
        position = np.stack([level[0] * time, level[1] * time, 0.5 + z], 1)[:count]
        quat = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
        np.savez(folder / f"{k:02d}.npz", position=position, quat_xyzw=quat, dt=DT)
    (tmp_path / "scene.yaml").write_text(SCENE)
    return folder, tmp_path / "scene.yaml"


def test_a_network_learns_a_rebound_that_the_scene_does_not_have(bounces, tmp_path):
    report = train(bounces[0], tmp_path / "run", preset="impacts", steps=150, scene=bounces[1])
    model = load_model(tmp_path / "run" / "model.safetensors")
    assert model.card["data"][0]["recordings"] == {"train": 10, "validation": 2}
    scene = load_scene(bounces[1])
    highest = {}
    for name, of in (("solver", "solver"), ("network", model)):
        sim = Simulator(scene, of)
        assert not sim.outside_training
        rollout = sim.run(1.0)
        rises = rollout.velocity[:, 1, 2] > 0.0
        highest[name] = rollout.position[rises, 1, 2].max() - 0.5
    # A ball that falls by 0.5 m comes back to e^2 of it.
    assert highest["solver"] == pytest.approx(0.5 * 0.3**2, abs=0.02)
    assert highest["network"] == pytest.approx(0.5 * REBOUND**2, abs=0.06)
    assert report["steps"] == 150


def test_what_the_network_is_told_of_its_effect_is_what_it_has(bounces):
    """The slope of the loss along the weights is that of differences, where free motion is all that follows."""
    recordings, scene = load_recordings([bounces[0]], bounces[1])
    task = MotionTask(recordings, scene)
    network = Run(PRESETS["impacts"], task, 10, 0, torch.device("cpu")).network
    assert isinstance(network, ImpulseNetwork)
    hit = [int((np.diff(r.velocity[:, 0, 2]) > 0).argmax()) for r in recordings]
    starts = task.starts([(k, max(0, t - 3)) for k, t in enumerate(hit)], 8)  # up to the second impact
    loss = task.loss(network, starts)
    loss.backward()
    bias = dict(network.named_parameters())["rounds.1.normal_impulse.bias"]
    assert bias.grad is not None
    slope = float(bias.grad[0])

    def off(change: float) -> float:
        with torch.no_grad():
            bias[0] += change
            found = float(task.loss(network, starts))
            bias[0] -= change
        return found

    assert slope == pytest.approx((off(0.01) - off(-0.01)) / 0.02, rel=1e-3)
    assert slope < -1e-3  # a harder push is nearer to what was recorded


def test_a_network_that_drives_bodies_beyond_all_bounds_has_a_loss_and_slopes(bounces):
    """It pushes the ball into the floor, faster in every step."""
    recordings, scene = load_recordings([bounces[0]], bounces[1])
    task = MotionTask(recordings, scene)
    network = Run(PRESETS["alone"], task, 10, 0, torch.device("cpu")).network
    assert isinstance(network, ImpulseNetwork)
    with torch.no_grad():
        for name, value in network.named_parameters():
            if name.endswith("impulse.bias"):
                value -= 1e6
    hit = [int((np.diff(r.velocity[:, 0, 2]) > 0).argmax()) for r in recordings]
    loss = task.loss(network, task.starts([(k, t) for k, t in enumerate(hit)], 20))
    loss.backward()
    slopes = [value.grad for value in network.parameters() if value.grad is not None]
    assert slopes and all(bool(slope.isfinite().all()) for slope in slopes)
    assert float(loss.detach()) == pytest.approx(LOST, rel=1e-3)  # of its place; it is not turned


def test_the_same_seed_trains_the_same_network_and_a_stopped_training_goes_on(bounces, tmp_path):
    how: dict[str, Any] = {"preset": "impacts", "scene": bounces[1]}
    train(bounces[0], tmp_path / "whole", steps=6, **how)
    train(bounces[0], tmp_path / "part", steps=6, budget=1e-9, **how)
    train(bounces[0], tmp_path / "part", steps=6, resume=True, **how)
    one, other = ((tmp_path / name / "model.safetensors").read_bytes() for name in ("whole", "part"))
    assert one[-1000:] == other[-1000:]


def test_what_does_not_fit_together_is_told(bounces, tmp_path):
    folder, scene = bounces
    out = tmp_path / "run"
    cases: list[tuple[str, dict[str, Any]]] = [
        ("impacts trains on recordings", {"preset": "impacts"}),
        ("only impacts and alone train", {"preset": "small", "scene": scene}),
        ("drawn in one process", {"preset": "impacts", "scene": scene, "workers": 2}),
    ]
    for told, given in cases:
        with pytest.raises(SdfsimError, match=told):
            train(folder, out, **given)
    with pytest.raises(SdfsimError, match=r"1 recordings \(at least 4"):
        train(folder / "00.npz", out, preset="impacts", scene=scene)
    asked = ["train", "--data", str(folder), "--scene", str(scene), "-o", str(out)]
    done = CliRunner().invoke(cli.app, asked)
    assert done.exit_code == 1 and "give --preset impacts" in done.output
