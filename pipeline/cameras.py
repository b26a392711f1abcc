"""Posed cameras and sparse points: their files, similarity transforms, and how cameras stand about a scene."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sdfsim.base.console import plain
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_arrays, read_json, write_json

# People hold cameras level to about this; if all look one way, straight down or at a wall, nothing is known.
CAREFUL, UNKNOWN = 2.0, 90.0  # degrees
# Field of view of the longer side, degrees: from a short telephoto to a wide angle lens.
FOV_RANGE = (18.0, 110.0)


@dataclass(frozen=True)
class View:
    """One posed photo: pinhole with one radial term.

    A pixel (u, v), centres at +0.5, relates to the ray (x, y, 1) in camera axes (x right, y down, z forward) by
    u = focal (1 + k r^2) x + cx, v = focal (1 + k r^2) y + cy, r^2 = x^2 + y^2.
    """

    name: str  # prepared photo
    source: str  # the user's file name
    width: int  # px
    height: int  # px
    focal: float  # px
    cx: float  # px
    cy: float  # px
    k: float  # radial distortion
    rotation: np.ndarray  # [3, 3] world to camera
    translation: np.ndarray  # [3] world to camera, units of the reconstruction

    @property
    def center(self) -> np.ndarray:
        """[3] camera centre in the world."""
        return -self.rotation.T @ self.translation

    @property
    def fov(self) -> float:
        """Field of view of the longer side, degrees."""
        return float(2 * np.degrees(np.arctan(0.5 * max(self.width, self.height) / self.focal)))

    def straight(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Directions (x, y, 1) [P, 3] in camera axes through pixels u, v [P]."""
        xd, yd = (u - self.cx) / self.focal, (v - self.cy) / self.focal
        x, y = xd, yd
        for _ in range(8):  # Fixed point; k r^2 is a few percent, so this is far below a hundredth of a pixel.
            scale = 1 + self.k * np.clip(x * x + y * y, 0, 4)
            x, y = xd / scale, yd / scale
        return np.stack([x, y, np.ones_like(x)], -1)

    def rays(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Unit directions [P, 3] in world axes through pixels u, v [P]."""
        direction = self.straight(u, v) @ self.rotation
        return direction / np.linalg.norm(direction, axis=-1, keepdims=True)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels [P, 2] and depths [P] of world points [P, 3]; pixels are meaningless where the depth is <= 0."""
        local = points @ self.rotation.T + self.translation
        depth = local[:, 2]
        xy = local[:, :2] / np.where(np.abs(depth) < 1e-12, 1e-12, depth)[:, None]
        scale = self.focal * (1 + self.k * np.einsum("pi,pi->p", xy, xy))
        return scale[:, None] * xy + [self.cx, self.cy], depth


@dataclass(frozen=True)
class Similarity:
    """A change of scale, orientation and place: x -> scale * rotation x + translation."""

    scale: float  # > 0
    rotation: np.ndarray  # [3, 3]
    translation: np.ndarray  # [3]

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points [P, 3] or a point [3], moved."""
        return self.scale * points @ self.rotation.T + self.translation

    def after(self, first: "Similarity") -> "Similarity":
        """The product: `first`, then this one."""
        rotation = self.rotation @ first.rotation
        return Similarity(self.scale * first.scale, rotation, self.points(first.translation))

    def inverse(self) -> "Similarity":
        """The inverse transform."""
        return Similarity(1 / self.scale, self.rotation.T, -(np.asarray(self.translation) @ self.rotation) / self.scale)

    def view(self, view: View) -> View:
        """A camera, moved with its world."""
        turned = view.rotation @ self.rotation.T
        moved = self.scale * view.translation - turned @ self.translation
        return replace(view, rotation=turned, translation=moved)

    def to_dict(self) -> dict:
        """Plain values for JSON."""
        return {"scale": self.scale, "rotation": self.rotation.tolist(), "translation": self.translation.tolist()}

    @staticmethod
    def from_dict(data: dict) -> "Similarity":
        """The inverse of `to_dict`."""
        return Similarity(float(data["scale"]), np.array(data["rotation"]), np.array(data["translation"]))


@dataclass(frozen=True)
class Sparse:
    """Points of structure-from-motion."""

    xyz: np.ndarray  # [P, 3] world
    rgb: np.ndarray  # [P, 3] uint8
    error: np.ndarray  # [P] mean reprojection error, px
    point_of: np.ndarray  # [O] point index of each observation
    view_of: np.ndarray  # [O] view index of each observation


STILL = Similarity(1.0, np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class PosedPhotos:
    """Posed photos and the points that they see, in one world, with the transform from the world of
    structure-from-motion. Moving it makes a new object, so cameras and points are always in the same world."""

    views: tuple[View, ...]
    sparse: Sparse
    moved_by: Similarity = STILL  # from the world of structure-from-motion to this one

    def moved(self, move: Similarity) -> "PosedPhotos":
        """The same in another world."""
        views = tuple(move.view(view) for view in self.views)
        return PosedPhotos(views, replace(self.sparse, xyz=move.points(self.sparse.xyz)), move.after(self.moved_by))


def save_views(views: Sequence[View], path: Path) -> None:
    """Writes `cameras.json`."""
    convention = "world to camera; x right, y down, z forward"
    write_json(path, {"version": 1, "convention": convention, "views": [plain(asdict(view)) for view in views]})


def load_views(path: Path) -> list[View]:
    """The views of a poses folder, or of a file that `save_views` wrote. Raises SdfsimError if it is absent or
    damaged."""
    path = path / "cameras.json" if path.is_dir() else path
    data = read_json(path, "run the poses stage first")
    try:
        return [view_of(entry) for entry in data["views"]]
    except (ValueError, KeyError, TypeError) as error:
        raise SdfsimError(f"{path}: damaged", "run the poses stage again") from error


def view_of(entry: dict) -> View:
    """A view from plain values."""
    arrays = {key: np.array(entry[key], float) for key in ("rotation", "translation")}
    return View(**{**entry, **arrays})


def load_poses(folder: Path) -> PosedPhotos:
    """Reads the cameras and points of a poses folder. Raises SdfsimError if `cameras.json` or `sparse.npz` is not
    readable."""
    views, path = load_views(folder), folder / "sparse.npz"
    try:
        return PosedPhotos(tuple(views), Sparse(**read_arrays(path, "sparse points", "run the poses stage again")))
    except TypeError as error:
        raise SdfsimError(f"{path}: damaged: {error}", "run the poses stage again") from error


def frame_of(normal: np.ndarray) -> np.ndarray:
    """A right-handed rotation [..., 3, 3] whose last row is a unit normal [..., 3]."""
    side = np.cross(normal, np.eye(3)[np.abs(normal).argmin(-1)])
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    return np.stack([side, np.cross(normal, side), normal], -2)


def nearest_to_axes(centers: np.ndarray, axes: np.ndarray, anchor: np.ndarray | None = None) -> np.ndarray:
    """The point [3] nearest to all lines through `centers` [N, 3] along unit `axes` [N, 3], by least squares; a weak
    pull to an `anchor` [3] fixes the depth if the lines are nearly parallel."""
    projector = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    matrix, right = projector.sum(0), (projector @ centers[:, :, None]).sum(0)[:, 0]
    weight = 1e-6 if anchor is None else 0.02
    pull = centers.mean(0) + axes.mean(0) if anchor is None else anchor
    matrix = matrix + weight * len(centers) * np.eye(3)
    return np.linalg.solve(matrix, right + weight * len(centers) * pull)


class Up(NamedTuple):
    """Up: a unit vector [3], its source, and its uncertainty in degrees."""

    direction: np.ndarray
    source: str
    within: float


def camera_up(views: Sequence[View]) -> Up:
    """Up from the cameras alone: people hold cameras level, so it is the direction with the least spread of their right
    axes; if these do not span a plane, the mean image up."""
    right = np.array([v.rotation[0] for v in views])
    mean, view = -np.mean([v.rotation[1] for v in views], axis=0), np.mean([v.rotation[2] for v in views], axis=0)
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    # Cameras that look straight down have no image up, and those that look ahead no view down.
    side = vectors[:, 0] @ (mean - view)
    if np.linalg.norm(mean) < 0.5 and np.linalg.norm(view) > 0.9:  # nobody turns a camera about before a wall
        return Up(-view / np.linalg.norm(view), "cameras", 3 * CAREFUL)
    if values[1] < 0.05 or values[0] > 0.3 * values[1] or abs(side) < 0.3:
        return Up(mean / (np.linalg.norm(mean) + 1e-12), "cameras", UNKNOWN)
    up = vectors[:, 0] * np.sign(side)
    # The less the right axes fan out, the more a roll of each camera tilts the result.
    return Up(up, "cameras", float(np.hypot(CAREFUL, np.degrees(np.sqrt(max(values[0], 0) / values[1])))))


def focus(views: Sequence[View], middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Point [3] that the cameras look at, and unit directions [N, 3] from them to it. Where their axes are parallel
    they cross nowhere: then the `middle` [3] of what they see decides."""
    centers = np.array([v.center for v in views])
    point = nearest_to_axes(centers, np.array([v.rotation[2] for v in views]), middle)
    rays = point - centers
    return point, rays / (np.linalg.norm(rays, axis=1, keepdims=True) + 1e-12)


def triangulation_angle(views: Sequence[View], sparse: Sparse) -> float:
    """Median over the points of the largest angle (degrees) between two lines on which photos see a point; 0 without
    points."""
    if not len(sparse.point_of):
        return 0.0
    rays = np.array([view.center for view in views])[sparse.view_of] - sparse.xyz[sparse.point_of]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True) + 1e-12
    order = np.argsort(sparse.point_of, kind="stable")
    groups = np.split(rays[order], np.flatnonzero(np.diff(sparse.point_of[order])) + 1)
    least = np.median([(group @ group.T).min() for group in groups])
    return float(np.degrees(np.arccos(np.clip(least, -1, 1))))


def view_span(views: list[View], middle: np.ndarray) -> float:
    """Degrees around the scene's upright axis that the cameras cover: 360 minus the largest gap. The `middle` [3] is
    that of what they see."""
    rays, up = focus(views, middle)[1], camera_up(views).direction
    flat = rays - np.outer(rays @ up, up)
    level = np.linalg.norm(flat, axis=1) > 0.1  # a photo from straight above has no side
    if level.sum() < 2:
        return 0.0
    east, north, _ = frame_of(up)
    angle = np.sort(np.degrees(np.arctan2(flat[level] @ north, flat[level] @ east)))
    return 360.0 - float(np.diff(np.append(angle, angle[0] + 360)).max())
