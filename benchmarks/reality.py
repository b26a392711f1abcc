"""How far engines are from real tosses of a cube, each with its own best parameters: RESULTS.md.

    python benchmarks/reality.py TOSSES -o DIR

TOSSES holds `cube.npz`: tosses of an acrylic cube onto a table, tracked at 148 Hz (ContactNets; Pfrommer, Halm and Posa
2020). Starts are fitted to the flight before the first impact. Every engine's parameters are found on 60 tosses, by the
same search with as many tries, and judged on 100 others, over the first 75 frames. A few minutes.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import differential_evolution, least_squares
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.results import progress, script, write_section
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_arrays, write_json
from sdfsim.data.pybullet_sim import import_pybullet
from sdfsim.evaluation.engines import engine_module
from sdfsim.evaluation.harness import markdown, number, one_thread
from sdfsim.evaluation.metrics import interval
from sdfsim.scene.scene import Body, Effects, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.simulate.simulator import Simulator

SIDE, MASS, INERTIA = 0.1048, 0.37, 0.00081  # m, kg, kg m2, as measured by those who tossed it
GRAVITY = 9.81  # m/s^2
FRAMES = 75  # that are compared: half a second
FIT, TEST, SEED = 60, 100, 0
CLEAR = 0.005  # m: a cube whose lowest corner is higher than this over z = 0 flies; the table is 1 to 6 mm lower
FLIGHT = 6  # frames at least, to fit a start to
INNER = 5  # inner steps of every engine in a frame
IMPRATIO = 14.0  # MuJoCo: how much stiffer friction is than the normal
FAR = 30.0  # % and degrees: errors of a toss that are larger count as this in the search for parameters
CROWD, ROUNDS = 25, 12  # of that search: points (rounded up to a power of two), and rounds


@dataclass(frozen=True)
class Toss:
    """One recording: T poses of the cube, evenly spaced in time."""

    dt: float  # s
    position: np.ndarray  # [T, 3] m, of the centre
    quat_xyzw: np.ndarray  # [T, 4]


@dataclass(frozen=True)
class FittedStart:
    """Pose and velocities at a recording's first frame, and how the flight that they were fitted to differs from it."""

    position: np.ndarray  # [3] m
    quat_xyzw: np.ndarray  # [4]
    velocity: np.ndarray  # [3] m/s
    angular_velocity: np.ndarray  # [3] rad/s, world
    flight: int  # frames before the first impact
    # root mean square over these frames, m and rad
    off: float
    turned_off: float


class Poses(NamedTuple):
    """Poses of B tosses in the frames after their first."""

    position: np.ndarray  # [B, T, 3] m
    quat_xyzw: np.ndarray  # [B, T, 4]


# --- recordings ---


def load_tosses(folder: Path) -> list[Toss]:
    """The tosses of `cube.npz`. Raises SdfsimError where it is absent or holds no such recordings."""
    file = folder / "cube.npz"
    found = read_arrays(file, "recorded tosses", "give the folder that holds cube.npz")
    if missing := {"start", "dt", "position", "quat_xyzw"} - set(found):
        raise SdfsimError(f"{file}: the array {min(missing)!r} is missing", f"it has {', '.join(sorted(found))}")
    rows = [slice(a, b) for a, b in zip(found["start"][:-1], found["start"][1:], strict=True)]
    dt, position, turn = float(found["dt"]), *(found[name].astype(np.float64) for name in ("position", "quat_xyzw"))
    return [Toss(dt, position[k], turn[k]) for k in rows]


def flight(toss: Toss) -> int:
    """How many frames pass before a cube is as near to the table as `CLEAR`; all, where it never is."""
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
    """The acceleration with which recorded cubes fall, m/s^2, and its standard error: a parabola without a given one.
    It is that of gravity where the given lengths and times are right."""
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


def split(tosses: Sequence[Toss]) -> tuple[list[Toss], list[Toss]]:
    """Tosses to find parameters on, and others to judge by; such as are long enough, and fly long enough."""
    usable = [toss for toss in tosses if len(toss.position) > FRAMES and flight(toss) >= FLIGHT]
    if len(usable) < FIT + TEST:
        raise SdfsimError(f"{len(usable)} tosses are long enough (at least {FIT + TEST})")
    order = np.random.default_rng(SEED).permutation(len(usable))
    return [usable[k] for k in order[:FIT]], [usable[k] for k in order[FIT : FIT + TEST]]


def recorded(tosses: Sequence[Toss]) -> Poses:
    """The frames of recordings that are compared."""
    frames = slice(1, FRAMES + 1)
    return Poses(*(np.array([getattr(toss, name)[frames] for toss in tosses]) for name in Poses._fields))


def errors(found: Poses, truth: Poses) -> tuple[np.ndarray, np.ndarray]:
    """[B] root mean square distances over frames in % of the side, and [B] mean angles in degrees."""
    way = np.linalg.norm(found.position - truth.position, axis=-1)
    angle = (_turns(found) * _turns(truth).inv()).magnitude().reshape(way.shape)
    return 100.0 / SIDE * np.sqrt(np.square(way).mean(1)), np.degrees(angle).mean(1)


def _turns(motion: Poses) -> Rotation:
    return Rotation.from_quat(motion.quat_xyzw.reshape(-1, 4))


# --- engines ---


def ours(starts: Sequence[FittedStart], dt: float, gravity: float, values: dict[str, float]) -> Poses:
    """All tosses side by side in one scene, where cubes meet the table alone."""
    side = values["side"] * SIDE
    cubes = [
        Body(
            name=str(k), shape=0, motion="dynamic", scale=1.0, position=start.position, quat_xyzw=start.quat_xyzw,
            velocity=start.velocity, angular_velocity=start.angular_velocity, mass=MASS, inertia=INERTIA * np.eye(3),
            friction=values["friction"], restitution=values["restitution"], collides_with=("table",),
        )
        for k, start in enumerate(starts)
    ]  # fmt: skip
    table = Body(
        name="table", shape=1, motion="static", scale=1.0, position=np.array([0.0, 0.0, values["height"]]),
        quat_xyzw=np.array([0.0, 0.0, 0.0, 1.0]), velocity=np.zeros(3), angular_velocity=np.zeros(3), mass=0.0,
        friction=1.0, restitution=1.0,
    )  # fmt: skip
    scene = Scene(
        (analytic_shape("box", size=(side,) * 3), analytic_shape("plane")), (*cubes, table),
        gravity=np.array([0.0, 0.0, -gravity]), duration=1.0, effects=Effects(sleep="off"),
    )  # fmt: skip
    simulator = Simulator(scene, "solver", dt=dt)
    rollout = simulator.run(steps=FRAMES)
    poses = (rollout.position, rollout.orientation)
    return Poses(*(np.swapaxes(pose[1:, :-1], 0, 1) for pose in poses))


def mujoco(starts: Sequence[FittedStart], dt: float, gravity: float, values: dict[str, float]) -> Poses:
    """MuJoCo's elliptic cone; its contacts are damped springs, of a time constant s and a damping ratio."""
    engine, rollout = (engine_module(name, "MuJoCo", "bench") for name in ("mujoco", "mujoco.rollout"))
    spec, step = engine.MjSpec(), dt / INNER
    spec.option.timestep, spec.option.gravity = step, [0.0, 0.0, -gravity]
    spec.option.cone, spec.option.impratio = engine.mjtCone.mjCONE_ELLIPTIC, IMPRATIO
    spec.worldbody.add_geom(type=engine.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1.0], pos=[0, 0, values["height"]])
    body = spec.worldbody.add_body(mass=MASS, inertia=[INERTIA] * 3, explicitinertial=True)
    body.add_freejoint()
    cube = body.add_geom(type=engine.mjtGeom.mjGEOM_BOX, size=[0.5 * values["side"] * SIDE] * 3)
    cube.priority, cube.condim, cube.friction[0] = 1, 3, values["friction"]
    cube.solref = [max(values["softness"], 2.0 * step), values["damping"]]
    model = spec.compile()
    state = [
        [
            0.0, *start.position, *np.roll(start.quat_xyzw, 1), *_half_a_step_ago(start, step, gravity),
            *Rotation.from_quat(start.quat_xyzw).inv().apply(start.angular_velocity),
        ]
        for start in starts
    ]  # fmt: skip
    states = rollout.rollout(model, engine.MjData(model), np.array(state), nstep=FRAMES * INNER)[0]
    found = states[:, INNER - 1 :: INNER]
    return Poses(found[..., 1:4], np.roll(found[..., 4:8], -1, axis=-1))


def bullet(starts: Sequence[FittedStart], dt: float, gravity: float, values: dict[str, float]) -> Poses:
    """PyBullet with its default settings."""
    engine = import_pybullet()
    client, step = engine.connect(engine.DIRECT), dt / INNER
    try:
        here: dict[str, Any] = {"physicsClientId": client}
        engine.setGravity(0.0, 0.0, -gravity, **here)
        engine.setTimeStep(step, **here)
        plane = engine.createCollisionShape(engine.GEOM_PLANE, **here)
        table = engine.createMultiBody(0.0, plane, basePosition=[0.0, 0.0, values["height"]], **here)
        engine.changeDynamics(table, -1, lateralFriction=1.0, restitution=1.0, **here)
        engine.setCollisionFilterGroupMask(table, -1, 1, 2, **here)
        box = engine.createCollisionShape(engine.GEOM_BOX, halfExtents=[0.5 * values["side"] * SIDE] * 3, **here)
        cubes = []
        for start in starts:
            cube = engine.createMultiBody(MASS, box, -1, start.position, start.quat_xyzw, **here)
            engine.changeDynamics(
                cube, -1, localInertiaDiagonal=[INERTIA] * 3, lateralFriction=values["friction"],
                restitution=values["restitution"], linearDamping=0.0, angularDamping=0.0, **here,
            )  # fmt: skip
            engine.setCollisionFilterGroupMask(cube, -1, 2, 1, **here)  # they meet the table alone
            speed = _half_a_step_ago(start, step, gravity), start.angular_velocity
            engine.resetBaseVelocity(cube, *speed, **here)
            cubes.append(cube)
        frames = []
        for _ in range(FRAMES):
            for _ in range(INNER):
                engine.stepSimulation(**here)
            frames.append([engine.getBasePositionAndOrientation(cube, **here) for cube in cubes])
    finally:
        engine.disconnect(client)
    poses = (np.array([[one[k] for one in frame] for frame in frames]) for k in range(2))
    return Poses(*(np.swapaxes(pose, 0, 1) for pose in poses))


def _half_a_step_ago(start: FittedStart, step: float, gravity: float) -> np.ndarray:
    """The velocity with which engines that add gravity first, and move by the sum, fly along the exact parabola."""
    return start.velocity + np.array([0.0, 0.0, 0.5 * step * gravity])


# Where engines look for their parameters: lower and upper bound. Sizes are in sides, heights in m, times in s.
SOLID = {"friction": (0.05, 0.4), "restitution": (0.0, 0.5), "height": (-0.006, 0.003), "side": (0.9, 1.02)}
SOFT = {
    "friction": (0.05, 0.4), "softness": (0.003, 0.04), "damping": (0.05, 1.2), "height": (-0.006, 0.003),
    "side": (0.9, 1.02),
}  # fmt: skip
Engine = Callable[[Sequence[FittedStart], float, float, dict[str, float]], Poses]
ENGINES: dict[str, tuple[Engine, dict[str, tuple[float, float]]]] = {
    "sdfsim": (ours, SOLID),
    "MuJoCo, elliptic cone": (mujoco, SOFT),
    "PyBullet": (bullet, SOLID),
}


def cost(found: Poses, truth: Poses) -> float:
    """Position error in % and rotation error in degrees, added up. A cube that comes to lie on another face counts as
    far off, no more: else the few that do so by chance decide about the fit."""
    return float(sum(np.minimum(error, FAR).mean() for error in errors(found, truth)))


def identified(loss: Callable[[dict[str, float]], float], bounds: dict[str, tuple[float, float]]) -> dict[str, float]:
    """The values within bounds of the least loss. On sixty tosses it has many dips, so that a simplex gets stuck."""
    found = differential_evolution(
        lambda point: loss(dict(zip(bounds, point, strict=True))), list(bounds.values()), maxiter=ROUNDS - 1,
        popsize=CROWD // len(bounds), init="sobol", tol=0.0, polish=False, rng=SEED,
    )  # fmt: skip
    return dict(zip(bounds, found.x.tolist(), strict=True))


# --- the table ---


@one_thread()
def main(tosses: Path, *, out: Path, gravity: float = GRAVITY) -> None:
    """Identify and judge every engine; the section of the page, and `reality.json` with every toss's errors."""
    known = load_tosses(tosses)
    groups = split(known)
    (fit, fit_truth), (test, test_truth) = (
        ([fitted_start(toss, gravity) for toss in group], recorded(group)) for group in groups
    )
    dt = known[0].dt
    result: dict[str, Any] = {}
    rows: list[tuple[str, ...]] = [("engine", "position, % of the side", "rotation, degrees", "on those 60", "found")]
    for k, (name, (engine, bounds)) in enumerate(ENGINES.items()):
        progress(k / len(ENGINES), f"{name}: {ROUNDS} rounds of a search over {len(bounds)} parameters")
        values = identified(lambda values, engine=engine: cost(engine(fit, dt, gravity, values), fit_truth), bounds)
        own = errors(engine(fit, dt, gravity, values), fit_truth)
        judged = errors(engine(test, dt, gravity, values), test_truth)
        result[name] = {"values": values, "fit": own, "test": judged}
        found = ", ".join(f"{of} {number(value)}" for of, value in values.items())
        rows.append((name, *map(_cell, judged), " / ".join(number(error.mean()) for error in own), found))
    falls, sure = fall(known)
    every = [*fit, *test]
    off = 1e3 * np.median([start.off for start in every])
    turned_off = np.degrees(np.median([start.turned_off for start in every]))
    write_json(out / "reality.json", {"gravity": gravity, "fall": [falls, sure], "engines": _plain(result)})
    text = (
        f"Found on {FIT} tosses, judged on {TEST} others (seed {SEED}), first {FRAMES} frames, means of tosses with "
        f"95 % intervals. Starts fit the free flight to {off:.2f} mm and {turned_off:.2f} degrees (medians of root "
        f"mean squares); recorded cubes fall with {falls:.3f} +- {sure:.3f} m/s^2.\n\n{markdown(rows)}"
    )
    write_section("reality", "python benchmarks/reality.py TOSSES -o DIR", text)


def _cell(error: np.ndarray) -> str:
    low, high = map(number, interval(error))
    return f"{number(float(error.mean()))} [{low}, {high}]"


def _plain(result: dict[str, Any]) -> dict[str, Any]:
    return {
        name: {"values": one["values"], **{of: [error.tolist() for error in one[of]] for of in ("fit", "test")}}
        for name, one in result.items()
    }


if __name__ == "__main__":
    script(__doc__, main)
