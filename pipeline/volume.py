"""Signed distances sampled on a regular grid, finely only near the surface, and the mesh of their zero surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sdfsim.errors import EXIT_QUALITY, SdfsimError
from sdfsim.shape.mesh import Mesh

Progress = Callable[[float, str], None]
Distance = Callable[[np.ndarray], np.ndarray]

BATCH = 1 << 17  # points a query


@dataclass(frozen=True)
class Volume:
    """Samples of a signed distance.

    Attributes:
        values: [X, Y, Z] float32.
        low: [3] position of the first sample.
        cell: between neighbouring samples.
    """

    values: np.ndarray
    low: np.ndarray
    cell: float

    def axes(self) -> list[np.ndarray]:
        """Positions of the samples along x, y and z."""
        return [low + self.cell * np.arange(count) for low, count in zip(self.low, self.values.shape, strict=True)]

    def points(self) -> np.ndarray:
        """Positions [X, Y, Z, 3] of the samples."""
        return np.stack(np.meshgrid(*self.axes(), indexing="ij"), -1)

    def along(self, direction: np.ndarray) -> np.ndarray:
        """Coordinate [X, Y, Z] of the samples along a direction [3]."""
        x, y, z = np.ix_(*self.axes())
        return x * direction[0] + y * direction[1] + z * direction[2]

    def at(self, points: np.ndarray) -> np.ndarray:
        """Trilinear values [P] at points [P, 3]; outside the grid those of its border."""
        from scipy.ndimage import map_coordinates

        return map_coordinates(self.values, ((points - self.low) / self.cell).T, order=1, mode="nearest")

    def limited(self, limit: Distance) -> Volume:
        """What of the solid lies within another one, whose distance [P] at points [P, 3] is given."""
        values = self.values.copy()
        for number, x in enumerate(self.axes()[0]):  # A fine grid has too many points to hold at once.
            slab = Volume(values[number : number + 1], np.array([x, *self.low[1:]]), self.cell)
            values[number] = np.maximum(slab.values, limit(slab.points().reshape(-1, 3)).reshape(slab.values.shape))[0]
        return replace(self, values=values)

    def mesh(self) -> Mesh:
        """The zero surface by marching cubes, faces counter-clockwise from outside.

        Raises:
            SdfsimError: (exit code 3) the values have one sign everywhere.
        """
        if not self.values.min() < 0 < self.values.max():
            raise SdfsimError("mesh: the field holds no surface", "try --preset standard", exit_code=EXIT_QUALITY)
        from skimage.measure import marching_cubes

        # A surface through a sample makes several vertices in one place; merged later, they would pinch a closed mesh.
        least = 0.02 * self.cell
        values = np.where(np.abs(self.values) < least, np.where(self.values < 0, -least, least), self.values)
        vertices, faces, _, _ = marching_cubes(values, 0.0)
        return Mesh(self.low + self.cell * vertices.astype(np.float64), faces.astype(np.int64))


def sample(distance: Distance, points: np.ndarray) -> np.ndarray:
    """Values [P] float32 of a distance at points [P, 3], in batches."""
    parts = np.array_split(points, max(1, len(points) // BATCH))
    return np.concatenate([distance(part) for part in parts]).astype(np.float32)


def sample_volume(
    distance: Distance, resolution: int, *, extent: float = 1.02, coarse: int = 4, on_progress: Progress | None = None
) -> Volume:
    """Samples over [-extent, extent]^3, fine only near the surface.

    Evaluates every `coarse`-th point first and all points only in blocks that can hold the surface, since an SDF
    changes by no more than the distance moved (a factor of 2 is left for fields that are not quite SDFs). Elsewhere
    values are interpolated.

    Args:
        distance: [P] at points [P, 3], float32.
        resolution: samples a side, rounded up to a multiple of `coarse` plus 1.
        extent: half the side.
        coarse: see above.
        on_progress: called with (fraction, message).
    """
    from scipy.ndimage import zoom

    blocks = -(-(resolution - 1) // coarse)
    n = blocks * coarse + 1
    line = np.linspace(-extent, extent, n, dtype=np.float32)
    knots = line[::coarse]
    values = sample(distance, np.stack(np.meshgrid(knots, knots, knots, indexing="ij"), -1).reshape(-1, 3))
    values = values.reshape(blocks + 1, blocks + 1, blocks + 1)
    volume = np.asarray(zoom(values, n / (blocks + 1), order=1, grid_mode=False, mode="nearest"), np.float32)
    reach = 2.0 * np.sqrt(3) * (knots[1] - knots[0])
    corners = np.stack(
        [values[a : a + blocks, b : b + blocks, c : c + blocks] for a in (0, 1) for b in (0, 1) for c in (0, 1)]
    )
    low, high = corners.min(0), corners.max(0)
    near = np.argwhere((np.abs(corners).min(0) < reach) | (low * high < 0))
    step = np.arange(coarse + 1)
    local = np.stack(np.meshgrid(step, step, step, indexing="ij"), -1).reshape(1, -1, 3)
    parts = np.array_split(near, max(1, len(near) * local.shape[1] // BATCH))
    for number, part in enumerate(parts):
        index = (part[:, None] * coarse + local).reshape(-1, 3)
        volume[tuple(index.T)] = distance(line[index])
        if on_progress and number % 4 == 0:
            on_progress((number + 1) / len(parts), f"sampling the field, {number + 1} of {len(parts)} parts")
    return Volume(volume, np.full(3, -extent), 2 * extent / (n - 1))


def sample_box(distance: Distance, low: np.ndarray, high: np.ndarray, cell: float) -> Volume:
    """All samples in the box between two corners [3], `cell` apart."""
    counts = np.ceil((np.asarray(high) - low) / cell).astype(int) + 1
    empty = Volume(np.empty(counts, np.float32), np.asarray(low, float), cell)
    return replace(empty, values=sample(distance, empty.points().reshape(-1, 3)).reshape(counts))
