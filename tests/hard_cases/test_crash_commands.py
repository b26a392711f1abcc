"""Killed at any moment: nothing torn under its final name, and the same command afterwards ends as if undisturbed."""

from __future__ import annotations

import json
import random
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sdfsim.data.dataset import Trajectory
from sdfsim.dynamics.model import Model, new_network
from sdfsim.shape.mesh import write_ply
from sdfsim.shape.primitives import box
from sdfsim.shape.shape import analytic_shape
from tests.hard_cases import crashing
from tests.hard_cases.crashing import NEVER, Ended, Moment, litter, whole

FEW, MANY = 2, 24
COMMANDS = ["fit", "simulate", "train", "reconstruct"]

SCENE = """version: 1
duration: 0.4
model: untrained.safetensors
shapes: {brick: {box: {size: [1, 1, 1]}}}
bodies:
  - {name: floor, plane: {}}
  - {name: bricks, shape: brick, arrange: {grid: [1, 1, 3], spacing: 1.02}, position: [0, 0, 0.51]}
"""


@dataclass(frozen=True)
class Work:
    """One command that can be killed.

    Attributes:
        arguments: after `sdfsim`, but for the folder.
        again: what is added to go on after a kill.
        prepare: makes its settings tiny.
        result: everything that two runs must agree in, from their folder.
        code: of an undisturbed run (3 where so short a fit cannot be used).
    """

    arguments: tuple[str, ...]
    again: tuple[str, ...]
    prepare: Callable[[], None]
    result: Callable[[Path], dict]
    code: int = 0


def bits(arrays) -> dict[str, bytes]:
    return {name: np.asarray(values).tobytes() for name, values in arrays.items()}


class Close:
    """Arrays that are equal up to rounding: matrix products round as their operands lie in memory."""

    def __init__(self, values: np.ndarray, bound: float = 1e-3) -> None:
        self.values, self.bound = values, bound

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Close) and np.allclose(self.values, other.values, rtol=0, atol=self.bound)

    __hash__ = None  # type: ignore[assignment]


def of_fit(folder: Path) -> dict:
    from safetensors.numpy import load_file

    record, tensors = json.loads((folder / "shape.json").read_text()), load_file(folder / "shape.safetensors")
    weights = {name: Close(values) for name, values in tensors.items() if name.startswith("layer")}
    told = {key: record[key] for key in ("name", "volume", "com", "source")}
    return weights | told | {"mesh": (folder / "mesh.ply").read_bytes(), "steps": record["certificate"]["steps"]}


def of_simulate(folder: Path) -> dict:
    report = json.loads((folder / "report.json").read_text())
    with np.load(folder / "rollout.npz", allow_pickle=False) as data:
        motion = ("time", "position", "orientation", "velocity", "angular_velocity", "contact_count", "contact_point")
        arrays = {name: data[name] for name in (*motion, "contact_body", "counter_kinetic_energy", "names")}
    return bits(arrays) | {"steps": report["steps"], "status": report["status"], "finite": report["finite"]}


def of_train(folder: Path) -> dict:
    from safetensors.numpy import load_file

    lines = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    log = np.array([(entry["step"], entry["loss"], entry["held_out_loss"]) for entry in lines])
    weights = load_file(folder / "model.safetensors")
    return {name: Close(values, 1e-6) for name, values in weights.items()} | {"log": Close(log, 1e-6)}


def of_reconstruct(folder: Path) -> dict:
    from safetensors.numpy import load_file

    report = json.loads((folder / "report.json").read_text())
    photos = {path.name: path.read_bytes() for path in (folder / "photos" / "images").iterdir()}
    made = {name: (folder / name).read_bytes() for name in ("scene.yaml", "mesh/mesh.ply")}
    shape = of_fit(folder / "assets" / "scene")
    return bits(load_file(folder / "distill" / "field.safetensors")) | photos | made | shape | {
        "stages": list(report["stages"])
    }  # fmt: skip


def falling(seed: int) -> Trajectory:
    """Two cubes of 1 m that fall onto the floor at z = 0 and stay there; no engine is needed for it."""
    rng, frames, dt = np.random.default_rng(seed), 12, 0.02
    height = np.maximum(0.5, rng.uniform(0.55, 0.7, 2) - 5 * (np.arange(frames)[:, None] * dt) ** 2)
    place = np.array([[-2.0, 0.0], [2.0, 0.0]])
    position = np.concatenate([np.broadcast_to(place, (frames, 2, 2)), height[..., None]], axis=2)
    velocity = np.diff(position, axis=0, prepend=position[:1]) / dt
    per_body = {"scale": 1.0, "mass": 1.0, "friction": 0.5, "restitution": 0.3}
    return Trajectory(
        position=position,
        quat_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (frames, 2, 1)),
        velocity=velocity,
        angular_velocity=np.zeros((frames, 2, 3)),
        shape=np.array(["cube", "cube"]),
        inertia=np.full((2, 3), 1 / 6),
        static=np.zeros(2, dtype=bool),
        dt=dt,
        gravity=np.array([0.0, 0.0, -10.0]),
        **{name: np.full(2, value) for name, value in per_body.items()},
    )


def write_cubes(folder: Path) -> None:
    """A dataset of one trajectory a split."""
    analytic_shape("box", size=(1, 1, 1), name="cube").save(folder / "shapes" / "cube")
    for split, seed in (("train", 0), ("validation", 1)):
        (folder / split).mkdir()
        falling(seed).save(folder / split / "00000.npz")
    (folder / "dataset.json").write_text('{"recipe": "cubes", "seed": 0}')


@pytest.fixture(scope="module")
def works(tmp_path_factory) -> dict[str, Work]:
    """The commands with what they read."""
    home = tmp_path_factory.mktemp("inputs")
    (home / "box.ply").write_bytes(write_ply(box()))
    (home / "scene.yaml").write_text(SCENE)
    torch.manual_seed(0)
    network = new_network("impulse", {"width": 8, "rounds": 1})
    Model("untrained", "impulse", network, 0.02, 10.0, 1.0, 0.1).save(home / "untrained.safetensors")
    write_cubes(home / "data")
    (home / "photos").mkdir()
    for k in range(4):
        pixels = np.random.default_rng(k).integers(0, 255, (80, 80, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(home / "photos" / f"{k}.png")
    reconstruct = ("reconstruct", str(home / "photos"), "--preset", "quick")
    simulate = ("simulate", str(home / "scene.yaml"), "--viewer", "none")
    return {
        "reconstruct": Work(reconstruct, (), crashing.tiny_reconstruct, of_reconstruct, 3),
        "fit": Work(("fit", str(home / "box.ply")), (), crashing.tiny_fit, of_fit, 3),
        "simulate": Work(simulate, ("--resume",), crashing.tiny_simulate, of_simulate),
        "train": Work(("train", "--data", str(home / "data")), ("--resume",), crashing.tiny_train, of_train),
    }


@pytest.fixture(scope="module")
def undisturbed(works, tmp_path_factory) -> Callable[[str], tuple[Ended, dict]]:
    """How a command ends, and what is in its folder then; run once for each."""
    found: dict[str, tuple[Ended, dict]] = {}

    def of(name: str) -> tuple[Ended, dict]:
        if name not in found:
            work, folder = works[name], tmp_path_factory.mktemp("whole") / name
            call(work, folder, NEVER)  # what a first run leaves in caches is not counted
            ended = call(work, folder.with_name(f"{name}.again"), NEVER)
            assert ended.code == work.code, ended.said
            whole(folder)
            assert litter(folder) == []
            found[name] = ended, work.result(folder)
        return found[name]

    return of


def call(work: Work, folder: Path, moment: Moment, *more: str) -> Ended:
    return crashing.run([*work.arguments, "-o", str(folder), *more], folder, moment, work.prepare)


def kill_and_resume(work: Work, folder: Path, moments: list[Moment], expected: dict) -> None:
    """Kill one run at each of the moments in turn, then let it end."""
    for moment in moments:
        ended = call(work, folder, moment, *work.again)
        stopped = (130,) if moment.how == signal.SIGINT else (-signal.SIGKILL, -signal.SIGPROF)
        assert ended.code in (*stopped, work.code), ended.said
        whole(folder)
    ended = call(work, folder, NEVER, *work.again)
    assert ended.code == work.code, ended.said
    whole(folder)
    assert litter(folder) == []
    assert work.result(folder) == expected


def moments(ended: Ended, count: int, seed: int) -> list[Moment]:
    """Half of them before a change of the file system, half anywhere in the time that the work takes."""
    rng = random.Random(seed)
    changes = [Moment(change=rng.randint(1, ended.changes)) for _ in range(count // 2)]
    return changes + [Moment(seconds=rng.uniform(0.01, ended.seconds)) for _ in range(count - count // 2)]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_killed_command_goes_on(works, undisturbed, tmp_path, name):
    ended, expected = undisturbed(name)
    for number, moment in enumerate(moments(ended, FEW, seed=1)):
        kill_and_resume(works[name], tmp_path / str(number) / name, [moment], expected)


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_killed_at_many_moments_goes_on(works, undisturbed, tmp_path, name):
    ended, expected = undisturbed(name)
    for number, moment in enumerate(moments(ended, MANY, seed=2)):
        kill_and_resume(works[name], tmp_path / str(number) / name, [moment], expected)


@pytest.mark.parametrize("name", COMMANDS)
def test_ctrl_c_keeps_what_was_finished(works, undisturbed, tmp_path, name):
    ended, expected = undisturbed(name)
    work, folder = works[name], tmp_path / name
    stopped = call(work, folder, Moment(change=max(3, ended.changes // 2), how=signal.SIGINT), *work.again)
    assert stopped.code == 130 and "interrupted; what was finished is kept" in stopped.said
    assert "Traceback" not in stopped.said
    whole(folder)
    kept = {
        "fit": ".",  # it starts over
        "simulate": "rollout.npz",
        "train": "checkpoint.npz",
        "reconstruct": "photos/stage.json",
    }[name]
    assert (folder / kept).exists()
    kill_and_resume(work, folder, [], expected)


def interruptions(ended: Ended, count: int, seed: int) -> list[Moment]:
    rng = random.Random(seed)
    return [Moment(seconds=rng.uniform(0.3, 0.9) * ended.seconds, how=signal.SIGINT) for _ in range(count)]


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_ctrl_c_at_any_moment_changes_nothing_in_the_end(works, undisturbed, tmp_path, name):
    ended, expected = undisturbed(name)
    for number, moment in enumerate(interruptions(ended, MANY // 2, seed=4)):
        kill_and_resume(works[name], tmp_path / str(number) / name, [moment], expected)
