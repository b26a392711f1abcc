"""Engines, run from the start of a recording or of a scene; and runs of scenes by them or by our models.

They collide convex pieces, or meshes; spheres, boxes, cylinders and capsules are exact.
"""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import write_text
from sdfsim.base.lazy import NotInstalled
from sdfsim.data.dataset import Trajectory, shapes_folder
from sdfsim.data.pybullet_sim import DT, SUBSTEPS, Teacher, TeacherBody, substeps_of, write_urdf
from sdfsim.data.shape_assets import decompose
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import wavefront
from sdfsim.learned.model import SOLVER, Model
from sdfsim.physics.bodies import Units, from_scene
from sdfsim.physics.motion import MOTION
from sdfsim.physics.rollout import Rollout, join
from sdfsim.scene.scene import Scene
from sdfsim.sdf.closed_forms import BoxSdf, CapsuleSdf, CylinderSdf, PlaneSdf, SphereSdf
from sdfsim.shape.shape import Shape, own_pieces
from sdfsim.simulate.simulator import SimulationError, Simulator

SAME_INERTIA = 1e-3  # relative
LONGEST = 60.0  # s of processor time that an engine may take for a motion

SI = Units(1.0, 1.0, 1.0)


class TooSlow(SdfsimError):
    """An engine was stopped because a motion took longer than `LONGEST`."""


@dataclass(frozen=True)
class Start:
    motion: Trajectory  # only its first frame is used
    urdfs: dict[str, Path]  # the engine's file of each shape, by name
    floor: tuple[float, float] | None  # friction and restitution of the floor z = 0, or None for no floor
    own_inertia: bool = False  # bodies get the inertias of `motion`; else the engine's own must agree
    meshes: dict[str, Mesh] = field(default_factory=dict)  # about centres of mass, for engines that collide surfaces
    scene: Scene | None = None  # with these units and starts, for engines that are given scenes


@dataclass(frozen=True)
class Timing:
    """ms of the first step, and of the mean step after it, by the clock and in processor time."""

    first_ms: float
    wall_ms: float
    cpu_ms: float


Engine = Callable[..., tuple[Trajectory, Timing]]  # called with a start, steps to record, and inner steps per step


def timed(advance: Callable[[int], object], steps: int) -> Timing:
    """Time `advance(count)` for a first step, and then for the others together."""
    began = time.perf_counter()
    advance(1)
    wall, cpu = time.perf_counter(), time.process_time()
    first = wall - began
    advance(steps - 1)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    count = max(1, steps - 1)
    return Timing(1e3 * first, 1e3 * wall / count, 1e3 * cpu / count)


def start_of_scene(scene: Scene, folder: Path, units: Units = SI) -> Start:
    """The start of a scene whose only plane, if any, is a level floor; shapes are named by their index in it.

    The engine's files are written to `folder` unless they exist. Raises SdfsimError for bodies on a path, or for planes
    other than one level floor.
    """
    planes = [b for b in scene.bodies if isinstance(scene.shapes[b.shape].sdf, PlaneSdf)]
    upright = [Rotation.from_quat(b.quat_xyzw).apply([0.0, 0.0, 1.0])[2] > 1 - 1e-9 for b in planes]
    if len(planes) > 1 or not all(upright) or any(b.motion == "kinematic" for b in scene.bodies):
        raise SdfsimError(
            f"{scene.path or 'scene'}: engines support one level plane as the floor, and no bodies on a path"
        )
    motion = start_motion(scene, units)
    motion.position[..., 2] -= planes[0].position[2] / units.length if planes else 0.0
    shapes = {name: scene.shapes[int(name)] for name in sorted(set(motion.shape.tolist()))}
    urdfs = {name: shape_urdf(shape, folder) for name, shape in shapes.items()}
    floor = (planes[0].friction, planes[0].restitution) if planes else None
    meshes = {name: Mesh(shape.mesh.vertices - shape.com, shape.mesh.faces) for name, shape in shapes.items()}
    below = planes[0].position[2] if planes else 0.0
    return Start(motion, urdfs, floor, True, meshes, in_units(scene, units, np.array([0.0, 0.0, below])))


def in_units(scene: Scene, units: Units, origin: np.ndarray) -> Scene:
    """A scene in other units than SI, around a point [3] m. Joints are kept as they are, in SI."""
    bodies = tuple(
        replace(
            b, scale=b.scale / units.length, position=(b.position - origin) / units.length,
            velocity=b.velocity / units.velocity, angular_velocity=b.angular_velocity * units.time,
            mass=b.mass / units.mass,
            inertia=None if b.inertia is None else b.inertia / (units.mass * units.length**2),
        )
        for b in scene.bodies
    )  # fmt: skip
    return replace(scene, bodies=bodies, gravity=scene.gravity / units.acceleration)


def start_motion(scene: Scene, units: Units = SI) -> Trajectory:
    """The start of all bodies except planes, as a recording of one frame; shapes are named by their index."""
    bodies, state = from_scene(scene, units)
    solid = solid_bodies(scene)

    def of(values: np.ndarray) -> np.ndarray:
        return values[solid].copy()

    return Trajectory(
        position=of(state.position)[None],
        orientation=of(state.orientation)[None],
        velocity=of(state.velocity)[None],
        angular_velocity=of(state.angular_velocity)[None],
        shape=np.array([str(b.shape) for b in scene.bodies])[solid],
        scale=of(bodies.scale),
        mass=of(bodies.mass),
        inertia=np.diagonal(of(bodies.inertia), axis1=1, axis2=2).copy(),
        friction=of(bodies.friction),
        restitution=of(bodies.restitution),
        static=~of(bodies.moves),
        dt=DT,
        gravity=scene.gravity / units.acceleration,
    )


def solid_bodies(scene: Scene) -> np.ndarray:
    """[N] bool: bodies that are not planes."""
    return np.array([not isinstance(scene.shapes[b.shape].sdf, PlaneSdf) for b in scene.bodies])


# --- PyBullet ---


def bullet(start: Start, steps: int, substeps: int | None = None) -> tuple[Trajectory, Timing]:
    """PyBullet's motion of `steps` recorded steps, by default with the inner steps of the training data.

    Raises:
        SdfsimError: PyBullet is not installed, the training data have no such step, or an inertia differs from the
            recorded one.
    """
    t, parts = start.motion, []
    with Teacher(t.gravity, start.floor, step=t.dt, substeps=substeps or substeps_of(t.dt)) as teacher:
        for i, name in enumerate(t.shape):
            urdf = start.urdfs[str(name)]
            mass = 0.0 if t.static[i] else float(t.mass[i])
            # Added far away and then moved, as in the recording, because the engine's order of pairs depends on it.
            teacher.add(TeacherBody(urdf, float(t.scale[i]), mass, float(t.friction[i]), float(t.restitution[i])))
            teacher.place(i, t.position[0, i], t.orientation[0, i])
            if t.static[i]:
                continue
            teacher.push(i, t.velocity[0, i], t.angular_velocity[0, i])
            if start.own_inertia:
                teacher.set_inertia(i, t.inertia[i])
            elif not np.allclose(teacher.inertia(i), t.inertia[i], rtol=SAME_INERTIA):
                raise SdfsimError(f"{urdf}: the engine's inertia differs from the recorded one")
        timing = timed(lambda count: parts.append(teacher.run(count)), steps)
    first, rest = parts
    return replace(t, **{name: np.concatenate([first[name][:1], rest[name]]) for name in MOTION}), timing


# --- engines that are given scenes ---


class World(Protocol):
    """A scene in an engine."""

    def advance(self, count: int) -> None: ...

    def state(self) -> tuple[np.ndarray, ...]: ...


def run_world(
    make: Callable[[Scene, float], World], start: Start, steps: int, substeps: int = SUBSTEPS
) -> tuple[Trajectory, Timing]:
    """The motion of a world that is made of the start's scene and of the engine's step, s."""
    assert start.scene is not None
    world = make(start.scene, start.motion.dt / substeps)
    return engine_motion(start.motion, steps, lambda: world.advance(substeps), world.state)


def engine_motion(
    start: Trajectory, steps: int, advance: Callable[[], None], state: Callable[[], tuple[np.ndarray, ...]]
) -> tuple[Trajectory, Timing]:
    """The motion of an engine over `steps` calls of `advance`, and its time.

    `state` gives positions [M, 3] m, quaternions [M, 4] xyzw and velocities [M, 3] m/s and rad/s of the dynamic bodies,
    in the world frame. Raises SdfsimError if the motion is not finite, and TooSlow if it takes too long.
    """
    began = time.process_time()
    frames = [state()]

    def advanced(count: int) -> None:
        for _ in range(count):
            advance()
            frames.append(state())
            if not np.isfinite(frames[-1][0]).all():
                raise SdfsimError(f"a position is not finite after {len(frames) - 1} steps")
            if time.process_time() - began > LONGEST:
                raise TooSlow(f"{len(frames) - 1} of {steps} steps in {LONGEST:g} s")

    timing = timed(advanced, steps)
    motion = {name: np.repeat(getattr(start, name)[:1], steps + 1, axis=0) for name in MOTION}
    for name, found in zip(MOTION, zip(*frames, strict=True), strict=True):
        motion[name][:, ~start.static] = found
    return replace(start, **motion), timing


# --- the engine's files ---


def shape_urdf(shape: Shape, folder: Path) -> Path:
    """The URDF of a shape, written to `folder` unless it exists: exact closed forms, and convex pieces of other shapes.

    Raises:
        SdfsimError: the shape's mesh cannot be cut into convex pieces.
    """
    sdf = shape.sdf
    if isinstance(sdf, SphereSdf | BoxSdf | CylinderSdf | CapsuleSdf):
        sizes = {"size": [2.0 * half for half in sdf.half]} if isinstance(sdf, BoxSdf) else {"radius": [sdf.radius]}
        if isinstance(sdf, CylinderSdf | CapsuleSdf):
            sizes["length"] = [2.0 * sdf.half]
        written = {name: " ".join(f"{value:.9g}" for value in values) for name, values in sizes.items()}
        urdf = folder / f"{sdf.KIND}-{'-'.join(written.values()).replace(' ', '-')}.urdf"
        folder.mkdir(parents=True, exist_ok=True)
        attributes = " ".join(f'{name}="{value}"' for name, value in written.items())
        return urdf if urdf.exists() else write_urdf(f"<{sdf.KIND} {attributes}/>", urdf)
    urdf = folder / f"pieces-{shape.mesh.digest()[:16]}.urdf"
    if not urdf.exists():
        folder.mkdir(parents=True, exist_ok=True)
        pieces, mesh = own_pieces(shape) or decompose(shape.mesh, folder / urdf.stem), urdf.with_suffix(".obj")
        write_text(mesh, wavefront([Mesh(piece.vertices - shape.com, piece.faces) for piece in pieces]))
        write_urdf(f'<mesh filename="{mesh.resolve()}"/>', urdf)
    return urdf


def dataset_urdf(data: Path, shape: str) -> Path:
    """The URDF of a dataset's shape. Raises SdfsimError if it, or the file of convex pieces beside it, is missing."""
    path = shapes_folder(data) / "engine" / f"{shape}.urdf"
    if not path.is_file() or not path.with_suffix(".obj").is_file():
        raise SdfsimError(f"{path}: no engine file of shape {shape!r}", "`sdfsim dataset` writes them")
    return path


def form_of(urdf: Path) -> tuple[str, np.ndarray]:
    """The geometry in a URDF of `shape_urdf`: "sphere" and its radius, "box" and its extents [3] m, "cylinder" or
    "capsule" with its radius and the length of its straight side, or "mesh" (its convex pieces)."""
    found = re.search(r"<(sphere|box|cylinder|capsule) ([^>]*)/>", urdf.read_text(encoding="utf-8"))
    if found is None:
        return "mesh", np.zeros(0)
    sizes = " ".join(re.findall(r'"([^"]*)"', found[2]))
    return found[1], np.array(sizes.split(), dtype=float)


# --- runs: a scene by a model of ours or by an engine, with the same record ---


@dataclass(frozen=True)
class Ran:
    """A motion of a scene, up to its last good state."""

    scene: Scene
    rollout: Rollout  # SI units; from an engine without contacts and counters
    broke: str = ""  # why it ended early

    @property
    def time(self) -> np.ndarray:
        """[T] s."""
        return self.rollout.time

    @cached_property
    def motion(self) -> Trajectory:
        """The bodies except planes as a recording; shapes are named by their index in the scene."""
        solid = solid_bodies(self.scene)
        frames = {name: getattr(self.rollout, name)[:, solid] for name in MOTION}
        return replace(start_motion(self.scene), **frames, dt=float(self.rollout.meta["dt"]))

    @property
    def path(self) -> np.ndarray:
        """[T, M, 3] m, positions of the dynamic bodies."""
        return self.motion.position[:, ~self.motion.static]


Runner = Callable[[Scene, float], Ran]  # runs a scene for a number of seconds


def by_model(scene: Scene, seconds: float, model: str | Model = SOLVER, device: str = "cpu") -> Ran:
    try:
        return Ran(scene, Simulator(scene, model, device).run(seconds))
    except SimulationError as error:
        return Ran(scene, error.rollout, error.message)


def by_engine(scene: Scene, seconds: float, engine: Engine, folder: Path, units: Units = SI) -> Ran:
    """An engine's motion of a scene, simulated in `units`, with its files in `folder`; its bodies never sleep. If the
    motion fails, bodies stay where they started.

    Raises:
        SdfsimError: see `start_of_scene`. NotInstalled, TooSlow.
    """
    start = start_of_scene(scene, folder, units)
    try:
        motion, _ = engine(start, max(1, round(seconds / (DT * units.time))))
    except (NotInstalled, TooSlow):
        raise
    except SdfsimError as error:
        return still(scene, seconds, error.message)
    if not (np.isfinite(motion.position).all() and np.isfinite(motion.velocity).all()):
        return still(scene, seconds, "a position is not finite")
    return Ran(scene, scene_rollout(scene, motion, units))


def still(scene: Scene, seconds: float, broke: str = "") -> Ran:
    """A run in which all bodies stay where they started, used for judging if there is no motion."""
    first = Simulator(scene, SOLVER).initial_rollout()
    return Ran(scene, join([first, replace(first, time=first.time + seconds)]), broke)


def scene_rollout(scene: Scene, motion: Trajectory, units: Units = SI) -> Rollout:
    """An engine's motion from a `start_of_scene` in `units` as a rollout of the scene in SI units, without contacts."""
    steps, solid = len(motion.position), solid_bodies(scene)
    arrays: dict[str, Any] = {}
    planes = [b for b in scene.bodies if isinstance(scene.shapes[b.shape].sdf, PlaneSdf)]
    for name, values in units.in_si(motion).items():
        arrays[name] = np.zeros((steps, len(solid), values.shape[2]))
        arrays[name][:, solid] = values
    for k, plane in zip(np.flatnonzero(~solid), planes, strict=True):
        arrays["position"][:, k], arrays["orientation"][:, k] = plane.position, plane.quat_xyzw
        arrays["position"][:, solid, 2] += plane.position[2]
    dt = float(motion.dt) * units.time
    return Rollout(
        time=dt * np.arange(steps),
        **arrays,
        contact_count=np.zeros(steps, np.int64),
        contact_point=np.zeros((0, 3)),
        contact_body=np.zeros((0, 2), np.int64),
        names=tuple(b.name for b in scene.bodies),
        meta={"dt": dt},
    )


def timed_rollout(simulator: Simulator, steps: int) -> tuple[Rollout, Timing]:
    frames: list[Rollout] = []
    timing = timed(lambda count: frames.extend(simulator.frames(count)), steps)
    return join(frames), timing
