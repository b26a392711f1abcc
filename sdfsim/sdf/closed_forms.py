"""Signed distances: the protocol, closed forms, samples on a grid, and the exact distance of a mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial, wraps
from typing import Any, ClassVar, Protocol, Self, runtime_checkable

import numpy as np
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.base.parallel import Progress, silent
from sdfsim.geometry.mesh import Frame, Mesh, lattice, normal_frame
from sdfsim.sdf.far_field import BOX, in_metres
from sdfsim.sdf.reference import MeshDistance

# Points of a grid evaluated at once: eight indices and corners with what is made of them, about 250 bytes a point.
CHUNK = 262_144
# All lengths of `MeshSdf` are relative to the mesh's largest extent. The hierarchy works in float32, so closest points
# are off by some 1e-7: nearer than this the offset to them says little about the direction, and differences over the
# step say it better.
NEAR = 1e-5
STEP = 1e-4
# Farther out float32 runs out of range (at 1e19), so such points ask for the point on this box in their place. What
# is nearest to that one is as near as makes no difference.
FAR = 1e3
# A difference quotient shorter than this is no direction: a crack, a sheet without thickness.
FLAT = 0.05
UP = (0.0, 0.0, 1.0)


@runtime_checkable
class Sdf(Protocol):
    """A signed distance with its gradient: positive outside, negative inside, metres, the shape's own frame.

    Its members, `MlpSdf`, the closed forms, `GridSdf` and `MeshSdf`, also have `to(device)` and `scaled(factor)`.

    Attributes:
        bounds: [2, 3] float64 m, the axis-aligned box that holds the solid (infinite for a plane).
    """

    @property
    def bounds(self) -> np.ndarray: ...

    def __call__(self, points: Any, /) -> tuple[Any, Any]:
        """Distance [P] m and gradient [P, 3] (unit length where the SDF is exact) at `points` [P, 3] m.

        The result has the dtype and device of `points`. Never NaN: where the gradient is undefined (medial axis, an
        edge) any valid one-sided gradient is returned. The members also take a NumPy array, and then return some.
        """
        ...


def accepts_numpy(call: Callable[..., tuple[torch.Tensor, torch.Tensor]]) -> Callable[..., tuple[Any, Any]]:
    """Let an Sdf's `__call__` also take what makes a NumPy array [P, 3] (whole numbers become float64), and then answer
    in NumPy. Raises ValueError for other shapes."""

    @wraps(call)
    def wrapper(self: Any, points: Any) -> tuple[Any, Any]:
        given = points if isinstance(points, torch.Tensor) else np.asarray(points)
        if given.ndim != 2 or given.shape[1] != 3:
            raise ValueError(f"points must be [P, 3], got {list(given.shape)}")
        if isinstance(given, torch.Tensor):
            return call(self, given)
        if not np.issubdtype(given.dtype, np.floating):
            given = given.astype(np.float64)
        tensor = torch.from_numpy(np.ascontiguousarray(given)).to(getattr(self, "device", "cpu"))
        distance, gradient = call(self, tensor)
        return distance.cpu().numpy(), gradient.cpu().numpy()

    return wrapper


class ClosedForm:
    """A solid about the origin with an exact distance; its fields are its sizes, m, positive (else SdfsimError)."""

    KIND: ClassVar[str]

    def __post_init__(self) -> None:
        sizes = np.array(self.sizes, dtype=np.float64)
        if self.bounds.shape != (2, 3) or not (np.isfinite(sizes) & (sizes > 0)).all():
            told = ", ".join(f"{name} {value}" for name, value in vars(self).items())
            raise SdfsimError(f"the sizes of a {self.KIND} must be > 0 (got {told})")

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

    def _measure(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and unit gradient [P, 3] at `points` [P, 3] m."""
        raise NotImplementedError

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


def trilinear(values: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Value [P] and gradient [P, 3] of a grid [R, R, R] over [-BOX, BOX]^3 at points [P, 3] in it; NaN for NaN. The
    gradient is the exact one of the interpolant, so that the step x - f grad f leads to the level that the value has;
    it jumps from cell to cell."""
    side = values.shape[-1]
    per_cell = (side - 1) / (2 * BOX)
    place = (points + BOX) * per_cell
    # Cut to the grid as integers, so that not even a NaN reads beside it; the far faces belong to the last cell.
    cell = place.long().clamp_(0, side - 2)
    across, along, up = (place - cell).unbind(1)
    first = (cell[:, 0] * side + cell[:, 1]) * side + cell[:, 2]
    bit = torch.arange(2, device=points.device)
    corner = ((bit[:, None, None] * side + bit[:, None]) * side + bit).view(8, 1)
    # Three times as fast on a CPU as brackets are, here.
    found = values.reshape(-1).index_select(0, (first + corner).view(-1)).view(2, 2, 2, -1)
    rise_x = found[1] - found[0]
    face = found[0] + across * rise_x
    rise_y = face[1] - face[0]
    edge = face[0] + along * rise_y
    rise_z = edge[1] - edge[0]
    slope_x = rise_x[0] + along * (rise_x[1] - rise_x[0])
    gradient = [slope_x[0] + up * (slope_x[1] - slope_x[0]), rise_y[0] + up * (rise_y[1] - rise_y[0]), rise_z]
    return edge[0] + up * rise_z, torch.stack(gradient, dim=1) * per_cell


@dataclass(frozen=True, eq=False)
class GridSdf:
    """A signed distance sampled on the box [-0.7, 0.7]^3 of the normalised frame, trilinear between the samples."""

    # [R, R, R] float32 normalised distances at R >= 2 evenly spaced places along x, y and z, the outermost on the faces
    # of the box
    values: torch.Tensor
    frame: Frame  # metres <-> normalised
    bounds: np.ndarray  # [2, 3] float64 m, the box that holds the solid

    def __post_init__(self) -> None:
        shape = tuple(self.values.shape)
        if len(shape) != 3 or len(set(shape)) != 1 or shape[0] < 2:
            raise ValueError(f"a grid must have as many samples along x, y and z, two or more (got {shape})")

    @property
    def device(self) -> torch.device:
        return self.values.device

    @property
    def resolution(self) -> int:
        """Samples along each side."""
        return self.values.shape[0]

    def to(self, device: torch.device | str) -> GridSdf:
        """The same grid on `device`."""
        return replace(self, values=self.values.to(device))

    def scaled(self, factor: float) -> GridSdf:
        """The solid `factor` times as large."""
        frame = Frame(self.frame.centre * factor, self.frame.scale * factor)
        return replace(self, frame=frame, bounds=self.bounds * factor)

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and gradient [P, 3] at `points` [P, 3] m; interpolated in float32 (see `trilinear`), cast
        back. See `everywhere` for what is far."""
        return in_metres(partial(trilinear, self.values), self.frame, self.bounds, points, CHUNK)


def sample_grid(
    distance: Callable[[np.ndarray], tuple[Any, ...]],
    bounds: np.ndarray,
    resolution: int,
    on_progress: Progress = silent,
) -> GridSdf:
    """Sample a signed distance (a `DistanceOracle` or an Sdf) of a solid within `bounds` [2, 3] m at `resolution`^3
    places over a cube 1.4 times as wide as the solid. Raises SdfsimError for fewer than two samples a side, or bounds
    without extent or not finite."""
    if resolution < 2:
        raise SdfsimError(f"a grid needs at least two samples along each side (got {resolution})")
    frame = normal_frame(bounds)
    axis = np.linspace(-BOX, BOX, resolution)
    values = np.empty((resolution, resolution, resolution), dtype=np.float32)
    for k, x in enumerate(axis):
        on_progress(k / resolution, "sampling the distance")
        found = np.asarray(distance(frame.outward(lattice([x], axis, axis)))[0])
        values[k] = (found / frame.scale).reshape(resolution, resolution)
    on_progress(1.0, "sampled")
    return GridSdf(torch.from_numpy(values), frame, np.asarray(bounds, dtype=np.float64))


@dataclass(frozen=True, eq=False)
class MeshSdf:
    """The signed distance of a triangle mesh, with the sign of `MeshDistance`, good to about 1e-7 of the mesh's size.
    It is asked on the CPU, wherever the points are. Raises SdfsimError where the mesh has no faces."""

    mesh: Mesh  # metres

    def __post_init__(self) -> None:
        if len(self.mesh.faces) == 0:
            raise SdfsimError("mesh has no faces")

    @property
    def bounds(self) -> np.ndarray:
        """[2, 3] float64 m, the box of the faces' corners."""
        return self._box

    @cached_property
    def _box(self) -> np.ndarray:
        corners = self.mesh.vertices[np.unique(self.mesh.faces)]
        return np.stack([corners.min(0), corners.max(0)])

    @cached_property
    def _oracle(self) -> MeshDistance:
        # Built on the first question: a scene that merely holds such a shape needs no open3d.
        return MeshDistance(self.mesh)

    def to(self, device: torch.device | str) -> MeshSdf:
        """Itself."""
        return self

    def scaled(self, factor: float) -> MeshSdf:
        """The solid `factor` times as large."""
        return MeshSdf(replace(self.mesh, vertices=self.mesh.vertices * factor))

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and unit gradient [P, 3] at `points` [P, 3] m: along the line to the closest point, on the
        surface along the normal (at an edge or corner between normals), and where there is neither, up."""
        distance, gradient = self._exact(points.detach().cpu().numpy().astype(np.float64))
        return torch.from_numpy(distance).to(points), torch.from_numpy(gradient).to(points)

    def _exact(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        low, high = self.bounds
        size = float((high - low).max())
        asked = np.clip(points, low - FAR * size, high + FAR * size)
        truth = self._oracle(asked)
        offset = points - truth.closest
        distance = np.where((points == asked).all(1), truth.distance, np.linalg.norm(offset, axis=1))
        here = np.abs(distance) <= NEAR * size
        # A touch on either side of zero has a direction too; only zero itself has none.
        gradient = offset / np.where(distance == 0, 1.0, distance)[:, None]
        if here.any():
            gradient[here] = self._normal(points[here], gradient[here], STEP * size)
        length = np.linalg.norm(gradient, axis=1, keepdims=True)
        gradient = np.where(length > 0.5, gradient / np.where(length > 0.5, length, 1.0), UP)
        return distance, gradient

    def _normal(self, points: np.ndarray, fallback: np.ndarray, step: float) -> np.ndarray:
        """[P, 3] central differences over `step` m, made unit length; `fallback` [P, 3] where they vanish."""
        around = points[:, None, None] + step * np.stack([np.eye(3), -np.eye(3)])
        ahead, behind = self._oracle(around.reshape(-1, 3)).distance.reshape(-1, 2, 3).transpose(1, 0, 2)
        slope = (ahead - behind) / (2 * step)
        length = np.linalg.norm(slope, axis=1, keepdims=True)
        return np.where(length > FLAT, slope / np.where(length > FLAT, length, 1.0), fallback)
