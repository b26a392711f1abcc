"""PyBullet and MuJoCo, run from the start of a recording or of a scene; and runs of scenes by them or by our models.

Both collide convex pieces; MuJoCo also collides a mesh as an SDF (in its own octree). Spheres, boxes, cylinders and
capsules are exact.
"""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import write_text
from sdfsim.base.lazy import NotInstalled, optional
from sdfsim.data.dataset import Trajectory, shapes_folder
from sdfsim.data.pybullet_sim import DT, SUBSTEPS, Teacher, TeacherBody, substeps_of, write_urdf
from sdfsim.data.shape_assets import decompose
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import load_pieces, wavefront
from sdfsim.learned.model import SOLVER, Model
from sdfsim.physics.bodies import Units, from_scene
from sdfsim.physics.motion import MOTION
from sdfsim.physics.rollout import Rollout, join
from sdfsim.scene.scene import Scene
from sdfsim.sdf.closed_forms import BoxSdf, CapsuleSdf, CylinderSdf, PlaneSdf, SphereSdf
from sdfsim.shape.shape import Shape, own_pieces
from sdfsim.simulate.simulator import SimulationError, Simulator

SAME_INERTIA = 1e-3  # relative
SOFTEST = 3.0  # MuJoCo: period of a contact's spring over 2 pi, in steps of the engine; stable from 2 upwards
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
    return Start(motion, urdfs, floor, True, {name: centred_mesh(shape) for name, shape in shapes.items()})


def centred_mesh(shape: Shape) -> Mesh:
    """A shape's surface, relative to its centre of mass."""
    return Mesh(shape.mesh.vertices - shape.com, shape.mesh.faces)


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


# --- MuJoCo ---


def mujoco(
    start: Start, steps: int, substeps: int = SUBSTEPS, *, pieces: bool = True, elliptic: bool = False
) -> tuple[Trajectory, Timing]:
    """MuJoCo's motion with the same masses, inertias and starts; with the same convex pieces, or with meshes as SDFs;
    with its usual friction pyramid, or with a cone.

    MuJoCo takes the larger of two coefficients of friction, PyBullet their product. So geoms that meet the floor have
    the product with the floor's, and those that meet other bodies have their square. Those of static bodies take
    priority, and have the product with the median body's, which is exact if all dynamic bodies are of one material.
    MuJoCo's contacts are soft: a damped spring gives the wanted restitution.

    Raises:
        SdfsimError: MuJoCo is not installed, a shape's engine file cannot be read, or the motion is unstable.
    """
    engine = optional("mujoco", "MuJoCo", "bench")
    t, step, spec = start.motion, start.motion.dt / substeps, engine.MjSpec()
    spec.option.timestep, spec.option.gravity = step, t.gravity
    spec.memory = 2**31
    if elliptic:
        spec.option.cone = engine.mjtCone.mjCONE_ELLIPTIC
    if start.floor:
        ground = spec.worldbody.add_geom(type=engine.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1.0])
        ground.contype, ground.conaffinity, ground.friction[0], ground.solmix = 0, 1, 0.0, 1e-6
    usual = tuple(np.median(values[~t.static]) if (~t.static).any() else 1.0 for values in (t.friction, t.restitution))
    forms = {name: _forms(engine, urdf, None if pieces else start.meshes[name]) for name, urdf in start.urdfs.items()}
    for i, name in enumerate(t.shape):
        body = spec.worldbody.add_body(name=f"b{i}")
        if t.static[i]:
            body.pos, body.quat = t.position[0, i], np.roll(t.orientation[0, i], 1)
        else:
            body.add_freejoint()
            body.explicitinertial = True
            body.mass, body.inertia, body.ipos = float(t.mass[i]), t.inertia[i], np.zeros(3)
        met = usual if t.static[i] else (t.friction[i], t.restitution[i])
        for k, (kind, form) in enumerate(forms[str(name)]):
            shape: dict[str, Any] = {"type": kind}
            if not isinstance(form, dict):
                shape["size"] = t.scale[i] * form
            else:
                shape["meshname"] = f"{name}_{t.scale[i]:.9g}_{k}"
                if spec.mesh(shape["meshname"]) is None:
                    scaled = {"uservert": (form["uservert"] * t.scale[i]).ravel()}
                    spec.add_mesh(name=shape["meshname"], **form | scaled)
            # One geom that meets the floor, and one that meets other bodies.
            for kinds, other in (((1, 0), start.floor), ((2, 2), met)):
                if other is None:
                    continue
                geom = body.add_geom(**shape)
                geom.contype, geom.conaffinity = kinds
                geom.priority = int(t.static[i])
                geom.condim, geom.friction[0] = 3, t.friction[i] * other[0]
                bounce = float(np.clip(t.restitution[i] * other[1], 1e-3, 1.0))
                damping = max(-np.log(bounce) / np.hypot(np.pi, np.log(bounce)), 1e-3)
                geom.solref = [SOFTEST * step / damping, damping]  # the spring's frequency is one over their product
    model = spec.compile()
    data: Any = engine.MjData(model)
    moving = np.flatnonzero(~t.static)
    place, speed = data.qpos.reshape(-1, 7), data.qvel.reshape(-1, 6)
    place[:, :3], place[:, 3:] = t.position[0, moving], np.roll(t.orientation[0, moving], 1, axis=-1)
    turned = Rotation.from_quat(t.orientation[0, moving])
    speed[:, :3], speed[:, 3:] = t.velocity[0, moving], turned.inv().apply(t.angular_velocity[0, moving])

    def state() -> tuple[np.ndarray, ...]:
        quat = np.roll(place[:, 3:], -1, axis=-1)
        return place[:, :3].copy(), quat, speed[:, :3].copy(), Rotation.from_quat(quat).apply(speed[:, 3:])

    engine.set_mju_user_warning(lambda message: None)  # by default they go to a file in the working directory
    kinds = engine.mjtWarning
    unstable = [data.warning[int(kind)] for kind in (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)]

    def advance() -> None:
        engine.mj_step(model, data, substeps)
        if any(warning.number for warning in unstable):
            raise SdfsimError("MuJoCo found the motion unstable and reset it")

    return engine_motion(t, steps, advance, state)


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


def _forms(engine: Any, urdf: Path, mesh: Mesh | None) -> list[tuple[Any, np.ndarray | dict[str, Any]]]:
    """MuJoCo's kinds of geoms, each with its size [3] m or the arguments of its mesh: one geom for each convex piece,
    or an SDF of `mesh`."""
    kind, sizes = form_of(urdf)
    if kind == "sphere":
        return [(engine.mjtGeom.mjGEOM_SPHERE, np.array([*sizes, 0.0, 0.0]))]
    if kind == "box":
        return [(engine.mjtGeom.mjGEOM_BOX, 0.5 * sizes)]
    if kind in ("cylinder", "capsule"):
        round_about = engine.mjtGeom.mjGEOM_CYLINDER if kind == "cylinder" else engine.mjtGeom.mjGEOM_CAPSULE
        return [(round_about, np.array([sizes[0], 0.5 * sizes[1], 0.0]))]
    if mesh is not None:
        return [(engine.mjtGeom.mjGEOM_SDF, {"uservert": mesh.vertices, "userface": mesh.faces.ravel()})]
    pieces = load_pieces(urdf.with_suffix(".obj"))
    return [(engine.mjtGeom.mjGEOM_MESH, {"uservert": piece.vertices}) for piece in pieces]


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
