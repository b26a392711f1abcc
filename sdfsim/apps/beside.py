"""A recorded motion beside a simulated one: the run begins where it does, and recordings and movies show it
translucent."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_arrays, write_arrays
from sdfsim.physics import pose
from sdfsim.physics.motion import MOTION
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.scene import Scene

FILE = "beside.npz"  # its name in a run folder
COLOR = (245, 140, 20)  # RGB of the recorded bodies
OPACITY = 0.5


@dataclass(frozen=True)
class Beside:
    """K recorded poses of the D moving bodies of a scene."""

    name: str  # name of the recording
    bodies: tuple[str, ...]  # their D names
    time: np.ndarray  # [K] s since the start of the run, which is the first pose
    position: np.ndarray  # [K, D, 3] m, centres of mass
    orientation: np.ndarray  # [K, D, 4] xyzw
    # [D, *] position, orientation, velocity and angular_velocity at the start, from fits; empty if read from a run
    # folder
    start: dict[str, np.ndarray]

    def rows(self, scene: Scene) -> np.ndarray:
        """[D] int64, their indices in the scene."""
        return np.array([[body.name for body in scene.bodies].index(name) for name in self.bodies], dtype=np.int64)

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions [T, D, 3] and orientations [T, D, 4] at times [T], interpolated between poses; after the last pose,
        that one."""
        return between(self.time, self.position, self.orientation, time)

    def begun(self, scene: Scene) -> Scene:
        """The scene with the poses and velocities of these bodies at the start of the recording."""
        bodies = list(scene.bodies)
        for d, k in enumerate(self.rows(scene)):
            place, turn, speed, spin = (self.start[name][d] for name in MOTION)
            away = pose.rotate(turn, bodies[k].scale * scene.shapes[bodies[k].shape].com)
            bodies[k] = replace(bodies[k], position=place - away, quat_xyzw=turn, velocity=speed, angular_velocity=spin)
        return replace(scene, bodies=tuple(bodies))

    def off(self, scene: Scene, rollout: Rollout) -> dict[str, Any]:
        """Deviation of a run from the recording while both last, over all bodies: root mean square in m, mean in
        degrees, and the time in s."""
        both, rows = self.time <= rollout.time[-1] + 1e-9, self.rows(scene)
        place, turn = between(rollout.time, rollout.position[:, rows], rollout.orientation[:, rows], self.time[both])
        away = np.linalg.norm(place - self.position[both], axis=-1)
        angle = pose.to_rotvec(pose.multiply(turn, pose.conjugate(self.orientation[both])))
        return {
            "recording": self.name,
            "seconds": float(self.time[both][-1]),
            "position_m": float(np.sqrt(np.square(away).mean())),
            "rotation_degrees": float(np.degrees(np.linalg.norm(angle, axis=-1).mean())),
        }

    def save(self, path: Path) -> None:
        arrays = {"time": self.time, "position": self.position, "orientation": self.orientation}
        write_arrays(path, arrays | {"name": np.array(self.name), "bodies": np.array(self.bodies, dtype=str)})


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


def beside_of(run: Path, scene: Scene) -> Beside | None:
    """The recorded motion beside which a run (its folder or `rollout.npz`) was simulated, None if there was none.
    Raises SdfsimError if the file is unreadable, or is about other bodies."""
    file = (run if run.is_dir() else run.parent) / FILE
    if not file.exists():
        return None
    found = read_arrays(file, "a recorded motion", "simulate the scene again")
    try:
        names = tuple(str(name) for name in found["bodies"])
        read = Beside(str(found["name"]), names, *(found[k] for k in ("time", "position", "orientation")), start={})
        read.rows(scene)
        shapes = (read.position.shape, read.orientation.shape)
        if shapes != tuple((len(read.time), len(names), width) for width in (3, 4)):
            raise ValueError(f"arrays of shapes {shapes}")
    except (KeyError, ValueError) as error:
        raise SdfsimError(f"{file}: not of this scene ({error})", "simulate the scene again") from error
    return read
