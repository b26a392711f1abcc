"""Signed distances in closed form: plane, ball, box, capsule, cylinder, cone, torus."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.sdf.sdf import accepts_tensors

if TYPE_CHECKING:
    import torch


class ClosedForm(ABC):
    """A solid about the origin with an exact distance. Its fields are its sizes in m. Raises SdfsimError if one is not
    positive."""

    KIND: ClassVar[str]

    def __post_init__(self) -> None:
        sizes = np.array(self.sizes, dtype=np.float64)
        if self.bounds.shape != (2, 3) or not (np.isfinite(sizes) & (sizes > 0)).all():
            given = ", ".join(f"{name} {value}" for name, value in vars(self).items())
            raise SdfsimError(f"the sizes of a {self.KIND} must be > 0 (got {given})")

    @property
    def sizes(self) -> tuple[float, ...]:
        """The sizes in m, in the order of the fields."""
        return tuple(np.hstack([*vars(self).values()]).tolist()) if vars(self) else ()

    @property
    def bounds(self) -> np.ndarray:
        """[2, 3] float64 m, the box that holds the solid."""
        return np.outer([-1.0, 1.0], self._reach())

    def _reach(self) -> tuple[float, ...]:
        """Half extents (x, y, z) in m. Not abstract, because a plane has none and gives its `bounds` itself."""
        raise NotImplementedError

    @abstractmethod
    def _measure(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance [P] m and unit gradient [P, 3] at `points` [P, 3] m."""

    def to(self, device: torch.device | str) -> Self:
        """Returns itself, as it holds no tensors."""
        return self

    def scaled(self, factor: float) -> Self:
        """The solid `factor` times as large."""
        values = vars(self).values()
        return type(self)(*(tuple(x * factor for x in v) if isinstance(v, tuple) else v * factor for v in values))

    @accepts_tensors
    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance [P] m and unit gradient [P, 3] at `points` [P, 3] m."""
        return self._measure(points)


@dataclass(frozen=True, eq=False)
class PlaneSdf(ClosedForm):
    """The half space below z = 0 is solid; the normal is +z. Infinite."""

    KIND = "plane"

    @property
    def bounds(self) -> np.ndarray:
        """[2, 3] m: infinite except for the top."""
        return np.array([[-np.inf] * 3, [np.inf, np.inf, 0.0]])

    def _measure(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return points[:, 2].copy(), _up(points)


@dataclass(frozen=True, eq=False)
class SphereSdf(ClosedForm):
    """A ball of `radius` m. The gradient at the centre points up."""

    KIND = "sphere"
    radius: float

    def _reach(self) -> tuple[float, ...]:
        return (self.radius,) * 3

    def _measure(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        length = _norm(points)
        tiny = np.finfo(points.dtype).tiny
        unit = points / np.maximum(length, tiny)[:, None]
        return length - length.dtype.type(self.radius), np.where((length > tiny)[:, None], unit, _up(points))


@dataclass(frozen=True, eq=False)
class BoxSdf(ClosedForm):
    """An axis-aligned box with half extents `half` (x, y, z) m. Inside, the gradient points to the nearest face; of
    equally near ones to the first, and on a middle plane to the positive side."""

    KIND = "box"
    half: tuple[float, float, float]

    def _reach(self) -> tuple[float, ...]:
        return self.half

    def _measure(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        side = np.where(points < 0, -1.0, 1.0).astype(points.dtype)
        excess = np.abs(points) - np.array(self.half, points.dtype)
        beyond = np.maximum(excess, 0)
        length = _norm(beyond)
        axis = excess.argmax(1)
        deepest, inward = excess[np.arange(len(axis)), axis], np.eye(3, dtype=points.dtype)[axis]
        tiny = np.finfo(points.dtype).tiny
        outside = length > tiny
        gradient = np.where(outside[:, None], beyond / np.maximum(length, tiny)[:, None], inward)
        return np.where(outside, length, deepest), side * gradient


@dataclass(frozen=True, eq=False)
class CapsuleSdf(ClosedForm):
    """All points within `radius` m of the segment |z| <= `half` m on the z axis."""

    KIND = "capsule"
    radius: float
    half: float

    def _reach(self) -> tuple[float, ...]:
        return self.radius, self.radius, self.half + self.radius

    def _measure(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        axis = np.zeros_like(points)
        axis[:, 2] = np.clip(points[:, 2], -self.half, self.half)
        return SphereSdf(self.radius)._measure(points - axis)


@dataclass(frozen=True, eq=False)
class CylinderSdf(ClosedForm):
    """A cylinder about z of `radius` m and half height `half` m. Inside, the gradient points to the side or the end,
    whichever is nearer, and to the end if both are equally near."""

    KIND = "cylinder"
    radius: float
    half: float

    def _reach(self) -> tuple[float, ...]:
        return self.radius, self.radius, self.half

    def _measure(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        radius, half = points.dtype.type(self.radius), points.dtype.type(self.half)
        away, outward = _outward(points)
        end = np.zeros_like(points)
        end[:, 2] = np.where(points[:, 2] < 0, -1.0, 1.0)
        aside, above = away - radius, np.abs(points[:, 2]) - half
        corner = (aside > 0) & (above > 0)
        length = np.hypot(np.maximum(aside, 0), np.maximum(above, 0))
        slanted = (aside[:, None] * outward + above[:, None] * end) / np.where(corner, length, 1.0)[:, None]
        side = aside > above
        distance = np.where(corner, length, np.maximum(aside, above))
        gradient = np.where(corner[:, None], slanted, np.where(side[:, None], outward, end))
        return distance, gradient


@dataclass(frozen=True, eq=False)
class ConeSdf(ClosedForm):
    """A cone about z: a disc of `radius` m at z = -`half` m, and its tip at z = `half`. Inside, the gradient points to
    the side or the disc, whichever is nearer."""

    KIND = "cone"
    radius: float
    half: float

    def _reach(self) -> tuple[float, ...]:
        return self.radius, self.radius, self.half

    def _measure(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        away, outward = _outward(points)
        slant = np.hypot(self.radius, 2.0 * self.half)
        x, z = away - self.radius, points[:, 2] + self.half  # from the rim
        sine, cosine = self.radius / slant, 2.0 * self.half / slant
        beyond_side, along = cosine * x + sine * z, np.clip(cosine * z - sine * x, 0.0, slant)
        to_side, to_disc = (x + sine * along, z - cosine * along), (np.maximum(x, 0.0), z)
        side_far, disc_far = np.hypot(*to_side), np.hypot(*to_disc)
        inside = (beyond_side <= 0.0) & (z >= 0.0)
        side = np.where(inside, beyond_side >= -z, side_far <= disc_far)
        length = np.where(side, side_far, disc_far)
        distance = np.where(inside, np.where(side, beyond_side, -z), length)
        divisor = np.where(inside, 1.0, np.maximum(length, np.finfo(points.dtype).tiny))
        across = np.where(inside, cosine * side, np.where(side, to_side[0], to_disc[0]) / divisor)
        up = np.where(inside, np.where(side, sine, -1.0), np.where(side, to_side[1], to_disc[1]) / divisor)
        gradient = across[:, None] * outward + up[:, None] * _up(points)
        return distance.astype(points.dtype), gradient.astype(points.dtype)


@dataclass(frozen=True, eq=False)
class TorusSdf(ClosedForm):
    """A ring about z: all points within `tube` m of a circle of `radius` m. On its circle the gradient points up."""

    KIND = "torus"
    radius: float
    tube: float

    def _reach(self) -> tuple[float, ...]:
        return self.radius + self.tube, self.radius + self.tube, self.tube

    def _measure(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        _, outward = _outward(points)
        return SphereSdf(self.tube)._measure(points - points.dtype.type(self.radius) * outward)


CLOSED_FORMS = {kind.KIND: kind for kind in (PlaneSdf, SphereSdf, BoxSdf, CapsuleSdf, CylinderSdf, ConeSdf, TorusSdf)}
# Those that other programs have too.
COMMON_FORMS = PlaneSdf, SphereSdf, BoxSdf, CapsuleSdf, CylinderSdf


def sizes_in_scene(form: ClosedForm) -> dict[str, Any]:
    """The sizes in m of a closed form, as scene files have them; none of a plane."""
    if isinstance(form, BoxSdf):
        return {"size": [2.0 * half for half in form.half]}
    if isinstance(form, CapsuleSdf | CylinderSdf | ConeSdf):
        caps = form.radius if isinstance(form, CapsuleSdf) else 0.0
        return {"radius": form.radius, "height": 2.0 * (form.half + caps)}
    return vars(form)


def _outward(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances [P] from the z axis, and the unit directions [P, 3] away from it; x on the axis."""
    away = _norm(points[:, :2])
    tiny = np.finfo(points.dtype).tiny
    outward = np.zeros_like(points)
    outward[:, 0] = 1.0
    unit = points[:, :2] / np.maximum(away, tiny)[:, None]
    outward[:, :2] = np.where((away > tiny)[:, None], unit, outward[:, :2])
    return away, outward


def _up(points: np.ndarray) -> np.ndarray:
    up = np.zeros_like(points)
    up[:, 2] = 1.0
    return up


def _norm(vectors: np.ndarray) -> np.ndarray:
    """[P] lengths."""
    return np.linalg.norm(vectors, axis=1)
