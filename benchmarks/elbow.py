"""Errors of engines on real tosses of an elbow, two links on a hinge, each engine with its own best parameters.

    python -m benchmarks elbow TOSSES -o DIR [--rounds N]

TOSSES holds `elbow.npz`: tosses of two printed links onto a table, tracked at 148 Hz (dair_pll). `sdfsim identify`
finds our parameters on 60 tosses. A search like that of `benchmarks/reality.py` for the cube finds the same number of
parameters for other engines on the same tosses. Errors are measured on 100 others, over the first 75 frames, from the
same starts.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.results import progress
from benchmarks.tosses import (
    CLEAR,
    FLIGHT,
    FRAMES,
    ROUNDS,
    SOFT,
    SOLID,
    Bounds,
    Engine,
    Motion,
    Start,
    Thing,
    apart,
    bullet,
    cost,
    drawn,
    mujoco,
    ours,
    read_tosses,
    recorded,
    searched,
)  # fmt: skip
from sdfsim.apps.identify import identify, write_scene
from sdfsim.apps.observed import Recording, cleaned, with_velocities
from sdfsim.base.files import read_arrays, write_json, write_text
from sdfsim.data.public_tosses import ARM, ELBOW, LINK, PIVOT, Links, links_of, lowest, upright
from sdfsim.evaluation.harness import markdown, one_thread
from sdfsim.evaluation.metrics import interval
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


# --- what recordings say without any engine ---

CORNERS = 0.5 * LINK * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
ALONE, AWAY = 0.008, 0.003  # m: how much lower an impact's corner is than the next; how high all corners are after it
BEFORE, AFTER = 9, 6  # frames for the velocities before and after an impact


class Moving(NamedTuple):
    """Both links at one time: turns, and places [2, 3] and velocities [2, 3] about their mass centre, which moves with
    `speed` [3]."""

    turns: tuple[Rotation, Rotation]
    place: np.ndarray  # m
    velocity: np.ndarray  # m/s
    spin: np.ndarray  # rad/s
    speed: np.ndarray  # m/s

    def corner(self, link: int, corner: int) -> np.ndarray:
        """[3] m, about the mass centre."""
        return self.place[link] + self.turns[link].apply(CORNERS[corner])

    def velocity_of(self, link: int, point: np.ndarray) -> np.ndarray:
        return self.speed + self.velocity[link] + np.cross(self.spin[link], point - self.place[link])

    def turning(self) -> np.ndarray:
        """[3] N m s, the angular momentum of solid links about the mass centre."""
        inertia = (turn.as_matrix() @ np.diag(EVEN) @ turn.as_matrix().T for turn in self.turns)
        own = sum(i @ w for i, w in zip(inertia, self.spin, strict=True))
        return own + MASS * np.cross(self.place, self.velocity).sum(0)


def moving(toss: Links, frames: np.ndarray, at: float, dt: float, gravity: np.ndarray) -> Moving:
    """By parabolas through these frames, at the time `at` in frames."""
    time = dt * (frames - at)[:, None]
    powers = time ** np.arange(3)
    one, two = (Rotation.from_quat(toss.quat_xyzw[frames, k]) for k in (0, 1))
    turn, rate = np.linalg.lstsq(powers, (one * one[0].inv()).as_rotvec(), rcond=None)[0][:2]
    first, tiny = Rotation.from_rotvec(turn) * one[0], 1e-5
    spin = (Rotation.from_rotvec(turn + tiny * rate) * Rotation.from_rotvec(turn).inv()).as_rotvec() / tiny
    bent = np.linalg.lstsq(powers, np.unwrap((one.inv() * two).as_rotvec()[:, 1]), rcond=None)[0]
    second = first * Rotation.from_rotvec([0.0, bent[0], 0.0])
    spins = np.stack([spin, spin + bent[1] * first.apply([0.0, 1.0, 0.0])])
    arms = first.apply(PIVOT), second.apply(ARM)
    apart, fast = sum(arms), sum(np.cross(w, arm) for w, arm in zip(spins, arms, strict=True))
    middle = toss.position[frames].mean(1) - 0.5 * time**2 * gravity
    speed = np.linalg.lstsq(powers[:, :2], middle, rcond=None)[0][1]
    half = 0.5 * np.array([[-1.0], [1.0]])
    return Moving((first, second), half * apart, half * fast, spins, speed)


def impacts(tosses: Sequence[Links], dt: float, gravity: np.ndarray) -> dict[str, list[float]]:
    """Quartiles, with the number of impacts, over first impacts of one corner with no contact for a while after:
    restitution of that corner, impulse along the table over that across it, and the share of the change of angular
    momentum that an impulse at that corner does not explain."""
    found: dict[str, list[float]] = {}
    for toss in tosses:
        first = flight(toss)
        turns = Rotation.from_quat(toss.quat_xyzw.reshape(-1, 4)).as_matrix().reshape(-1, 2, 3, 3)
        height = (toss.position[:, :, None] + np.einsum("tkij,cj->tkci", turns, CORNERS))[..., 2].reshape(-1, 16)
        low = height.min(1)
        if first < BEFORE + 1 or first + 2 >= len(low):
            continue
        at = first - 1 + int(np.argmin(low[first - 1 : first + 2]))
        after = np.arange(at + 1, at + 1 + AFTER)
        if after[-1] >= len(low) or low[after[1:]].min() < AWAY or np.diff(np.sort(height[at])[:2])[0] < ALONE:
            continue
        # Between frames: a fifth of one before the lowest.
        a, b = (moving(toss, k, at - 0.2, dt, gravity) for k in (np.arange(first - BEFORE - 1, first - 1), after))
        link, corner = divmod(int(height[at].argmin()), 8)
        push, arm = 2.0 * MASS * (b.speed - a.speed), a.corner(link, corner)
        if push[2] < 0.3:  # N s; the least impulse of the table
            continue
        turned = b.turning() - a.turning()
        came, went = (one.velocity_of(link, one.corner(link, corner))[2] for one in (a, b))
        told = -went / came, np.hypot(*push[:2]) / push[2]
        left = np.linalg.norm(turned - np.cross(arm, push)) / np.linalg.norm(turned)
        names = "restitution", "impulse along over across", "angular momentum that is left"
        for name, value in zip(names, (*told, left), strict=True):
            found.setdefault(name, []).append(float(value))
    return {name: [*np.percentile(values, [25, 50, 75]).tolist(), len(values)] for name, values in found.items()}


def growth(found: Motion, truth: Motion, flights: Sequence[int]) -> dict[int, tuple[float, float]]:
    """By frames since the last one before the first impact: medians of the links' errors in position, mm, and rotation,
    degrees."""
    way, angle = apart(found, truth)
    way, angle = 1e3 * np.sqrt(np.square(way).mean(-1)), np.degrees(angle.mean(-1))
    told = {}
    for frame in (0, 1, 2, 4, 8, 16, 32):
        rows = [(k, n - 2 + frame) for k, n in enumerate(flights) if 0 <= n - 2 + frame < FRAMES]  # poses from 1 on
        told[frame] = tuple(float(np.median([of[row] for row in rows])) for of in (way, angle))
    return told


def table(result: dict[str, tuple[np.ndarray, np.ndarray]]) -> str:
    """The table of each engine's errors [3, B] on the tosses of its fit, and on the others; best first."""
    heads = "position, % of a link", "rotation, degrees", "hinge, degrees", "sdfsim minus it", "the same on the 60"
    rows: list[tuple[str, ...]] = [("", *heads)]
    for name, (fitted, judged) in sorted(result.items(), key=lambda item: item[1][1][0].mean()):
        cells = [f"{np.mean(e):.1f} +- {interval(e)[1] - np.mean(e):.1f}" for e in judged]
        less = judged if name == "sdfsim" or "sdfsim" not in result else result["sdfsim"][1] - judged
        apart = " / ".join("{:.1f} [{:.1f}, {:.1f}]".format(np.mean(e), *interval(e)) for e in less)
        known = ", ".join(f"{np.mean(e):.1f}" for e in fitted)
        rows.append((name, *cells, "" if less is judged else apart, known))
    return markdown(rows)


HINGE = {"drag": (0.0, 0.05), "damping_of_hinge": (0.0, 0.005), "inertia": (0.7, 2.0), "friction": (0.05, 0.6)}
THING = Thing(LINK, MASS, EVEN, hinged=True)
ENGINES: dict[str, tuple[Engine, Bounds]] = {
    "MuJoCo": (partial(mujoco, THING), SOFT | HINGE),
    "PyBullet": (partial(bullet, THING), SOLID | HINGE),
}
ALL = ["sdfsim", *ENGINES]


@one_thread()
def main(tosses: Path, *, out: Path, rounds: int = ROUNDS, only: list[str] = ALL) -> None:
    dt, known = load_tosses(tosses)
    out.mkdir(parents=True, exist_ok=True)
    gravity = gravity_of(known, dt)
    write_text(out / "scene.yaml", ELBOW.format(gravity=np.round(gravity, 4).tolist()))
    scene = load_scene(out / "scene.yaml")
    groups = drawn(begun(known, dt, scene))[:2]
    (fit, fit_truth), (test, test_truth) = (
        ([start_of(r) for _, r in group], recorded([toss for toss, _ in group])) for group in groups
    )
    flights = [flight(toss) for toss, _ in groups[1]]
    result: dict[str, Any] = {}
    for name, (low, middle, high, count) in impacts(known, dt, gravity).items():
        print(f"first impacts of one corner, {name}: {middle:.3f} ({low:.3f} to {high:.3f}), {count:.0f} of them")
    for k, name in enumerate(only):
        if name == "sdfsim":
            progress(0.0, "sdfsim: identify")
            own = identify([r for _, r in groups[0]], scene, on_progress=progress)
            write_scene(own, out / "scene.yaml", out / "identified.yaml")
            found = load_scene(out / "identified.yaml")
            values = {"bodies": own.scene_values, "joints": own.joint_values}
            moved = [ours(starts, dt, found) for starts in (fit, test)]
            print("sdfsim, mm and degrees by frames from the first impact:", growth(moved[1], test_truth, flights))
            write_json(out / "identified.json", own.report())
        else:
            engine, bounds = ENGINES[name]
            progress(k / len(only), f"{name}: {rounds} rounds of a search over {len(bounds)} parameters")
            values = searched(
                lambda v, engine=engine: cost(errors(engine(fit, dt, gravity, v), fit_truth)[:2]), bounds, rounds
            )
            moved = [engine(starts, dt, gravity, values) for starts in (fit, test)]
        result[name] = values, *(errors(m, t) for m, t in zip(moved, (fit_truth, test_truth), strict=True))
    kept = {n: {"values": v, "fit": f.tolist(), "test": j.tolist()} for n, (v, f, j) in result.items()}
    write_json(out / f"elbow-{'-'.join(result)}.json", kept)
    for name, (values, *_) in result.items():
        print(name, values)
    print(table({name: (fitted, judged) for name, (_, fitted, judged) in result.items()}))
