"""PyBullet (the teacher) and MuJoCo, run from one start: of a recording, or of a scene."""

from __future__ import annotations

import importlib
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from sdfsim.data.dataset import Trajectory, shapes_folder
from sdfsim.data.pybullet_sim import DT, SUBSTEPS, Teacher, TeacherBody, substeps_of, write_form_urdf, write_urdf
from sdfsim.data.shape_assets import decompose
from sdfsim.dynamics.bodies import Units, from_scene
from sdfsim.dynamics.rollout import Rollout
from sdfsim.errors import SdfsimError
from sdfsim.files import replacing, write_text
from sdfsim.scene.scene import Scene
from sdfsim.shape.mesh import Mesh, load_pieces, wavefront
from sdfsim.shape.sdf import BoxSdf, PlaneSdf, SphereSdf
from sdfsim.shape.shape import Shape, own_pieces

SAME_INERTIA = 1e-3  # relative
SOFTEST = 3.0  # MuJoCo: time constant of a contact over the engine's step, at least 2 for it to be stable


@dataclass(frozen=True)
class Start:
    """What an engine starts from.

    Attributes:
        motion: its first frame counts.
        urdfs: the engine's file of each shape, by name.
        floor: friction and restitution of the floor z = 0, or None for no floor.
        own_inertia: the bodies get the inertias of `motion`; else the engine takes its own, which must be the same.
    """

    motion: Trajectory
    urdfs: dict[str, Path]
    floor: tuple[float, float] | None
    own_inertia: bool = False


@dataclass(frozen=True)
class Timing:
    """ms of the first step, and of the mean step after it by the clock and of the processor."""

    first_ms: float
    wall_ms: float
    cpu_ms: float


def timed(advance: Callable[[int], object], steps: int) -> Timing:
    """How long `advance` takes for a first step, and then for the others together."""
    began = time.perf_counter()
    advance(1)
    wall, cpu = time.perf_counter(), time.process_time()
    first = wall - began
    advance(steps - 1)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    count = max(1, steps - 1)
    return Timing(1e3 * first, 1e3 * wall / count, 1e3 * cpu / count)


def start_of_scene(scene: Scene, folder: Path, units: Units | None = None) -> Start:
    """A scene whose only plane, if any, is a level floor; shapes are called by their index in it.

    The engine's files are written to `folder` where they are not there yet. Units are SI unless given.

    Raises:
        SdfsimError: bodies on a path, or planes other than one level floor.
    """
    planes = [b for b in scene.bodies if isinstance(scene.shapes[b.shape].sdf, PlaneSdf)]
    upright = [Rotation.from_quat(b.quat_xyzw).apply([0.0, 0.0, 1.0])[2] > 1 - 1e-9 for b in planes]
    where = f"{scene.path}: " if scene.path else ""
    if any(b.motion == "kinematic" for b in scene.bodies):
        raise SdfsimError(f"{where}has bodies on a path, which the engines do not know")
    if len(planes) > 1 or not all(upright):
        raise SdfsimError(f"{where}the engines know one level plane as the floor (has {len(planes)} planes)")
    units = units or Units(1.0, 1.0, 1.0)
    motion = start_motion(scene, units)
    motion.position[..., 2] -= planes[0].position[2] / units.length if planes else 0.0
    urdfs = {name: shape_urdf(scene.shapes[int(name)], folder) for name in sorted(set(motion.shape.tolist()))}
    return Start(motion, urdfs, (planes[0].friction, planes[0].restitution) if planes else None, own_inertia=True)


def start_motion(scene: Scene, units: Units = Units(1.0, 1.0, 1.0)) -> Trajectory:  # noqa: B008
    """The start of a scene's bodies but for planes as a recording of one frame, shapes called by their index."""
    bodies, state = from_scene(scene, units, torch.device("cpu"))
    solid = np.array([not isinstance(scene.shapes[b.shape].sdf, PlaneSdf) for b in scene.bodies])

    def of(values: torch.Tensor) -> np.ndarray:
        return values.numpy()[solid].copy()

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
    solid = [not isinstance(scene.shapes[b.shape].sdf, PlaneSdf) for b in scene.bodies]
    names = {"quat_xyzw": "orientation"}
    frames = ("position", "quat_xyzw", "velocity", "angular_velocity")
    found = {name: getattr(rollout, names.get(name, name))[:, solid] for name in frames}
    return replace(start_motion(scene), **found, dt=float(rollout.meta["dt"]))


# --- PyBullet ---


def bullet(start: Start, steps: int, substeps: int | None = None) -> tuple[Trajectory, Timing]:
    """PyBullet's motion of `steps` recorded steps, in the teacher's own inner steps unless told.

    Raises:
        SdfsimError: PyBullet is not installed, a step that is none of the teacher's, or another inertia than recorded.
    """
    parts: list[dict[str, np.ndarray]] = []
    with bullet_at(start, substeps) as teacher:
        timing = timed(lambda count: parts.append(teacher.run(count)), steps)
    first, rest = parts
    motion = {name: np.concatenate([first[name][:1], rest[name]]) for name in first}
    return replace(start.motion, **motion), timing


@contextmanager
def bullet_at(start: Start, substeps: int | None = None) -> Iterator[Teacher]:
    """The teacher at a start. Raises as `bullet` does."""
    t = start.motion
    inner = substeps or substeps_of(t.dt)
    with Teacher(t.gravity, start.floor, step=t.dt, substeps=inner) as teacher:
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
        yield teacher


# --- MuJoCo ---


def mujoco(start: Start, steps: int, substeps: int = SUBSTEPS) -> tuple[Trajectory, Timing]:
    """MuJoCo's motion of the same geometry, masses, inertias and starts.

    It takes the larger of two coefficients of friction where the teacher multiplies. So geoms that meet the floor carry
    the product with the floor's, and those that meet other bodies carry their square: exact for bodies of one material.
    Its contacts are soft: the restitution wanted is that of a damped spring.

    Raises:
        SdfsimError: MuJoCo is not installed, or a shape's engine file cannot be read.
    """
    try:
        engine: Any = importlib.import_module("mujoco")
    except ImportError as error:
        raise SdfsimError("MuJoCo is not installed", "pip install 'sdfsim[bench]'") from error
    t = start.motion
    model = _mujoco_model(engine, start, t.dt / substeps)
    data: Any = engine.MjData(model)
    moving = np.flatnonzero(~t.static)
    place, speed = data.qpos.reshape(-1, 7), data.qvel.reshape(-1, 6)
    place[:, :3], place[:, 3:] = t.position[0, moving], np.roll(t.quat_xyzw[0, moving], 1, axis=-1)
    turned = Rotation.from_quat(t.quat_xyzw[0, moving])
    speed[:, :3], speed[:, 3:] = t.velocity[0, moving], turned.inv().apply(t.angular_velocity[0, moving])
    frames = [(place.copy(), speed.copy())]

    def advance(count: int) -> None:
        for _ in range(count):
            for _ in range(substeps):
                engine.mj_step(model, data)
            frames.append((place.copy(), speed.copy()))

    timing = timed(advance, steps)
    places, speeds = (np.array(kind) for kind in zip(*frames, strict=True))
    still = np.zeros((steps + 1, *t.velocity.shape[1:]))
    motion = {"position": still + t.position[0], "velocity": still, "angular_velocity": still.copy()}
    motion["quat_xyzw"] = np.repeat(t.quat_xyzw[:1], steps + 1, axis=0)
    motion["position"][:, moving] = places[..., :3]
    motion["quat_xyzw"][:, moving] = np.roll(places[..., 3:], -1, axis=-1)
    motion["velocity"][:, moving] = speeds[..., :3]
    turned = Rotation.from_quat(motion["quat_xyzw"][:, moving].reshape(-1, 4))
    motion["angular_velocity"][:, moving] = turned.apply(speeds[..., 3:].reshape(-1, 3)).reshape(len(speeds), -1, 3)
    return replace(t, **motion), timing


def _mujoco_model(engine: Any, start: Start, step: float) -> Any:
    t, spec = start.motion, engine.MjSpec()
    spec.option.timestep, spec.option.gravity = step, t.gravity
    spec.memory = 2**31
    if start.floor:
        ground = spec.worldbody.add_geom(type=engine.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1.0])
        ground.contype, ground.conaffinity, ground.friction[0], ground.solmix = 0, 1, 0.0, 1e-6
    forms = {name: _forms(engine, urdf) for name, urdf in start.urdfs.items()}
    for i, name in enumerate(t.shape):
        body = spec.worldbody.add_body(name=f"b{i}")
        if t.static[i]:
            body.pos, body.quat = t.position[0, i], np.roll(t.quat_xyzw[0, i], 1)
        else:
            body.add_freejoint()
            body.explicitinertial = True
            body.mass, body.inertia, body.ipos = float(t.mass[i]), t.inertia[i], np.zeros(3)
        for k, (kind, size, vertices) in enumerate(forms[str(name)]):
            shape: dict[str, Any] = {"type": kind}
            if vertices is None:
                shape["size"] = t.scale[i] * size
            else:
                shape["meshname"] = f"{name}_{t.scale[i]:.9g}_{k}"
                if spec.mesh(shape["meshname"]) is None:
                    spec.add_mesh(name=shape["meshname"], uservert=(vertices * t.scale[i]).ravel())
            for other in (start.floor, (t.friction[i], t.restitution[i])):
                if other is None:
                    continue
                geom = body.add_geom(**shape)
                geom.contype, geom.conaffinity = (1, 0) if other is start.floor else (2, 2)
                geom.condim, geom.friction[0] = 3, t.friction[i] * other[0]
                bounce = float(np.clip(t.restitution[i] * other[1], 1e-3, 1.0))
                damping = -np.log(bounce) / np.hypot(np.pi, np.log(bounce))
                geom.solref = [SOFTEST * step, max(damping, 1e-3)]
    return spec.compile()


def _forms(engine: Any, urdf: Path) -> list[tuple[Any, np.ndarray, np.ndarray | None]]:
    """MuJoCo's kind of geom, its size [3] m, and its vertices [V, 3] m where it is a mesh: one a convex piece."""
    kind, sizes = form_of(urdf)
    if kind == "sphere":
        return [(engine.mjtGeom.mjGEOM_SPHERE, np.array([*sizes, 0.0, 0.0]), None)]
    if kind == "box":
        return [(engine.mjtGeom.mjGEOM_BOX, 0.5 * sizes, None)]
    return [
        (engine.mjtGeom.mjGEOM_MESH, np.zeros(3), piece.vertices) for piece in load_pieces(urdf.with_suffix(".obj"))
    ]


# --- the engine's files ---


def shape_urdf(shape: Shape, folder: Path) -> Path:
    """The URDF of a shape, written into `folder` unless it is there: exact spheres and boxes, convex pieces of others.

    Raises:
        SdfsimError: the shape's mesh cannot be cut into convex pieces.
    """
    sdf = shape.sdf
    if isinstance(sdf, SphereSdf | BoxSdf):
        sphere = isinstance(sdf, SphereSdf)
        sizes = " ".join(f"{s:.9g}" for s in ([sdf.radius] if sphere else [2.0 * half for half in sdf.half]))
        geometry = f'<sphere radius="{sizes}"/>' if sphere else f'<box size="{sizes}"/>'
        urdf = folder / f"{'sphere' if sphere else 'box'}-{sizes.replace(' ', '-')}.urdf"
        folder.mkdir(parents=True, exist_ok=True)
        return urdf if urdf.exists() else write_form_urdf(geometry, urdf)
    urdf = folder / f"pieces-{shape.mesh.digest()[:16]}.urdf"
    if not urdf.exists():
        folder.mkdir(parents=True, exist_ok=True)
        pieces, mesh = own_pieces(shape) or decompose(shape.mesh, folder / urdf.stem), urdf.with_suffix(".obj")
        write_text(mesh, wavefront([Mesh(piece.vertices - shape.com, piece.faces) for piece in pieces]))
        with replacing(urdf) as partial:
            write_urdf(mesh.resolve(), partial)
    return urdf


def dataset_urdf(data: Path, shape: str) -> Path:
    """The URDF of a dataset's shape. Raises SdfsimError when it, or the convex pieces beside it, are absent."""
    path = shapes_folder(data) / "engine" / f"{shape}.urdf"
    if not path.is_file() or not path.with_suffix(".obj").is_file():
        raise SdfsimError(f"{path}: no engine file of shape {shape!r}", "`sdfsim dataset` writes them")
    return path


def form_of(urdf: Path) -> tuple[str, np.ndarray]:
    """What a URDF of ours collides: "sphere" and its radius, "box" and its extents [3] m, or "mesh", its pieces."""
    found = re.search(r'<(sphere|box) (?:radius|size)="([^"]*)"', urdf.read_text(encoding="utf-8"))
    return (found[1], np.array(found[2].split(), dtype=float)) if found else ("mesh", np.zeros(0))
