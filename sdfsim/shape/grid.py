"""A signed distance as samples on a voxel grid, which most simulators with signed distances keep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from sdfsim.errors import SdfsimError
from sdfsim.shape.far_field import BOX, everywhere, half_extents
from sdfsim.shape.mesh import Frame, normal_frame
from sdfsim.shape.sdf import accepts_numpy

# Points evaluated at once: eight indices and corners with what is made of them, about 250 bytes a point, is 65 MB.
CHUNK = 262_144
# Distances asked for at once while a grid is sampled.
SAMPLED = 200_000


def trilinear(
    values: torch.Tensor, slot: torch.Tensor | None, points: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Interpolate a stack of grids over [-BOX, BOX]^3, each point in its own, and differentiate what comes out.

    The gradient is the exact one of the interpolant, not an interpolation of central differences: the step
    x - f grad f then leads to the level that the value has (which is what contact points and nodes are made of), and
    it takes the eight samples that the value takes anyway, not thirty-two. It jumps from cell to cell, by about
    the cell over the radius of curvature.

    Args:
        values: [S, R, R, R] float32 distances; the outermost samples lie on the faces of the box.
        slot: [P] int64 which grid, or None for the only one.
        points: [P, 3] float32 within the box; from a NaN comes a NaN.

    Returns:
        value [P] and gradient [P, 3].
    """
    side = values.shape[-1]
    per_cell = (side - 1) / (2 * BOX)
    place = (points + BOX) * per_cell
    # Cut to the grid as integers, so that not even a NaN reads beside it; the far faces belong to the last cell.
    cell = place.long().clamp_(0, side - 2)
    across, along, up = (place - cell).unbind(1)
    first = (cell[:, 0] * side + cell[:, 1]) * side + cell[:, 2]
    if slot is not None:
        first = first + slot * side**3
    bit = torch.arange(2, device=points.device)
    corner = ((bit[:, None, None] * side + bit[:, None]) * side + bit).view(8, 1)
    # Three times as fast on a CPU as brackets are, here and in the bank.
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
    """A signed distance sampled on the box [-0.7, 0.7]^3 of the normalised frame, trilinear between the samples.

    Attributes:
        values: [R, R, R] float32 normalised distances at R >= 2 evenly spaced places along x, y and z, the
            outermost on the faces of the box.
        frame: metres <-> normalised.
        bounds: [2, 3] float64 m, the box that holds the solid.

    Raises:
        ValueError: `values` is not a cube of at least two samples a side.
    """

    values: torch.Tensor
    frame: Frame
    bounds: np.ndarray

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

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and gradient [P, 3] at `points` [P, 3] m; interpolated in float32, cast back.

        Near the solid the gradient is the interpolant's own (see `trilinear`); see `everywhere` for what is far.
        """
        centre = torch.as_tensor(self.frame.centre, dtype=points.dtype, device=points.device)
        half = half_extents(self.frame, self.bounds).to(points.device)
        distance, gradient = [], []
        for part in points.split(CHUNK) if len(points) else (points,):
            # The centre leaves in the precision of the points, before the cast.
            local = ((part - centre) / self.frame.scale).float()
            value, slope = everywhere(lambda rows, inside: trilinear(self.values, None, inside), local, half)
            distance.append(value.to(points.dtype) * self.frame.scale)
            gradient.append(slope.to(points.dtype))
        return torch.cat(distance), torch.cat(gradient)


def sample_grid(
    distance: Callable[[np.ndarray], tuple[Any, ...]],
    bounds: np.ndarray,
    resolution: int,
    on_progress: Callable[[float, str], None] | None = None,
) -> GridSdf:
    """Sample a signed distance on a voxel grid.

    Args:
        distance: a `DistanceOracle` or an Sdf: of what it answers to points [P, 3] float64 m, the distances [P] m come
            first. Signs are taken as they are.
        bounds: [2, 3] float64 m, the box that holds the solid.
        resolution: samples along each side of the cube 1.4 times as wide as the solid: `resolution`^3 in all,
            4 bytes each, 1.4 / (resolution - 1) of the solid's largest extent apart.
        on_progress: called with (fraction done, message).

    Raises:
        SdfsimError: fewer than two samples a side, or bounds that have no extent or are not finite.
    """
    if resolution < 2:
        raise SdfsimError(f"a grid needs at least two samples along each side (got {resolution})")
    frame = normal_frame(bounds)
    axis = np.linspace(-BOX, BOX, resolution)
    values = np.empty((resolution, resolution, resolution), dtype=np.float32)
    layers = max(1, SAMPLED // resolution**2)
    tell = on_progress or (lambda fraction, message: None)
    for start in range(0, resolution, layers):
        tell(start / resolution, "sampling the distance")
        some = axis[start : start + layers]
        points = np.stack(np.meshgrid(some, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        found = np.asarray(distance(frame.outward(points))[0])
        values[start : start + layers] = (found / frame.scale).reshape(len(some), resolution, resolution)
    tell(1.0, "sampled")
    return GridSdf(torch.from_numpy(values), frame, np.asarray(bounds, dtype=np.float64))
