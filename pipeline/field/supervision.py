"""Supervision of the training from structure-from-motion and depth: the object's position, its surface, and free
space."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from pipeline.cameras import PosedPhotos, Similarity, Sparse, View, nearest_to_axes
from pipeline.grids.interpolation import interpolate
from pipeline.inputs.photos import Photo
from pipeline.stereo.depth import DepthMap
from sdfsim.base.errors import SdfsimError

# In cells of the field's finest grid, the limit of its accuracy. All four were set by hand on the bundled set, as round
# lengths of the unit sphere (0.0075, 0.01, -0.002 and 0.001), and only converted to cells.
GAP = 0.9525  # gap between the end of a line of sight and its point, because points and surface are uncertain
CLEARANCE = 1.27  # largest clearance that free space demands, and the shortest line of sight that counts
# Free space counts as filled if the field is below the first value; the loss demands the second, and no more.
FILLED, JUST_EMPTY = -0.254, 0.127
# Clearance as a share of the distance to the point, which may be on a plane at a grazing angle.
SLOPE = 0.1
DEPTH_POINTS, DEPTH_LINES = 500_000, 60_000  # used, from a depth sensor or from stereo
STEREO_POINTS = 20_000  # per photo
CERTAIN = 0.3  # Less certain pixels of stereo are used neither for the surface nor for free space.
NOISES = 5.0  # gap before the point in median errors of the depth, because a line through the surface erodes it
APART = 0.2  # A scale that differs by more than this share means wrong units, or another photo's depth.
USUAL = 0.01  # relative error of a phone's depth, if nothing better is known
FEWEST = 50  # sparse points on pixels with depth needed for the scale
TRIES = 16  # points along each line checked for filled free space
LINES = 2000  # checked at once for solids that they cross


@dataclass(frozen=True)
class DepthPoints:
    """Pixels with depth."""

    xyz: np.ndarray  # [P, 3] in the world of the poses, at the sensor's depth
    pixel: np.ndarray  # [P, 2] in the undistorted photo
    view: np.ndarray  # [P] index of the view


def depth_points(views: Sequence[View], photos: list[Photo], folder: Path, *, scale: float = 1.0) -> DepthPoints:
    """All pixels with depth, times `scale`, in the world of the poses, which is nominally in metres. Raises SdfsimError
    if a file of the photos stage is missing."""
    by_name = {photo.name: photo for photo in photos}
    xyz, pixel, index = [np.zeros((0, 3))], [np.zeros((0, 2))], [np.zeros(0, np.int32)]
    for number, view in enumerate(views):
        photo = by_name[view.name]
        if not photo.depth:
            continue
        try:
            depth = np.load(folder / "depth" / f"{view.name}.npy", allow_pickle=False)
        except (OSError, ValueError) as error:
            raise SdfsimError(f"{folder}: no depth of {view.name}", "run the photos stage again") from error
        row, column = np.nonzero(depth)
        shape = np.array(photo.original) / depth.shape[::-1]
        at = photo.prepared((np.stack([column, row], 1) + 0.5) * shape, view)
        rays = view.rays(*at.T)
        # Depth is along the optical axis.
        away = scale * depth[row, column] / (rays @ view.rotation[2])
        xyz.append(view.center + away[:, None] * rays)
        pixel.append(at)
        index.append(np.full(len(at), number, np.int32))
    return DepthPoints(np.concatenate(xyz), np.concatenate(pixel), np.concatenate(index))


def depth_scale(poses: PosedPhotos, points: DepthPoints) -> dict[str, float]:
    """Compares depth with the triangulated points that lie on the same pixels.

    Returns `scale`, the factor of the depth that makes both agree; `spread`, the median relative difference of a pixel
    after that; `points`, the number compared: with fewer than `FEWEST` the depth is not scaled. Raises SdfsimError if
    they differ by more than `APART`, because the depth is then not in metres or not of these photos.
    """
    ratios, sparse = [], poses.sparse
    for number, view in enumerate(poses.views):
        mine = points.view == number
        seen = sparse.point_of[sparse.view_of == number]
        if not mine.any() or not len(seen):
            continue
        shown, depth = view.project(sparse.xyz[seen])
        spacing = np.sqrt(view.width * view.height / mine.sum())
        off, nearest = KDTree(points.pixel[mine]).query(shown)
        ahead = (points.xyz[mine][nearest] - view.center) @ view.rotation[2]
        ratios.append((depth / ahead)[off < spacing])
    ratio = np.concatenate(ratios) if ratios else np.zeros(0)
    if len(ratio) < FEWEST:
        return {"scale": 1.0, "spread": USUAL, "points": len(ratio)}
    scale = float(np.median(ratio))
    if not 1 / (1 + APART) < scale < 1 + APART:
        message = f"depth: the cameras' distances are {scale:.3g} times those of the depth files"
        raise SdfsimError(message, "give its unit (depth_unit_scale_factor, metres a count), or leave it out")
    return {"scale": scale, "spread": float(np.median(np.abs(ratio / scale - 1))), "points": len(ratio)}


def stereo_points(maps: Sequence[DepthMap], poses: PosedPhotos) -> DepthPoints:
    """At most `STEREO_POINTS` points per depth map that are `CERTAIN`, preferably the most certain. Maps are in the
    space of the poses, the result is in the world before their move."""
    names, back = [view.name for view in poses.views], poses.moved_by.inverse()
    rng, xyz, index = np.random.default_rng(0), [np.zeros((0, 3))], [np.zeros(0, np.int32)]
    for one in maps:
        points, certain = one.points(), one.certain[one.inverse > 0].astype(float)
        points, certain = points[certain > CERTAIN], certain[certain > CERTAIN]
        some = rng.permutation(len(points))
        if len(points) > STEREO_POINTS:
            some = rng.choice(len(points), STEREO_POINTS, replace=False, p=certain / certain.sum())
        xyz.append(back.points(points[some]))
        index.append(np.full(len(some), names.index(one.view.name), np.int32))
    found = np.concatenate(xyz)
    return DepthPoints(found, np.zeros((len(found), 2)), np.concatenate(index))


@dataclass(frozen=True)
class Supervision:
    """Sparse points and free space in the unit sphere."""

    points: np.ndarray  # [P, 3] surface points in the unit sphere
    weights: np.ndarray  # [P] trust in each, mean 1
    sight: np.ndarray  # [L, 6] starts and ends of stretches of free space
    # [D, 3] points of a depth sensor in the unit sphere
    depth: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))


def supervision_of(
    poses: PosedPhotos, cell: float, depth: DepthPoints | None = None, noise: float = 0.0,
    fused: Callable[[Tensor], Tensor] | None = None,
) -> Supervision:  # fmt: skip
    """Sparse points seen by three views or more with a small error, and their lines of sight within the sphere.

    Poses are in the unit sphere; a sensor's depth is in the world before that move. `cell` is the width of a cell of
    the field's finest grid. Pixels with depth give lines of sight as well, which end earlier by `noise`, the median
    relative error of the depth. Those that cross a solid of fused depth, the distance [P] at points [P, 3], are left
    out: a few wrong pixels at the rim of a vase see through its wall, and lines of sight would open slits in it.
    """
    sparse = poses.sparse
    points = sparse.xyz
    seen = np.bincount(sparse.point_of, minlength=len(points))
    good = (seen >= 3) & (sparse.error < 1.5)
    inside = good & (np.linalg.norm(points, axis=1) < 1.0)
    weights = point_weights(sparse, len(points))[inside]
    use = good[sparse.point_of]
    centers = np.array([view.center for view in poses.views]).reshape(-1, 3)
    end, start = points[sparse.point_of[use]], centers[sparse.view_of[use]]
    sparse_lines = len(end)
    measured, gap = np.zeros((0, 3)), np.full(len(end), GAP * cell)
    if depth is not None:
        rng = np.random.default_rng(0)
        some = rng.permutation(len(depth.xyz))
        measured = poses.moved_by.points(depth.xyz[some])
        end = np.concatenate([end, measured[:DEPTH_LINES]])
        start = np.concatenate([start, centers[depth.view[some[:DEPTH_LINES]]]])
        away = np.linalg.norm(end[len(gap) :] - start[len(gap) :], axis=1)
        gap = np.concatenate([gap, GAP * cell + NOISES * noise * away])
        measured = measured[np.linalg.norm(measured, axis=1) < 1.0][:DEPTH_POINTS]
    length = np.linalg.norm(end - start, axis=1)
    direction = (end - start) / np.maximum(length, 1e-9)[:, None]
    along = -(start * direction).sum(1)
    half = np.sqrt(np.maximum(1 - ((start**2).sum(1) - along**2), 0))
    # Not all the way, because a point and the surface there are a little uncertain.
    low, high = np.maximum(along - half, 0), np.minimum(along + half, length - gap)
    crosses = (half > 0) & (high > low + CLEARANCE * cell)
    sight = np.concatenate([start + low[:, None] * direction, start + high[:, None] * direction], 1)
    if fused is not None:  # Sparse points are in more photos, so their lines stay.
        asked = np.flatnonzero(crosses[sparse_lines:]) + sparse_lines
        crosses[asked] = ~blocked(sight[asked], fused, cell)
    sight = sight[crosses]
    weights = weights / max(float(weights.mean()), 1e-9) if len(weights) else weights
    return Supervision(points[inside], weights, sight, measured)


def blocked(sight: np.ndarray, distance: Callable[[Tensor], Tensor], cell: float) -> np.ndarray:
    """Whether lines [L, 6] cross a solid, whose distance [P] is known at points [P, 3], deeper than `FILLED` cells."""
    start, end = np.split(sight, 2, 1)
    along = torch.linspace(0, 1, math.ceil(2 / cell))[:, None]  # a place per cell of the longest line
    found = np.zeros(len(sight), bool)
    with torch.no_grad():
        for first in range(0, len(sight), LINES):
            low, high = (
                torch.tensor(part[first : first + LINES], dtype=torch.float32)[:, None] for part in (start, end)
            )
            value = distance((low + along * (high - low)).reshape(-1, 3)).reshape(len(low), -1)
            found[first : first + LINES] = (value.amin(1) < FILLED * cell).numpy()
    return found


class FreeSpace:
    """Points on lines [L, 6] from cameras to seen points, which must be empty. Half of the picked points are where the
    field is still solid: only one line of sight in hundreds crosses a vase's mouth, which would stay filled if lines
    were drawn evenly. `cell` is the width of a cell of the field's finest grid."""

    def __init__(self, sight: np.ndarray, cell: float, device: str) -> None:
        self.cell = cell
        self.start, self.end = (
            torch.tensor(part, dtype=torch.float32, device=device).reshape(-1, 3) for part in np.split(sight, 2, 1)
        )
        self.filled = torch.zeros(0, 2, device=device)

    def __len__(self) -> int:
        return len(self.start)

    def look(self, cache: Tensor, rng: torch.Generator) -> None:
        """Finds filled points with the SDF on a grid [n, n, n, 1] over [-1, 1]^3, at random points of every line."""
        device = self.start.device
        found = []
        for _ in range(TRIES):
            along = torch.rand(len(self), generator=rng).to(device)
            line = torch.arange(len(self), device=device)
            wrong = interpolate(cache, self.at(line, along)[0])[:, 0] < FILLED * self.cell
            found.append(torch.stack([line[wrong].float(), along[wrong]], 1))
        self.filled = torch.cat(found)

    def at(self, line: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
        """Points [P, 3] at fractions [P] of lines [P], and the clearance [P] that each demands."""
        start, end = self.start[line], self.end[line]
        rest = (1 - along) * (end - start).norm(dim=1) + GAP * self.cell
        return start + along[:, None] * (end - start), (SLOPE * rest).clamp_max(CLEARANCE * self.cell)

    def pick(self, count: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
        """At most `count` points [P, 3] and the SDF [P] that each must at least have."""
        count, device = min(count, len(self)), self.start.device
        line = torch.randint(max(1, len(self)), (count,), generator=rng).to(device)
        along = torch.rand(count, generator=rng).to(device)
        again = torch.randint(max(1, len(self.filled)), (count // 2,), generator=rng).to(device)
        if not len(self.filled):
            return self.at(line, along)
        line[: count // 2] = self.filled[again, 0].long()
        along[: count // 2] = self.filled[again, 1]
        points, clearance = self.at(line, along)
        # Emptied, but no more: a surface may be right next to it, and this loss returns to the same places.
        clearance[: count // 2].clamp_(max=JUST_EMPTY * self.cell)
        return points, clearance


def point_weights(sparse: Sparse, count: int) -> np.ndarray:
    """Weight [P] of each sparse point: the number of views that see it, reduced if its error is large."""
    seen = np.bincount(sparse.point_of, minlength=count).astype(float)
    return seen / (1 + np.maximum(sparse.error, 0) ** 2)


def unit_sphere_of(poses: PosedPhotos, *, masked: bool = False) -> Similarity:
    """The similarity that moves the scene in front of the cameras into the unit sphere; `masked`: all points lie on the
    object.

    The centre is where the optical axes meet, with a weak pull to the points' median. The radius fits the longer side
    of most photos, is smaller if nearly all points are nearer, and never reaches the nearest cameras.
    """
    views, sparse = poses.views, poses.sparse
    centers = np.array([v.center for v in views])
    axes = np.array([v.rotation[2] for v in views])
    weights = point_weights(sparse, len(sparse.xyz))

    def quantile(values: np.ndarray, q: float) -> np.ndarray:
        """Of values [P] or [P, 3], by the weights."""
        return np.quantile(values, q, axis=0, weights=weights, method="inverted_cdf")

    if masked:
        center = (quantile(sparse.xyz, 0.005) + quantile(sparse.xyz, 0.995)) / 2
        radius = 1.15 * float(quantile(np.linalg.norm(sparse.xyz - center, axis=1), 0.99))
    else:
        center = nearest_to_axes(centers, axes, anchor=quantile(sparse.xyz, 0.5))
        in_front = ((center - centers) * axes).sum(1) > 0
        if in_front.mean() < 0.8:  # Axes that meet behind the cameras (a capture looking outwards) are useless.
            center = quantile(sparse.xyz, 0.5)
        away = np.linalg.norm(centers - center, axis=1)
        half = np.array([np.arctan(0.5 * max(v.width, v.height) / v.focal) for v in views])
        points = np.linalg.norm(sparse.xyz - center, axis=1)
        radius = min(
            float(np.median(away * np.sin(half))), 1.25 * float(quantile(points, 0.95)),
            0.9 * float(np.quantile(away, 0.05)),
        )  # fmt: skip
        radius = max(radius, 1e-9)
    return Similarity(1 / radius, np.eye(3), -center / radius)
