"""Errors of engines on real tosses of a cube, each with its own best parameters: RESULTS.md.

    python -m benchmarks reality TOSSES -o DIR

TOSSES holds `cube.npz`: tosses of an acrylic cube onto a table, tracked at 148 Hz (ContactNets; Pfrommer, Halm and Posa
2020). Starts are fitted to the flight before the first impact. `sdfsim identify` finds our parameters on 60 tosses; for
other engines a search finds the same number of parameters on the same tosses, with the same number of tries. Networks
on our solve with these parameters are trained on 8 to 256 tosses, three seeds of each, and chosen by the errors of
whole motions on further tosses. Errors are measured on 100 others, over the first 75 frames, from the same starts.
Drake takes part if it is installed. It takes five minutes, about forty more for the networks, and ten more with Drake.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any, cast

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.results import progress, write_section
from benchmarks.tosses import (
    BODY,
    CLEAR,
    FIT,
    FLIGHT,
    FRAMES,
    INNER,
    ROUNDS,
    SEED,
    SOFT,
    SOLID,
    TEST,
    Bounds,
    Engine,
    Motion,
    Start,
    Thing,
    apart,
    bullet,
    cost,
    drawn,
    half_a_step_ago,
    mujoco,
    ours,
    read_tosses,
    recorded,
    searched,
)  # fmt: skip
from sdfsim.apps.identify import identify, write_scene
from sdfsim.apps.observed import Recording, cleaned, with_velocities
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import write_json, write_text
from sdfsim.base.lazy import NotInstalled, optional
from sdfsim.data.batching import roll_out
from sdfsim.data.dataset import Trajectory
from sdfsim.data.public_tosses import CUBE
from sdfsim.evaluation.harness import Job, Line, Panel, Results, draw, markdown, measure, number, one_thread
from sdfsim.evaluation.metrics import interval
from sdfsim.learned.impulse import ImpulseNetwork
from sdfsim.learned.model import SURFACE, Model, load_model
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Body, Scene
from sdfsim.training.motion_task import MotionTask, Starts
from sdfsim.training.presets import PRESETS, Preset
from sdfsim.training.run import Run
from sdfsim.training.surface_task import SurfaceTask

SIDE, MASS, INERTIA = 0.1048, 0.37, 0.00081  # m, kg, kg m2, as published
THING = Thing(np.full(3, SIDE), MASS, np.full(3, INERTIA))
GRAVITY = 9.81  # m/s^2
FEW = 16  # first tosses, for a second fit of ours
TRAINED, SEEDS = (8, 16, 64, 256), 3  # training tosses of networks, and seeds of each
STEPS, LOOKS = 240, 4  # of a training, and its states among which the choosing tosses decide


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


def drake(starts: Sequence[Start], dt: float, gravity: np.ndarray, values: dict[str, float]) -> Motion:
    """Drake's discrete point contact, the cubes far apart on one half space; its contacts have no rebound, but a
    stiffness and a dissipation."""
    lib: Any = optional("pydrake.all", "Drake", "rivals")
    step, apart, cubes = dt / INNER, 20.0, []
    plant, _ = lib.AddMultibodyPlantSceneGraph(builder := lib.DiagramBuilder(), step)
    plant.mutable_gravity_field().set_gravity_vector(gravity)
    table = lib.ProximityProperties()
    lib.AddContactMaterial(0.0, 1e9, lib.CoulombFriction(1.0, 1.0), table)
    ground = lib.RigidTransform([0.0, 0.0, values["height"]])
    plant.RegisterCollisionGeometry(plant.world_body(), ground, lib.HalfSpace(), "table", table)
    # Drake combines two coefficients a, b to 2 a b / (a + b): with 1 for the table this value gives the wanted
    # friction.
    mu = values["friction"] / (2.0 - values["friction"])
    touch = lib.ProximityProperties()
    lib.AddContactMaterial(values["dissipation"], 10.0 ** values["stiffness"], lib.CoulombFriction(mu, mu), touch)
    side, inertia = values["side"] * SIDE, values["inertia"] * INERTIA
    for k in range(len(starts)):
        unit = lib.UnitInertia(*[inertia / MASS] * 3)
        body = plant.AddRigidBody(f"cube{k}", lib.SpatialInertia(MASS, np.zeros(3), unit))
        plant.RegisterCollisionGeometry(body, lib.RigidTransform(), lib.Box(side, side, side), f"box{k}", touch)
        cubes.append(body)
    plant.Finalize()
    simulator = lib.Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    shift = np.array([[apart * k, 0.0, 0.0] for k in range(len(starts))])
    speeds = plant.GetVelocities(context)
    for cube, start, to in zip(cubes, starts, shift, strict=True):
        turn = lib.RotationMatrix(Rotation.from_quat(start.quat_xyzw).as_matrix())
        plant.SetFreeBodyPose(context, cube, lib.RigidTransform(turn, start.position + to))
        first = cube.floating_velocities_start_in_v()
        speeds[first : first + 3] = start.angular_velocity
        speeds[first + 3 : first + 6] = half_a_step_ago(start, step, gravity)
    plant.SetVelocities(context, speeds)
    place, turns = np.empty((len(starts), FRAMES, 3)), np.empty((len(starts), FRAMES, 4))
    for frame in range(FRAMES):
        simulator.AdvanceTo((frame + 1) * dt)
        for k, cube in enumerate(cubes):
            found = plant.EvalBodyPoseInWorld(context, cube)
            place[k, frame] = found.translation() - shift[k]
            turns[k, frame] = Rotation.from_matrix(found.rotation().matrix()).as_quat()
    return Motion(place, turns)


# --- networks ---


def rolled(network: ImpulseNetwork, task: MotionTask, starts: Sequence[Start]) -> Motion:
    worlds = task.worlds(len(starts))
    position, turn, speed, spin = (
        np.array([getattr(start, name) for start in starts])
        for name in ("position", "quat_xyzw", "velocity", "angular_velocity")
    )
    first = Starts(position, turn, speed, spin, np.zeros((0, 0, 7)))
    steps = worlds.roll(network, first, FRAMES)
    place, turn = (np.stack([getattr(step, name) for step in steps], 1) for name in ("position", "orientation"))
    return Motion(place * worlds.units.length, turn)


def trained(how: Trained, seed: int, rows: Sequence[int], lesson: Lesson) -> tuple[Judged, float, float]:
    """The state of a training on the recordings `rows` with the least error on the choosing tosses: a function that
    moves tosses with it, this error, and the seconds of processor time in total."""
    began = process_time()
    with TemporaryDirectory() as folder:
        plan, known = how.plan(), [lesson.known[k] for k in rows]
        if plan.kind in SURFACE:
            task: Any = SurfaceTask(dataset_of(known, lesson, Path(folder)), "train", plan, noisy=True)
        else:
            task = MotionTask(known or lesson.known[:1], lesson.scene, noisy=True)

        def judged(run: Run) -> Judged:
            if plan.kind in SURFACE:
                return partial(on_surfaces, run.export(plan.kind, []), lesson)
            return partial(rolled, cast("ImpulseNetwork", run.averaged()), task)

        start = load_model(TEACHERS[seed]) if how.teacher else None
        run = Run(plan, task, how.steps, seed, torch.device("cpu"), first=start)
        states = [] if how.steps else [judged(run)]
        while run.step < how.steps:
            run.advance()
            if run.step % (how.steps // LOOKS) == 0:
                states.append(judged(run))
        run.close()
    starts, truth = lesson.chooses
    off = [summed(state(starts), truth) for state in states]
    best = int(np.argmin(off))
    return states[best], off[best], process_time() - began


def summed(found: Motion, truth: Motion) -> float:
    """The criterion for choosing a state of a training: the sum of mean errors, % and degrees."""
    return float(sum(error.mean() for error in errors(found, truth)))


@dataclass(frozen=True)
class Lesson:
    """Data for a network: training, choosing and test tosses."""

    known: list[Recording]  # for training
    scene: Scene  # as identified
    # starts with the recorded motion: of the choosing tosses, and of the test tosses
    chooses: tuple[Sequence[Start], Motion]
    judges: tuple[Sequence[Start], Motion]


@dataclass(frozen=True)
class Trained:
    """One row of the table of networks."""

    preset: str
    tosses: int
    steps: int = STEPS
    teacher: bool = False  # whether it begins with the weights of `TEACHERS`, trained on an engine's recordings

    def plan(self) -> Preset:
        """Its training plan: networks on surface nodes have the size of `sdf-sim-small`, with the lengths of their
        presets scaled from MOVi-B's bodies to this cube."""
        plan = PRESETS[self.preset]
        if plan.kind not in SURFACE:
            return plan
        small, share = PRESETS["sdf-sim-small"], SIDE / BODIES
        return replace(
            plan, config=small.config, batch=small.batch, nodes=NODES, reach=share * plan.reach,
            noise=share * (plan.noise or 0.0),
        )  # fmt: skip


Judged = Callable[[Sequence[Start]], Motion]
BODIES = 1.87  # m, the middle of the sizes of MOVi-B's bodies
NODES = 32  # of a cube, at most
SURFACE_STEPS = 800  # for networks on surface nodes, which have one seed
HERE = Path(__file__).with_name("models")
TEACHERS = [
    HERE / "alone-0.safetensors",
    "gnn",
    HERE / "alone-2.safetensors",
]  # each of 2,000 trajectories (docs/gpu.md)
NETWORKS = {f"on the solve, {count} tosses": Trained("impacts", count) for count in TRAINED}
NETWORKS |= {
    "on the solve, 1,000 steps, 256 tosses": Trained("impacts", 256, PRESETS["impacts"].steps),
    "alone, 256 tosses": Trained("alone", 256),
    "alone, after the engine, no tosses": Trained("alone", 0, 0, teacher=True),
    "alone, after the engine, 256 tosses": Trained("alone", 256, teacher=True),
    **{f"{kind}, 256 tosses": Trained(kind, 256, SURFACE_STEPS) for kind in SURFACE},
}


def learnt(how: Trained, seed: int, lesson: Lesson) -> dict[str, Any]:
    """One network: errors [2, TEST] on the test tosses, and its error on the choosing tosses."""
    rows = np.random.default_rng([seed, how.tosses]).choice(len(lesson.known), how.tosses, replace=False)
    state, off, taken = trained(how, seed, rows.tolist(), lesson)
    starts, truth = lesson.judges
    return {"test": np.array(errors(state(starts), truth)).tolist(), "chosen": off, "seconds": taken}


def _table(scene: Scene) -> tuple[Rotation, np.ndarray, Body]:
    """Rotation and position of a scene's table, and the cube."""
    table, cube = scene.bodies
    return Rotation.from_quat(table.quat_xyzw), np.asarray(table.position), cube


def dataset_of(recordings: Sequence[Recording], lesson: Lesson, folder: Path) -> Path:
    """Recordings as a dataset, with the table as its floor at z = 0."""
    (folder / "train").mkdir()
    shape = lesson.scene.shapes[_table(lesson.scene)[2].shape]
    shape.save(folder / "shapes" / "cube")
    for k, r in enumerate(recordings):
        place, turn, speed, spin = r.position[:, 0], r.orientation[:, 0], r.velocity[:, 0], r.angular_velocity[:, 0]
        trajectory_of(place, turn, speed, spin, r.dt, lesson.scene).save(folder / "train" / f"{k:03}.npz")
    return folder


def trajectory_of(
    position: np.ndarray, turn: np.ndarray, velocity: np.ndarray, spin: np.ndarray, dt: float, scene: Scene
) -> Trajectory:
    """Poses and velocities [T, *] of the cube of a scene as seen from its table."""
    lies, at, cube = _table(scene)
    still, inertia = lies.inv(), cube.inertia if cube.inertia is not None else np.eye(3) * EVEN
    return Trajectory(
        position=still.apply(position - at)[:, None], orientation=(still * Rotation.from_quat(turn)).as_quat()[:, None],
        velocity=still.apply(velocity)[:, None], angular_velocity=still.apply(spin)[:, None], shape=np.array(["cube"]),
        scale=np.array([cube.scale]), mass=np.array([cube.mass]), inertia=np.diag(inertia)[None],
        friction=np.array([cube.friction]), restitution=np.array([cube.restitution]), static=np.zeros(1, bool), dt=dt,
        gravity=still.apply(scene.gravity),
    )  # fmt: skip


def on_surfaces(model: Model, lesson: Lesson, starts: Sequence[Start]) -> Motion:
    """The motion of a network on surface nodes from these starts; bodies without contact fly exactly."""
    lies, at, cube = _table(lesson.scene)
    table, dt = lesson.scene.bodies[0], lesson.known[0].dt

    def begun(start: Start) -> Trajectory:
        place, turn, speed, spin = (
            getattr(start, name)[None] for name in ("position", "quat_xyzw", "velocity", "angular_velocity")
        )
        return trajectory_of(place, turn, speed, spin, dt, lesson.scene)

    shapes, floor = {"cube": lesson.scene.shapes[cube.shape]}, (table.friction, table.restitution)
    moved = roll_out(model, list(map(begun, starts)), shapes, FRAMES, floor=floor)
    place = np.stack([lies.apply(t.position[1:, 0]) + at for t in moved])
    turn = np.stack([(lies * Rotation.from_quat(t.orientation[1:, 0])).as_quat() for t in moved])
    return Motion(place, turn)


def networks(groups: tuple[list[Toss], list[Toss], list[Toss]], scene: Path, gravity: float, out: Path) -> Results:
    """Every network of `NETWORKS` with every seed by (seed, name), each kept in a file in `out`; and the solve without
    a network. The tosses of the parameter fit are used for training too."""
    fit, test, rest = groups
    pool = [*fit, *rest]
    free, held = pool[: max(TRAINED)], pool[max(TRAINED) :]
    known = load_scene(scene)
    chooses, judges = (([fitted_start(toss, gravity) for toss in some], recorded(some)) for some in (held, test))
    lesson = Lesson(recordings_of(free, known), known, chooses, judges)
    told = [scene.read_text(encoding="utf-8"), gravity, free, held, test]
    jobs = [
        Job(f"seed {seed}", name, [how, how.plan(), LOOKS, seed, *told], learnt, (how, seed, lesson))
        for seed in range(SEEDS)
        for name, how in NETWORKS.items()
        if seed == 0 or how.preset not in SURFACE
    ]
    return measure([Job("-", SOLVE, told, solved, (lesson, known)), *jobs], out, on_progress=progress)


SOLVE = "the solve alone"


def solved(lesson: Lesson, scene: Scene) -> dict[str, Any]:
    """The same for the solve without a network."""
    found = [ours(starts, lesson.known[0].dt, scene) for starts, _ in (lesson.chooses, lesson.judges)]
    return {
        "test": np.array(errors(found[1], lesson.judges[1])).tolist(), "chosen": summed(found[0], lesson.chooses[1])
    }  # fmt: skip


ENGINES: dict[str, tuple[Engine, Bounds]] = {
    "MuJoCo, elliptic cone": (partial(mujoco, THING), SOFT),
    "MuJoCo, pyramidal cone": (partial(mujoco, THING, elliptic=False), SOFT),
    "PyBullet": (partial(bullet, THING), SOLID),
    # stiffness in powers of ten of N/m
    "Drake": (drake, BODY | {"stiffness": (3.5, 6.0), "dissipation": (0.0, 2.0)}),
}


# --- the table ---


@one_thread()
def main(tosses: Path, *, out: Path, gravity: float = GRAVITY, networks_only: bool = False) -> None:
    """Fit and test every engine; write the section of the page, `reality.json` with every toss's errors, the identified
    scene, and pictures. Then the networks; use `networks_only` if DIR already holds that scene."""
    known = load_tosses(tosses)
    groups = split(known)
    if networks_only:
        write_networks(groups, out, gravity)
        return
    (fit, fit_truth), (test, test_truth) = (
        ([fitted_start(toss, gravity) for toss in group], recorded(group)) for group in groups[:2]
    )
    dt, down = known[0].dt, np.array([0.0, 0.0, -gravity])
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "scene.yaml", CUBE.format(gravity=-gravity, factor=INERTIA / EVEN))
    scene = load_scene(out / "scene.yaml")
    moved = {}
    for name, count, file in ((FEWER, FEW, "identified-few.yaml"), (OURS, FIT, "identified.yaml")):
        progress(0.0, f"{name}: identify")
        own = identify(recordings_of(groups[0][:count], scene), scene)
        write_scene(own, out / "scene.yaml", out / file)
        known_by_it = load_scene(out / file)
        table, cube = own.scene_values["table"], own.scene_values["cube"]
        found = {
            "friction": cube["friction"], "restitution": cube["restitution"], "height": table["position"][2],
            "side": cube["scale"], "inertia": cube["inertia_factor"] * EVEN / INERTIA,
        }  # fmt: skip
        moved[name] = found, ours(fit, dt, known_by_it), ours(test, dt, known_by_it)
    scene = load_scene(out / "identified.yaml")
    for k, (name, (engine, bounds)) in enumerate(ENGINES.items(), 1):
        progress(k / (len(ENGINES) + 1), f"{name}: {ROUNDS} rounds of a search over {len(bounds)} parameters")
        try:
            values = searched(lambda v, engine=engine: cost(errors(engine(fit, dt, down, v), fit_truth)), bounds)
        except NotInstalled as error:
            progress(k / (len(ENGINES) + 1), f"{name} is left out: {error.message}")
            continue
        moved[name] = values, engine(fit, dt, down, values), engine(test, dt, down, values)
    result = {
        name: {"values": values, "fit": errors(fitted, fit_truth), "test": errors(judged, test_truth)}
        for name, (values, fitted, judged) in moved.items()
    }
    falls, sure = fall(known)
    every = [*fit, *test]
    off = 1e3 * np.median([start.off for start in every])
    turned_off = np.degrees(np.median([start.turned_off for start in every]))
    seen = shown(recordings_of(known, scene))
    kept = {"gravity": gravity, "fall": [falls, sure], "shown": seen, "engines": _plain(result)}
    write_json(out / "reality.json", kept)
    pictures(moved, test_truth, dt, out)
    text = (
        f"Parameters are from {FIT} tosses, errors from {TEST} others (seed {SEED}), over the first {FRAMES} frames: "
        "means over tosses with 95 % intervals. Differences between engines are paired by toss. The starts fit the "
        f"free flight to {off:.2f} mm "
        f"and {turned_off:.2f} degrees (medians of root mean squares); recorded cubes fall with {falls:.3f} +- "
        f"{sure:.3f} m/s^2.\n\n{markdown(table_of(result))}"
    )
    write_section("reality", COMMAND, text)
    write_networks(groups, out, gravity)


OURS, FEWER = "sdfsim", f"sdfsim, found on {FEW} tosses"
COMMAND = "python -m benchmarks reality TOSSES -o DIR"


def shown(recordings: Sequence[Recording]) -> dict[str, list[float]]:
    """Facts on contacts from recordings without any engine, each as quartiles with their number: for first impacts of
    one corner (the next one a centimetre higher) the restitution, the impulse along the table over that across it, and
    the change of the spin over that of a rigid corner; for stretches of 8 frames in which a face slides, the
    deceleration over gravity, by speed."""
    corners = 0.5 * SIDE * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    found: dict[str, list[float]] = {}
    for r in recordings:
        fly, speed, spin = r.flying[:, 0], r.velocity[:, 0], r.angular_velocity[:, 0]
        for t in range(len(fly) - 3):
            t2 = next((u for u in (t + 1, t + 2, t + 3) if fly[t] and fly[u] and (speed[u] - speed[t])[2] > 0.0), 0)
            if not t2:
                continue
            at, after = (Rotation.from_quat(r.orientation[u, 0]).apply(corners) for u in (t, t2))
            low = int(at[:, 2].argmin())
            push = MASS * (speed[t2] - speed[t] + (t2 - t) * r.dt * np.array([0.0, 0.0, GRAVITY]))
            turn = np.cross(at[low], push) / INERTIA
            came = (speed[t] + np.cross(spin[t], at[low]))[2]
            if came < -0.2 and np.sort(at[:, 2])[1] - at[low, 2] > 0.01:
                went = (speed[t2] + np.cross(spin[t2], after[low]))[2]
                found.setdefault("restitution", []).append(-went / came)
                found.setdefault("impulse along over across", []).append(np.hypot(*push[:2]) / push[2])
                found.setdefault("spin over a rigid corner's", []).append(turn @ (spin[t2] - spin[t]) / (turn @ turn))
            break
        slides = r.known & ~fly & (np.linalg.norm(spin, axis=1) < 1.0) & (np.abs(speed[:, 2]) < 0.03)
        for t in (t for t in range(len(fly) - 7) if slides[t : t + 8].all()):
            fast = float(np.linalg.norm(speed[t + 3 : t + 5].mean(0)))
            name = next((f"friction up to {end} m/s" for end in (0.2, 0.4, 0.7) if 0.1 < fast < end), "")
            if name:
                slow = np.linalg.norm(speed[t + 7] - speed[t]) / (7 * r.dt * GRAVITY)
                found.setdefault(name, []).append(float(slow))
    return {name: [*np.percentile(values, [25, 50, 75]).tolist(), len(values)] for name, values in found.items()}


def table_of(result: dict[str, Any]) -> list[tuple[str, ...]]:
    """Engines better than ours come first, then ours, then the others."""
    head = (
        "engine",
        "position, % of the side",
        "rotation, degrees",
        "sdfsim minus it",
        "the same on the 60",
        "parameters",
    )

    def lost(name: str) -> float:
        return float(np.mean(result[name]["test"][0]) - np.mean(result[OURS]["test"][0]))

    rows: list[tuple[str, ...]] = [head]
    for name in sorted(result, key=lambda name: (lost(name), name != OURS)):
        one = result[name]
        change = [own - its for own, its in zip(result[OURS]["test"], one["test"], strict=True)]
        less = "" if name == OURS else " / ".join(map(_told, change))
        found = ", ".join(f"{of} {number(value)}" for of, value in one["values"].items())
        own = " / ".join(number(error.mean()) for error in one["fit"])
        rows.append((name, *map(_told, one["test"]), less, own, found))
    return rows


def write_networks(groups: tuple[list[Toss], list[Toss], list[Toss]], out: Path, gravity: float) -> None:
    """Train and test all networks in the identified scene; write their section of the page."""
    found = networks(groups, out / "identified.yaml", gravity, out / "networks")
    chosen = len(groups[0]) + len(groups[2]) - max(TRAINED)
    text = (
        f"These are networks in the identified scene. A training has {STEPS} steps unless its row says otherwise "
        f"({SURFACE_STEPS} for networks on surface nodes). {chosen} tosses choose the best of its {LOOKS} states, "
        f"which is measured once on {TEST} others. Means are over the listed seeds, with 95 % intervals over tosses. "
        "Differences to the solve are paired by toss. Times are seconds of one core for one training.\n\n"
        f"{markdown(network_table(found))}"
    )
    write_section("reality networks", f"{COMMAND} --networks-only", text)


def network_table(found: Results) -> list[tuple[str, ...]]:
    """Means over seeds, and their difference to the solve alone, paired by toss; the worst comes first."""
    solve = found["-", SOLVE]
    own = np.array(solve["test"])
    head = ("network", "position, %", "rotation, degrees", "minus the solve", "position, % / degrees of each seed")
    rows = []
    for name in dict.fromkeys(method for _, method in found if method != SOLVE):
        seeds = [one for (_, method), one in found.items() if method == name]
        if why := next((one["failed"] for one in seeds if "failed" in one), ""):
            rows.append((np.inf, (name, why, *[""] * (len(head) - 1))))
            continue
        test = np.array([one["test"] for one in seeds])
        mean = test.mean(0)
        less = " / ".join(_told(change) for change in mean - own)
        each = "; ".join(" / ".join(map(number, of)) for of in test.mean(2).tolist())
        on = " / ".join(number(one["chosen"]) for one in seeds)
        taken = number(float(np.mean([one["seconds"] for one in seeds])))
        rows.append((float((mean - own).sum(0).mean()), (name, *map(_told, mean), less, each, on, taken)))
    rows.sort(key=lambda row: -row[0])
    on = f"sum of both errors on the tosses that choose (solve: {number(solve['chosen'])})"
    return [(*head, on, "s"), *(row for _, row in rows), (SOLVE, *map(_told, own), "", "", "", "")]


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


def _told(error: np.ndarray) -> str:
    low, high = map(number, interval(error))
    return f"{number(float(error.mean()))} [{low}, {high}]"


def _plain(result: dict[str, Any]) -> dict[str, Any]:
    return {
        name: {"values": one["values"], **{of: [error.tolist() for error in one[of]] for of in ("fit", "test")}}
        for name, one in result.items()
    }
