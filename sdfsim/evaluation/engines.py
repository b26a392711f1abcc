"""PyBullet (the teacher), MuJoCo, Drake and Newton, run from one start: of a recording, or of a scene.

Each takes the geometry that it is made for: PyBullet and MuJoCo convex pieces, MuJoCo also a mesh as an SDF (its own
octree), Drake tetrahedra and Newton triangles. Spheres and boxes are exact in all of them, and so are cylinders and
capsules but in Newton.
"""

from __future__ import annotations

import importlib
import re
import tempfile
import time
from collections.abc import Callable
from contextlib import chdir
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import write_text
from sdfsim.data.batching import MOTION
from sdfsim.data.dataset import Trajectory, shapes_folder
from sdfsim.data.pybullet_sim import DT, SUBSTEPS, Teacher, TeacherBody, substeps_of, write_urdf
from sdfsim.data.shape_assets import decompose
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import load_pieces, wavefront
from sdfsim.physics.bodies import Units, from_scene
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.scene import Scene
from sdfsim.sdf.closed_forms import BoxSdf, CapsuleSdf, CylinderSdf, PlaneSdf, SphereSdf
from sdfsim.shape.shape import Shape, own_pieces
from sdfsim.simulate.simulator import Simulator, join

SAME_INERTIA = 1e-3  # relative
SOFTEST = 3.0  # MuJoCo: time in which a contact swings over 2 pi, in steps of the engine; it is stable from 2 on
MODULUS = 1e7  # Pa, of Drake's compliant bodies: its own default
TETRAHEDRA = 0.05  # their edges over the diagonal of a shape's box
ITERATIONS = 10  # of Newton's XPBD in an inner step
LONGEST = 60.0  # s of the processor that an engine may take for a motion

SI = Units(1.0, 1.0, 1.0)


class NotInstalled(SdfsimError):
    """An engine, or a package that it needs for a shape, is not installed."""


class TooSlow(SdfsimError):
    """An engine that was stopped because a motion took longer than `LONGEST`."""


@dataclass(frozen=True)
class Start:
    """What an engine starts from."""

    motion: Trajectory  # its first frame counts
    urdfs: dict[str, Path]  # the engine's file of each shape, by name
    floor: tuple[float, float] | None  # friction and restitution of the floor z = 0, or None for no floor
    own_inertia: bool = False  # bodies get the inertias of `motion`; else the engine's own must be the same
    meshes: dict[str, Mesh] = field(default_factory=dict)  # about centres of mass, for engines that collide surfaces


@dataclass(frozen=True)
class Timing:
    """ms of the first step, and of the mean step after it by the clock and of the processor."""

    first_ms: float
    wall_ms: float
    cpu_ms: float


Engine = Callable[..., tuple[Trajectory, Timing]]  # called with a start, steps to record, and inner steps in one


def timed(advance: Callable[[int], object], steps: int) -> Timing:
    """How long `advance(count)` takes for a first step, and then for the others together."""
    began = time.perf_counter()
    advance(1)
    wall, cpu = time.perf_counter(), time.process_time()
    first = wall - began
    advance(steps - 1)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    count = max(1, steps - 1)
    return Timing(1e3 * first, 1e3 * wall / count, 1e3 * cpu / count)


def ours(simulator: Simulator, steps: int) -> tuple[Rollout, Timing]:
    """Our motion, and its time."""
    frames: list[Rollout] = []
    timing = timed(lambda count: frames.extend(simulator.frames(count)), steps)
    return join(frames), timing


def start_of_scene(scene: Scene, folder: Path, units: Units = SI) -> Start:
    """A scene whose only plane, if any, is a level floor; shapes are called by their index in it.

    The engine's files are written to `folder` where they are not there yet. Raises SdfsimError for bodies on a path, or
    planes other than one level floor.
    """
    planes = [b for b in scene.bodies if isinstance(scene.shapes[b.shape].sdf, PlaneSdf)]
    upright = [Rotation.from_quat(b.quat_xyzw).apply([0.0, 0.0, 1.0])[2] > 1 - 1e-9 for b in planes]
    if len(planes) > 1 or not all(upright) or any(b.motion == "kinematic" for b in scene.bodies):
        raise SdfsimError(
            f"{scene.path or 'scene'}: engines know one level plane as the floor, and no bodies on a path"
        )
    motion = start_motion(scene, units)
    motion.position[..., 2] -= planes[0].position[2] / units.length if planes else 0.0
    shapes = {name: scene.shapes[int(name)] for name in sorted(set(motion.shape.tolist()))}
    urdfs = {name: shape_urdf(shape, folder) for name, shape in shapes.items()}
    floor = (planes[0].friction, planes[0].restitution) if planes else None
    return Start(motion, urdfs, floor, True, {name: centred_mesh(shape) for name, shape in shapes.items()})


def centred_mesh(shape: Shape) -> Mesh:
    """A shape's surface about its centre of mass."""
    return Mesh(shape.mesh.vertices - shape.com, shape.mesh.faces)


def start_motion(scene: Scene, units: Units = SI) -> Trajectory:
    """The start of a scene's bodies but for planes as a recording of one frame, shapes called by their index."""
    bodies, state = from_scene(scene, units)
    solid = _solid(scene)

    def of(values: np.ndarray) -> np.ndarray:
        return values[solid].copy()

    return Trajectory(
        position=of(state.position)[None],
        quat_xyzw=of(state.orientation)[None],
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


def rollout_motion(scene: Scene, rollout: Rollout) -> Trajectory:
    """Our motion of a scene as `start_motion` has its start."""
    frames = (rollout.position, rollout.orientation, rollout.velocity, rollout.angular_velocity)
    found = {name: values[:, _solid(scene)] for name, values in zip(MOTION, frames, strict=True)}
    return replace(start_motion(scene), **found, dt=float(rollout.meta["dt"]))


def motion_rollout(scene: Scene, motion: Trajectory, units: Units = SI) -> Rollout:
    """An engine's motion from a `start_of_scene` in `units` as a rollout of the scene in SI units, without contacts."""
    steps, solid = len(motion.position), _solid(scene)
    arrays = {name: np.zeros((steps, len(solid), 4 if name == "quat_xyzw" else 3)) for name in MOTION}
    planes = [b for b in scene.bodies if isinstance(scene.shapes[b.shape].sdf, PlaneSdf)]
    own = {"position": units.length, "velocity": units.velocity, "angular_velocity": 1.0 / units.time}
    for name, values in arrays.items():
        values[:, solid] = own.get(name, 1.0) * getattr(motion, name)
    for k, plane in zip(np.flatnonzero(~solid), planes, strict=True):
        arrays["position"][:, k], arrays["quat_xyzw"][:, k] = plane.position, plane.quat_xyzw
        arrays["position"][:, solid, 2] += plane.position[2]
    dt = float(motion.dt) * units.time
    return Rollout(
        time=dt * np.arange(steps),
        position=arrays["position"],
        orientation=arrays["quat_xyzw"],
        velocity=arrays["velocity"],
        angular_velocity=arrays["angular_velocity"],
        contact_count=np.zeros(steps, np.int64),
        contact_point=np.zeros((0, 3)),
        contact_body=np.zeros((0, 2), np.int64),
        names=tuple(b.name for b in scene.bodies),
        meta={"dt": dt},
    )


def _solid(scene: Scene) -> np.ndarray:
    """[N] bool: which bodies are no planes."""
    return np.array([not isinstance(scene.shapes[b.shape].sdf, PlaneSdf) for b in scene.bodies])


def in_metres(motion: Trajectory, units: Units) -> Trajectory:
    """An engine's motion from a `start_of_scene` in `units`, with positions, scales and velocities in m and m/s."""
    lengths = {"position": units.length, "scale": units.length, "velocity": units.velocity}
    return replace(motion, **{name: factor * getattr(motion, name) for name, factor in lengths.items()})


# --- PyBullet ---


def bullet(start: Start, steps: int, substeps: int | None = None) -> tuple[Trajectory, Timing]:
    """PyBullet's motion of `steps` recorded steps, in the teacher's own inner steps unless told.

    Raises:
        SdfsimError: PyBullet is not installed, a step that the teacher does not make, or another inertia than recorded.
    """
    t, parts = start.motion, []
    with Teacher(t.gravity, start.floor, step=t.dt, substeps=substeps or substeps_of(t.dt)) as teacher:
        for i, name in enumerate(t.shape):
            urdf = start.urdfs[str(name)]
            mass = 0.0 if t.static[i] else float(t.mass[i])
            # Far away first and moved then, as when it was recorded: the engine's order of pairs depends on it.
            teacher.add(TeacherBody(urdf, float(t.scale[i]), mass, float(t.friction[i]), float(t.restitution[i])))
            teacher.place(i, t.position[0, i], t.quat_xyzw[0, i])
            if t.static[i]:
                continue
            teacher.push(i, t.velocity[0, i], t.angular_velocity[0, i])
            if start.own_inertia:
                teacher.set_inertia(i, t.inertia[i])
            elif not np.allclose(teacher.inertia(i), t.inertia[i], rtol=SAME_INERTIA):
                raise SdfsimError(f"{urdf}: the engine's inertia is not the recorded one")
        timing = timed(lambda count: parts.append(teacher.run(count)), steps)
    first, rest = parts
    return replace(t, **{name: np.concatenate([first[name][:1], rest[name]]) for name in MOTION}), timing


# --- MuJoCo ---


def mujoco(
    start: Start, steps: int, substeps: int = SUBSTEPS, *, pieces: bool = True, elliptic: bool = False
) -> tuple[Trajectory, Timing]:
    """MuJoCo's motion of the same masses, inertias and starts; of the same convex pieces, or of meshes as SDFs; with
    its usual pyramid of friction, or with a cone.

    It takes the larger of two coefficients of friction where the teacher multiplies. So geoms that meet the floor carry
    the product with the floor's, and those that meet other bodies carry their square. Those of static bodies have the
    say, and carry the product with the median body's: all exact where all bodies that move are of one material. Its
    contacts are soft: the restitution wanted is that of a damped spring.

    Raises:
        SdfsimError: MuJoCo is not installed, a shape's engine file cannot be read, or the motion is unstable.
    """
    engine = engine_module("mujoco", "MuJoCo", "bench")
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
            body.pos, body.quat = t.position[0, i], np.roll(t.quat_xyzw[0, i], 1)
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
            # One geom that meets the floor, and one that meets bodies.
            for kinds, other in (((1, 0), start.floor), ((2, 2), met)):
                if other is None:
                    continue
                geom = body.add_geom(**shape)
                geom.contype, geom.conaffinity = kinds
                geom.priority = int(t.static[i])
                geom.condim, geom.friction[0] = 3, t.friction[i] * other[0]
                bounce = float(np.clip(t.restitution[i] * other[1], 1e-3, 1.0))
                damping = max(-np.log(bounce) / np.hypot(np.pi, np.log(bounce)), 1e-3)
                geom.solref = [SOFTEST * step / damping, damping]  # its frequency is one over their product
    model = spec.compile()
    data: Any = engine.MjData(model)
    moving = np.flatnonzero(~t.static)
    place, speed = data.qpos.reshape(-1, 7), data.qvel.reshape(-1, 6)
    place[:, :3], place[:, 3:] = t.position[0, moving], np.roll(t.quat_xyzw[0, moving], 1, axis=-1)
    turned = Rotation.from_quat(t.quat_xyzw[0, moving])
    speed[:, :3], speed[:, 3:] = t.velocity[0, moving], turned.inv().apply(t.angular_velocity[0, moving])

    def state() -> tuple[np.ndarray, ...]:
        quat = np.roll(place[:, 3:], -1, axis=-1)
        return place[:, :3].copy(), quat, speed[:, :3].copy(), Rotation.from_quat(quat).apply(speed[:, 3:])

    engine.set_mju_user_warning(lambda message: None)  # it would write them to a file where it runs
    kinds = engine.mjtWarning
    unstable = [data.warning[int(kind)] for kind in (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)]

    def advance() -> None:
        engine.mj_step(model, data, substeps)
        if any(warning.number for warning in unstable):
            raise SdfsimError("MuJoCo found the motion unstable, and put it back to its start")

    return _motion(t, steps, advance, state)


def engine_module(module: str, title: str, extra: str) -> Any:
    """An optional package. Raises NotInstalled."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise NotInstalled(f"{title} is not installed", f"pip install 'sdfsim[{extra}]'") from error


def _motion(
    start: Trajectory, steps: int, advance: Callable[[], None], state: Callable[[], tuple[np.ndarray, ...]]
) -> tuple[Trajectory, Timing]:
    """The motion of an engine of `steps` calls of `advance`, and its time.

    `state` gives positions [M, 3] m, quaternions [M, 4] xyzw and velocities [M, 3] m/s and rad/s of the bodies that
    move, in the frame of the world. Raises SdfsimError where the motion is not finite, and TooSlow.
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
    """MuJoCo's kind of geom, and its size [3] m or what makes its mesh: one a convex piece, or an SDF of `mesh`."""
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


# --- Drake ---


def drake(start: Start, steps: int, substeps: int = SUBSTEPS) -> tuple[Trajectory, Timing]:
    """Drake's motion with hydroelastic contact: bodies that move are compliant tetrahedra, others rigid triangles.

    It combines two coefficients of friction by their harmonic mean, where the teacher multiplies. So every body carries
    its own square (one that moves alone, its product with the roughest thing that it may meet), and floor and static
    bodies what suits the median body: exact where all that move have one friction, of at least half of the others'.
    Restitution is 0.

    Raises:
        SdfsimError: Drake or fTetWild are not installed, or the motion fails.
    """
    lib = engine_module("pydrake.all", "Drake", "rivals")
    t, builder = start.motion, lib.DiagramBuilder()
    settings = lib.MultibodyPlantConfig(time_step=t.dt / substeps, contact_model="hydroelastic_with_fallback")
    plant, _ = lib.AddMultibodyPlant(settings, builder)
    plant.mutable_gravity_field().set_gravity_vector(t.gravity)

    def surface(friction: float, compliant: bool, size: float) -> Any:
        found = lib.ProximityProperties()
        lib.AddContactMaterial(dissipation=None, friction=lib.CoulombFriction(friction, friction), properties=found)
        if compliant:
            lib.AddCompliantHydroelasticProperties(0.25 * size, MODULUS, found)
        else:
            lib.AddRigidHydroelasticProperties(0.25 * size, found)
        return found

    moving = ~t.static if (~t.static).any() else t.static
    others = [*t.friction[t.static], *(start.floor or ())[:1]]
    own = t.friction * (max(others, default=1.0) if (~t.static).sum() == 1 else t.friction)

    def beside(friction: float) -> float:
        wanted = friction * t.friction[moving]
        return float(np.median(wanted * own[moving] / np.maximum(2.0 * own[moving] - wanted, 1e-3)))

    if start.floor:
        world, friction = (plant.world_body(), lib.RigidTransform()), beside(start.floor[0])
        plant.RegisterCollisionGeometry(*world, lib.HalfSpace(), "floor", surface(friction, False, 1.0))
    bodies = []
    with tempfile.TemporaryDirectory() as scratch:  # files are read when the simulator is made
        for i, name in enumerate(map(str, t.shape)):
            kind, sizes = form_of(start.urdfs[name])
            place = lib.RigidTransform(lib.Quaternion(np.roll(t.quat_xyzw[0, i], 1)), t.position[0, i])
            scale, moves = float(t.scale[i]), not t.static[i]
            if kind == "mesh":
                file, mesh = Path(scratch) / (f"{name}.vtk" if moves else f"{name}.obj"), start.meshes[name]
                if not file.exists():
                    write_text(file, _tetrahedra(mesh, start.urdfs[name]) if moves else wavefront([mesh]))
                form, smallest = lib.Mesh(str(file), scale), np.ptp(mesh.vertices, axis=0).min()
            else:
                known = {"sphere": lib.Sphere, "box": lib.Box, "cylinder": lib.Cylinder, "capsule": lib.Capsule}
                form, smallest = known[kind](*(scale * sizes)), sizes.min()
            friction = float(own[i]) if moves else beside(float(t.friction[i]))
            properties = surface(friction, moves, scale * float(smallest))
            if not moves:
                plant.RegisterCollisionGeometry(plant.world_body(), place, form, f"g{i}", properties)
                continue
            inertia = lib.UnitInertia(*(t.inertia[i] / t.mass[i]))
            body = plant.AddRigidBody(f"b{i}", lib.SpatialInertia(float(t.mass[i]), np.zeros(3), inertia))
            plant.RegisterCollisionGeometry(body, lib.RigidTransform(), form, f"g{i}", properties)
            bodies.append((i, body, place))
        plant.Finalize()
        simulator = lib.Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    for i, body, place in bodies:
        plant.SetFreeBodyPose(context, body, place)
        speed = lib.SpatialVelocity(t.angular_velocity[0, i], t.velocity[0, i])
        plant.SetFreeBodySpatialVelocity(context=context, body=body, V_JpJc=speed)
    simulator.Initialize()

    def state() -> tuple[np.ndarray, ...]:
        places = [plant.EvalBodyPoseInWorld(context, body) for _, body, _ in bodies]
        speeds = [plant.EvalBodySpatialVelocityInWorld(context, body) for _, body, _ in bodies]
        quat = np.roll([place.rotation().ToQuaternion().wxyz() for place in places], -1, axis=-1)
        velocities = (np.array([getattr(v, of)() for v in speeds]) for of in ("translational", "rotational"))
        return np.array([place.translation() for place in places]), quat, *velocities

    return _motion(t, steps, lambda: simulator.AdvanceTo(round(context.get_time() / t.dt + 1) * t.dt), state)


def _tetrahedra(mesh: Mesh, beside: Path) -> str:
    """A VTK file of tetrahedra that fill a closed mesh, kept beside the shape's URDF."""
    kept = beside.with_suffix(".vtk").resolve()
    if not kept.exists():
        filler = engine_module("pytetwild", "fTetWild", "rivals")
        with tempfile.TemporaryDirectory() as scratch, chdir(scratch):  # it leaves a file where it runs
            points, cells = filler.tetrahedralize(
                mesh.vertices.astype(float), mesh.faces.astype(np.int32), edge_length_fac=TETRAHEDRA
            )
        corner = points[cells[:, 0], None]
        volume = np.linalg.det(points[cells[:, 1:]] - corner)
        cells = np.where(volume[:, None] < 0, cells[:, [0, 2, 1, 3]], cells)[np.abs(volume) > 0]
        lines = ["# vtk DataFile Version 3.0", "tetrahedra", "ASCII", "DATASET UNSTRUCTURED_GRID"]
        lines += [f"POINTS {len(points)} double", *(" ".join(f"{x:.9g}" for x in point) for point in points)]
        lines += [f"CELLS {len(cells)} {5 * len(cells)}", *("4 " + " ".join(map(str, cell)) for cell in cells)]
        lines += [f"CELL_TYPES {len(cells)}", *["10"] * len(cells)]
        write_text(kept, "\n".join(lines) + "\n")
    return kept.read_text(encoding="utf-8")


# --- Newton ---


def newton(start: Start, steps: int, substeps: int = SUBSTEPS) -> tuple[Trajectory, Timing]:
    """Newton's motion on the CPU, by XPBD on triangle meshes, contacts searched in every inner step.

    It takes the mean of two coefficients of friction. So every body carries its square, and the floor what suits the
    median body: exact where all have one friction. Its kernels compile for a minute on a machine's first run.

    Raises:
        SdfsimError: Newton is not installed, or the motion fails.
    """
    warp, lib = (engine_module(name, "Newton", "rivals") for name in ("warp", "newton"))
    warp.config.quiet = True
    t, builder = start.motion, lib.ModelBuilder(gravity=tuple(map(float, start.motion.gravity)))

    def surface(friction: float) -> Any:
        return lib.ModelBuilder.ShapeConfig(mu=friction, density=0.0)

    own = t.friction**2
    if start.floor:
        builder.add_ground_plane(cfg=surface(max(0.0, float(np.median(2.0 * start.floor[0] * t.friction - own)))))
    meshes, moving = {}, []
    for i, name in enumerate(map(str, t.shape)):
        kind, sizes = form_of(start.urdfs[name])
        scale, body, place = float(t.scale[i]), -1, warp.transform(t.position[0, i], t.quat_xyzw[0, i])
        if not t.static[i]:
            inertia = warp.mat33(np.diag(t.inertia[i]))
            body = builder.add_body(xform=place, mass=float(t.mass[i]), inertia=inertia, lock_inertia=True)
            moving.append(i)
        shape = {"cfg": surface(float(own[i])), "xform": place if body < 0 else None}
        if kind == "sphere":
            builder.add_shape_sphere(body, radius=scale * float(sizes[0]), **shape)
        elif kind == "box":
            half = 0.5 * scale * sizes
            builder.add_shape_box(body, hx=half[0], hy=half[1], hz=half[2], **shape)
        else:
            if name not in meshes:
                mesh = start.meshes[name]
                meshes[name] = lib.Mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32).ravel())
            builder.add_shape_mesh(body, mesh=meshes[name], scale=(scale,) * 3, **shape)
    model = builder.finalize(device="cpu")
    solver = lib.solvers.SolverXPBD(model, iterations=ITERATIONS)
    pipeline = lib.CollisionPipeline(model)
    contacts, now, then = pipeline.contacts(), model.state(), model.state()
    speeds = np.concatenate([t.velocity[0, moving], t.angular_velocity[0, moving]], axis=1).astype(np.float32)
    now.body_qd.assign(speeds)

    def advance() -> None:
        nonlocal now, then
        for _ in range(substeps):
            now.clear_forces()
            pipeline.collide(now, contacts)
            solver.step(now, then, None, contacts, t.dt / substeps)
            now, then = then, now

    def state() -> tuple[np.ndarray, ...]:
        places, speeds = now.body_q.numpy().astype(float), now.body_qd.numpy().astype(float)
        return places[:, :3], places[:, 3:], speeds[:, :3], speeds[:, 3:]

    return _motion(t, steps, advance, state)


# --- the engine's files ---


def shape_urdf(shape: Shape, folder: Path) -> Path:
    """The URDF of a shape, written into `folder` unless it is there: exact closed forms, convex pieces of others.

    Raises:
        SdfsimError: the shape's mesh cannot be cut into convex pieces.
    """
    sdf = shape.sdf
    if isinstance(sdf, SphereSdf | BoxSdf | CylinderSdf | CapsuleSdf):
        sizes = {"size": [2.0 * half for half in sdf.half]} if isinstance(sdf, BoxSdf) else {"radius": [sdf.radius]}
        if isinstance(sdf, CylinderSdf | CapsuleSdf):
            sizes["length"] = [2.0 * sdf.half]
        told = {name: " ".join(f"{value:.9g}" for value in values) for name, values in sizes.items()}
        urdf = folder / f"{sdf.KIND}-{'-'.join(told.values()).replace(' ', '-')}.urdf"
        folder.mkdir(parents=True, exist_ok=True)
        attributes = " ".join(f'{name}="{value}"' for name, value in told.items())
        return urdf if urdf.exists() else write_urdf(f"<{sdf.KIND} {attributes}/>", urdf)
    urdf = folder / f"pieces-{shape.mesh.digest()[:16]}.urdf"
    if not urdf.exists():
        folder.mkdir(parents=True, exist_ok=True)
        pieces, mesh = own_pieces(shape) or decompose(shape.mesh, folder / urdf.stem), urdf.with_suffix(".obj")
        write_text(mesh, wavefront([Mesh(piece.vertices - shape.com, piece.faces) for piece in pieces]))
        write_urdf(f'<mesh filename="{mesh.resolve()}"/>', urdf)
    return urdf


def dataset_urdf(data: Path, shape: str) -> Path:
    """The URDF of a dataset's shape. Raises SdfsimError when it, or the convex pieces beside it, are absent."""
    path = shapes_folder(data) / "engine" / f"{shape}.urdf"
    if not path.is_file() or not path.with_suffix(".obj").is_file():
        raise SdfsimError(f"{path}: no engine file of shape {shape!r}", "`sdfsim dataset` writes them")
    return path


def form_of(urdf: Path) -> tuple[str, np.ndarray]:
    """What a URDF of ours collides: "sphere" and its radius, "box" and its extents [3] m, "cylinder" or "capsule", its
    radius and the length of its straight side, or "mesh", its pieces."""
    found = re.search(r"<(sphere|box|cylinder|capsule) ([^>]*)/>", urdf.read_text(encoding="utf-8"))
    if found is None:
        return "mesh", np.zeros(0)
    sizes = " ".join(re.findall(r'"([^"]*)"', found[2]))
    return found[1], np.array(sizes.split(), dtype=float)
