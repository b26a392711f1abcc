"""Commands in a process of their own that ends at a chosen moment, as by a power cut, and tiny settings for them."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

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

    from sdfsim.shape.mesh import read_mesh

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
    from sdfsim.shape import baked_grid
    from sdfsim.shape import fit as fit_module

    plan = replace(fit_module.PLANS["default"], width=8, layers=3, steps=120, batch=64, pool=1000, goal=None)
    fit_module.PLANS["default"] = fit_module.PLANS["quick"] = plan
    fit_module.CHECK_EVERY = 20
    baked_grid.CELLS = baked_grid.FINEST = 16


def tiny_train() -> None:
    """A training of 30 steps with a checkpoint after each, and a line of the log every three."""
    from sdfsim.training import train

    train.PRESETS["small"] = train.Preset("impulse", {"width": 8, "rounds": 1}, steps=30, batch=4, rate=3e-3)
    train.CHECKPOINT_SECONDS = 0.0


def tiny_simulate() -> None:
    """A checkpoint after every step."""
    from sdfsim import run

    run.EVERY = 0.0


def tiny_reconstruct() -> None:
    """Poses that are given, 12 steps of training, a checkpoint after each, and a tiny fit of the ball it began as."""
    from pipeline import stages
    from pipeline.field import training
    from pipeline.field.grid_field import FieldSize

    small = FieldSize((8, 16), (2, 2), 16, 8)
    training.PRESETS["quick"] = replace(
        training.PRESETS["quick"], size=small, rays=32, iterations=12, surface_points=16, long_side=64
    )
    # One thread: its sums do not depend on how busy the machine is.
    training.train.__kwdefaults__ |= {"checkpoint_every": 0.0, "threads": 1}
    stages.STAGES["poses"] = replace(stages.STAGES["poses"], run=_given_poses)
    tiny_fit()


def _given_poses(run: Any, work: Path) -> dict:
    """Four cameras around the origin, in place of structure from motion."""
    from pipeline.cameras import View, save_views
    from pipeline.inputs.photos import load_photos
    from sdfsim.files import write_arrays

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
