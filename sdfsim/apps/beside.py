"""A recorded motion beside a simulated one: the run begins where it does, and recordings and movies show it
translucent. It is a `Rollout` of the moving bodies of a scene without contacts, whose `meta` has the name of the
recording, and whose first frame has the velocities at the start."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.physics import pose
from sdfsim.physics.motion import MOTION
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.scene import Scene

FILE = "beside.npz"  # its name in a run folder
COLOR = (245, 140, 20)  # RGB of the recorded bodies
OPACITY = 0.5


def rows_in(scene: Scene, recorded: Rollout) -> np.ndarray:
    """[D] int64, the indices of recorded bodies in a scene. Raises ValueError if it lacks one."""
    return np.array([[body.name for body in scene.bodies].index(name) for name in recorded.names], dtype=np.int64)


def begun(scene: Scene, recorded: Rollout) -> Scene:
    """The scene with the poses and velocities of these bodies at the start of the recording."""
    bodies = list(scene.bodies)
    for d, k in enumerate(rows_in(scene, recorded)):
        place, turn, speed, spin = (getattr(recorded, name)[0, d] for name in MOTION)
        away = pose.rotate(turn, bodies[k].scale * scene.shapes[bodies[k].shape].com)
        bodies[k] = replace(bodies[k], position=place - away, quat_xyzw=turn, velocity=speed, angular_velocity=spin)
    return replace(scene, bodies=tuple(bodies))


def off(scene: Scene, rollout: Rollout, recorded: Rollout) -> dict[str, Any]:
    """Deviation of a run from the recording while both last, over all bodies: root mean square in m, mean in degrees,
    and the time in s."""
    both, rows = recorded.time <= rollout.time[-1] + 1e-9, rows_in(scene, recorded)
    place, turn = between(rollout.time, rollout.position[:, rows], rollout.orientation[:, rows], recorded.time[both])
    away = np.linalg.norm(place - recorded.position[both], axis=-1)
    angle = pose.to_rotvec(pose.multiply(turn, pose.conjugate(recorded.orientation[both])))
    return {
        "recording": recorded.meta["recording"],
        "seconds": float(recorded.time[both][-1]),
        "position_m": float(np.sqrt(np.square(away).mean())),
        "rotation_degrees": float(np.degrees(np.linalg.norm(angle, axis=-1).mean())),
    }


def between(
    time: np.ndarray, position: np.ndarray, orientation: np.ndarray, at: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Poses at times `at` [T] of a motion [K, D, *], interpolated between its frames; after the last frame, that
    one."""
    if len(time) < 2:
        return np.repeat(position, len(at), 0), np.repeat(orientation, len(at), 0)
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    part = np.clip((at - time[after - 1]) / (time[after] - time[after - 1]), 0.0, 1.0)[:, None, None]
    place = (1.0 - part) * position[after - 1] + part * position[after]
    turn = pose.to_rotvec(pose.multiply(orientation[after], pose.conjugate(orientation[after - 1])))
    return place, pose.multiply(pose.from_rotvec(part * turn), orientation[after - 1])


def beside_of(run: Path, scene: Scene) -> Rollout | None:
    """The recorded motion beside which a run (its folder or `rollout.npz`) was simulated, None if there was none.
    Raises SdfsimError if the file is unreadable, or is about other bodies."""
    file = (run if run.is_dir() else run.parent) / FILE
    if not file.exists():
        return None
    recorded = Rollout.load(file)
    try:
        rows_in(scene, recorded)
    except ValueError as error:
        raise SdfsimError(f"{file}: not of this scene ({error})", "simulate the scene again") from error
    return recorded
