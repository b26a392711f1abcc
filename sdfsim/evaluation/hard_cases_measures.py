"""What the hard cases measure, on motions of whatever made them: the simulator, the teacher, or a formula."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.dynamics.bodies import largest_extent
from sdfsim.dynamics.rollout import Rollout
from sdfsim.evaluation.hard_cases_depth import penetration
from sdfsim.evaluation.hard_cases_scenes import UP, WALL, body_inertia
from sdfsim.scene.scene import Scene

FALLEN = 0.25  # of a body's height at the start: what has sunk by more has fallen
GAIN = 0.01  # of the energy at the start: a step that adds more is counted
APART = 0.1  # of a body's size: motions farther from each other than this have diverged
RUNAWAY = 10.0  # times the energy at the start, and no motion is worth measuring
CURVE = 120  # points kept of a curve


@dataclass(frozen=True)
class Run:
    """One motion of one scene.

    Attributes:
        scene: what moved.
        rollout: how, up to the last good state.
        broke: the simulator's error where it ended early, else empty.
    """

    scene: Scene
    rollout: Rollout
    broke: str = ""


@dataclass(frozen=True)
class Measured:
    """What one case gave.

    Attributes:
        figures: name -> value.
        curve: [2, K]: what is drawn; empty where there is nothing to draw.
        worst: index of the run that is worth watching.
    """

    figures: dict[str, float]
    curve: np.ndarray
    worst: int = 0


Measure = Callable[[Sequence[Run]], Measured]


def movers(scene: Scene) -> np.ndarray:
    """[M] indices of the dynamic bodies."""
    return np.array([k for k, b in enumerate(scene.bodies) if b.motion == "dynamic"])


def size(scene: Scene) -> float:
    """m, the mean largest extent of the dynamic bodies."""
    return float(np.mean([largest_extent(scene.shapes[b.shape]) * b.scale for b in _dynamic(scene)]))


def energy(run: Run) -> np.ndarray:
    """[T+1] J: kinetic energy of the dynamic bodies, and their potential energy above the height 0."""
    scene, motion = run.scene, run.rollout
    total = np.zeros(len(motion.time))
    for k in movers(scene):
        body = scene.bodies[k]
        turn = Rotation.from_quat(motion.orientation[:, k])
        spin = turn.inv().apply(motion.angular_velocity[:, k])
        total += 0.5 * body.mass * np.square(motion.velocity[:, k]).sum(1)
        total += 0.5 * np.einsum("ti,ij,tj->t", spin, body_inertia(body, scene.shapes[body.shape]), spin)
        total -= body.mass * motion.position[:, k] @ scene.gravity
    return total


def ran_away(run: Run) -> str:
    """When a motion had more than `RUNAWAY` times the energy it started with; empty if never.

    The energy at the start counts from one size below the lowest body, so that it is not zero.
    """
    scene, motion = run.scene, run.rollout
    rows = movers(scene)
    mass = np.array([scene.bodies[k].mass for k in rows])
    strength = float(np.linalg.norm(scene.gravity))
    course = energy(run)
    lowest = (motion.position[0, rows] @ -scene.gravity).min() - strength * size(scene)
    at = np.flatnonzero(course - mass.sum() * lowest > RUNAWAY * (course[0] - mass.sum() * lowest))
    if not len(at):
        return ""
    return f"more than {RUNAWAY:g} times the energy of the start from {motion.time[at[0]]:.2f} s on"


def rest(runs: Sequence[Run], *, times: Sequence[float]) -> Measured:
    """How a body at rest behaves: drift after each of `times`, and speed, height and motion over the last second."""
    run = runs[0]
    motion, k, extent = run.rollout, movers(run.scene)[0], size(run.scene)
    path = motion.position[:, k]
    drift = 100 / extent * np.linalg.norm((path - path[0])[:, :2], axis=1)
    last = motion.time >= motion.time[-1] - 1.0
    moved = np.abs(path[last] - path[-1]).max() + np.abs(motion.orientation[last, k] - motion.orientation[-1, k]).max()
    seconds = max(float(np.ptp(motion.time[last])), 1e-9)
    figures = {f"drift {t:g} s": float(drift[min(np.searchsorted(motion.time, t), len(drift) - 1)]) for t in times}
    figures["speed"] = float(np.linalg.norm(np.diff(path[last], axis=0), axis=1).sum()) / seconds
    figures["height"] = 100 * abs(float(path[-1, 2] - path[0, 2])) / float(path[0, 2])
    figures["motion"] = float(moved)
    return Measured(figures, _curve(motion.time, drift))


def standing(runs: Sequence[Run]) -> Measured:
    """How many bodies of a stack have fallen, and how far the others have shifted sideways at most, % of size."""
    run = runs[0]
    motion, rows = run.rollout, movers(run.scene)
    path = motion.position[:, rows]
    sunk = (path[0, :, 2] - path[-1, :, 2]) / _heights(run.scene)
    shift = 100 / size(run.scene) * np.linalg.norm(path - path[0], axis=2)
    fallen = sunk > FALLEN
    figures = {"fallen": float(fallen.sum()), "shift": float(shift[-1, ~fallen].max(initial=0.0))}
    return Measured(figures, _curve(motion.time, shift.max(1)))


def squeezed(runs: Sequence[Run]) -> Measured:
    """Penetration of a stack, % of size, and how many have fallen."""
    depth = penetration(runs[0].scene, runs[0].rollout)
    figures = {"worst depth": 100 * float(depth.max(initial=0.0)) / size(runs[0].scene)}
    stood = standing(runs)
    return Measured(figures | {"fallen": stood.figures["fallen"]}, stood.curve)


def separated(runs: Sequence[Run]) -> Measured:
    """Highest speed m/s of bodies that start in each other, and how deep they still are at the end, % of size."""
    run = runs[0]
    motion = run.rollout
    speed = np.linalg.norm(motion.velocity[:, movers(run.scene)], axis=2).max(1)
    left = 100 * float(penetration(run.scene, run.rollout, every=len(motion) or 1).max(initial=0.0)) / size(run.scene)
    return Measured({"exit speed": float(speed.max()), "depth left": left}, _curve(motion.time, speed))


def passed(runs: Sequence[Run]) -> Measured:
    """Share % of bodies thrown at a plate about the origin that have been below it while over its area."""
    shares = []
    for run in runs:
        plate = next(b for b in run.scene.bodies if b.motion == "static")
        half = run.scene.shapes[plate.shape].sdf.bounds[1]
        path = run.rollout.position[:, movers(run.scene)]
        over = (np.abs(path[..., :2]) < half[:2]).all(-1)
        below = path[..., 2] < plate.position[2] - 0.5 * size(run.scene)
        shares.append(100 * float((over & below).any(0).mean()))
    return Measured({"through": float(np.mean(shares))}, np.zeros((2, 0)), int(np.argmax(shares)))


def rebound(runs: Sequence[Run], *, restitution: float) -> Measured:
    """Height of the first rebound of balls dropped onto the floor, % of what they fell, against e^2.

    The mean over the balls of a scene; the curve is that of the first, its lowest point.
    """
    run = runs[0]
    motion, shares = run.rollout, []
    for k in movers(run.scene):
        radius = run.scene.shapes[run.scene.bodies[k].shape].sdf.bounds[1, 2]
        low, rate = motion.position[:, k, 2] - radius, motion.velocity[:, k, 2]
        hit = np.flatnonzero(rate[1:] > rate[:-1])  # what flies gets slower upwards with every step
        up = np.flatnonzero(rate[hit[0] + 1 :] > 0) if len(hit) else hit
        shares.append(100 * max(0.0, float(low[hit[0] + 1 + up[0] :].max())) / float(low[0]) if len(up) else 0.0)
    share = float(np.mean(shares))
    first = movers(run.scene)[0]
    radius = run.scene.shapes[run.scene.bodies[first].shape].sdf.bounds[1, 2]
    figures = {"rebound": share, "error": abs(share - 100 * restitution**2)}
    return Measured(figures, _curve(motion.time, motion.position[:, first, 2] - radius))


def slipped(runs: Sequence[Run], *, friction: float, offsets: Sequence[float]) -> Measured:
    """Where a body on a slope begins to slide, in degrees from atan(friction).

    The first of the angles tried at which it travels more than half of what it would slide two degrees beyond the
    critical one tells: from its distance we go back as far as Coulomb's law says that each degree adds.

    Args:
        runs: one an angle, rising, each from rest.
        friction: of the contact.
        offsets: of the angles, degrees from the critical one.
    """
    critical = float(np.degrees(np.arctan(friction)))
    travelled = np.array([np.linalg.norm(r.rollout.position[-1, 0] - r.rollout.position[0, 0]) for r in runs])
    seconds, gravity = float(runs[0].rollout.time[-1]), float(np.linalg.norm(runs[0].scene.gravity))
    a_degree = slide(friction, critical + 2.0, seconds, gravity) / 2.0
    over = np.flatnonzero(travelled > a_degree)
    begins = float(offsets[over[0]] - travelled[over[0]] / a_degree) if len(over) else float(offsets[-1])
    return Measured({"slips at": begins, "error": abs(begins)}, np.array([offsets, travelled]))


def slide(friction: float, degrees: float, seconds: float, gravity: float) -> float:
    """m that a body at rest slides on a slope in so many seconds, by Coulomb's law."""
    angle = np.radians(degrees)
    return 0.5 * gravity * max(0.0, float(np.sin(angle) - friction * np.cos(angle))) * seconds**2


def heaped(runs: Sequence[Run]) -> Measured:
    """A pile in a bowl: penetration, who left through the wall, and energy beyond that of the start."""
    run = runs[0]
    motion, rows, extent = run.rollout, movers(run.scene), size(run.scene)
    bowl = next(b for b in run.scene.bodies if b.name == "bowl")
    outer = 0.5 * bowl.scale
    middle = outer * (1 - 0.5 * WALL)
    from_centre = motion.position[:, rows] - bowl.position
    radius, under = np.linalg.norm(from_centre, axis=2), from_centre[..., 2] < 0
    out = (under[:-1] & under[1:] & (radius[:-1] < middle) & (radius[1:] >= middle)).any(0)
    course = energy(run)
    mass = np.array([run.scene.bodies[k].mass for k in rows])
    given = course[0] - float(mass.sum() * np.linalg.norm(run.scene.gravity) * (outer - middle))
    depth = penetration(run.scene, run.rollout, every=10)
    figures = {
        "depth 95 %": 100 * float(np.percentile(depth, 95)) / extent if len(depth) else 0.0,
        "through the wall": float(out.sum()),
        "energy gain": 100 * float((course - course[0]).max() / given),
    }
    return Measured(figures, _curve(motion.time, 100 * course / course[0]))


def created(runs: Sequence[Run]) -> Measured:
    """Energy that came from nothing: share % of steps that add more than `GAIN` of the start's, and the worst, %."""
    gains = [np.diff(energy(run)) / energy(run)[0] for run in runs]
    every = np.concatenate(gains)
    worst = [float(gain.max(initial=0.0)) for gain in gains]
    figures = {"steps with gain": 100 * float((every > GAIN).mean()), "worst gain": 100 * max(worst)}
    return Measured(figures, np.zeros((2, 0)), int(np.argmax(worst)))


def turned_back(runs: Sequence[Run], *, degrees: Sequence[float]) -> Measured:
    """Deviation % of size, at the end, of turned scenes from themselves; `degrees` is one group's, the first 0."""
    apart, curve, worst = 0.0, np.zeros((2, 0)), 0
    for start in range(0, len(runs), len(degrees)):
        reference = runs[start]
        for offset, angle in enumerate(degrees[1:], 1):
            back = Rotation.from_euler("z", -angle, degrees=True)
            distance = _apart(reference, runs[start + offset], back)
            if len(distance) and distance[-1] >= apart:
                apart, worst = float(distance[-1]), start + offset
                curve = _curve(reference.rollout.time[: len(distance)], distance)
    return Measured({"deviation": apart}, curve, worst)


def diverged(runs: Sequence[Run]) -> Measured:
    """Mean time s until motions of the second half are 10 % of a size from the first half's; their length if never."""
    half = len(runs) // 2
    times, curves = [], []
    for one, other in zip(runs[:half], runs[half:], strict=True):
        distance = _apart(one, other, Rotation.identity())
        clock = one.rollout.time[: len(distance)]
        away = np.flatnonzero(distance > 100 * APART)
        times.append(float(clock[away[0]] if len(away) else clock[-1]))
        curves.append(_curve(clock, distance))
    first = int(np.argmin(times))
    return Measured({"diverges after": float(np.mean(times))}, curves[first], half + first)


def _apart(reference: Run, other: Run, back: Rotation) -> np.ndarray:
    """[T+1] % of size: root mean square over the bodies of how far they are from each other."""
    rows = movers(reference.scene)
    frames = min(len(reference.rollout.time), len(other.rollout.time))
    place = other.rollout.position[:frames, rows]
    returned = back.apply(place.reshape(-1, 3)).reshape(place.shape)
    distance = np.square(returned - reference.rollout.position[:frames, rows]).sum(2).mean(1) ** 0.5
    return 100 / size(reference.scene) * distance


def _heights(scene: Scene) -> np.ndarray:
    """[M] m, vertical extent of the dynamic bodies as they stand at the start."""
    tops = []
    for body in _dynamic(scene):
        level = Rotation.from_quat(body.quat_xyzw).apply(scene.shapes[body.shape].mesh.vertices) @ UP
        tops.append(float(np.ptp(level)) * body.scale)
    return np.array(tops)


def _dynamic(scene: Scene) -> list:
    return [b for b in scene.bodies if b.motion == "dynamic"]


def _curve(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    kept = np.unique(np.linspace(0, len(x) - 1, min(len(x), CURVE)).astype(int))
    return np.array([x[kept], y[kept]])
