"""The camera of a film: fixed, without distortion, and known to some uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sdfsim.physics import pose
from sdfsim.simulate.camera import Camera

WAYS = 7  # rotation about the camera's axes (rad), shift along them (m), logarithm of the focal length


@dataclass(frozen=True)
class Eye:
    """A camera and how well it is known. `doubt` [WAYS, K]: independent changes of one standard deviation each."""

    rotation: np.ndarray  # [3, 3] world to camera: x right, y down, z ahead
    translation: np.ndarray  # [3] m
    focal: float  # px
    width: int
    height: int
    doubt: np.ndarray
    source: str = ""

    def moved(self, change: np.ndarray) -> Eye:
        """The camera after a small change [WAYS]."""
        turn = pose.to_matrix(pose.from_rotvec(change[:3]))
        return replace(
            self, rotation=turn @ self.rotation, translation=turn @ self.translation + change[3:6],
            focal=float(self.focal * np.exp(change[6])),
        )  # fmt: skip

    @property
    def middle(self) -> np.ndarray:
        return 0.5 * np.array([self.width, self.height])

    def seen(self, points: np.ndarray) -> np.ndarray:
        """Points [..., 3] of the world in the camera's axes, m."""
        return points @ self.rotation.T + self.translation

    def project(self, points: np.ndarray) -> np.ndarray:
        """[..., 2] px of points [..., 3] m of the world."""
        local = self.seen(points)
        return self.focal * local[..., :2] / local[..., 2:] + self.middle

    def rays(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Directions [..., 3] in the camera's axes, one metre deep, through places x, y px."""
        across, down = (x - self.middle[0]) / self.focal, (y - self.middle[1]) / self.focal
        return np.stack(np.broadcast_arrays(across, down, 1.0), -1)

    @cached_property
    def camera(self) -> Camera:
        """The camera that draws what it sees."""
        return Camera.posed(self.rotation, self.translation, (self.focal, self.focal), self.width, self.height)
