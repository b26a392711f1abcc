"""Photos of solids with a closed form: a ball on a plane, and hollow things, in a texture that never repeats."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates

from pipeline.cameras import PosedPhotos, Sparse, View
from tests.helpers.surfaces import box, look_at

Distance = Callable[[np.ndarray], np.ndarray]
BALL, GROUND = 0.35, -0.35  # radius of the ball about the origin, and height of the plane below it


def ball_on_plane(points: np.ndarray) -> np.ndarray:
    """Signed distance [P] at points [P, 3]."""
    return np.minimum(np.linalg.norm(points, axis=-1) - BALL, points[..., 2] - GROUND)


def cup(radius: float, wall: float, depth: float, height: float) -> Distance:
    """Signed distance to a cup about the z axis from 0 to `height`, hollow from its rim down by `depth`, on a plane."""

    def rod(points: np.ndarray, around: float, low: float, high: float) -> np.ndarray:
        flat = np.linalg.norm(points[..., :2], axis=-1) - around
        up = np.abs(points[..., 2] - (low + high) / 2) - (high - low) / 2
        beyond = np.hypot(np.maximum(flat, 0), np.maximum(up, 0))
        return beyond + np.minimum(np.maximum(flat, up), 0)

    def distance(points: np.ndarray) -> np.ndarray:
        outside = rod(points, radius, -0.02, height)
        hollow = rod(points, radius - wall, height - depth, height + 1.0)
        return np.minimum(np.maximum(outside, -hollow), points[..., 2])

    return distance


def crate(sides: tuple[float, float], wall: float, depth: float, height: float) -> Distance:
    """The same for a box with these sides, hollow from its rim down by `depth`, on a plane."""

    def distance(points: np.ndarray) -> np.ndarray:
        outside = box(points, (0, 0, height / 2), (0.5 * sides[0], 0.5 * sides[1], height / 2 + 0.02))
        hollow = box(points, (0, 0, height), (0.5 * sides[0] - wall, 0.5 * sides[1] - wall, depth))
        return np.minimum(np.maximum(outside, -hollow), points[..., 2])

    return distance


def true_depth(view: View, distance: Distance, far: float = 8.0) -> np.ndarray:
    """Distance [H, W] along the rays through pixel centres, by sphere tracing; NaN where nothing is hit."""
    row, column = np.indices((view.height, view.width)) + 0.5
    rays = view.rays(column.ravel(), row.ravel())
    along = np.full(len(rays), 0.05)
    for _ in range(80):
        along = np.minimum(along + distance(view.center + along[:, None] * rays), far)
    missed = np.abs(distance(view.center + along[:, None] * rays)) > 1e-3
    return np.where(missed, np.nan, along).reshape(view.height, view.width)


def grey_of(points: np.ndarray) -> np.ndarray:
    """The texture [P] in 0..1 at points [P, 3]: values between random ones on two lattices, plain far away."""
    rng = np.random.default_rng(0)
    grids = [rng.random((n, n, n)) for n in (64, 127)]
    parts = [share * map_coordinates(grid, ((points + 1.5) / 3 * (len(grid) - 1)).T, order=1, mode="nearest")
             for share, grid in zip((0.6, 0.4), grids, strict=True)]  # fmt: skip
    return parts[0] + parts[1]


def shoot(views: list[View], distance: Distance, folder: Path) -> PosedPhotos:
    """Writes the photos of views to `folder`/images; returns them with sparse points of the surface."""
    noise = np.random.default_rng(0)
    (folder / "images").mkdir(parents=True)
    points, point_of, view_of = [], [], []
    for view in views:
        row, column = np.indices((view.height, view.width)) + 0.5
        rays = view.rays(column.ravel(), row.ravel())
        along = true_depth(view, distance).ravel()
        at = view.center + np.nan_to_num(along, nan=8.0)[:, None] * rays
        grey = grey_of(at)
        shade = np.where(np.isnan(along), 0.5, grey).reshape(view.height, view.width)
        picture = (255 * np.clip(shade, 0, 1)).astype(np.uint8)
        Image.fromarray(picture).convert("RGB").save(folder / "images" / view.name, quality=97)
        some = noise.permutation(np.flatnonzero(np.isfinite(along)))[:60]
        points.append(at[some])
    everything = np.concatenate(points)
    for number, view in enumerate(views):
        pixels, depth = view.project(everything)
        towards = everything - view.center
        length = np.linalg.norm(towards, axis=1)
        inside = (depth > 0) & (pixels > 1).all(1) & (pixels < [view.width - 1, view.height - 1]).all(1)
        clear = np.ones(len(everything), bool)
        for share in np.linspace(0.3, 0.97, 30):
            clear &= distance(view.center + share * towards) > 0.01 * length * (1 - share)
        seen = np.flatnonzero(inside & clear)
        point_of.append(seen)
        view_of.append(np.full(len(seen), number))
    sparse = Sparse(
        everything, np.full((len(everything), 3), 128, np.uint8), np.full(len(everything), 0.3),
        np.concatenate(point_of), np.concatenate(view_of),
    )  # fmt: skip
    return PosedPhotos(tuple(views), sparse)


def ring(count: int, radius: float, elevation: float, width: int, height: int, focal: float,
         target: tuple[float, float, float] = (0, 0, 0), start: int = 0) -> list[View]:  # fmt: skip
    """Cameras all around that look down at a target by so many degrees."""
    tilt, found = np.radians(elevation), []
    for k in range(count):
        turn = 2 * np.pi * (k + 0.5 * (start % 2)) / count
        away = radius * np.array([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)])
        found.append(look_at(target + away, target, name=f"{start + k:03d}.png", size=(width, height), focal=focal))
    return found
