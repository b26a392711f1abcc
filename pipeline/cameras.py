"""Posed cameras: intrinsics, poses, rays; and the file they live in."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from pipeline.sfm.supervision import camera_up, nearest_to_axes
from sdfsim.errors import SdfsimError
from sdfsim.files import read_arrays, read_json, write_json


@dataclass(frozen=True)
class View:
    """One posed photo: pinhole with one radial term.

    A pixel (u, v), centres at +0.5, relates to the ray (x, y, 1) in camera axes (x right, y down, z forward) by
    u = focal (1 + k r^2) x + cx, v = focal (1 + k r^2) y + cy, r^2 = x^2 + y^2.

    Attributes:
        name: prepared photo.
        source: the user's file name.
        width: px.
        height: px.
        focal: px.
        cx: px.
        cy: px.
        k: radial distortion.
        rotation: [3, 3] world to camera.
        translation: [3] world to camera, units of the reconstruction.
    """

    name: str
    source: str
    width: int
    height: int
    focal: float
    cx: float
    cy: float
    k: float
    rotation: np.ndarray
    translation: np.ndarray

    @property
    def center(self) -> np.ndarray:
        """[3] camera centre in the world."""
        return -self.rotation.T @ self.translation

    @property
    def fov(self) -> float:
        """Field of view of the longer side, degrees."""
        return float(2 * np.degrees(np.arctan(0.5 * max(self.width, self.height) / self.focal)))

    def rays(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Unit directions [P, 3] in world axes through pixels u, v [P]."""
        xd, yd = (u - self.cx) / self.focal, (v - self.cy) / self.focal
        x, y = xd.copy(), yd.copy()
        for _ in range(8):  # Fixed point; k r^2 is a few percent, so this is far below a hundredth of a pixel.
            scale = 1 + self.k * np.clip(x * x + y * y, 0, 4)
            x, y = xd / scale, yd / scale
        direction = np.stack([x, y, np.ones_like(x)], -1) @ self.rotation
        return direction / np.linalg.norm(direction, axis=-1, keepdims=True)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels [P, 2] and depths [P] of world points [P, 3]; pixels mean nothing where the depth is <= 0."""
        local = points @ self.rotation.T + self.translation
        depth = local[:, 2]
        xy = local[:, :2] / np.where(np.abs(depth) < 1e-12, 1e-12, depth)[:, None]
        scale = self.focal * (1 + self.k * (xy**2).sum(1, keepdims=True))
        return scale * xy + [self.cx, self.cy], depth

    def transformed(self, scale: float, rotation: np.ndarray, translation: np.ndarray) -> View:
        """The view after the world moved by x -> scale R x + t."""
        turned = self.rotation @ rotation.T
        moved = scale * self.translation - turned @ translation
        return View(**{**self.__dict__, "rotation": turned, "translation": moved})


@dataclass(frozen=True)
class Sparse:
    """Points of structure-from-motion.

    Attributes:
        xyz: [P, 3] world.
        rgb: [P, 3] uint8.
        error: [P] mean reprojection error, px.
        point_of: [O] point index of each observation.
        view_of: [O] view index of each observation.
    """

    xyz: np.ndarray
    rgb: np.ndarray
    error: np.ndarray
    point_of: np.ndarray
    view_of: np.ndarray


def save_views(views: list[View], path: Path) -> None:
    """Writes `cameras.json`."""
    entries = [
        {**asdict(v), "rotation": np.asarray(v.rotation).tolist(), "translation": np.asarray(v.translation).tolist()}
        for v in views
    ]
    data = {"version": 1, "convention": "world to camera; x right, y down, z forward", "views": entries}
    write_json(path, data)


def load_views(folder: Path) -> list[View]:
    """Reads the views of a poses folder.

    Raises:
        SdfsimError: no readable `cameras.json`.
    """
    return load_view_file(Path(folder) / "cameras.json")


def load_view_file(path: Path) -> list[View]:
    """Reads the views that `save_views` wrote to a file.

    Raises:
        SdfsimError: it is absent or damaged.
    """
    data = read_json(path, "run the poses stage first")
    try:
        return [
            View(**{**v, "rotation": np.array(v["rotation"], float), "translation": np.array(v["translation"], float)})
            for v in data["views"]
        ]
    except (ValueError, KeyError, TypeError) as error:
        raise SdfsimError(f"{path}: damaged", "run the poses stage again") from error


def load_sparse(folder: Path) -> Sparse:
    """Reads the sparse points of a poses folder.

    Raises:
        SdfsimError: no readable `sparse.npz`.
    """
    path = Path(folder) / "sparse.npz"
    data = read_arrays(path, "sparse points", "run the poses stage again")
    try:
        return Sparse(**{key: data[key] for key in ("xyz", "rgb", "error", "point_of", "view_of")})
    except KeyError as error:
        raise SdfsimError(f"{path}: damaged: no {error}", "run the poses stage again") from error


def focus(views: list[View]) -> tuple[np.ndarray, np.ndarray]:
    """Point [3] that the cameras look at, and unit directions [N, 3] from them to it."""
    centers = np.array([v.center for v in views])
    point = nearest_to_axes(centers, np.array([v.rotation[2] for v in views]))
    rays = point - centers
    return point, rays / (np.linalg.norm(rays, axis=1, keepdims=True) + 1e-12)


def spread_angle(views: list[View]) -> float:
    """Largest angle (degrees) between viewing rays to the centre of what the cameras look at."""
    rays = focus(views)[1]
    return float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))


def view_span(views: list[View]) -> float:
    """Degrees around the scene's upright axis from which it was photographed: 360 less the largest gap."""
    rays, up = focus(views)[1], camera_up(views).normal
    flat = rays - np.outer(rays @ up, up)
    level = np.linalg.norm(flat, axis=1) > 0.1  # a photo from straight above has no side
    if level.sum() < 2:
        return 0.0
    east = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    angle = np.sort(np.degrees(np.arctan2(flat[level] @ np.cross(up, east), flat[level] @ east)))
    return 360.0 - float(np.diff(np.append(angle, angle[0] + 360)).max())
