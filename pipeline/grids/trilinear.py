"""Trilinear interpolation and its gradient, compiled for the CPU: `interpolation.py` has the same in torch.

A grid of `side` points per side is a table [R, C] of its rows: all of them in z, y, x order, or those of existing
bricks. `bricks` [m, m, m] int32 has the brick's number at each place, -1 for none; it is empty if all rows exist.
"""

from typing import Any

from numba import njit, prange

BRICK = 4  # places of a grid along each side of a brick


@njit(cache=True, inline="always")
def _cell(points: Any, p: int, side: int) -> Any:
    """The lower corner (x, y, z) of the cell of a point, and the point's place in it, 0 to 1."""
    last, half = side - 1, 0.5 * (side - 1)
    x = min(max((points[p, 0] + 1.0) * half, 0.0), last)
    y = min(max((points[p, 1] + 1.0) * half, 0.0), last)
    z = min(max((points[p, 2] + 1.0) * half, 0.0), last)
    i, j, k = min(int(x), side - 2), min(int(y), side - 2), min(int(z), side - 2)
    return i, j, k, x - i, y - j, z - k


@njit(cache=True, inline="always")
def _row(bricks: Any, side: int, i: int, j: int, k: int) -> Any:
    """The row of a place in the table; below 0 if there is none."""
    if bricks.shape[0] == 0:
        return (k * side + j) * side + i
    brick = bricks[k // BRICK, j // BRICK, i // BRICK]
    return brick * BRICK**3 + ((k % BRICK) * BRICK + j % BRICK) * BRICK + i % BRICK if brick >= 0 else -1


@njit(cache=True)
def gather(table: Any, bricks: Any, side: int, points: Any, found: Any, first: int, last: int) -> None:
    """Writes the values of a grid at points [first:last, 3] to `found` [first:last, C], 0 for rows that are missing."""
    for p in range(first, last):
        i, j, k, x, y, z = _cell(points, p, side)
        rows = (
            _row(bricks, side, i, j, k), _row(bricks, side, i + 1, j, k),
            _row(bricks, side, i, j + 1, k), _row(bricks, side, i + 1, j + 1, k),
            _row(bricks, side, i, j, k + 1), _row(bricks, side, i + 1, j, k + 1),
            _row(bricks, side, i, j + 1, k + 1), _row(bricks, side, i + 1, j + 1, k + 1),
        )  # fmt: skip
        a, b, c, d = (1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y
        shares = (a * (1 - z), b * (1 - z), c * (1 - z), d * (1 - z), a * z, b * z, c * z, d * z)
        for channel in range(table.shape[1]):
            total = 0.0
            for n in range(8):
                if rows[n] >= 0:
                    total += shares[n] * table[rows[n], channel]
            found[p, channel] = total


@njit(cache=True)
def scatter(gradient: Any, bricks: Any, side: int, points: Any, given: Any, shares: int, share: int) -> None:
    """Adds gradients [P, C] at points [P, 3] to `gradient` [R, C] of each row of a grid.

    Each share has every n-th layer and adds in the order of points, so that sums do not depend on the number of shares.
    """
    for p in range(len(points)):
        i, j, k, x, y, z = _cell(points, p, side)
        for layer, part in ((k, 1 - z), (k + 1, z)):
            if layer % shares == share:
                a, b = _row(bricks, side, i, j, layer), _row(bricks, side, i + 1, j, layer)
                c, d = _row(bricks, side, i, j + 1, layer), _row(bricks, side, i + 1, j + 1, layer)
                for n in range(gradient.shape[1]):
                    value = given[p, n] * part
                    if a >= 0:
                        gradient[a, n] += value * (1 - y) * (1 - x)
                    if b >= 0:
                        gradient[b, n] += value * (1 - y) * x
                    if c >= 0:
                        gradient[c, n] += value * y * (1 - x)
                    if d >= 0:
                        gradient[d, n] += value * y * x


@njit(cache=True, parallel=True)
def gather_with_threads(table: Any, bricks: Any, side: int, points: Any, found: Any, threads: int) -> None:
    """The same as `gather` for all points."""
    count = len(points)
    for t in prange(threads):
        gather(table, bricks, side, points, found, t * count // threads, (t + 1) * count // threads)


@njit(cache=True, parallel=True)
def scatter_with_threads(gradient: Any, bricks: Any, side: int, points: Any, given: Any, threads: int) -> None:
    """The same as `scatter`, with one share per thread."""
    for t in prange(threads):
        scatter(gradient, bricks, side, points, given, threads, t)
