"""Errors of engines on real tosses, each with its own best parameters: RESULTS.md, docs/joints.md.

    python -m benchmarks tosses cube TOSSES -o DIR
    python -m benchmarks tosses elbow TOSSES -o DIR

TOSSES holds `cube.npz`, tosses of an acrylic cube onto a table (ContactNets; Pfrommer, Halm and Posa 2020), and
`elbow.npz`, tosses of two printed links on a hinge (dair_pll; Bianchini, Halm and Posa 2023), both tracked at 148 Hz.
Starts are fitted to the flight before the first impact, as `sdfsim identify` does, which finds our parameters on 60
tosses; for other engines a search finds the same number of parameters on the same tosses, with the same number of
tries. Errors are measured on 100 others, over the first 75 frames, from the same starts. Engines that are not installed
are left out. The cube takes five minutes, and ten more with Drake.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from scipy.optimize import differential_evolution
from scipy.spatial.transform import Rotation

from benchmarks.engines.drake import DrakeWorld
from benchmarks.engines.pybullet import BulletWorld
from benchmarks.records import Cell, Out, progress, write_record
from sdfsim.apps.identify.optimiser import identify
from sdfsim.apps.identify.report import Identified, write_scene
from sdfsim.apps.identify.residuals import repeated
from sdfsim.apps.mujoco_world import MujocoWorld, Unstable
from sdfsim.apps.observed import Recording, cleaned, with_velocities
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_arrays, write_text
from sdfsim.base.lazy import NotInstalled
from sdfsim.data.public_tosses import CUBE, ELBOW, FALL, LINK, Links, links_of, upright
from sdfsim.evaluation.engines import World
from sdfsim.evaluation.harness import Line, Panel, draw, number, one_thread
from sdfsim.evaluation.metrics import interval
from sdfsim.physics.motion import MOTION
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Scene

FRAMES = 75  # compared: half a second
FIT, FEW, TEST, SEED = 60, 16, 100, 0  # tosses for fits, and for a second fit of ours
CLEAR = 0.005  # m: a body higher than this over z = 0 flies; the table is 1 to 6 mm lower
FLIGHT = 6  # frames at least, to fit a start to
INNER = 5  # inner steps of every engine in a frame
APART = np.array([20.0, 0.0, 0.0])  # m between tosses, which meet the table alone
IMPRATIO = 14.0  # MuJoCo: stiffness of friction relative to the normal
FAR = 30.0  # % and degrees: cap on the errors of a toss in the search for parameters
CROWD, ROUNDS = 25, 15  # of that search: points (rounded up to a power of two), and rounds
# Bounds of the engines' parameters, lower and upper. Sizes are relative, heights in m, times in s, inertias relative to
# the published one, or to a solid link's.
BODY = {"friction": (0.05, 0.4), "height": (-0.006, 0.003), "side": (0.9, 1.02), "inertia": (0.8, 1.4)}
SOLID = BODY | {"restitution": (0.0, 0.5)}
SOFT = BODY | {"softness": (0.003, 0.04), "damping": (0.05, 1.2)}
HINGE = {"drag": (0.0, 0.05), "damping_of_hinge": (0.0, 0.005), "inertia": (0.7, 2.0), "friction": (0.05, 0.6)}
OURS, FEWER = "sdfsim", f"sdfsim, found on {FEW} tosses"
Bounds = dict[str, tuple[float, float]]
One = TypeVar("One")


class Motion(NamedTuple):
    """Poses of B tosses of D bodies in the frames after their first."""

    position: np.ndarray  # [B, T, D, 3] m
    quat_xyzw: np.ndarray  # [B, T, D, 4]


# --- recordings ---


@dataclass(frozen=True)
class Thing:
    """What was tossed; its scene is that of the public recordings."""

    name: str  # of its file
    scene: str
    sides: np.ndarray  # [3] m, of each body
    inertia: np.ndarray  # [3] kg m2, of each body

    def load(self, folder: Path) -> Scene:
        """The scene, which is also written to a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        write_text(folder / "scene.yaml", self.scene)
        return load_scene(folder / "scene.yaml")

    def tosses(self, folder: Path) -> tuple[float, list[Links]]:
        """Frame spacing s, and the poses [T, D, *] of every toss, in axes that are upright on the table. Raises
        SdfsimError if the file is absent."""
        file, tosses = folder / f"{self.name}.npz", []
        found = read_arrays(file, "recorded tosses", f"give the folder that holds {file.name}")
        for k, (a, b) in enumerate(zip(found["start"][:-1], found["start"][1:], strict=True)):
            place, quat = (found[name][a:b].astype(np.float64) for name in ("position", "quat_xyzw"))
            if "hinge" in found:
                both = links_of(place, Rotation.from_quat(quat), found["hinge"][a:b].astype(np.float64))
                tosses.append(upright(both, int(found["number"][k])))
            else:
                tosses.append(Links(place[:, None], quat[:, None]))
        return float(found["dt"]), tosses

    def flight(self, toss: Links) -> int:
        """Number of frames before the lowest corner is as near to the table as `CLEAR`; all, if it never is."""
        up = Rotation.from_quat(toss.quat_xyzw.reshape(-1, 4)).as_matrix()[:, 2]
        low = toss.position[..., 2] - 0.5 * (np.abs(up) @ self.sides).reshape(toss.position.shape[:2])
        near = np.any(low < CLEAR, axis=1)
        return int(np.argmax(near)) if near.any() else len(near)

    def begun(self, tosses: Sequence[Links], dt: float, scene: Scene) -> list[tuple[Links, Recording]]:
        """Tosses, and what `sdfsim identify` makes of them, from the first frame of the flight before the first impact:
        only tosses with such a flight and of sufficient length."""
        poses = [np.concatenate(toss, -1) for toss in tosses]
        known = with_velocities([cleaned(str(k), dt, p, scene) for k, p in enumerate(poses)], scene)
        found = []
        for toss, r in zip(tosses, known, strict=True):
            end = self.flight(toss)
            rows = np.flatnonzero(r.flying[:end].all(1))
            if not len(rows) or end - rows[-1] > FLIGHT:
                continue
            held = np.flatnonzero(~r.flying[: rows[-1]].all(1))
            first = int(held[-1]) + 1 if len(held) else 0
            if rows[-1] + 1 - first >= FLIGHT and len(toss.position) - first > FRAMES:
                names = (*MOTION, "known", "flying", "seen")
                later = {name: getattr(r, name)[first:] for name in names}
                goal = (r.goal[0][first:], r.goal[1][first:])
                found.append((Links(*(part[first:] for part in toss)), replace(r, goal=goal, **later)))
        return found


SIDE, MASS = 0.1048, 0.37  # m and kg; a link has the same mass
INERTIA, EVEN = 0.00081, MASS * SIDE**2 / 6.0  # kg m2, as published, and a solid cube's
SOLID_LINK = MASS / 12.0 * np.array([LINK[b] ** 2 + LINK[c] ** 2 for b, c in ((1, 2), (2, 0), (0, 1))])
A_CUBE = Thing("cube", CUBE.format(gravity=-9.81, factor=INERTIA / EVEN), np.full(3, SIDE), np.full(3, INERTIA))
AN_ELBOW = Thing("elbow", ELBOW.format(gravity=FALL), LINK, SOLID_LINK)


def drawn(usable: Sequence[One]) -> tuple[list[One], list[One], list[One]]:
    """Tosses for fitting parameters, others for testing, and the rest. Raises SdfsimError for too few."""
    if len(usable) < FIT + TEST:
        raise SdfsimError(f"{len(usable)} tosses are long enough (at least {FIT + TEST})")
    order = np.random.default_rng(SEED).permutation(len(usable))
    fit, test, rest = ([usable[k] for k in part] for part in np.split(order, [FIT, FIT + TEST]))
    return fit, test, rest


def recorded(tosses: Sequence[Links]) -> Motion:
    """The compared frames of recordings."""
    frames = slice(1, FRAMES + 1)
    return Motion(*(np.array([getattr(toss, name)[frames] for toss in tosses]) for name in Motion._fields))


def apart(found: Motion, truth: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Distances m and angles rad of poses, [B, T, D]."""
    way = np.linalg.norm(found.position - truth.position, axis=-1)
    return way, (_turns(found) * _turns(truth).inv()).magnitude().reshape(way.shape)


def _turns(motion: Motion, *bodies: int) -> Rotation:
    return Rotation.from_quat((motion.quat_xyzw[:, :, bodies[0]] if bodies else motion.quat_xyzw).reshape(-1, 4))


def errors(found: Motion, truth: Motion, length: float) -> np.ndarray:
    """[2 or 3, B] of each toss: root mean square distance in % of a length, mean turn in degrees, and, of two bodies,
    the mean error of the angle between them in degrees."""
    way, angle = apart(found, truth)
    told = [100.0 / length * np.sqrt(np.square(way).mean((1, 2))), np.degrees(angle.mean((1, 2)))]
    if way.shape[2] > 1:
        bent, true = (_turns(m, 0).inv() * _turns(m, 1) for m in (found, truth))
        told.append(np.degrees((bent * true.inv()).magnitude().reshape(way.shape[:2]).mean(1)))
    return np.stack(told)


def cost(errors: Iterable[np.ndarray]) -> float:
    """Sum of the mean errors [B] of tosses, % and degrees. Errors are capped, because otherwise the few cubes that come
    to rest on another face by chance would dominate the fit."""
    return float(sum(np.minimum(error, FAR).mean() for error in errors))


def with_interval(errors: np.ndarray) -> list[float]:
    """The mean over tosses [B], and its 95 % interval."""
    return [float(errors.mean()), *interval(errors)]


def searched(loss: Callable[[dict[str, float]], float], bounds: Bounds, rounds: int = ROUNDS) -> dict[str, float]:
    """The values within bounds with the least loss. On sixty tosses the loss has many local minima, in which a simplex
    gets stuck."""
    found = differential_evolution(
        lambda point: loss(dict(zip(bounds, point, strict=True))), list(bounds.values()), maxiter=rounds - 1,
        popsize=CROWD // len(bounds), init="sobol", tol=0.0, polish=False, rng=SEED,
    )  # fmt: skip
    return dict(zip(bounds, found.x.tolist(), strict=True))


# --- engines ---


def ours(starts: Sequence[Recording], dt: float, scene: Scene) -> Motion:
    """The motion of the scene that `sdfsim identify` wrote, from the first frames of recordings."""
    begun = []
    for r in starts:
        place, turn, speed, spin = (np.repeat(getattr(r, name)[:1], FRAMES + 1, axis=0) for name in MOTION)
        yes = np.ones(place.shape[:2], bool)
        begun.append(Recording("", dt, place, turn, speed, spin, yes[:, 0], ~yes, yes, (place, turn)))
    return Motion(*repeated(begun, scene, FRAMES))


def thrown(
    scene: Scene, starts: Sequence[Recording], step: float, values: dict[str, float], inertia: np.ndarray
) -> Scene:
    """The bodies of a scene at the first frames of recordings, far from each other on its table, with an engine's
    parameters.

    Engines with symplectic Euler follow the exact parabola if they start with the velocity of half a step ago.
    `inertia` [3] kg m2 is that of a body.
    """
    table, *things = scene.bodies
    bodies, joints = [replace(table, position=np.array([0.0, 0.0, values["height"]]))], []
    for k, start in enumerate(starts):
        first = [getattr(start, name)[0] for name in MOTION]
        for joint in scene.joints:
            one, other = (of + k * len(things) for of in joint.bodies)
            drag, damping = values["drag"], values["damping_of_hinge"]
            turn, held = (
                Rotation.from_quat(first[1][of - 1]) * Rotation.from_quat(quat)
                for of, quat in zip(joint.bodies, joint.quat_xyzw, strict=True)
            )
            angle = float((held.inv() * turn).as_rotvec()[0])
            hinge = replace(joint, name=f"joint{k}", bodies=(one, other), friction=drag, damping=damping, start=angle)
            joints.append(hinge)
        for body, place, quat, speed, spin in zip(things, *first, strict=True):
            bodies.append(replace(
                body, name=f"{body.name}{k}", position=place + k * APART, quat_xyzw=quat, angular_velocity=spin,
                velocity=speed - 0.5 * step * scene.gravity, scale=values["side"], friction=values["friction"],
                restitution=values.get("restitution", 0.0), inertia=np.diag(values["inertia"] * inertia),
            ))  # fmt: skip
    return replace(scene, bodies=tuple(bodies), joints=tuple(joints))


def moved(world: World, count: int) -> Motion:
    """The motion of `count` thrown things in an engine."""
    poses: list[tuple[np.ndarray, ...]] = []
    for _ in range(FRAMES):
        world.advance(INNER)
        poses.append(world.state()[:2])
    place, quat = (
        np.swapaxes(np.reshape(of, (FRAMES, count, -1, of[0].shape[-1])), 0, 1) for of in zip(*poses, strict=True)
    )
    place = place - APART * np.arange(count)[:, None, None, None]
    return Motion(place, quat)


def mujoco(
    scene: Scene, inertia: np.ndarray, starts: Sequence[Recording], dt: float, values: dict[str, float], *,
    cone: Literal["elliptic", "pyramidal"] = "elliptic",
) -> Motion:  # fmt: skip
    """MuJoCo: contacts are damped springs with a time constant, s, and a damping ratio."""
    step, contact = dt / INNER, (values["softness"], values["damping"])
    world = MujocoWorld(
        thrown(scene, starts, step, values, inertia), step, cone=cone, contact=contact,
        impratio=IMPRATIO if cone == "elliptic" else 1.0,
    )  # fmt: skip
    return moved(world, len(starts))


def bullet(
    scene: Scene, inertia: np.ndarray, starts: Sequence[Recording], dt: float, values: dict[str, float]
) -> Motion:
    """PyBullet with default settings."""
    step = dt / INNER
    with BulletWorld(thrown(scene, starts, step, values, inertia), step) as world:
        return moved(world, len(starts))


def drake(
    scene: Scene, inertia: np.ndarray, starts: Sequence[Recording], dt: float, values: dict[str, float]
) -> Motion:
    """Drake with point contact."""
    step = dt / INNER
    thing = thrown(scene, starts, step, values, inertia)
    return moved(DrakeWorld(thing, step, 10.0 ** values["stiffness"], values["dissipation"]), len(starts))


# Called with the scene of one thing on a table, the inertia [3] of each of its bodies, starts, dt and values.
Engine = Callable[[Scene, np.ndarray, Sequence[Recording], float, dict[str, float]], Motion]
ENGINES: dict[str, tuple[Engine, Bounds]] = {
    "MuJoCo, elliptic cone": (mujoco, SOFT),
    "MuJoCo, pyramidal cone": (partial(mujoco, cone="pyramidal"), SOFT),
    "PyBullet": (bullet, SOLID),
    # stiffness in powers of ten of N/m
    "Drake": (drake, BODY | {"stiffness": (3.5, 6.0), "dissipation": (0.0, 2.0)}),
}
HINGED: dict[str, tuple[Engine, Bounds]] = {"MuJoCo": (mujoco, SOFT | HINGE), "PyBullet": (bullet, SOLID | HINGE)}


# --- the tables ---


def values_of(own: Identified) -> dict[str, float]:
    """What `identify` found, by name."""
    every = own.scene_values | own.joint_values
    return {
        f"{name} {key}": value if isinstance(value, float) else value[2]  # of a place, the height
        for name, found in every.items()
        for key, value in found.items()
        if isinstance(value, float) or key == "position"
    }


class Tried(NamedTuple):
    """An engine's parameters, and its motions on the tosses of the fit and on the others."""

    values: dict[str, float]
    fitted: Motion
    judged: Motion


def compared(
    thing: Thing, engines: dict[str, tuple[Engine, Bounds]], tosses: Path, out: Path, fits: dict[str, int]
) -> tuple[dict[str, Tried], list[Motion], float]:
    """Fit and test ours, on so many tosses by its names, and every engine; also the true motions, and dt. Parameters
    with which an engine is unstable cost as much as the cap."""
    scene = thing.load(out)
    dt, known = thing.tosses(tosses)
    groups = drawn(thing.begun(known, dt, scene))[:2]
    fit, test = ([r for _, r in group] for group in groups)
    truths, tried = [recorded([toss for toss, _ in group]) for group in groups], {}
    for name, count in fits.items():
        progress(0.0, f"{name}: identify")
        own = identify(fit[:count], scene)
        write_scene(own, out / "scene.yaml", out / f"identified-{count}.yaml")
        found = load_scene(out / f"identified-{count}.yaml")
        tried[name] = Tried(values_of(own), ours(fit, dt, found), ours(test, dt, found))
    for k, (name, (engine, bounds)) in enumerate(engines.items(), 1):
        progress(k / (len(engines) + 1), f"{name}: {ROUNDS} rounds of a search over {len(bounds)} parameters")
        run = partial(engine, scene, thing.inertia)

        def loss(values: dict[str, float], run: partial[Motion] = run) -> float:
            try:
                return cost(errors(run(fit, dt, values), truths[0], thing.sides[0])[:2])
            except Unstable:
                return 2.0 * FAR

        try:
            values = searched(loss, bounds)
        except NotInstalled as error:
            progress(k / (len(engines) + 1), f"{name} is left out: {error.message}")
            continue
        tried[name] = Tried(values, run(fit, dt, values), run(test, dt, values))
    return tried, truths, dt


def record(name: str, thing: Thing, tried: dict[str, Tried], truths: list[Motion], whats: list[str]) -> None:
    """Write the record: engines better than ours come first, then ours, then the others."""
    found = {
        who: [errors(motion, truth, thing.sides[0]) for motion, truth in zip(one[1:], truths, strict=True)]
        for who, one in tried.items()
    }
    lost = {who: float(np.mean(judged[0] - found[OURS][1][0])) for who, (_, judged) in found.items()}
    rows: list[tuple[Cell, ...]] = []
    for who in sorted(found, key=lambda who: (lost[who], who != OURS)):
        fitted, judged = found[who]
        less = [""] * len(judged) if who == OURS else map(with_interval, found[OURS][1] - judged)
        values = ", ".join(f"{of} {number(value)}" for of, value in tried[who].values.items())
        rows.append((who, *map(with_interval, judged), *less, *(float(e.mean()) for e in fitted), values))
    short = [what.partition(",")[0] for what in whats]
    columns = ["engine", *whats, *(f"{OURS} minus it, {what}" for what in short)]
    columns += [*(f"{what} on the 60" for what in short), "parameters"]
    measured = (
        f"Parameters are from {FIT} tosses, errors from {TEST} others (seed {SEED}), over the first {FRAMES} frames "
        "from the same starts: means over tosses with 95 % intervals. Differences between engines are paired by toss."
    )
    command = f"python -m benchmarks tosses {thing.name} TOSSES -o DIR"
    write_record(name, command, measured, columns, rows)


@one_thread()
def cube(tosses: Path, *, out: Out) -> None:
    """Fit and test every engine on tosses of a cube; write the record, the identified scenes, and a picture."""
    tried, truths, dt = compared(A_CUBE, ENGINES, tosses, out, {FEWER: FEW, OURS: FIT})
    record("reality", A_CUBE, tried, truths, ["position, % of the side", "rotation, degrees"])
    picture(tried, truths[1], dt, out)


@one_thread()
def elbow(tosses: Path, *, out: Out) -> None:
    """Fit and test every engine on tosses of an elbow; write the record, and the identified scene."""
    tried, truths, _ = compared(AN_ELBOW, HINGED, tosses, out, {OURS: FIT})
    record("elbow", AN_ELBOW, tried, truths, ["position, % of a link", "rotation, degrees", "hinge, degrees"])


def picture(tried: dict[str, Tried], truth: Motion, dt: float, out: Path) -> None:
    time = (dt * np.arange(1, FRAMES + 1)).tolist()
    typical = int(np.argsort(errors(tried[OURS].judged, truth, SIDE)[0])[TEST // 2])
    seen = {"recorded": truth, **{name: one.judged for name, one in tried.items()}}
    place = {name: motion.position[typical, :, 0] for name, motion in seen.items()}
    along = place["recorded"][-1, :2] - place["recorded"][0, :2]
    along /= np.linalg.norm(along)
    side = [Line(name, (p[:, :2] @ along).tolist(), p[:, 2].tolist()) for name, p in place.items()]
    height = [Line(name, time, p[:, 2].tolist()) for name, p in place.items()]
    draw([Panel("a typical toss", "m along it", "m", side), Panel("", "s", "height, m", height)], out / "toss.png")


COMMANDS = (cube, elbow)
