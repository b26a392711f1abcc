"""Signed distances in closed form: plane, ball, box, capsule, cylinder."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.sdf.sdf import accepts_numpy


class ClosedForm(ABC):
    """A solid about the origin with an exact distance; its fields are its sizes, m, positive (else SdfsimError)."""

    KIND: ClassVar[str]

    def __post_init__(self) -> None:
        sizes = np.array(self.sizes, dtype=np.float64)
        if self.bounds.shape != (2, 3) or not (np.isfinite(sizes) & (sizes > 0)).all():
            given = ", ".join(f"{name} {value}" for name, value in vars(self).items())
            raise SdfsimError(f"the sizes of a {self.KIND} must be > 0 (got {given})")

    @property
    def sizes(self) -> tuple[float, ...]:
        """m, one after the other."""
        return tuple(np.hstack([*vars(self).values()]).tolist()) if vars(self) else ()

    @property
    def bounds(self) -> np.ndarray:
        """[2, 3] float64 m, the box that holds the solid."""
        return np.outer([-1.0, 1.0], self._reach())

    def _reach(self) -> tuple[float, ...]:
        """(x, y, z) m, its half extents. A plane has none and gives its `bounds` itself, so this is not abstract."""
        raise NotImplementedError

    @abstractmethod
    def _measure(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and unit gradient [P, 3] at `points` [P, 3] m."""

    def to(self, device: torch.device | str) -> Self:
        """Itself: it holds no tensors."""
        return self

    def scaled(self, factor: float) -> Self:
        """The solid `factor` times as large."""
        values = vars(self).values()
        return type(self)(*(tuple(x * factor for x in v) if isinstance(v, tuple) else v * factor for v in values))

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and unit gradient [P, 3] at `points` [P, 3] m."""
        return self._measure(points)


@dataclass(frozen=True, eq=False)
class PlaneSdf(ClosedForm):
    """The half space below z = 0 is solid; the normal is +z. Infinite."""

    KIND = "plane"

    @property
    def bounds(self) -> np.ndarray:
        """[2, 3] m: infinite but for the top."""
        return np.array([[-np.inf] * 3, [np.inf, np.inf, 0.0]])

    def _measure(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return points[:, 2].clone(), _up(points)


@dataclass(frozen=True, eq=False)
class SphereSdf(ClosedForm):
    """A ball of `radius` m. The gradient at the centre points up."""

    KIND = "sphere"
    radius: float

    def _reach(self) -> tuple[float, ...]:
        return (self.radius,) * 3

    def _measure(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        length = points.norm(dim=1)
        tiny = torch.finfo(points.dtype).tiny
        unit = points / length.clamp_min(tiny)[:, None]
        return length - self.radius, torch.where((length > tiny)[:, None], unit, _up(points))


@dataclass(frozen=True, eq=False)
class BoxSdf(ClosedForm):
    """An axis-aligned box with half extents `half` (x, y, z) m. Inside, the gradient points to the nearest face: the
    first of equally near ones, and the positive side of an axis at its middle."""

    KIND = "box"
    half: tuple[float, float, float]

    def _reach(self) -> tuple[float, ...]:
        return self.half

    def _measure(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        side = torch.where(points < 0, -1.0, 1.0).to(points.dtype)
        excess = points.abs() - points.new_tensor(self.half)
        beyond = excess.clamp_min(0)
        length = beyond.norm(dim=1)
        deepest, axis = excess.max(dim=1)
        inward = torch.nn.functional.one_hot(axis, 3).to(points.dtype)
        tiny = torch.finfo(points.dtype).tiny
        outside = length > tiny
        gradient = torch.where(outside[:, None], beyond / length.clamp_min(tiny)[:, None], inward)
        return torch.where(outside, length, deepest), side * gradient


@dataclass(frozen=True, eq=False)
class CapsuleSdf(ClosedForm):
    """All within `radius` m of the segment |z| <= `half` m."""

    KIND = "capsule"
    radius: float
    half: float

    def _reach(self) -> tuple[float, ...]:
        return self.radius, self.radius, self.half + self.radius

    def _measure(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        axis = torch.zeros_like(points)
        axis[:, 2] = points[:, 2].clamp(-self.half, self.half)
        return SphereSdf(self.radius)._measure(points - axis)


@dataclass(frozen=True, eq=False)
class CylinderSdf(ClosedForm):
    """A cylinder about z of `radius` m and half height `half` m. Inside, the gradient points to the nearer of side and
    end; of equally near ones to the end."""

    KIND = "cylinder"
    radius: float
    half: float

    def _reach(self) -> tuple[float, ...]:
        return self.radius, self.radius, self.half

    def _measure(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        tiny = torch.finfo(points.dtype).tiny
        away = points[:, :2].norm(dim=1)
        outward = torch.zeros_like(points)
        outward[:, 0] = 1.0
        unit = points[:, :2] / away.clamp_min(tiny)[:, None]
        outward[:, :2] = torch.where((away > tiny)[:, None], unit, outward[:, :2])
        end = torch.zeros_like(points)
        end[:, 2] = torch.where(points[:, 2] < 0, -1.0, 1.0).to(points.dtype)
        aside, above = away - self.radius, points[:, 2].abs() - self.half
        corner = (aside > 0) & (above > 0)
        length = torch.sqrt(aside.clamp_min(0) ** 2 + above.clamp_min(0) ** 2)
        slanted = (aside[:, None] * outward + above[:, None] * end) / length.clamp_min(tiny)[:, None]
        side = aside > above
        distance = torch.where(corner, length, torch.maximum(aside, above))
        gradient = torch.where(corner[:, None], slanted, torch.where(side[:, None], outward, end))
        return distance, gradient


CLOSED_FORMS = {kind.KIND: kind for kind in (PlaneSdf, SphereSdf, BoxSdf, CapsuleSdf, CylinderSdf)}


def _up(points: torch.Tensor) -> torch.Tensor:
    up = torch.zeros_like(points)
    up[:, 2] = 1.0
    return up
