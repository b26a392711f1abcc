"""Level surfaces without texture: photos cannot be matched on a table top of one colour, so the field sinks or bulges
there. If photos allow it, its plane is extended from its visible parts.

Everything here is in normalised space.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy import ndimage

from pipeline.cameras import PosedPhotos, View, frame_of
from pipeline.inputs.images import reduced
from pipeline.inputs.photos import open_photo
from pipeline.mesh.bodies import LevelPlane, find_level_planes
from pipeline.mesh.extraction import MIN_SEEN, RIM, Distance, FieldSurface, Volume, marked
from pipeline.mesh.visibility import bilinear, framed
from sdfsim.geometry.bvh import Caster

# Chosen by hand on rendered sets. In samples of the volume:
ON = 1.5  # largest distance of a surface that belongs to a plane
STEP = 1.0  # side of the squares into which a plane is divided
PATCH, NARROW = 2.0, 0.5  # half of the width of the patch around a square, and of the square alone
SLAB = 4.0  # thickness of the completed slab
BULGE = 24.0  # largest height of matter that is removed above it
# Of colours, 0 to 255: spread within a patch of a photo, and between photos; more is texture, or another surface.
PLAIN, SAME = 9.0, 16.0
LIFTED = 0.02  # normalised units above a plane, start of rays for occlusion
CROSSED = 2  # lines of sight through a square to points below: from here on the plane does not exist there
RIM_SQUARES = 12  # next to visible parts of the plane that a region needs
SUPPORTS = 0.04  # of the largest level plane's area: visible part of another plane to be completed, such as a mat
LEAST = 0.05  # of the visible area of the plane: less is not worth the change
GROWN = 10.0  # of the visible area: a larger region is not known to be the same surface
POINTS = 30  # sparse points for the brightness of a photo
LONG_SIDE = 480  # px, longer side of the photos used


@dataclass(frozen=True)
class Completed:
    """The completed region of one level plane."""

    level: LevelPlane
    corner: np.ndarray  # [2] of the first square, in the axes of `frame_of` the plane's normal
    step: float  # side of a square
    squares: np.ndarray  # [A, B] bool

    @property
    def area(self) -> float:
        """In normalised units."""
        return float(self.squares.sum()) * self.step**2

    def covers(self, points: np.ndarray) -> np.ndarray:
        """Whether points [P, 3] lie in the columns of the squares [P]."""
        flat = points @ frame_of(self.level.normal)[:2].T
        return marked(self.squares, np.floor((flat - self.corner) / self.step).astype(int))

    def on(self, points: np.ndarray, width: float) -> np.ndarray:
        """Whether points [P, 3] are within `width` of the completed region [P]."""
        return (np.abs(self.level.above(points)) < width) & self.covers(points)

    def filled(self, volume: Volume) -> Volume:
        """The samples with a slab below the squares, and without matter that the field piled up on them."""
        values = volume.values.copy()
        height = volume.along(self.level.normal) - self.level.height
        index = np.argwhere((height > -SLAB * volume.cell) & (height < BULGE * volume.cell))
        at = tuple(index.T)
        values[at] = self._changed(volume.low + volume.cell * index, values[at])
        return replace(volume, values=values)

    def within(self, distance: Distance) -> Distance:
        """The same change of a signed distance [P] at points [P, 3]."""
        return lambda points: self._changed(points, distance(points))

    def _changed(self, points: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Signed distances [P] at points [P, 3], with the slab and without what is piled up on it."""
        cell, away = self.step / STEP, self.level.above(points)
        mine = (away > -SLAB * cell) & (away < BULGE * cell) & self.covers(points)
        # A field piles up false matter only to a limited height; higher places do not change.
        over = np.minimum(away, (BULGE * cell - away) / 2)
        changed = np.where(away > 0, np.maximum(values, over), np.minimum(values, away))
        changed = np.where(np.abs(away) < ON * cell, away, changed)  # the two nearest samples define a surface
        return np.where(mine, changed, values).astype(values.dtype)


def complete(surface: FieldSurface, up: np.ndarray, finest: float, poses: PosedPhotos, photos_folder: Path
             ) -> list[Completed]:  # fmt: skip
    """Extends level planes beyond their visible parts: over plain squares that are connected to these, look alike from
    everywhere, are not hidden, and through which no photo sees a point below. `up` [3] is unit, `finest` the width of a
    cell of the field's finest grid."""
    levels = find_level_planes(surface.visible, up, finest, SUPPORTS)
    pictures = _pictures(poses, photos_folder)
    blocking = Caster(surface.visible)
    found = [_complete(surface, level, poses, pictures, blocking) for level in levels]
    return [one for one in found if one is not None]


def on_any(completed: Sequence[Completed], width: float) -> Callable[[np.ndarray], np.ndarray]:
    """Whether points [P, 3] lie within `width` of any of these."""
    return lambda points: np.any([one.on(points, width) for one in completed], axis=0)


def _complete(surface: FieldSurface, level: LevelPlane, poses: PosedPhotos, pictures: list[tuple[View, np.ndarray]],
              blocking: Caster) -> Completed | None:  # fmt: skip
    cell = surface.volume.cell
    frame, step = frame_of(level.normal), STEP * cell
    count = int(np.ceil(2 * RIM / step))
    corner = np.full(2, -count * step / 2)

    def squares(points: np.ndarray, least: int = 1) -> np.ndarray:
        """Squares [A, B] bool below or above at least this many points [P, 3]."""
        index = np.floor((points @ frame[:2].T - corner) / step).astype(int)
        index = index[((index >= 0) & (index < count)).all(1)]
        return np.bincount(index[:, 0] * count + index[:, 1], minlength=count * count).reshape(count, count) >= least

    shown = surface.raw.vertices[np.unique(surface.raw.faces[surface.shown])]
    height = level.above(shown)
    known = np.asarray(ndimage.binary_closing(squares(shown[np.abs(height) < ON * cell])), bool)
    taken = squares(shown[(height >= ON * cell) & (height < BULGE * cell)])
    middle = corner + step * (np.indices((count, count)).reshape(2, -1).T + 0.5)
    points = middle @ frame[:2] + level.height * level.normal
    there = (np.linalg.norm(points, axis=1) < RIM - 2 * cell).reshape(count, count)
    open_ = there & ~known & ~taken & ~squares(_crossings(level, poses, ON * cell), CROSSED)
    index = np.flatnonzero(open_)
    if len(index) * step**2 < LEAST * level.area:
        return None

    def alike(patch: float) -> tuple[np.ndarray, np.ndarray]:
        """Squares [A, B] bool by `_alike`, and their colours [A, B, 3]."""
        plain, color = np.zeros(count * count, bool), np.zeros((count * count, 3))
        plain[index], color[index] = _alike(points[index], level, patch * cell, pictures, blocking)
        return plain.reshape(count, count), color.reshape(count, count, 3)

    plain, color = alike(PATCH)
    plain = np.asarray(ndimage.binary_opening(plain)) & open_
    region = np.empty(plain.shape, np.int32)
    number = int(ndimage.label(plain, output=region))  # type: ignore[arg-type]
    around = np.asarray(ndimage.binary_dilation(known, iterations=2), bool) & plain
    beside = np.bincount(region[around], minlength=number + 1)
    beside[0] = 0
    core = (beside >= RIM_SQUARES)[region]
    if core.sum() * step**2 < LEAST * level.area:
        return None
    # A patch reaches past the edge of the plain region: there only the square itself has to look the same.
    narrow, own = alike(NARROW)
    nearest: Any = ndimage.distance_transform_edt(~core, return_distances=False, return_indices=True)
    same = narrow & (np.abs(own - color[tuple(nearest)]).max(2) < SAME)
    grown = ndimage.binary_dilation(core, iterations=int(PATCH) + 1, mask=core | (same & open_))
    found = Completed(level, corner, step, np.asarray(grown, bool))
    return found if found.area < GROWN * level.area else None


def _crossings(level: LevelPlane, poses: PosedPhotos, clear: float) -> np.ndarray:
    """Points [C, 3] of a plane at which lines of sight, to sparse points more than `clear` below it, go through."""
    sparse = poses.sparse
    centers = np.array([view.center for view in poses.views]).reshape(-1, 3)
    start, end = centers[sparse.view_of], sparse.xyz[sparse.point_of]
    high, low = level.above(start), level.above(end)
    through = (high > 0) & (low < -clear)
    share = (high / np.maximum(high - low, 1e-9))[through, None]
    return (1 - share) * start[through] + share * end[through]


def _pictures(poses: PosedPhotos, folder: Path) -> list[tuple[View, np.ndarray]]:
    """Photos [H, W, 3] float, with cameras of their size; as bright as the sparse points, which are means of photos."""
    found, sparse = [], poses.sparse
    for number, view in enumerate(poses.views):
        image = open_photo(folder, view)
        size = reduced(image.size, LONG_SIDE)
        pixels = np.asarray(image.resize(size, Image.Resampling.BOX), np.float32)
        sx, sy = size[0] / view.width, size[1] / view.height
        small = replace(view, width=size[0], height=size[1], focal=view.focal * (sx + sy) / 2, cx=view.cx * sx,
                        cy=view.cy * sy)  # fmt: skip
        mine = sparse.point_of[sparse.view_of == number]
        if len(mine) >= POINTS:
            shown = bilinear(pixels, small.project(sparse.xyz[mine])[0] - 0.5)
            pixels = pixels * np.median((sparse.rgb[mine] + 8.0) / (shown + 8.0), axis=0).astype(np.float32)
        found.append((small, pixels))
    return found


def _alike(points: np.ndarray, level: LevelPlane, reach: float, pictures: list[tuple[View, np.ndarray]],
           blocking: Caster) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Whether a plane is plain and of one colour within `reach` of points [P, 3] in the photos that show them [P], and
    that colour [P, 3]."""
    colors = np.full((len(pictures), len(points), 3), np.nan, np.float32)
    spread = np.full((len(pictures), len(points)), np.nan, np.float32)
    for number, (view, picture) in enumerate(pictures):
        pixels, inside = framed(view, points)
        towards = view.center - points
        inside &= towards @ level.normal > 0.1 * np.linalg.norm(towards, axis=1)
        index = np.flatnonzero(inside)
        index = index[~blocking.blocked(points[index] + LIFTED * level.normal, view.center)]
        if not len(index):
            continue
        # A patch of the plane is as many pixels wide as its distance says.
        away = float(np.median(view.project(points[index])[1]))
        width = 2 * max(1, round(reach * view.focal / away)) + 1
        mean = ndimage.uniform_filter(picture, width, axes=(0, 1))
        square = ndimage.uniform_filter(picture**2, width, axes=(0, 1))
        rough = np.sqrt(np.maximum(square - mean**2, 0)).mean(2, keepdims=True)
        read = bilinear(np.concatenate([mean, rough], 2), pixels[index] - 0.5)
        colors[number, index], spread[number, index] = read[:, :3], read[:, 3]
    seen = np.isfinite(spread).sum(0) >= MIN_SEEN
    plain, middle = np.zeros(len(points), bool), np.zeros((len(points), 3))
    if seen.any():
        colors, spread = colors[:, seen], spread[:, seen]
        middle[seen] = np.nanmedian(colors, axis=0)
        off = np.nanmedian(np.abs(colors - middle[seen]).max(2), axis=0)
        plain[seen] = (np.nanmedian(spread, axis=0) < PLAIN) & (off < SAME)
    return plain, middle
