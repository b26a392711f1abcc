"""Errors of engines on real tosses of a cube, each with its own best parameters: RESULTS.md.

    python -m benchmarks reality TOSSES -o DIR

TOSSES holds `cube.npz`: tosses of an acrylic cube onto a table, tracked at 148 Hz (ContactNets; Pfrommer, Halm and Posa
2020). Starts are fitted to the flight before the first impact. `sdfsim identify` finds our parameters on 60 tosses; for
other engines a search finds the same number of parameters on the same tosses, with the same number of tries. Errors are
measured on 100 others, over the first 75 frames, from the same starts. Drake takes part if it is installed. It takes
five minutes, and ten more with Drake.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.records import Cell, Out, progress, write_record
from benchmarks.tosses import (
    BODY,
    CLEAR,
    FIT,
    FLIGHT,
    FRAMES,
    ROUNDS,
    SEED,
    SOFT,
    SOLID,
    TEST,
    Bounds,
    Engine,
    Motion,
    Start,
    apart,
    bullet,
    cost,
    drake,
    drawn,
    mujoco,
    ours,
    read_tosses,
    recorded,
    searched,
    with_interval,
)  # fmt: skip
from sdfsim.apps.identify import identify, write_scene
from sdfsim.apps.observed import Recording, cleaned, with_velocities
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import write_text
from sdfsim.base.lazy import NotInstalled
from sdfsim.data.public_tosses import CUBE
from sdfsim.evaluation.harness import Line, Panel, draw, number, one_thread
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Scene

SIDE, MASS, INERTIA = 0.1048, 0.37, 0.00081  # m, kg, kg m2, as published
GRAVITY = 9.81  # m/s^2
EACH = np.full(3, INERTIA)
FEW = 16  # first tosses, for a second fit of ours


@dataclass(frozen=True)
class Toss:
    """One recording: T poses of the cube, evenly spaced in time."""

    dt: float  # s
    position: np.ndarray  # [T, 3] m, of the centre
    quat_xyzw: np.ndarray  # [T, 4]


@dataclass(frozen=True)
class FittedStart(Start):
    """A start, with the error of its fit to the flight."""

    flight: int  # frames before the first impact
    # root mean square over these frames, m and rad
    off: float
    turned_off: float


# --- recordings ---


def load_tosses(folder: Path) -> list[Toss]:
    """The tosses of `cube.npz`. Raises SdfsimError if it is absent or holds no such recordings."""
    dt, tosses = read_tosses(folder / "cube.npz", "position", "quat_xyzw")
    return [Toss(dt, **arrays) for arrays in tosses]


def flight(toss: Toss) -> int:
    """Number of frames before a cube is as near to the table as `CLEAR`; all, if it never is."""
    half = 0.5 * SIDE * np.abs(Rotation.from_quat(toss.quat_xyzw).as_matrix()[:, 2]).sum(1)
    near = toss.position[:, 2] - half < CLEAR
    return int(near.argmax()) if near.any() else len(near)


def fitted_start(toss: Toss, gravity: float = GRAVITY) -> FittedStart:
    """A parabola and an even turn (a cube's free rotation) through the flight before the first impact. Raises
    SdfsimError for fewer frames than `FLIGHT`."""
    count = flight(toss)
    if count < FLIGHT:
        raise SdfsimError(f"a toss of {count} frames before its first impact (at least {FLIGHT})")
    time = toss.dt * np.arange(count)[:, None]
    even = np.concatenate([np.ones_like(time), time], 1)
    fallen = toss.position[:count] + 0.5 * time**2 * [0.0, 0.0, gravity]
    straight = np.linalg.lstsq(even, fallen, rcond=None)[0]
    turns = Rotation.from_quat(toss.quat_xyzw[:count])
    rate = (turns[1:] * turns[:-1].inv()).as_rotvec().mean(0) / toss.dt

    def apart(guess: np.ndarray) -> np.ndarray:
        turned = Rotation.from_rotvec(time * guess[3:]) * Rotation.from_rotvec(guess[:3]) * turns[0]
        return (turns * turned.inv()).as_rotvec().ravel()

    found = least_squares(apart, np.concatenate([np.zeros(3), rate]), x_scale=[0.01] * 3 + [0.1] * 3)
    off, turned_off = fallen - even @ straight, found.fun.reshape(-1, 3)
    return FittedStart(
        position=straight[0],
        quat_xyzw=(Rotation.from_rotvec(found.x[:3]) * turns[0]).as_quat(),
        velocity=straight[1],
        angular_velocity=found.x[3:],
        flight=count,
        off=float(np.sqrt(np.square(off).sum(1).mean())),
        turned_off=float(np.sqrt(np.square(turned_off).sum(1).mean())),
    )


def fall(tosses: Sequence[Toss]) -> tuple[float, float]:
    """The acceleration of recorded cubes in flight, m/s^2, from parabolas, and its standard error. It is that of
    gravity if the recorded lengths and times are right."""
    known, weight = [], []
    for toss in tosses:
        time = toss.dt * np.arange(flight(toss))
        if len(time) < FLIGHT:
            continue
        powers = np.stack([np.ones_like(time), time, -0.5 * time**2], 1)
        known.append(np.linalg.lstsq(powers, toss.position[: len(time), 2], rcond=None)[0][2])
        weight.append(1.0 / np.linalg.inv(powers.T @ powers)[2, 2])
    mean = float(np.average(known, weights=weight))
    spread = np.average((np.array(known) - mean) ** 2, weights=weight)
    return mean, float(np.sqrt(spread * np.square(weight).sum()) / np.sum(weight))


def split(tosses: Sequence[Toss]) -> tuple[list[Toss], list[Toss], list[Toss]]:
    """The result of `drawn`, from tosses that are long enough and fly long enough."""
    return drawn([toss for toss in tosses if len(toss.position) > FRAMES and flight(toss) >= FLIGHT])


def errors(found: Motion, truth: Motion) -> tuple[np.ndarray, np.ndarray]:
    """[B] root mean square distances over frames in % of the side, and [B] mean angles in degrees."""
    way, angle = apart(found, truth)
    return 100.0 / SIDE * np.sqrt(np.square(way).mean(1)), np.degrees(angle).mean(1)


# --- engines ---


EVEN = MASS * SIDE**2 / 6.0  # kg m2, a solid cube's inertia


def recordings_of(tosses: Sequence[Toss], scene: Scene) -> list[Recording]:
    poses = [np.concatenate([toss.position, toss.quat_xyzw], 1)[:, None] for toss in tosses]
    return with_velocities([cleaned(str(k), tosses[k].dt, one, scene) for k, one in enumerate(poses)], scene)


def cube(gravity: float, folder: Path) -> Scene:
    """The cube above the table, which is also written to `scene.yaml` in a folder."""
    write_text(folder / "scene.yaml", CUBE.format(gravity=-gravity, factor=INERTIA / EVEN))
    return load_scene(folder / "scene.yaml")


ENGINES: dict[str, tuple[Engine, Bounds]] = {
    "MuJoCo, elliptic cone": (mujoco, SOFT),
    "MuJoCo, pyramidal cone": (partial(mujoco, cone="pyramidal"), SOFT),
    "PyBullet": (bullet, SOLID),
    # stiffness in powers of ten of N/m
    "Drake": (drake, BODY | {"stiffness": (3.5, 6.0), "dissipation": (0.0, 2.0)}),
}


# --- the table ---


@one_thread()
def main(tosses: Path, *, out: Out, gravity: float = GRAVITY) -> None:
    """Fit and test every engine; write the record, the identified scenes, and pictures."""
    known = load_tosses(tosses)
    groups = split(known)
    (fit, fit_truth), (test, test_truth) = (
        ([fitted_start(toss, gravity) for toss in group], recorded(group)) for group in groups[:2]
    )
    dt = known[0].dt
    out.mkdir(parents=True, exist_ok=True)
    thing = cube(gravity, out)
    moved = {}
    for name, count, file in ((FEWER, FEW, "identified-few.yaml"), (OURS, FIT, "identified.yaml")):
        progress(0.0, f"{name}: identify")
        own = identify(recordings_of(groups[0][:count], thing), thing)
        write_scene(own, out / "scene.yaml", out / file)
        known_by_it = load_scene(out / file)
        table, thrown = own.scene_values["table"], own.scene_values["cube"]
        found = {
            "friction": thrown["friction"], "restitution": thrown["restitution"], "height": table["position"][2],
            "side": thrown["scale"], "inertia": thrown["inertia_factor"] * EVEN / INERTIA,
        }  # fmt: skip
        moved[name] = found, ours(fit, dt, known_by_it), ours(test, dt, known_by_it)
    for k, (name, (engine, bounds)) in enumerate(ENGINES.items(), 1):
        progress(k / (len(ENGINES) + 1), f"{name}: {ROUNDS} rounds of a search over {len(bounds)} parameters")
        try:
            values = searched(lambda v, engine=engine: cost(errors(engine(thing, EACH, fit, dt, v), fit_truth)), bounds)
        except NotInstalled as error:
            progress(k / (len(ENGINES) + 1), f"{name} is left out: {error.message}")
            continue
        moved[name] = values, *(engine(thing, EACH, some, dt, values) for some in (fit, test))
    result = {
        name: {"values": values, "fit": errors(fitted, fit_truth), "test": errors(judged, test_truth)}
        for name, (values, fitted, judged) in moved.items()
    }
    falls, sure = fall(known)
    every = [*fit, *test]
    off = 1e3 * np.median([start.off for start in every])
    turned_off = np.degrees(np.median([start.turned_off for start in every]))
    pictures(moved, test_truth, dt, out)
    measured = (
        f"Parameters are from {FIT} tosses, errors from {TEST} others (seed {SEED}), over the first {FRAMES} frames: "
        "means over tosses with 95 % intervals. Differences between engines are paired by toss. The starts fit the "
        f"free flight to {off:.2f} mm "
        f"and {turned_off:.2f} degrees (medians of root mean squares); recorded cubes fall with {falls:.3f} +- "
        f"{sure:.3f} m/s^2."
    )
    write_record("reality", COMMAND, measured, COLUMNS, rows_of(result))


OURS, FEWER = "sdfsim", f"sdfsim, found on {FEW} tosses"
COMMAND = "python -m benchmarks reality TOSSES -o DIR"


COLUMNS = (
    "engine", "position, % of the side", "rotation, degrees", "sdfsim minus it, position", "sdfsim minus it, rotation",
    "position on the 60", "rotation on the 60", "parameters",
)  # fmt: skip


def rows_of(result: dict[str, Any]) -> list[tuple[Cell, ...]]:
    """Engines better than ours come first, then ours, then the others."""

    def lost(name: str) -> float:
        return float(np.mean(result[name]["test"][0]) - np.mean(result[OURS]["test"][0]))

    rows: list[tuple[Cell, ...]] = []
    for name in sorted(result, key=lambda name: (lost(name), name != OURS)):
        one = result[name]
        change = [own - its for own, its in zip(result[OURS]["test"], one["test"], strict=True)]
        found = ", ".join(f"{of} {number(value)}" for of, value in one["values"].items())
        own = [float(error.mean()) for error in one["fit"]]
        less = ["", ""] if name == OURS else map(with_interval, change)
        rows.append((name, *map(with_interval, one["test"]), *less, *own, found))
    return rows


def pictures(moved: dict[str, tuple], truth: Motion, dt: float, out: Path) -> None:
    time, way, turn = (dt * np.arange(1, FRAMES + 1)).tolist(), [], []
    for name, (_, _, found) in moved.items():
        off, angle = apart(found, truth)
        way.append(Line(name, time, (100.0 * np.median(off / SIDE, 0)).tolist()))
        turn.append(Line(name, time, np.degrees(np.median(angle, 0)).tolist()))
    draw(
        [Panel("median of 100 tosses", "s", "% of the side", way), Panel("", "s", "degrees", turn)], out / "reality.png"
    )
    typical = int(np.argsort(errors(moved[OURS][2], truth)[0])[TEST // 2])
    seen = {"recorded": truth, **{name: found for name, (_, _, found) in moved.items()}}
    place = {name: motion.position[typical] for name, motion in seen.items()}
    along = place["recorded"][-1, :2] - place["recorded"][0, :2]
    along /= np.linalg.norm(along)
    side = [Line(name, (p[:, :2] @ along).tolist(), p[:, 2].tolist()) for name, p in place.items()]
    height = [Line(name, time, p[:, 2].tolist()) for name, p in place.items()]
    draw([Panel("a typical toss", "m along it", "m", side), Panel("", "s", "height, m", height)], out / "toss.png")
