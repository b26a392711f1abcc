"""Exact signed distances of plane, sphere, capsule, box and cylinder, with a defined gradient everywhere."""

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


def capsule_distance(
    points: torch.Tensor, radius: torch.Tensor, half: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance [P] to all within `radius` [P] or [1] of the segment |z| <= `half` [P] or [1], and its gradient [P, 3].

    Args:
        points: [P, 3] m.
        radius, half: m.
    """
    up = torch.zeros_like(points)
    up[:, 2] = torch.minimum(torch.maximum(points[:, 2], -half), half)
    return sphere_distance(points - up, radius)


def cylinder_distance(
    points: torch.Tensor, radius: torch.Tensor, half: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance [P] to a cylinder about z of half height `half` [P] or [1], and its gradient [P, 3].

    Inside, the gradient points to the nearer of side and end; of equally near ones to the end.
    """
    tiny = torch.finfo(points.dtype).tiny
    away = points[:, :2].norm(dim=1)
    outward = torch.zeros_like(points)
    outward[:, 0] = 1.0
    outward[:, :2] = torch.where((away > tiny)[:, None], points[:, :2] / away.clamp_min(tiny)[:, None], outward[:, :2])
    end = torch.zeros_like(points)
    end[:, 2] = torch.where(points[:, 2] < 0, -1.0, 1.0).to(points.dtype)
    aside, above = away - radius, points[:, 2].abs() - half
    corner = (aside > 0) & (above > 0)
    length = torch.sqrt(aside.clamp_min(0) ** 2 + above.clamp_min(0) ** 2)
    slanted = (aside[:, None] * outward + above[:, None] * end) / length.clamp_min(tiny)[:, None]
    side = aside > above
    distance = torch.where(corner, length, torch.maximum(aside, above))
    gradient = torch.where(corner[:, None], slanted, torch.where(side[:, None], outward, end))
    return distance, gradient


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


@dataclass(frozen=True, eq=False)
class CapsuleSdf:
    """All within a radius of a segment along z whose middle is the origin.

    Attributes:
        radius: m, > 0.
        half: m, > 0, half the length of the segment.

    Raises:
        SdfsimError: one of them is not a positive finite number.
    """

    radius: float
    half: float

    def __post_init__(self) -> None:
        _check_round("capsule", self.radius, self.half)

    @property
    def bounds(self) -> np.ndarray:
        """[2, 3] m."""
        high = np.array([self.radius, self.radius, self.half + self.radius])
        return np.stack([-high, high])

    def to(self, device: torch.device | str) -> CapsuleSdf:
        """Itself: it holds no tensors."""
        return self

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and unit gradient [P, 3] at `points` [P, 3] m."""
        return capsule_distance(points, points.new_tensor([self.radius]), points.new_tensor([self.half]))


@dataclass(frozen=True, eq=False)
class CylinderSdf:
    """A cylinder about z whose middle is the origin.

    Attributes:
        radius: m, > 0.
        half: m, > 0, half its height.

    Raises:
        SdfsimError: one of them is not a positive finite number.
    """

    radius: float
    half: float

    def __post_init__(self) -> None:
        _check_round("cylinder", self.radius, self.half)

    @property
    def bounds(self) -> np.ndarray:
        """[2, 3] m."""
        high = np.array([self.radius, self.radius, self.half])
        return np.stack([-high, high])

    def to(self, device: torch.device | str) -> CylinderSdf:
        """Itself: it holds no tensors."""
        return self

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and unit gradient [P, 3] at `points` [P, 3] m."""
        return cylinder_distance(points, points.new_tensor([self.radius]), points.new_tensor([self.half]))


def _check_round(kind: str, radius: float, half: float) -> None:
    for name, value in (("radius", radius), ("half height", half)):
        if not (np.isfinite(value) and value > 0):
            raise SdfsimError(f"{kind} {name} must be > 0 (got {value})")
