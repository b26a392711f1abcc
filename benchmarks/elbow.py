"""Errors of engines on real tosses of an elbow, two links on a hinge, each engine with its own best parameters.

    python -m benchmarks elbow TOSSES -o DIR

TOSSES holds `elbow.npz`: tosses of two printed links onto a table, tracked at 148 Hz (dair_pll). `sdfsim identify`
finds our parameters on 60 tosses. A search like that of `benchmarks/reality.py` for the cube finds the same number of
parameters for other engines on the same tosses. Errors are measured on 100 others, over the first 75 frames, from the
same starts.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.records import Cell, Out, progress, write_record
from benchmarks.tosses import (
    CLEAR,
    FIT,
    FLIGHT,
    FRAMES,
    ROUNDS,
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
from sdfsim.base.files import read_arrays, write_text
from sdfsim.data.public_tosses import ELBOW, LINK, Links, links_of, lowest, upright
from sdfsim.evaluation.harness import number, one_thread
from sdfsim.physics.motion import MOTION
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Scene

MASS = 0.37  # kg of a link
EVEN = MASS / 12.0 * np.array([LINK[b] ** 2 + LINK[c] ** 2 for b, c in ((1, 2), (2, 0), (0, 1))])  # kg m^2, solid
LONGEST, HELD = 10, 0.002  # frames and m: flights used for gravity are longer, and nearer to a parabola


def load_tosses(folder: Path) -> tuple[float, list[Links]]:
    """Frame spacing s, and both links' poses in every toss, in axes aligned with the table."""
    file = folder / "elbow.npz"
    dt, tosses = read_tosses(file, "position", "quat_xyzw", "hinge")
    links = (links_of(t["position"], Rotation.from_quat(t["quat_xyzw"]), t["hinge"]) for t in tosses)
    return dt, [
        upright(both, int(number))
        for both, number in zip(links, read_arrays(file, "recorded tosses")["number"], strict=True)
    ]


def flight(toss: Links) -> int:
    """Number of frames before the lowest corner is as near to the table as `CLEAR`."""
    near = np.any(lowest(toss) < CLEAR, axis=1)
    return int(np.argmax(near)) if near.any() else len(toss.position)


def gravity_of(tosses: Sequence[Links], dt: float) -> np.ndarray:
    """[3] m/s^2, the acceleration of recorded elbows in flight: the median over tosses of that of the mass centre of
    both links until the first impact, if a parabola fits it. Some tosses begin in the hand."""
    found = []
    for toss in tosses:
        count = flight(toss)
        if count < LONGEST:
            continue
        time = dt * np.arange(count)
        powers = np.stack([np.ones_like(time), time, 0.5 * time**2], 1)
        middle = toss.position[:count].mean(1)
        fit = np.linalg.lstsq(powers, middle, rcond=None)[0]
        if np.linalg.norm(middle - powers @ fit, axis=1).max() < HELD:
            found.append(fit[2])
    return np.median(found, axis=0)


def begun(tosses: Sequence[Links], dt: float, scene: Scene) -> list[tuple[Links, Recording]]:
    """Tosses, and their starts by `sdfsim identify`, from the first frame of the flight before the first impact: only
    tosses with such a flight and of sufficient length."""
    poses = [np.concatenate(toss, -1) for toss in tosses]
    found = []
    for toss, r in zip(
        tosses, with_velocities([cleaned(str(k), dt, p, scene) for k, p in enumerate(poses)], scene), strict=True
    ):
        rows = np.flatnonzero(r.flying[: flight(toss)].all(1))
        if not len(rows) or flight(toss) - rows[-1] > FLIGHT:
            continue
        held = np.flatnonzero(~r.flying[: rows[-1]].all(1))
        first = int(held[-1]) + 1 if len(held) else 0
        if rows[-1] + 1 - first >= FLIGHT and len(toss.position) - first > FRAMES:
            found.append((Links(*(part[first:] for part in toss)), _from(r, first)))
    return found


def _from(r: Recording, first: int) -> Recording:
    names = (*MOTION, "known", "flying", "seen")
    return replace(r, goal=(r.goal[0][first:], r.goal[1][first:]), **{n: getattr(r, n)[first:] for n in names})


def start_of(r: Recording) -> Start:
    return Start(r.position[0], r.orientation[0], r.velocity[0], r.angular_velocity[0])


def errors(found: Motion, truth: Motion) -> np.ndarray:
    """[3, B] of each toss: root mean square distance of the links in % of a link's length, mean turn of the links in
    degrees, and mean error of the hinge's angle in degrees."""
    way, angle = apart(found, truth)
    bent = [
        Rotation.from_quat(m.quat_xyzw[:, :, 0].reshape(-1, 4)).inv()
        * Rotation.from_quat(m.quat_xyzw[:, :, 1].reshape(-1, 4))
        for m in (found, truth)
    ]
    hinge = (bent[0] * bent[1].inv()).magnitude().reshape(angle.shape[:2])
    far = 100.0 / LINK[0] * np.sqrt(np.square(way).mean((1, 2)))
    return np.stack([far, np.degrees(angle.mean((1, 2))), np.degrees(hinge.mean(1))])


COLUMNS = (
    "engine", "position, % of a link", "rotation, degrees", "hinge, degrees",
    "sdfsim minus it, position", "sdfsim minus it, rotation", "sdfsim minus it, hinge",
    "position on the 60", "rotation on the 60", "hinge on the 60",
)  # fmt: skip


def rows_of(result: dict[str, tuple[np.ndarray, np.ndarray]]) -> list[tuple[Cell, ...]]:
    """Each engine's errors [3, B] on the tosses of its fit, and on the others; best first."""
    rows: list[tuple[Cell, ...]] = []
    for name, (fitted, judged) in sorted(result.items(), key=lambda item: item[1][1][0].mean()):
        less = [""] * 3 if name == "sdfsim" else map(with_interval, result["sdfsim"][1] - judged)
        rows.append((name, *map(with_interval, judged), *less, *(float(e.mean()) for e in fitted)))
    return rows


HINGE = {"drag": (0.0, 0.05), "damping_of_hinge": (0.0, 0.005), "inertia": (0.7, 2.0), "friction": (0.05, 0.6)}
ENGINES: dict[str, tuple[Engine, Bounds]] = {
    "MuJoCo": (mujoco, SOFT | HINGE),
    "PyBullet": (bullet, SOLID | HINGE),
}


@one_thread()
def main(tosses: Path, *, out: Out) -> None:
    dt, known = load_tosses(tosses)
    out.mkdir(parents=True, exist_ok=True)
    gravity = gravity_of(known, dt)
    write_text(out / "scene.yaml", ELBOW.format(gravity=np.round(gravity, 4).tolist()))
    scene = load_scene(out / "scene.yaml")
    groups = drawn(begun(known, dt, scene))[:2]
    (fit, fit_truth), (test, test_truth) = (
        ([start_of(r) for _, r in group], recorded([toss for toss, _ in group])) for group in groups
    )
    progress(0.0, "sdfsim: identify")
    own = identify([r for _, r in groups[0]], scene, on_progress=progress)
    write_scene(own, out / "scene.yaml", out / "identified.yaml")
    found = load_scene(out / "identified.yaml")
    moved, notes = {"sdfsim": [ours(starts, dt, found) for starts in (fit, test)]}, []
    for k, (name, (engine, bounds)) in enumerate(ENGINES.items(), 1):
        progress(k / (len(ENGINES) + 1), f"{name}: {ROUNDS} rounds of a search over {len(bounds)} parameters")
        values = searched(lambda v, engine=engine: cost(errors(engine(scene, EVEN, fit, dt, v), fit_truth)[:2]), bounds)
        moved[name] = [engine(scene, EVEN, starts, dt, values) for starts in (fit, test)]
        notes.append(f"- {name}: {', '.join(f'{of} {number(value)}' for of, value in values.items())}")
    result = {name: (errors(fitted, fit_truth), errors(judged, test_truth)) for name, (fitted, judged) in moved.items()}
    measured = (
        f"Parameters are from {FIT} tosses of an elbow, errors from {TEST} others, over the first {FRAMES} frames from "
        "the same starts: means with 95 % intervals. Differences between engines are paired by toss."
    )
    write_record("elbow", "python -m benchmarks elbow TOSSES -o DIR", measured, COLUMNS, rows_of(result), notes)
