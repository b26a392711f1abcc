"""Depth maps -> a signed distance: the mean over all photos that see a place (TSDF).

A place that no photo sees takes the sign of the nearest place that one does: the inside of a table's leg is solid, the
air beyond a picture's edge is empty.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from pipeline.cameras import Similarity
from pipeline.grids.connected import largest
from pipeline.grids.interpolation import near_bricks, places_of
from pipeline.inputs.images import stacked
from pipeline.stereo.compiled import carve, paint
from pipeline.stereo.depth import DepthMap, straightened
from sdfsim.base.files import read_arrays, write_arrays
from sdfsim.base.parallel import Progress, silent, threads

BACK = 2.0  # cells in front of and behind a surface within which its distance counts
# A place is empty if photos that see past it have more than this share of the weight of those that see a surface there.
# Their distances are not part of the mean: a few wrong ones would move the surface.
OUTVOTED = 0.5  # a majority
# What lies behind one surface may lie in front of another: the air in the neck of a vase. A place more than `DEEP`
# cells behind a surface is empty if more than a share `FACING` of the `NEAREST` nearest points of surfaces face it. So
# many, because the very nearest points to the middle of a thin wall are near only because they are wrong. Less than
# half, because fewer points are known of the inside of a vase than of its outside.
DEEP, NEAREST, FACING = 0.5, 96, 0.4  # chosen of six pairs on one vase, the bundled set's, and on one drawn thin board
SURFACE_POINTS = 30_000  # per photo, for this search
SEEN = 0.3  # weight above which a place is known; one certain pixel has 1. Set by hand
EDGE = 0.05  # largest relative difference of inverse depth between neighbouring pixels on one surface; by hand
LEAST_TILT = 0.15  # cosine of the flattest angle that counts; by hand
BATCH = 1 << 18  # places per batch
# The field describes the unit sphere only. Photos also show the floor, the walls and the furniture around it. Their
# depth gives a coarse signed distance there, whose cells are as wide as a hundredth of the room.
AROUND = "surroundings.npz"  # in the folder of the field: the signed distance
FAR_SIDE = 96  # samples a side
FARTHEST = 10.0  # radii of the ball: what is farther away is not solid enough to be met
WITHIN = 0.98  # of the places outside of the ball lie within the sampled cube
OUTSIDE = 0.02  # share of the photos' depth that lies outside: with less there is nothing to show
MARGIN = 1.02  # of the cube beyond them


@dataclass(frozen=True)
class Fused:
    """A signed distance on [-1, 1]^3, sampled coarsely everywhere, and finely in bricks near its surface."""

    coarse: np.ndarray  # [n, n, n] float32 (z, y, x), normalised units
    side: int  # fine samples along a side, 2 n - 1
    bricks: np.ndarray  # [B, 3] int16 (z, y, x), see `places_of`
    fine: np.ndarray  # [B * 64] float32, difference of the bricks' fine samples from the coarse ones
    # [B * 64, 3] float32 RGB in 0..1, the mean of the photos that show the surface there; grey if none does
    color: np.ndarray


def fuse(
    maps: Sequence[DepthMap], side: int, photos_folder: Path, *, on_progress: Progress = silent
) -> Fused | None:  # fmt: skip
    """Fuses depth maps in the space of the unit sphere, `side` samples along each side and twice as many near the
    surface, with the colours of their photos; None if they show no surface."""
    given, surface = _prepared(maps), _surface(maps)
    coarse, cell = _coarse(given, surface, side, on_progress), 2.0 / (side - 1)
    if coarse is None:
        return None
    bricks = near_bricks(coarse, 2 * side - 1)
    place = places_of(bricks)
    start = ndimage.map_coordinates(coarse, place.T / 2, order=1, mode="nearest")
    value, weight = _carved(given, surface, (cell / 2 * place[:, ::-1] - 1).astype(np.float32), cell / 2, silent)
    # Where less is known, the coarse distance stays.
    share = np.clip(weight / SEEN, 0, 1) * (np.abs(start) < 1.5 * cell)
    fine = np.clip(share * (value - start), -cell, cell)
    color = _painted(maps, given, place, coarse, start + fine, cell, photos_folder)
    return Fused(coarse, 2 * side - 1, bricks, fine.astype(np.float32), color)


def _coarse(given: tuple[np.ndarray, ...], surface: tuple[KDTree, np.ndarray], side: int, on_progress: Progress
            ) -> np.ndarray | None:  # fmt: skip
    line = np.linspace(-1, 1, side, dtype=np.float32)
    cell = float(line[1] - line[0])
    places = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)[:, ::-1]
    value, weight = (part.reshape((side,) * 3) for part in _carved(given, surface, places, cell, on_progress))
    known = weight > SEEN
    if not (known & (value < 0)).any() or not (known & (value > 0)).any():
        return None
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    solid = without_cavities((value < 0)[tuple(np.asarray(nearest))])
    return _distance(solid, np.where(known, value, np.nan), cell)


def without_cavities(solid: np.ndarray) -> np.ndarray:
    """A solid [n, n, n] bool with its cavities filled: air that is not connected to the largest part of the air, or
    only by ways that are at most two samples wide. No photo sees into them. They come from wrong pixels, which now and
    then see past the front of a thick body; nothing else is known about its inside."""
    air = largest(~solid)[0]
    core, part = largest(ndimage.binary_erosion(air, border_value=1))
    if not core.any():
        return ~air
    nearest = ndimage.distance_transform_edt(part == 0, return_distances=False, return_indices=True)
    return ~(air & core[tuple(np.asarray(nearest))])


def _painted(maps: Sequence[DepthMap], given: tuple[np.ndarray, ...], place: np.ndarray, coarse: np.ndarray,
             value: np.ndarray, cell: float, photos_folder: Path) -> np.ndarray:  # fmt: skip
    """Colours [R, 3] of the surface nearest to fine samples at `place` [R, 3] (z, y, x), with distances `value` [R]."""
    inverse, sizes, _, trust, lines, _ = given
    colors = np.zeros((*inverse.shape, 3), np.uint8)
    for n, one in enumerate(maps):
        picture = straightened(one.view, photos_folder, max(one.inverse.shape), "RGB")[0]
        colors[n, : picture.shape[0], : picture.shape[1]] = picture
    slope = np.stack([ndimage.map_coordinates(part, place.T / 2, order=1, mode="nearest")
                      for part in np.gradient(coarse, cell)], 1)  # fmt: skip
    slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 0.5)
    surface = ((cell / 2 * place - 1 - value[:, None] * slope)[:, ::-1]).astype(np.float32)
    total, weight = np.zeros((len(place), 3), np.float32), np.zeros(len(place), np.float32)
    parts = [slice(start, start + BATCH) for start in range(0, len(place), BATCH)]
    jobs = [(np.ascontiguousarray(surface[part]), colors, inverse, sizes, trust, lines, BACK * cell, total[part],
             weight[part]) for part in parts]  # fmt: skip
    for _ in threads(paint, jobs):
        pass
    return np.where(weight[:, None] > 0, total / np.maximum(weight[:, None], 1e-9) / 255, 0.5).astype(np.float32)


def _prepared(maps: Sequence[DepthMap]) -> tuple[np.ndarray, ...]:
    """The arguments of `carve` from depth maps, `inverse` to `lines` without `tilts`, and then `tilts`."""
    inverse, sizes = stacked([one.inverse for one in maps])
    slopes, tilts = np.zeros((*inverse.shape, 2), np.float32), np.zeros(inverse.shape, np.float32)
    trust = stacked([one.certain for one in maps])[0]
    lines = []
    for n, one in enumerate(maps):
        rows, columns = one.inverse.shape
        slope, normal = _tangents(one)
        slopes[n, :rows, :columns] = slope
        tilt = one.inverse / np.maximum(np.linalg.norm(normal, axis=-1), 1e-9)
        ray = np.linalg.norm(one.rays, axis=-1)
        cosine = tilt / ray
        tilts[n, :rows, :columns] = tilt
        trust[n, :rows, :columns] *= np.clip(cosine, LEAST_TILT, 1)
        lines.append(one.matrix @ np.concatenate([one.view.rotation, one.view.translation[:, None]], 1))
    return inverse, sizes, slopes, trust, np.array(lines), tilts


def _tangents(one: DepthMap) -> tuple[np.ndarray, np.ndarray]:
    """Slopes of inverse depth, see `_slopes`, and normals n [H, W, 3] in camera axes, away from the camera, of the
    tangent planes n . place = 1."""
    slope = _slopes(one.inverse)
    row, column = np.indices(one.inverse.shape)
    rest = one.inverse - slope[..., 0] * column - slope[..., 1] * row
    return slope, np.concatenate([slope, rest[..., None]], -1) @ one.matrix


def _surface(maps: Sequence[DepthMap]) -> tuple[KDTree, np.ndarray]:
    """Some surface points of the maps, and unit normals [P, 3] there, towards the photo's camera."""
    rng = np.random.default_rng(0)
    points, normals = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for one in maps:
        normal = _tangents(one)[1][one.inverse > 0] @ one.view.rotation
        known = one.points()
        some = rng.permutation(len(known))[:SURFACE_POINTS]
        points.append(known[some])
        normals.append(-normal[some] / np.linalg.norm(normal[some], axis=1, keepdims=True))
    return KDTree(np.concatenate(points)), np.concatenate(normals)


def _in_front(surface: tuple[KDTree, np.ndarray], places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether enough surface points nearest to places [P, 3] face them; and the mean distance [P] from those that
    do."""
    tree, normals = surface
    index = np.minimum(tree.query(places, NEAREST, workers=-1)[1], len(normals) - 1)
    along = ((places[:, None] - tree.data[index]) * normals[index]).sum(-1)
    front = along > 0
    mean = np.where(front, along, 0).sum(1) / np.maximum(front.sum(1), 1)
    return front.mean(1) > FACING, mean


def _slopes(inverse: np.ndarray) -> np.ndarray:
    """Slope of inverse depth [H, W] along columns and rows [H, W, 2]; 0 next to edges and gaps."""
    found = np.zeros((*inverse.shape, 2), np.float32)
    for axis, slot in ((1, 0), (0, 1)):
        before, after = np.roll(inverse, 1, axis), np.roll(inverse, -1, axis)
        fair = (np.minimum(before, after) > 0) & (np.abs(after - before) < EDGE * inverse)
        found[..., slot] = np.where(fair, (after - before) / 2, 0)
    found[[0, -1]] = 0
    found[:, [0, -1]] = 0
    return np.stack([ndimage.uniform_filter(found[..., slot], 3) for slot in (0, 1)], -1)


def _carved(given: tuple[np.ndarray, ...], surface: tuple[KDTree, np.ndarray], places: np.ndarray, cell: float,
            on_progress: Progress) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Distances and weights [P] at places [P, 3], for samples `cell` apart."""
    total, weight, past = np.zeros((3, len(places)), np.float32)
    parts = [slice(start, start + BATCH) for start in range(0, len(places), BATCH)]
    jobs = [(np.ascontiguousarray(places[part], np.float32), *given, BACK * cell, total[part], weight[part], past[part])
            for part in parts]  # fmt: skip
    for number, _ in enumerate(threads(carve, jobs)):
        on_progress((number + 1) / len(jobs), f"fusing depth, {number + 1} of {len(jobs)} parts")
    mean = total / np.maximum(weight, 1e-9)
    empty = (mean <= 0) & (past > OUTVOTED * weight)
    value = np.where(empty, BACK * cell, mean)
    behind = np.nonzero((value < -DEEP * cell) & (weight > 0))[0]
    if len(behind):
        front, far = _in_front(surface, places[behind])
        value[behind[front]] = np.minimum(far[front], BACK * cell)
    return value, weight + past


def _distance(solid: np.ndarray, value: np.ndarray, cell: float) -> np.ndarray:
    """Signed distance [n, n, n]: near the surface from photos (`value`, NaN where unknown), elsewhere from the nearest
    sample on the other side of the surface."""
    outside = np.asarray(ndimage.distance_transform_edt(~solid), np.float32)
    inside = np.asarray(ndimage.distance_transform_edt(solid), np.float32)
    rough = np.where(solid, 0.5 - inside, outside - 0.5) * cell
    good = np.isfinite(value) & (np.abs(rough) < 1.5 * cell)
    return np.where(good, np.clip(np.nan_to_num(value), rough - cell, rough + cell), rough).astype(np.float32)


# --- what lies outside of the trained ball ---


@dataclass(frozen=True)
class Far:
    """Samples of the signed distance around the ball."""

    values: np.ndarray  # [FAR_SIDE, FAR_SIDE, FAR_SIDE] float32 (x, y, z)
    reach: float  # of the cube of the samples, to each side of the middle


def surrounding_distance(maps: Sequence[DepthMap], on_progress: Progress = silent) -> Far | None:
    """The signed distance outside of the ball, within the cube that holds nearly all that photos show there; None if
    they show hardly anything there."""
    away = np.linalg.norm(np.concatenate([one.points() for one in maps]), axis=1)
    if not len(away) or (away > 1).mean() < OUTSIDE:
        return None
    reach = min(float(np.quantile(away[away > 1], WITHIN)), FARTHEST) * MARGIN
    shrink = Similarity(1 / reach, np.eye(3), np.zeros(3))
    # The same photos of a smaller world, which fits into the unit sphere.
    small = [replace(one, view=shrink.view(one.view), inverse=one.inverse * np.float32(reach)) for one in maps]
    coarse = _coarse(_prepared(small), _surface(small), FAR_SIDE, on_progress)
    if coarse is None:
        return None
    return Far(reach * coarse.transpose(2, 1, 0), reach)


def save_far(far: Far, folder: Path) -> None:
    """Writes it to the folder of a field."""
    arrays = {"values": far.values.astype(np.float16), "reach": np.array(far.reach)}
    write_arrays(folder / AROUND, arrays)


def load_far(folder: Path) -> Far | None:
    """The signed distance that the training has left; None if photos show nothing outside of the ball."""
    if not (folder / AROUND).exists():
        return None
    kept = read_arrays(folder / AROUND, "surroundings", "run the distill stage again")
    return Far(kept["values"].astype(np.float32), float(kept["reach"]))
