"""Trilinear interpolation and its gradient, compiled for the CPU: `interpolation.py` has the same in torch."""

from typing import Any

from numba import njit, prange


@njit(cache=True, inline="always")
def _cell(points: Any, p: int, side: int) -> Any:
    """The lower corner (x, y, z) of the cell of a point, and the point's place in it, 0 to 1."""
    last, half = side - 1, 0.5 * (side - 1)
    x = min(max((points[p, 0] + 1.0) * half, 0.0), last)
    y = min(max((points[p, 1] + 1.0) * half, 0.0), last)
    z = min(max((points[p, 2] + 1.0) * half, 0.0), last)
    i, j, k = min(int(x), side - 2), min(int(y), side - 2), min(int(z), side - 2)
    return i, j, k, x - i, y - j, z - k


@njit(cache=True)
def gather(grid: Any, points: Any, found: Any, first: int, last: int) -> None:
    """Writes the values of a grid [n, n, n, C] at points [first:last, 3] to `found` [first:last, C]."""
    side, channels = grid.shape[0], grid.shape[3]
    for p in range(first, last):
        i, j, k, x, y, z = _cell(points, p, side)
        for c in range(channels):
            low = (grid[k, j, i, c] * (1 - x) + grid[k, j, i + 1, c] * x) * (1 - y) + (
                grid[k, j + 1, i, c] * (1 - x) + grid[k, j + 1, i + 1, c] * x
            ) * y
            high = (grid[k + 1, j, i, c] * (1 - x) + grid[k + 1, j, i + 1, c] * x) * (1 - y) + (
                grid[k + 1, j + 1, i, c] * (1 - x) + grid[k + 1, j + 1, i + 1, c] * x
            ) * y
            found[p, c] = low * (1 - z) + high * z


@njit(cache=True)
def scatter(gradient: Any, points: Any, given: Any, shares: int, share: int) -> None:
    """Adds what gradients [P, C] at points [P, 3] are of each value of a grid to `gradient` [n, n, n, C].

    A share has every so many layers and adds in the order of points, so that sums do not depend on how many there are.
    """
    side, channels = gradient.shape[0], gradient.shape[3]
    for p in range(len(points)):
        i, j, k, x, y, z = _cell(points, p, side)
        for layer, part in ((k, 1 - z), (k + 1, z)):
            if layer % shares == share:
                for c in range(channels):
                    value = given[p, c] * part
                    gradient[layer, j, i, c] += value * (1 - y) * (1 - x)
                    gradient[layer, j, i + 1, c] += value * (1 - y) * x
                    gradient[layer, j + 1, i, c] += value * y * (1 - x)
                    gradient[layer, j + 1, i + 1, c] += value * y * x


@njit(cache=True, parallel=True)
def gather_with_threads(grid: Any, points: Any, found: Any, threads: int) -> None:
    """The same as `gather` for all points."""
    count = len(points)
    for t in prange(threads):
        gather(grid, points, found, t * count // threads, (t + 1) * count // threads)


@njit(cache=True, parallel=True)
def scatter_with_threads(gradient: Any, points: Any, given: Any, threads: int) -> None:
    """The same as `scatter`, a share a thread."""
    for t in prange(threads):
        scatter(gradient, points, given, threads, t)


BRICK = 4  # places of a grid along each side of a brick


@njit(cache=True, inline="always")
def _row(bricks: Any, i: int, j: int, k: int) -> Any:
    """The row of a place in the table of a grid that is there in bricks only; below 0 where there is none."""
    brick = bricks[k // BRICK, j // BRICK, i // BRICK]
    return brick * BRICK**3 + ((k % BRICK) * BRICK + j % BRICK) * BRICK + i % BRICK if brick >= 0 else -1


@njit(cache=True)
def gather_bricks(table: Any, bricks: Any, side: int, points: Any, found: Any, first: int, last: int) -> None:
    """The same as `gather` for a grid of `side` places a side that is there in bricks only, the numbers of which are in
    `bricks` [m, m, m], -1 for none: rows of a `table` [R, C], and 0 where there are none."""
    channels = table.shape[1]
    for p in range(first, last):
        i, j, k, x, y, z = _cell(points, p, side)
        for c in range(channels):
            found[p, c] = 0
        for corner in range(8):
            a, b, d = corner & 1, (corner >> 1) & 1, corner >> 2
            row = _row(bricks, i + a, j + b, k + d)
            if row >= 0:
                share = (x if a else 1 - x) * (y if b else 1 - y) * (z if d else 1 - z)
                for c in range(channels):
                    found[p, c] += share * table[row, c]


@njit(cache=True)
def scatter_bricks(gradient: Any, bricks: Any, side: int, points: Any, given: Any, shares: int, share: int) -> None:
    """The same as `scatter` for `gather_bricks`, to `gradient` [R, C]."""
    channels = gradient.shape[1]
    for p in range(len(points)):
        i, j, k, x, y, z = _cell(points, p, side)
        for d in range(2):
            if (k + d) % shares != share:
                continue
            for corner in range(4):
                a, b = corner & 1, corner >> 1
                row = _row(bricks, i + a, j + b, k + d)
                if row >= 0:
                    part = (x if a else 1 - x) * (y if b else 1 - y) * (z if d else 1 - z)
                    for c in range(channels):
                        gradient[row, c] += part * given[p, c]


@njit(cache=True, parallel=True)
def gather_bricks_with_threads(table: Any, bricks: Any, side: int, points: Any, found: Any, threads: int) -> None:
    """The same as `gather_bricks` for all points."""
    count = len(points)
    for t in prange(threads):
        gather_bricks(table, bricks, side, points, found, t * count // threads, (t + 1) * count // threads)


@njit(cache=True, parallel=True)
def scatter_bricks_with_threads(
    gradient: Any, bricks: Any, side: int, points: Any, given: Any, threads: int
) -> None:  # fmt: skip
    """The same as `scatter_bricks`, a share a thread."""
    for t in prange(threads):
        scatter_bricks(gradient, bricks, side, points, given, threads, t)
