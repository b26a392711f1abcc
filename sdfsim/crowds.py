"""Many bodies of one shape in a recording: copies of one mesh, whose poses at a step are one row."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sdfsim.dynamics.rollout import Rollout
from sdfsim.scene.types import Scene

if TYPE_CHECKING:
    import rerun as rr

MANY = 24  # bodies of one shape that do not stay put, from which on they are a crowd
COLORS = 4  # copies share their mesh's colour, so a crowd is split to be told apart


@dataclass(frozen=True)
class Crowd:
    """Bodies drawn as copies of one mesh.

    Attributes:
        path: entity path below the world.
        shape: index into `Scene.shapes`.
        bodies: [C] int64, which.
        scale: [C] of each.
    """

    path: str
    shape: int
    bodies: np.ndarray
    scale: np.ndarray

    def log_scale(self, stream: rr.RecordingStream, rr: Any) -> None:
        """What never changes."""
        stream.log(self.path, rr.InstancePoses3D.from_fields(scales=np.repeat(self.scale[:, None], 3, 1)), static=True)

    def log_steps(self, stream: rr.RecordingStream, rr: Any, times: list, chunk: Rollout) -> None:
        """Where all of them are in the frames of `chunk`."""
        places, turns = (getattr(chunk, k)[:, self.bodies] for k in ("position", "orientation"))
        poses = rr.InstancePoses3D.columns(
            translations=places.reshape(-1, 3).astype(np.float32), quaternions=turns.reshape(-1, 4).astype(np.float32)
        )
        stream.send_columns(self.path, times, poses.partition(np.full(len(chunk.time), len(self.bodies))))


def crowds(scene: Scene, world: str) -> list[Crowd]:
    """The crowds of a scene; bodies in none of them are drawn one by one.

    Args:
        scene: bodies and shapes.
        world: the entity path that theirs begin with.
    """
    import rerun as rr

    found = []
    shape = np.array([b.shape if b.motion != "static" else -1 for b in scene.bodies])
    scale = np.array([b.scale for b in scene.bodies])
    for number, name in enumerate(s.name for s in scene.shapes):
        members = np.flatnonzero(shape == number)
        for k in range(COLORS if len(members) >= MANY else 0):
            some, called = members[k::COLORS], rr.escape_entity_path_part(f"{number}_{name}")
            found.append(Crowd(f"{world}/crowds/{called}/{k}", number, some, scale[some]))
    return found
