"""Commands in a process of their own that ends at a chosen moment, as by a power cut, and tiny settings for them."""

import json
import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from PIL import Image

from sdfsim.data.dataset import Trajectory
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.geometry.primitives import box
from sdfsim.shape.make import analytic_shape
from tests.helpers.scenes import tiny_model

WRITING = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate")
BALL = 0.5  # m


class Moment(NamedTuple):
    """When a process is to end: before its n-th change of the file system, or after so much processor time.

    Attributes:
        change: counted from 1 over everything that is opened for writing, renamed, removed or made; 0 for none.
        seconds: of processor time; 0 for never.
        how: the signal.
    """

    change: int = 0
    seconds: float = 0.0
    how: int = signal.SIGKILL


NEVER = Moment()


class Ended(NamedTuple):
    """How a process ended: its exit code (negative: a signal), what it said, its changes and its seconds."""

    code: int
    said: str
    changes: int
    seconds: float


def run(arguments: list[str], folder: Path, moment: Moment = NEVER, prepare: Callable[[], None] | None = None) -> Ended:
    """`sdfsim ARGUMENTS` in a child that ends at the moment given.

    Args:
        arguments: of the command line.
        folder: changes below it count.
        moment: when to end.
        prepare: called in the child first; makes the settings tiny.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.hard_cases.preloaded"])
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:  # not beside the folder, where the disk may be full
        said, told = Path(place) / "said", Path(place) / "told"
        child = context.Process(target=_child, args=(arguments, str(folder), moment, prepare, str(said), str(told)))
        child.start()
        child.join()
        changes, seconds = json.loads(told.read_text()) if told.exists() else (0, 0.0)
        return Ended(child.exitcode or 0, said.read_text(errors="replace"), changes, seconds)


def _child(
    arguments: list[str], folder: str, moment: Moment, prepare: Callable[[], None] | None, said: str, told: str
) -> None:
    import torch

    torch.set_num_threads(1)
    os.environ["LOKY_MAX_CPU_COUNT"] = "1"  # this process does all the work: others take seconds to start
    descriptor = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    count = 0

    def hook(event: str, values: tuple[Any, ...]) -> None:
        nonlocal count
        writes = event == "open" and isinstance(values[1], str) and any(c in values[1] for c in "wax+")
        # What is removed with its whole folder is named relative to it.
        inside = values and (str(values[0]).startswith(folder) or (event == "os.remove" and values[1] != -1))
        if (writes or event in WRITING) and inside:
            count += 1
            if count == moment.change:
                os.kill(os.getpid(), moment.how)

    if prepare:
        prepare()
    sys.addaudithook(hook)
    if moment.seconds:
        signal.setitimer(signal.ITIMER_PROF, moment.seconds)  # nobody handles it: as sudden as SIGKILL
        if moment.how == signal.SIGINT:
            signal.signal(signal.SIGPROF, lambda *_: os.kill(os.getpid(), signal.SIGINT))
    import cli

    started, code = time.process_time(), -1
    try:
        cli.app(arguments)
    except SystemExit as end:
        code = int(end.code or 0)
    Path(told).write_text(json.dumps([count, time.process_time() - started]))
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def whole(folder: Path) -> None:
    """That every file under its final name can be read to its end; hidden ones are nobody's results."""
    from safetensors.numpy import load_file

    from sdfsim.geometry.mesh_io import read_mesh

    for path in folder.rglob("*"):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if hidden or not path.is_file():
            continue
        if path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as data:
                assert all(data[name] is not None for name in data.files)
        elif path.suffix == ".safetensors":
            load_file(path)
        elif path.suffix == ".ply":
            read_mesh(path)
        elif path.suffix == ".yaml":
            assert path.read_text().endswith("\n")
        elif path.suffix == ".rrd":
            assert path.read_bytes()[:3] == b"RRF"


def litter(folder: Path) -> list[str]:
    """Files that only a killed process can have left."""
    return [p.name for p in folder.rglob("*") if p.name.endswith((".part", ".partial", ".lock"))]


def tiny_fit() -> None:
    """Fits of 120 steps, baked coarsely."""
    from sdfsim.sdf import baked_grid
    from sdfsim.sdf.fit import train as fit_module

    plan = replace(fit_module.RECIPES["default"], width=8, layers=3, steps=120, batch=64, pool=1000, goal=None)
    fit_module.RECIPES["default"] = fit_module.RECIPES["quick"] = plan
    fit_module.CHECK_EVERY = 20
    baked_grid.CELLS = baked_grid.FINEST = 16


def tiny_train() -> None:
    """A training of 30 steps with a checkpoint after each, and a line of the log every three."""
    from sdfsim.training import train

    train.PRESETS["gnn"] = train.Preset("impulse", {"width": 8, "rounds": 1}, steps=30, batch=4, rate=3e-3)
    train.CHECKPOINT_SECONDS = 0.0


def tiny_simulate() -> None:
    """A checkpoint after every step."""
    from sdfsim.apps import run

    run.EVERY = 0.0


def tiny_reconstruct() -> None:
    """Poses that are given, 12 steps of training, a checkpoint after each, and a tiny fit of the ball it began as."""
    from pipeline import stages
    from pipeline.field import training
    from pipeline.field.grid_field import FieldSize
    from pipeline.mesh import meshing

    small = FieldSize((8, 16), (2, 2), 16, 8)
    training.PRESETS["quick"] = replace(
        training.PRESETS["quick"], size=small, rays=32, iterations=12, surface_points=16, long_side=64
    )
    # One thread: its sums do not depend on how busy the machine is.
    training.train.__kwdefaults__ |= {"checkpoint_every": 0.0, "threads": 1}
    meshing.RESOLUTION["quick"] = 64  # four times that of the field
    stages.STAGES["poses"] = replace(stages.STAGES["poses"], run=_given_poses)
    tiny_fit()


def _given_poses(run: Any, work: Path) -> dict:
    """Four cameras around the origin, in place of structure from motion."""
    from pipeline.cameras import View, save_views
    from pipeline.inputs.photos import load_photos
    from sdfsim.base.files import write_arrays

    views, rng = [], np.random.default_rng(0)
    for k, photo in enumerate(load_photos(run.place("photos"))):
        turn = k * np.pi / 2
        rotation = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
        size = (photo.width, photo.height, 80.0, photo.width / 2, photo.height / 2, 0.0)
        views.append(View(photo.name, photo.source, *size, rotation, np.array([0.0, 0.0, 3.0])))
    points = rng.normal(size=(50, 3)) * 0.3
    point_of, view_of = np.repeat(np.arange(50), 4), np.tile(np.arange(4), 50)
    save_views(views, work / "cameras.json")
    sparse = {"xyz": points, "rgb": np.zeros((50, 3), np.uint8), "error": np.full(50, 0.5)}
    write_arrays(work / "sparse.npz", sparse | {"point_of": point_of, "view_of": view_of})
    told = {"mean_error": 0.5, "points": len(points), "field_of_view": [60.0], "spread_angle": 90.0, "focal": 80.0}
    return told | {"posed": len(views), "photos": len(views), "left_out": [], "warnings": []}


# --- the commands, and how each ends undisturbed ---

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
    steps = record["certificate"].get("steps")  # a grid is sampled, not fitted
    return weights | told | {"mesh": (folder / "mesh.ply").read_bytes(), "steps": steps}


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
        orientation=np.tile([0.0, 0.0, 0.0, 1.0], (frames, 2, 1)),
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
    from tests.helpers.recordings import write_dataset  # here, as it loads what the processes that end do not need

    cube = analytic_shape("box", size=(1, 1, 1), name="cube")
    splits = {"train": [falling(0)], "validation": [falling(1)]}
    write_dataset(folder, cube, splits, {"recipe": "cubes", "seed": 0})


@pytest.fixture(scope="session")
def works(tmp_path_factory) -> dict[str, Work]:
    """The commands with what they read."""
    home = tmp_path_factory.mktemp("inputs")
    (home / "box.ply").write_bytes(write_ply(box()))
    (home / "scene.yaml").write_text(SCENE)
    tiny_model(home / "untrained.safetensors")
    write_cubes(home / "data")
    (home / "photos").mkdir()
    for k in range(4):
        pixels = np.random.default_rng(k).integers(0, 255, (80, 80, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(home / "photos" / f"{k}.png")
    reconstruct = ("reconstruct", str(home / "photos"), "--preset", "quick")
    simulate = ("simulate", str(home / "scene.yaml"), "--viewer", "none")
    return {
        "reconstruct": Work(reconstruct, (), tiny_reconstruct, of_reconstruct),
        "fit": Work(("fit", str(home / "box.ply")), (), tiny_fit, of_fit, 3),
        "simulate": Work(simulate, ("--resume",), tiny_simulate, of_simulate),
        "train": Work(("train", "--data", str(home / "data")), ("--resume",), tiny_train, of_train),
    }


@pytest.fixture(scope="session")
def undisturbed(works, tmp_path_factory) -> Callable[[str], tuple[Ended, dict]]:
    """How a command ends, and what is in its folder then; run once for each."""
    found: dict[str, tuple[Ended, dict]] = {}

    def of(name: str) -> tuple[Ended, dict]:
        if name not in found:
            work, folder = works[name], tmp_path_factory.mktemp("whole") / name
            ended = call(work, folder, NEVER)
            assert ended.code == work.code, ended.said
            whole(folder)
            assert litter(folder) == []
            found[name] = ended, work.result(folder)
        return found[name]

    return of


def call(work: Work, folder: Path, moment: Moment, *more: str) -> Ended:
    return run([*work.arguments, "-o", str(folder), *more], folder, moment, work.prepare)
