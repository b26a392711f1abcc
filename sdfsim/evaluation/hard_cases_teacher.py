"""The teacher in the scenes of the hard cases: PyBullet with the settings that made the training data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.data.convex_pieces import decompose, wavefront
from sdfsim.data.pybullet_sim import DT, Teacher, TeacherBody, write_form_urdf, write_urdf
from sdfsim.dynamics.rollout import Rollout
from sdfsim.errors import SdfsimError
from sdfsim.evaluation.hard_cases_scenes import body_inertia
from sdfsim.files import replacing, write_text
from sdfsim.scene.types import Body, Scene
from sdfsim.shape.mesh import Mesh
from sdfsim.shape.primitives import PRIMITIVES, convex_pieces
from sdfsim.shape.sdf import BoxSdf, PlaneSdf, SphereSdf
from sdfsim.shape.shape import Shape


def engine_file(shape: Shape, folder: Path) -> Path:
    """The URDF of a shape, written into `folder` unless it is there: exact spheres and boxes, convex pieces of others.

    Raises:
        SdfsimError: the shape's mesh cannot be cut into convex pieces.
    """
    sdf = shape.sdf
    if isinstance(sdf, SphereSdf):
        name, geometry = f"sphere-{sdf.radius:.9g}", f'<sphere radius="{sdf.radius:.9g}"/>'
    elif isinstance(sdf, BoxSdf):
        size = [2.0 * half for half in sdf.half]
        name = "box-" + "-".join(f"{s:.9g}" for s in size)
        geometry = '<box size="{:.9g} {:.9g} {:.9g}"/>'.format(*size)
    else:
        return _pieces_file(shape, folder)
    urdf = folder / f"{name}.urdf"
    if not urdf.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_form_urdf(geometry, urdf)
    return urdf


def _pieces_file(shape: Shape, folder: Path) -> Path:
    name = f"pieces-{shape.mesh.digest()[:16]}"
    urdf, mesh = folder / f"{name}.urdf", folder / f"{name}.obj"
    if not urdf.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_text(mesh, wavefront(_pieces(shape, folder / name)))
        with replacing(urdf) as partial:
            write_urdf(mesh.resolve(), shape.com, partial)
    return urdf


def _pieces(shape: Shape, scratch: Path) -> list[Mesh]:
    kind = str(shape.source.get("primitive", ""))
    try:
        pieces = convex_pieces(kind)
    except SdfsimError:
        return decompose(shape.mesh, scratch)
    factor = float(np.ptp(shape.mesh.vertices, axis=0).max() / np.ptp(PRIMITIVES[kind]().vertices, axis=0).max())
    return [Mesh(piece.vertices * factor, piece.faces) for piece in pieces]


def teach(scene: Scene, folder: Path, *, seconds: float | None = None, steps: int | None = None) -> Rollout:
    """The teacher's motion of a scene whose only plane, if any, is the floor z = 0.

    Masses and the inertia about the shapes' own axes are the scene's. The teacher has no sleep.

    Args:
        scene: what to simulate.
        folder: of the engine's files.
        seconds: how long.
        steps: or so many steps of the teacher's own length.

    Returns:
        A rollout like the simulator's, of all bodies of the scene, without contact points.

    Raises:
        SdfsimError: PyBullet is not installed, or a body that it does not know.
    """
    count = steps if steps is not None else max(1, round((seconds or scene.duration) / DT))
    planes = [isinstance(scene.shapes[b.shape].sdf, PlaneSdf) for b in scene.bodies]
    floors = [b for b, plane in zip(scene.bodies, planes, strict=True) if plane]
    if len(floors) > 1 or any(b.motion == "kinematic" for b in scene.bodies):
        raise SdfsimError("the teacher knows one floor, and no body on a path")
    floor = (floors[0].friction, floors[0].restitution) if floors else None
    solid = [k for k, plane in enumerate(planes) if not plane]
    with Teacher(scene.gravity, floor) as teacher:
        for k in solid:
            _add(teacher, scene.bodies[k], scene.shapes[scene.bodies[k].shape], folder)
        motion = teacher.run(count)
    frames = count + 1
    pose = np.tile([0.0, 0.0, 0.0, 1.0], (frames, len(scene.bodies), 1))
    still = np.zeros((3, frames, len(scene.bodies), 3))
    position, velocity, angular = still
    position[:, solid], pose[:, solid] = motion["position"], motion["quat_xyzw"]
    velocity[:, solid], angular[:, solid] = motion["velocity"], motion["angular_velocity"]
    return Rollout(
        time=np.arange(frames) * DT,
        position=position,
        orientation=pose,
        velocity=velocity,
        angular_velocity=angular,
        contact_count=np.zeros(frames, dtype=np.int64),
        contact_point=np.zeros((0, 3)),
        contact_body=np.zeros((0, 2), dtype=np.int64),
        names=tuple(b.name for b in scene.bodies),
        meta={"model": "teacher", "dt": DT},
    )


def _add(teacher: Teacher, body: Body, shape: Shape, folder: Path) -> None:
    mass = body.mass if body.motion == "dynamic" else 0.0
    one = TeacherBody(engine_file(shape, folder), body.scale, mass, body.friction, body.restitution)
    centre = body.position + Rotation.from_quat(body.quat_xyzw).apply(shape.com * body.scale)
    index = teacher.add(one, centre, body.quat_xyzw)
    if mass:
        teacher.set_inertia(index, np.diag(body_inertia(body, shape)))
        teacher.push(index, body.velocity, body.angular_velocity)
