"""Trilinear interpolation of grids that are learned.

On a CPU it is compiled, because torch's `grid_sample` uses one thread per volume, channel by channel. On other devices
the eight corners of a point are rows of a table, summed by `embedding_bag`.
"""

from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor
from torch.nn import functional

from sdfsim.base.compiling import cache_of, kept

NEAR = 2.0  # cells from a surface within which all bricks exist

with kept(cache_of([Path(__file__).with_name("trilinear.py")])):
    from pipeline.grids.trilinear import BRICK, gather, gather_with_threads, scatter, scatter_with_threads

WHOLE = torch.zeros((0, 0, 0), dtype=torch.int32)  # the bricks of a complete grid


def interpolate(grid: Tensor, points: Tensor) -> Tensor:
    """Trilinear values [P, C] of a grid [n, n, n, C] (z, y, x order) over [-1, 1]^3 at points [P, 3] (x, y, z);
    outside, those of its border. Differentiable in the grid, not in the points."""
    return interpolate_bricks(grid.reshape(-1, grid.shape[3]), WHOLE, grid.shape[0], points)


def interpolate_bricks(table: Tensor, bricks: Tensor, side: int, points: Tensor) -> Tensor:
    """The same as `interpolate` for a grid [side, side, side, C] that exists only in bricks: rows of a table [R, C] by
    `bricks` [m, m, m] int32 (z, y, x order), the numbers of existing bricks, else -1; outside of bricks it is 0."""
    if table.is_cuda:
        return by_rows(table, bricks, side, points)
    return _OnCpu.apply(table, bricks, side, points.detach().contiguous())  # type: ignore[no-any-return]


def by_rows(table: Tensor, bricks: Tensor, side: int, points: Tensor) -> Tensor:
    """The same as `interpolate_bricks` in pure torch, for any device."""
    rows, weights = _corners(side, points)
    if len(bricks):
        x, y, z = rows % side, rows // side % side, rows // side**2
        number = bricks[z // BRICK, y // BRICK, x // BRICK].long()
        rows = number * BRICK**3 + ((z % BRICK) * BRICK + y % BRICK) * BRICK + x % BRICK
        rows, weights = rows.clamp_min(0), weights * (number >= 0)
    return _WeightedRows.apply(table, rows, weights)  # type: ignore[no-any-return]


def near_bricks(distance: np.ndarray, side: int) -> np.ndarray:
    """Bricks [B, 3] int16 (z, y, x) of a grid with `side` points per side that contain points within `NEAR` cells of
    the zero level of a signed distance [n, n, n] over [-1, 1]^3."""
    cell, step = 2 / (side - 1), BRICK * 2 / (side - 1)
    middles = (np.arange(-(-side // BRICK)) + 0.5) * step - 0.5 * cell - 1
    at = (middles + 1) * (len(distance) - 1) / 2
    found = map_coordinates(distance, np.stack(np.meshgrid(at, at, at, indexing="ij")), order=1, mode="nearest")
    reach = NEAR * cell + 0.5 * 3**0.5 * (BRICK - 1) * cell
    return np.argwhere(np.abs(found) < reach).astype(np.int16)


def places_of(bricks: np.ndarray) -> np.ndarray:
    """The places [B * 64, 3] int (z, y, x) of bricks [B, 3] in their grid, in the order of their rows."""
    inner = np.stack(np.meshgrid(*[np.arange(BRICK)] * 3, indexing="ij"), -1).reshape(-1, 3)
    return (BRICK * bricks[:, None].astype(np.int64) + inner).reshape(-1, 3)


class _OnCpu(torch.autograd.Function):
    """Values of a grid on the CPU, with torch's number of threads."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, bricks: Tensor, side: int, points: Tensor) -> Tensor:
        """[P, C] from a table [R, C] at points [P, 3], see `interpolate_bricks`."""
        ctx.save_for_backward(bricks, points)
        ctx.shape, ctx.side = table.shape, side
        found = table.new_empty(len(points), table.shape[1])
        given = table.detach().contiguous().numpy(), bricks.numpy(), side, points.numpy(), found.numpy()
        if torch.get_num_threads() == 1:
            gather(*given, 0, len(points))
        else:
            _with_threads(gather_with_threads, *given)
        return found

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        bricks, points = ctx.saved_tensors
        gradient = grads[0].new_zeros(ctx.shape)
        given = gradient.numpy(), bricks.numpy(), ctx.side, points.numpy(), grads[0].contiguous().numpy()
        if torch.get_num_threads() == 1:
            scatter(*given, 1, 0)
        else:
            _with_threads(scatter_with_threads, *given)
        return gradient, None, None, None


def _with_threads(work: Any, *given: Any) -> None:
    """Compiled work on as many threads as torch uses, if available. Not for one thread, because threads do not survive
    a fork."""
    before = numba.get_num_threads()
    count = min(torch.get_num_threads(), before)
    numba.set_num_threads(count)
    work(*given, count)
    numba.set_num_threads(before)


def _corners(side: int, points: Tensor) -> tuple[Tensor, Tensor]:
    """For the cells of points [P, 3] in a grid with this many points per side: the eight corners as numbers in z, y, x
    order, and their weights, both [P, 8]."""
    place = ((points.detach().t() + 1) * (0.5 * (side - 1))).clamp(0, side - 1)
    cell = place.long().clamp_max(side - 2)
    x1, y1, z1 = place - cell
    x0, y0, z0 = 1 - x1, 1 - y1, 1 - z1
    first = cell[0] + side * cell[1] + side * side * cell[2]
    steps = [x + side * y + side * side * z for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    weights = torch.stack([face * x for face in (z0 * y0, z0 * y1, z1 * y0, z1 * y1) for x in (x0, x1)], 1)
    return first[:, None] + torch.tensor(steps, device=points.device), weights


class _WeightedRows(torch.autograd.Function):
    """Sums of rows of a table; unlike the gradient of `embedding_bag`, its gradient does not sort."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
        """[P, C] from a table [N, C] by rows [P, K] and their weights [P, K]."""
        ctx.save_for_backward(rows, weights)
        ctx.shape = table.shape
        return functional.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        rows, weights = ctx.saved_tensors
        parts = (weights[..., None] * grads[0][:, None]).view(-1, ctx.shape[1])
        return grads[0].new_zeros(ctx.shape).index_add_(0, rows.view(-1), parts), None, None
