"""Depth from photos alone: the depth of every pixel, by comparison with neighbouring photos.

Planes are swept through the scene at a small photo size. Then depths around the result are tried at the full size,
along the slope of that surface; so windows follow slopes, unlike planes in front of the camera. Near edges the surface
behind is tried too, because windows mix the surfaces in front of and behind an edge. A pixel counts if other photos
agree.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from pipeline.cameras import PosedPhotos, View, focus
from pipeline.inputs.images import stacked
from pipeline.inputs.photos import open_mask, open_photo
from pipeline.stereo.compiled import agreeing, sweep
from sdfsim.base.parallel import Progress, silent, threads

COARSE = 320  # px of the longer side while planes are swept
LARGER = 1.5  # times, from round to round
NEIGHBOURS = 4  # photos with which a photo is compared
ASKED = 8  # photos that are checked for the same depth
# Degrees between lines of sight at which two photos match best, and how fast they match less below and above.
BEST_ANGLE, NARROWER, WIDER = 9.0, 4.0, 9.0
APART = 0.7  # Reduced weight of a neighbour in the direction of one already chosen.
PLACES = 300  # sparse points used to choose neighbours
PLANES = (48, 128)  # fewest and most
STEP = 1.25  # px of motion from plane to plane, in the photo farthest away
FINER, TRIED = 0.5, 4  # px between the depths that are tried again, and how many to either side
AROUND = 9  # px, the width in which the farthest surface is also tried
HALF = 3  # px from the middle of a window to its sides
AGREE = 0.01  # share by which inverse depths differ at most
FEWEST = 2  # photos that have to agree
ALIKE = 0.4  # correlation below which a depth is unknown
BEYOND = 1e-3  # inverse depth of empty space
MARGIN = 1.25  # margin beyond the nearest and farthest sparse points of a photo


@dataclass(frozen=True)
class Pinhole:
    """A small grey photo without distortion. Pixel centres are at whole numbers."""

    view: View  # of the photo itself
    grey: np.ndarray  # [H, W] float32, mean 0
    matrix: np.ndarray  # [3, 3] from camera axes to its pixels


@dataclass(frozen=True)
class DepthMap:
    """Depth of one photo where others agree."""

    view: View  # of the photo itself
    matrix: np.ndarray  # [3, 3] from camera axes to pixels, whose centres are at whole numbers
    inverse: np.ndarray  # [H, W] float32, 1 / depth along the optical axis; 0 where unknown
    certain: np.ndarray  # [H, W] float32, 0 to 1

    @property
    def rays(self) -> np.ndarray:
        """Directions [H, W, 3] in the world through the pixels, 1 long along the optical axis."""
        row, column = np.indices(self.inverse.shape)
        pixels = np.stack([column, row, np.ones_like(row)], -1)
        return pixels @ np.linalg.inv(self.matrix).T @ self.view.rotation

    def points(self) -> np.ndarray:
        """Points [P, 3] of the pixels with known depth."""
        known = self.inverse > 0
        return self.view.center + self.rays[known] / self.inverse[known][:, None]


def stereo(
    poses: PosedPhotos, photos_folder: Path, long_side: int, *, on_progress: Progress = silent
) -> list[DepthMap]:  # fmt: skip
    """Depth of every photo in the space of the poses, no larger than `long_side` px, for surfaces in the unit sphere
    and behind it. Raises SdfsimError if a photo is missing. None if there are fewer than three photos."""
    views = poses.views
    if len(views) <= FEWEST:
        return []
    order = neighbours(poses)
    spans = [span(poses, number) for number in range(len(views))]
    inverse: list[np.ndarray] = [np.zeros((0, 0))] * len(views)
    score, counts = list(inverse), list(inverse)
    sides = [min(COARSE, long_side)]
    while sides[-1] < long_side or len(sides) == 1:
        sides.append(min(round(LARGER * sides[-1]), long_side))
    done, total = 0, 2 * len(sides) * len(views)

    def each(function, jobs: Sequence[tuple], words: str) -> list:
        nonlocal done
        found: list = [None] * len(jobs)
        for number, result in threads(function, jobs):
            found[number] = result
            done += 1
            on_progress(done / total, f"stereo: {words}, {number + 1} of {len(jobs)} photos")
        return found

    pictures: list[Pinhole] = []
    for side in sides:
        first = side is sides[0]
        pictures = [pinhole(view, photos_folder, side) for view in views]
        jobs = []
        for number in range(len(views)):
            near = [pictures[k] for k in order[number][:NEIGHBOURS]]
            start = None if first else filled(inverse[number], (counts[number] >= FEWEST) & (score[number] > ALIKE))
            jobs.append((_search, pictures[number], near, spans[number], start))
        found = each(lambda search, *job: search(*job), jobs, "planes" if first else "places")
        inverse, score = (list(part) for part in zip(*found, strict=True))
        jobs = [(pictures, inverse, number, order[number][:ASKED]) for number in range(len(views))]
        counts = each(_agreement, jobs, "agreement")
    maps = []
    for number, picture in enumerate(pictures):
        good = (counts[number] >= FEWEST) & (score[number] > ALIKE)
        certain = np.where(good, (score[number] - ALIKE) / (1 - ALIKE) * np.minimum(counts[number] / 4, 1), 0)
        known = np.where(good, inverse[number], 0).astype(np.float32)
        maps.append(DepthMap(picture.view, picture.matrix, known, certain.astype(np.float32)))
    return maps


def only(poses: PosedPhotos, index: Sequence[int]) -> PosedPhotos:
    """Some of the photos, with their observations of sparse points."""
    sparse, place = poses.sparse, np.full(len(poses.views), -1)
    place[index] = np.arange(len(index))
    view_of = place[sparse.view_of]
    there = view_of >= 0
    left = replace(sparse, point_of=sparse.point_of[there], view_of=view_of[there])
    return replace(poses, views=tuple(poses.views[k] for k in index), sparse=left)


def outside_mask(depth: DepthMap, photos_folder: Path) -> DepthMap:
    """The same for a masked object: pixels outside the photo's mask are empty space, infinitely far."""
    rows, columns = depth.inverse.shape
    mask = open_mask(photos_folder, depth.view, (columns, rows))
    empty = np.logical_not(ndimage.binary_dilation(mask > 0, iterations=2))
    inverse = np.where(empty, np.float32(BEYOND), np.where(mask > 127, depth.inverse, 0))
    return replace(depth, inverse=inverse, certain=np.where(empty, np.float32(1), depth.certain))


def stereo_summary(maps: Sequence[DepthMap], poses: PosedPhotos) -> dict[str, float]:
    """For the report: the share of pixels with depth (`valid`), and the median share by which it differs from the
    sparse points of the same pixels (`spread`)."""
    off = []
    for number, one in enumerate(maps):
        seen = poses.sparse.xyz[poses.sparse.point_of[poses.sparse.view_of == number]]
        local = (seen @ one.view.rotation.T + one.view.translation) @ one.matrix.T
        at = np.round(local[:, :2] / np.maximum(local[:, 2:], 1e-9)).astype(int)
        inside = (local[:, 2] > 0) & (at >= 0).all(1) & (at < one.inverse.shape[::-1]).all(1)
        inverse = one.inverse[at[inside, 1], at[inside, 0]]
        off.append(np.abs(inverse * local[inside, 2] - 1)[inverse > 0])
    found = np.concatenate([np.zeros(0), *off])
    valid = float(np.mean([(one.inverse > 0).mean() for one in maps])) if maps else 0.0
    return {"valid": round(valid, 3), "spread": round(float(np.median(found)), 5) if len(found) else AGREE}


def pinhole(view: View, photos_folder: Path, long_side: int) -> Pinhole:
    """The photo of a view, grey, reduced and undistorted. Raises SdfsimError if it is missing."""
    grey, matrix = straightened(view, photos_folder, long_side, "L")
    return Pinhole(view, np.ascontiguousarray(grey - grey.mean(), np.float32), matrix)


def straightened(view: View, photos_folder: Path, long_side: int, mode: str) -> tuple[np.ndarray, np.ndarray]:
    """The photo of a view, reduced and undistorted, in one of PIL's modes: [H, W] float32 (grey, L) or [H, W, 3] uint8
    (RGB), and the matrix [3, 3] from camera axes to its pixels, whose centres are at whole numbers. Raises SdfsimError
    if it is missing."""
    import cv2

    pixels = np.asarray(open_photo(photos_folder, view, mode, long_side))
    pixels, size = pixels.astype(np.float32) if mode == "L" else pixels, pixels.shape[1::-1]
    sx, sy = size[0] / view.width, size[1] / view.height
    matrix = np.array([[view.focal * sx, 0, view.cx * sx - 0.5], [0, view.focal * sy, view.cy * sy - 0.5], [0, 0, 1]])
    if view.k:
        column, row = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
        local = np.stack([column, row, np.ones_like(row)], -1).reshape(-1, 3) @ np.linalg.inv(matrix).T
        bent = 1 + view.k * (local[:, :2] ** 2).sum(1)
        at = (local[:, :2] * bent[:, None] * np.diag(matrix)[:2] + matrix[:2, 2]).astype(np.float32)
        maps = (at[:, 0].reshape(row.shape), at[:, 1].reshape(row.shape))
        pixels = cv2.remap(pixels, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return pixels, matrix


def neighbours(poses: PosedPhotos) -> list[list[int]]:
    """For each view the others that match it best, the best first: they show the same sparse points from an angle that
    is neither too narrow nor too wide, and the first few are on different sides."""
    views, sparse = poses.views, poses.sparse
    middle = focus(views, np.median(sparse.xyz, axis=0))[0]
    centers = np.array([view.center for view in views])
    rng = np.random.default_rng(0)
    found = []
    for number, view in enumerate(views):
        mine = np.unique(sparse.point_of[sparse.view_of == number])
        points = sparse.xyz[rng.permutation(mine)[:PLACES]] if len(mine) else middle[None]
        towards = points[None] - centers[:, None]
        towards /= np.linalg.norm(towards, axis=2, keepdims=True)
        angle = np.degrees(np.arccos(np.clip((towards * towards[number]).sum(2), -1, 1)))
        width = np.where(angle < BEST_ANGLE, NARROWER, WIDER)
        fit = np.exp(-(((angle - BEST_ANGLE) / width) ** 2) / 2)
        for other, there in enumerate(views):
            pixels, depth = there.project(points)
            shown = (depth > 0) & (pixels > 0).all(1) & (pixels < [there.width, there.height]).all(1)
            fit[other] *= shown
        worth = fit.mean(1)
        worth[number] = -1
        side = (centers - view.center) @ view.rotation[:2].T
        side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
        chosen: list[int] = []
        while len(chosen) < min(ASKED, len(views) - 1):
            alike = side @ side[chosen].T if chosen else np.zeros((len(views), 1))
            reduced_worth = worth * (1 - APART * np.clip(alike.max(1), 0, 1) ** 2)
            reduced_worth[[number, *chosen]] = -2
            chosen.append(int(reduced_worth.argmax()))
        found.append(chosen)
    return found


def span(poses: PosedPhotos, number: int) -> tuple[float, float]:
    """Smallest and largest inverse depth to search in a photo: the unit sphere, and the space behind it."""
    view, sparse = poses.views[number], poses.sparse
    seen = sparse.xyz[sparse.point_of[sparse.view_of == number]]
    depth = seen @ view.rotation[2] + view.translation[2]
    depth = depth[depth > 0]
    away = float(np.linalg.norm(view.center))
    nearest, farthest = max(away - 1, 0.05), away + 1
    if len(depth):
        low, high = np.quantile(depth, [0.01, 0.99])
        nearest, farthest = max(nearest, low / MARGIN / MARGIN), max(farthest, high * MARGIN)
    return 1 / farthest, 1 / min(nearest, 0.9 * farthest)


def relation(first: Pinhole | DepthMap, second: Pinhole | DepthMap) -> tuple[np.ndarray, np.ndarray]:
    """The map from pixels of one photo to those of another: [3, 3] and [3], see `sweep`."""
    turn = second.view.rotation @ first.view.rotation.T
    shift = second.view.translation - turn @ first.view.translation
    return second.matrix @ turn @ np.linalg.inv(first.matrix), second.matrix @ shift


def _search(picture: Pinhole, near: list[Pinhole], limits: tuple[float, float], start: np.ndarray | None
            ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Inverse depth and score [H, W] of a photo, by planes, or around a `start` [h, w]."""
    import cv2

    rows, columns = picture.grey.shape
    turns, shifts = (np.array(part) for part in zip(*(relation(picture, other) for other in near), strict=True))
    row, column = np.mgrid[0 : rows - 1 : 5j, 0 : columns - 1 : 5j]
    pixels = np.stack([column.ravel(), row.ravel(), np.ones(25)], 1)

    def shown(inverse: float) -> np.ndarray:
        at = pixels @ turns.transpose(0, 2, 1) + inverse * shifts[:, None]
        return at[..., :2] / np.maximum(at[..., 2:], 1e-6)

    middle = (limits[0] * limits[1]) ** 0.5 if start is None else float(np.median(start))
    slope = np.linalg.norm(shown(1.01 * middle) - shown(middle), axis=2) / (0.01 * middle)  # px a unit of inverse depth
    fastest = max(float(np.median(slope, axis=1).max()), 1e-9)
    others, sizes = stacked([other.grey for other in near])

    def best(base: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return sweep(picture.grey, others, sizes, turns.astype(np.float32), shifts.astype(np.float32), base,
                     offsets.astype(np.float32), HALF)  # fmt: skip

    if start is None:
        count = int(np.clip((limits[1] - limits[0]) * fastest / STEP, *PLANES))
        return best(np.zeros((rows, columns), np.float32), np.linspace(*limits, count))
    base, far = (
        cv2.resize(part.astype(np.float32), (columns, rows), interpolation=cv2.INTER_LINEAR)
        for part in (start, ndimage.minimum_filter(start, AROUND))
    )
    offsets = np.arange(-TRIED, TRIED + 1) * FINER / fastest
    inverse, score = best(base, offsets)
    # Windows that reach over an edge find the front surface even for pixels that show the surface behind: in the mouth
    # of a vase every window does. Surfaces nearer than the tried depths are the same surface.
    beyond = base - far > offsets[-1]
    if not beyond.any():
        return inverse, score
    other, its_score = best(np.where(beyond, far, base), offsets)
    better = beyond & (its_score > score)
    return np.where(better, other, inverse), np.where(better, its_score, score)


def _agreement(pictures: list[Pinhole], inverse: list[np.ndarray], number: int, asked: list[int]) -> np.ndarray:
    """The number of photos [H, W] that agree with the inverse depth of one."""
    turns, shifts = zip(*(relation(pictures[number], pictures[k]) for k in asked), strict=True)
    others, sizes = stacked([inverse[k] for k in asked])
    return agreeing(inverse[number], others, sizes, np.array(turns), np.array(shifts), AGREE)


def filled(inverse: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Inverse depth [H, W] where it is `known` [H, W], without specks; elsewhere that of the nearest such pixel."""
    import cv2

    if not known.any():
        return inverse
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    whole = inverse[tuple(np.asarray(nearest))].astype(np.float32)
    return cv2.medianBlur(whole, 5)
