"""Exact signed distances of the plane, the sphere and the box, with a defined gradient everywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from sdfsim.errors import SdfsimError
from sdfsim.shape.sdf import accepts_numpy


def plane_distance(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance [P] to z = 0 and its gradient [P, 3], at `points` [P, 3]."""
    gradient = torch.zeros_like(points)
    gradient[:, 2] = 1.0
    return points[:, 2].clone(), gradient


def sphere_distance(points: torch.Tensor, radius: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance [P] to a sphere about the origin and its gradient [P, 3]; up (+z) at the centre.

    Args:
        points: [P, 3] m.
        radius: [P] or [1] m.
    """
    length = points.norm(dim=1)
    up = torch.zeros_like(points)
    up[:, 2] = 1.0
    tiny = torch.finfo(points.dtype).tiny
    gradient = torch.where((length > tiny)[:, None], points / length.clamp_min(tiny)[:, None], up)
    return length - radius, gradient


def box_distance(points: torch.Tensor, half: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance [P] to an axis-aligned box about the origin and its gradient [P, 3].

    Inside, the gradient points to the nearest face: the first of equally near ones, and the positive side of an
    axis at its middle.

    Args:
        points: [P, 3] m.
        half: [P, 3] or [1, 3] half extents, m.
    """
    side = torch.where(points < 0, -1.0, 1.0).to(points.dtype)
    excess = points.abs() - half
    beyond = excess.clamp_min(0)
    length = beyond.norm(dim=1)
    deepest, axis = excess.max(dim=1)
    inward = torch.nn.functional.one_hot(axis, 3).to(points.dtype)
    tiny = torch.finfo(points.dtype).tiny
    outside = length > tiny
    gradient = torch.where(outside[:, None], beyond / length.clamp_min(tiny)[:, None], inward)
    return torch.where(outside, length, deepest), side * gradient


@dataclass(frozen=True, eq=False)
class PlaneSdf:
    """The half space below z = 0 is solid; the normal is +z. Infinite."""

    @property
    def bounds(self) -> np.ndarray:
        """[2, 3] m: infinite but for the top."""
        return np.array([[-np.inf] * 3, [np.inf, np.inf, 0.0]])

    def to(self, device: torch.device | str) -> PlaneSdf:
        """Itself: it holds no tensors."""
        return self

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and unit gradient [P, 3] at `points` [P, 3] m."""
        return plane_distance(points)


@dataclass(frozen=True, eq=False)
class SphereSdf:
    """A ball about the origin.

    Attributes:
        radius: m, > 0.

    Raises:
        SdfsimError: the radius is not a positive finite number.
    """

    radius: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.radius) and self.radius > 0):
            raise SdfsimError(f"sphere radius must be > 0 (got {self.radius})")

    @property
    def bounds(self) -> np.ndarray:
        """[2, 3] m."""
        return np.array([[-self.radius] * 3, [self.radius] * 3], dtype=np.float64)

    def to(self, device: torch.device | str) -> SphereSdf:
        """Itself: it holds no tensors."""
        return self

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and unit gradient [P, 3] at `points` [P, 3] m."""
        return sphere_distance(points, torch.tensor([self.radius], dtype=points.dtype, device=points.device))


@dataclass(frozen=True, eq=False)
class BoxSdf:
    """An axis-aligned box about the origin.

    Attributes:
        half: (x, y, z) half extents m, > 0.

    Raises:
        SdfsimError: a half extent is not a positive finite number.
    """

    half: tuple[float, float, float]

    def __post_init__(self) -> None:
        if len(self.half) != 3 or not all(np.isfinite(value) and value > 0 for value in self.half):
            raise SdfsimError(f"box half extents must be three numbers > 0 (got {self.half})")

    @property
    def bounds(self) -> np.ndarray:
        """[2, 3] m."""
        return np.array([[-value for value in self.half], list(self.half)], dtype=np.float64)

    def to(self, device: torch.device | str) -> BoxSdf:
        """Itself: it holds no tensors."""
        return self

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and unit gradient [P, 3] at `points` [P, 3] m."""
        return box_distance(points, torch.tensor([self.half], dtype=points.dtype, device=points.device))
