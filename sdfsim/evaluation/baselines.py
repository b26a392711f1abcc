"""The chaos floor: how far the teacher departs from its own recording when its starts differ by next to nothing."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from sdfsim.data.dataset import Trajectory, floor_of, home_of, read_info, shapes_folder
from sdfsim.data.pybullet_sim import Teacher, TeacherBody, engine_settings, import_pybullet, substeps_of
from sdfsim.errors import SdfsimError
from sdfsim.parallel import parallel

# m/s; 0 tells what the recording alone does not bring back: an engine's state is more than its recorded frames.
PERTURBATIONS = {"0": 0.0, "1e-6": 1e-6, "1e-3": 1e-3}
SAME_INERTIA = 1e-3  # relative


def chaos_floor(data: Path, trajectories: list[Trajectory], steps: int, seed: int = 0) -> dict[str, list[Trajectory]]:
    """Run the teacher again from the recorded starts.

    Args:
        data: dataset folder (or one split of it) whose `shapes/engine` holds a URDF for every shape.
        trajectories: recorded ones, with velocities as recorded.
        steps: how far.
        seed: of the directions of the perturbations.

    Returns:
        name in `PERTURBATIONS` -> the same bodies in the motion (steps + 1 frames) that follows when the velocity of
        each that moves is changed by so much in a random direction.

    Raises:
        SdfsimError: PyBullet or an engine file is absent, or the recording is not this teacher's.
    """
    import_pybullet()
    info = read_info(home_of(data) or data.parent)
    _check_teacher(info, trajectories)
    names = {str(n) for t in trajectories for n in t.shape}
    urdfs = {name: engine_file(data, name) for name in names}
    surface = floor_of(info)
    jobs = [
        (perturbed(t, size, [seed, k]), urdfs, surface, steps)
        for size in PERTURBATIONS.values()
        for k, t in enumerate(trajectories)
    ]
    done = dict(parallel(run_again, jobs))
    count = len(trajectories)
    return {name: [done[i * count + k] for k in range(count)] for i, name in enumerate(PERTURBATIONS)}


def run_again(start: Trajectory, urdfs: dict[str, Path], floor: tuple[float, float], steps: int) -> Trajectory:
    """The teacher's motion of `steps` steps from the first frame of `start`.

    Raises:
        SdfsimError: a step that is none of the teacher's, or the engine takes another inertia than the recorded one.
    """
    with started(start, urdfs, floor) as teacher:
        return replace(start, **teacher.run(steps))


@contextmanager
def started(
    start: Trajectory, urdfs: dict[str, Path], floor: tuple[float, float], substeps: int | None = None
) -> Iterator[Teacher]:
    """The teacher at the first frame of `start`, in its own inner steps unless told. Raises as `run_again` does."""
    inner = substeps or substeps_of(start.dt)
    with Teacher(start.gravity, floor, step=start.dt, substeps=inner) as teacher:
        for i, name in enumerate(start.shape):
            mass = 0.0 if start.static[i] else float(start.mass[i])
            body = TeacherBody(
                urdfs[str(name)], float(start.scale[i]), mass, float(start.friction[i]), float(start.restitution[i])
            )
            # Far away first and moved then, as when it was recorded: the engine's order of pairs depends on it.
            teacher.add(body, np.array([0.0, 0.0, -100.0]), np.array([0.0, 0.0, 0.0, 1.0]))
            teacher.place(i, start.position[0, i], start.quat_xyzw[0, i])
            if not start.static[i]:
                teacher.push(i, start.velocity[0, i], start.angular_velocity[0, i])
                if not np.allclose(teacher.inertia(i), start.inertia[i], rtol=SAME_INERTIA):
                    raise SdfsimError(f"{urdfs[str(name)]}: the engine's inertia is not the recorded one")
        yield teacher


def engine_file(data: Path, shape: str) -> Path:
    """The URDF of a dataset's shape. Raises SdfsimError when it, or the mesh that it names, is absent."""
    path = shapes_folder(data) / "engine" / f"{shape}.urdf"
    if not path.is_file():
        raise SdfsimError(f"{path}: no engine file of shape {shape!r}", "`sdfsim dataset` writes them")
    if not is_sphere(path) and not (mesh := collision_mesh(path)[0]).is_file():
        raise SdfsimError(f"{path}: the mesh that it names, {mesh}, is absent", "make the dataset again")
    return path


def is_sphere(urdf: Path) -> bool:
    """Whether a URDF's body collides as an exact sphere. Raises SdfsimError when it is unreadable."""
    return any(body.find("geometry/sphere") is not None for body in _collisions(urdf))


def collision_mesh(urdf: Path) -> tuple[Path, np.ndarray]:
    """The mesh file that a URDF's body collides with, and where [3] m its origin is in the body's frame.

    Raises:
        SdfsimError: unreadable, or anything but one mesh, unturned and at its own size.
    """
    bodies = _collisions(urdf)
    mesh = bodies[0].find("geometry/mesh") if len(bodies) == 1 else None
    if mesh is None or "scale" in mesh.attrib or "filename" not in mesh.attrib:
        raise SdfsimError(f"{urdf}: must hold one collision mesh without a scale")
    origin = bodies[0].find("origin")
    attributes = {} if origin is None else origin.attrib
    if any(float(turn) for turn in attributes.get("rpy", "").split()):
        raise SdfsimError(f"{urdf}: the collision mesh must not be turned")
    offset = np.array([float(value) for value in attributes.get("xyz", "0 0 0").split()])
    return urdf.parent / mesh.attrib["filename"], offset


def _collisions(urdf: Path) -> list[ElementTree.Element]:
    try:
        return ElementTree.parse(urdf).getroot().findall("link/collision")
    except (OSError, ElementTree.ParseError) as error:
        raise SdfsimError(f"{urdf}: cannot be read as a URDF: {error}") from error


def perturbed(t: Trajectory, size: float, seed: list[int]) -> Trajectory:
    """The trajectory with velocities of its moving bodies changed by `size` m/s in random directions."""
    direction = np.random.default_rng(seed).normal(size=t.velocity[0].shape)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return replace(t, velocity=t.velocity + size * direction * ~t.static[:, None])


def _check_teacher(info: dict, trajectories: list[Trajectory]) -> None:
    """That the recording was made by the engine, and the settings, that would run it again."""
    settings = info.get("engine_settings")
    if info.get("engine") != "pybullet" or not isinstance(settings, dict):
        raise SdfsimError(f"recorded by {info.get('engine') or 'an unnamed engine'}, not by PyBullet as it is set here")
    for step in {t.dt for t in trajectories}:
        ours = engine_settings(step, substeps_of(step))
        if other := [name for name, value in ours.items() if settings.get(name) != value]:
            raise SdfsimError(f"recorded with other engine settings ({', '.join(other)})")
