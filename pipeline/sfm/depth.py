"""Depth of the photos' pixels as points in the world of the poses, and how it agrees with what the photos say."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.cameras import Sparse, View
from pipeline.inputs.photos import Photo
from sdfsim.errors import SdfsimError

APART = 0.2  # A scale that differs by more than this share means other units, or another photo's depth.
USUAL = 0.01  # share by which a phone's depth is off, where nothing tells better
FEWEST = 50  # sparse points on pixels with depth that the scale needs


@dataclass(frozen=True)
class DepthPoints:
    """Pixels with depth."""

    xyz: np.ndarray  # [P, 3] in the world of the poses, as far away as the sensor says
    pixel: np.ndarray  # [P, 2] where the straight photo shows them
    view: np.ndarray  # [P] index of the view


def depth_points(views: list[View], photos: list[Photo], folder: Path, *, scale: float = 1.0) -> DepthPoints:
    """All pixels with depth, times `scale`, in the world of the poses, whose unit is the metre as far as the cameras
    know. Raises SdfsimError where a file of the photos stage is missing."""
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


def depth_scale(views: list[View], sparse: Sparse, points: DepthPoints) -> dict[str, float]:
    """Compares depth with the triangulated points that lie on the same pixels.

    Returns `scale`, the factor of the depth that makes both agree; `spread`, the median share by which a pixel differs
    after that; `points`, how many were compared: with fewer than `FEWEST` the depth is taken as it is. Raises
    SdfsimError where they differ by more than `APART`, so that the depth cannot be that of these photos in metres.
    """
    from scipy.spatial import KDTree

    ratios = []
    for number, view in enumerate(views):
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
        raise SdfsimError(
            f"depth: the cameras say {scale:.3g} times as far as the depth does",
            "give the unit of the depth (depth_unit_scale_factor, metres a count), or leave the depth out",
        )
    return {"scale": scale, "spread": float(np.median(np.abs(ratio / scale - 1))), "points": len(ratio)}
