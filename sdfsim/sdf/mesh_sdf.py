"""The exact signed distance of a triangle mesh as an SDF."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.mesh import Mesh
from sdfsim.sdf.reference import MeshDistance
from sdfsim.sdf.sdf import accepts_tensors

if TYPE_CHECKING:
    import torch

# All lengths of `MeshSdf` are relative to the mesh's largest extent. The hierarchy works in float32, so closest points
# are wrong by some 1e-7. Nearer than this the offset to them gives no direction, so central differences with this step
# are used.
NEAR = 1e-5
STEP = 1e-4
# Farther out float32 overflows (at 1e19), so such points are moved to this box. The face nearest to the moved point is
# a good enough answer.
FAR = 1e3
# A difference quotient shorter than this gives no direction, as at a crack or at a sheet without thickness.
FLAT = 0.05
UP = (0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class MeshSdf:
    """The signed distance of a triangle mesh, with the sign of `MeshDistance`, exact to about 1e-7 of the mesh's size.
    It runs on the CPU, also for points on a GPU. Raises SdfsimError if the mesh has no faces."""

    mesh: Mesh  # metres

    def __post_init__(self) -> None:
        if len(self.mesh.faces) == 0:
            raise SdfsimError("mesh has no faces")

    @cached_property
    def bounds(self) -> np.ndarray:
        """[2, 3] float64 m, the box of the faces' corners."""
        corners = self.mesh.vertices[np.unique(self.mesh.faces)]
        return np.stack([corners.min(0), corners.max(0)])

    @cached_property
    def _oracle(self) -> MeshDistance:
        # Built on first use: a scene that only contains such a shape does not need open3d.
        return MeshDistance(self.mesh)

    @property
    def simple(self) -> bool:
        """Whether a single clean surface bounds the solid."""
        return self._oracle.solid.simple

    def to(self, device: torch.device | str) -> MeshSdf:
        """Itself."""
        return self

    def scaled(self, factor: float) -> MeshSdf:
        """The solid `factor` times as large."""
        return MeshSdf(replace(self.mesh, vertices=self.mesh.vertices * factor))

    @accepts_tensors
    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance [P] m and unit gradient [P, 3] at `points` [P, 3] m: the gradient is along the line to the closest
        point; on the surface it is the normal (at an edge or corner a direction between normals); if neither exists, it
        points up."""
        distance, gradient = self._exact(points.astype(np.float64))
        return distance.astype(points.dtype), gradient.astype(points.dtype)

    def closest(self, points: np.ndarray) -> np.ndarray:
        """The points [P, 3] m of the surface that are nearest to others [P, 3] m, without a sign, which takes most of
        the time where faces cross each other."""
        return self._oracle.closest(points)

    def _exact(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        low, high = self.bounds
        size = float((high - low).max())
        near = np.clip(points, low - FAR * size, high + FAR * size)
        truth = self._oracle(near)
        offset = points - truth.closest
        distance = np.where((points == near).all(1), truth.distance, np.linalg.norm(offset, axis=1))
        here = np.abs(distance) <= NEAR * size
        # A tiny distance on either side of zero has a direction too; only zero itself has none.
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
