"""A scene file as a case: the teacher simulates it, in the model's units, and that is what contenders are judged by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.data.dataset import Trajectory
from sdfsim.data.pybullet_sim import DT, SUBSTEP, Teacher, TeacherBody
from sdfsim.dynamics.bodies import Units
from sdfsim.dynamics.froude import scene_units
from sdfsim.dynamics.model import load_model
from sdfsim.errors import SdfsimError
from sdfsim.evaluation.baselines import collision_mesh, run_again
from sdfsim.evaluation.hard_cases_teacher import engine_file
from sdfsim.evaluation.penetration import exact_solids
from sdfsim.evaluation.tradeoff_cases import STEPS, TIMED_STEPS, Cases
from sdfsim.scene.load import load_scene
from sdfsim.scene.types import Body, Scene
from sdfsim.shape.mesh import Mesh, convex_hull, load_pieces
from sdfsim.shape.mlp_sdf import MlpSdf
from sdfsim.shape.sdf import GridSdf, MeshSdf, PlaneSdf
from sdfsim.shape.shape import Shape

PHYSICAL = ("contact", "friction", "restitution", "rotation")  # effects that the teacher always has


def cases_of_scene(
    path: Path, model: str, scratch: Path, *, quick: bool, on_progress: Callable[[float, str], None]
) -> Cases:
    """The one case that a scene file makes.

    Lengths, times and masses are the model's (Froude scaling), so that the teacher, whose steps and margins are meant
    for bodies of about a metre, serves scenes of any size.

    Args:
        path: scene.yaml.
        model: whose units are taken.
        scratch: folder for the engine's files and what is sampled.
        quick: a shorter course.
        on_progress: called with the fraction done and a message.

    Raises:
        SdfsimError: bad input; a floor other than one level plane, bodies on a path, bodies that may not touch all
            others, or effects that are off; nothing moves; PyBullet is not installed.
    """
    scene = load_scene(path, on_progress)
    _check_known(scene)
    floor, height = _floor(scene)
    units = scene_units(scene, load_model(model, weights=False), None)
    solid = [b for b in scene.bodies if not isinstance(scene.shapes[b.shape].sdf, PlaneSdf)]
    if not any(b.motion == "dynamic" for b in solid):
        raise SdfsimError(f"{scene.path}: nothing moves in it")
    shapes = {str(k): _centred(scene.shapes[k], str(k)) for k in sorted({b.shape for b in solid})}
    on_progress(0.5, "convex pieces for the teacher")
    urdfs = {name: engine_file(shape, scratch / "engine") for name, shape in shapes.items()}
    surface = (floor.friction, floor.restitution)
    steps = max(2, min(50 if quick else STEPS, round(scene.duration / units.time / DT)))
    start = _start(scene, solid, units, height)
    start = replace(start, inertia=_inertias(start, urdfs))
    on_progress(0.9, "the teacher's motion")
    # The engine's flights are those of bodies that are half an inner step of gravity faster than it is told.
    lead = 0.5 * SUBSTEP * start.gravity * ~start.static[:, None]
    recorded = run_again(replace(start, velocity=start.velocity - lead), urdfs, surface, steps)
    return Cases(
        data=path,
        scratch=scratch,
        recorded=[recorded],
        starts=[start],
        shapes=shapes,
        urdfs=urdfs,
        pieces={name: _pieces(shapes[name], urdf) for name, urdf in urdfs.items()},
        solids=exact_solids(path.parent, shapes),
        floor=surface,
        timed=[0],
        timed_steps=min(30 if quick else TIMED_STEPS, steps),
        length=units.length,
        time=units.time,
    )


def _check_known(scene: Scene) -> None:
    """Raises SdfsimError where the teacher, or `scene_of`, would make another scene of it."""
    if any(b.motion == "kinematic" for b in scene.bodies):
        raise SdfsimError(f"{scene.path}: has bodies on a path, which the teacher does not know")
    if any(b.collides_with is not None for b in scene.bodies):
        raise SdfsimError(f"{scene.path}: has bodies that may not touch all others, which is not measured")
    if off := [name for name in PHYSICAL if getattr(scene.effects, name) == "off"]:
        raise SdfsimError(f"{scene.path}: effects: {off[0]} is off, which is not measured", "leave it at auto")


def _floor(scene: Scene) -> tuple[Body, float]:
    """The floor and its height m."""
    planes = [b for b in scene.bodies if isinstance(scene.shapes[b.shape].sdf, PlaneSdf)]
    up = [Rotation.from_quat(b.quat_xyzw).apply([0.0, 0.0, 1.0]) for b in planes]
    if len(planes) != 1 or up[0][2] < 1 - 1e-9:
        raise SdfsimError(f"{scene.path}: needs one level plane as its floor (has {len(planes)} planes)")
    return planes[0], float(planes[0].position[2])


def _start(scene: Scene, solid: list[Body], units: Units, height: float) -> Trajectory:
    """The first frame, model units, the floor at z = 0; inertias are still to come."""
    turns = Rotation.from_quat(np.array([b.quat_xyzw for b in solid]))
    centres = np.array([b.scale * scene.shapes[b.shape].com for b in solid])
    position = np.array([b.position for b in solid]) + turns.apply(centres) - np.array([0.0, 0.0, height])
    gravity = scene.gravity / units.acceleration
    moving = np.array([b.motion == "dynamic" for b in solid])
    return Trajectory(
        position=position[None] / units.length,
        quat_xyzw=turns.as_quat()[None],
        velocity=np.array([b.velocity for b in solid])[None] / units.velocity,
        angular_velocity=np.array([b.angular_velocity for b in solid])[None] * units.time,
        shape=np.array([str(b.shape) for b in solid]),
        scale=np.array([b.scale for b in solid]) / units.length,
        mass=np.array([b.mass for b in solid]) / units.mass,
        inertia=np.ones((len(solid), 3)),
        friction=np.array([b.friction for b in solid]),
        restitution=np.array([b.restitution for b in solid]),
        static=~moving,
        dt=DT,
        gravity=gravity,
    )


def _inertias(start: Trajectory, urdfs: dict[str, Path]) -> np.ndarray:
    """[N, 3] as the engine takes them, so that all contenders have the same."""
    found = np.ones((len(start.mass), 3))
    with Teacher(start.gravity, None) as teacher:
        for i, name in enumerate(start.shape):
            if not start.static[i]:
                index = teacher.add(
                    TeacherBody(urdfs[str(name)], float(start.scale[i]), float(start.mass[i]), 0.0, 0.0)
                )
                found[i] = teacher.inertia(index)
    return found


def _centred(shape: Shape, name: str) -> Shape:
    """The shape with its origin at its centre of mass."""
    sdf, mesh = shape.sdf, replace(shape.mesh, vertices=shape.mesh.vertices - shape.com)
    if isinstance(sdf, MlpSdf | GridSdf):
        sdf = replace(sdf, frame=replace(sdf.frame, centre=sdf.frame.centre - shape.com), bounds=sdf.bounds - shape.com)
    elif isinstance(sdf, MeshSdf):
        sdf = MeshSdf(replace(sdf.mesh, vertices=sdf.mesh.vertices - shape.com))
    pieces = tuple(piece - shape.com for piece in shape.pieces)
    return replace(shape, name=name, mesh=mesh, sdf=sdf, nodes=shape.nodes - shape.com, com=np.zeros(3), pieces=pieces)


def _pieces(shape: Shape, urdf: Path) -> list[Mesh]:
    try:
        mesh, offset = collision_mesh(urdf)
    except SdfsimError:  # an exact sphere or box
        return [convex_hull(shape.mesh.vertices)]
    return [Mesh(piece.vertices + offset, piece.faces) for piece in load_pieces(mesh)]
