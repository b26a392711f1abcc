"""Visibility of surface points in photos, or from straight above, and their colours."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree

from pipeline.cameras import View
from pipeline.inputs.photos import open_photo
from sdfsim.base.parallel import Progress, silent
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, vertex_normals

# Cosines between normal and line of sight. At a flatter angle than 85 degrees a point does not count as seen; from 70
# degrees on a photo helps.
FLATTEST, FAIR = 0.08, 0.35


@dataclass(frozen=True)
class PhotoColors:
    """The photos' colours of some points."""

    count: np.ndarray  # [V] number of views that see each
    # [V, 3] float in 0..255, the mean over photos, weighted by viewing angle and nearness
    color: np.ndarray
    weight: np.ndarray  # [V] total weight of the colour; 0: no photo shows the point


def heights(mesh: Mesh, at: np.ndarray) -> np.ndarray:
    """Heights [...] m of a mesh's topmost surface over the points `at` [..., 2] m; NaN where no surface is."""
    top = float(mesh.vertices[:, 2].max() + 0.1 * np.ptp(mesh.vertices, axis=0).max())
    origin = np.insert(at.reshape(-1, 2), 2, top, axis=1)
    distance, _ = Caster(mesh).hits(origin, np.broadcast_to([0.0, 0.0, -1.0], origin.shape))
    return np.where(np.isfinite(distance), top - distance, np.nan).reshape(at.shape[:-1])


class Visibility:
    """The visibility of a mesh's vertices in views; vertices are lifted by `offset` along their normals, and `blocking`
    (or the mesh itself) occludes them."""

    def __init__(self, mesh: Mesh, offset: float, blocking: Caster | None = None) -> None:
        self.vertices, self.normals = mesh.vertices, vertex_normals(mesh)
        self._from = mesh.vertices + offset * self.normals
        self._blocking = blocking or Caster(mesh)

    def at(self, index: np.ndarray) -> "Visibility":
        """The same for some of the vertices [S]."""
        part = copy(self)
        part.vertices, part.normals, part._from = self.vertices[index], self.normals[index], self._from[index]
        return part

    def of_view(self, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices [S] that a view sees, their pixels [S, 2], and the cosines [S] between normal and line of sight."""
        pixels, inside = framed(view, self.vertices)
        index, cosine = self.of_place(view.center, inside)
        return index, pixels[index], cosine

    def of_place(self, place: np.ndarray, among: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Vertices [S], of those `among` [V] bool, in sight of a place [3], and cosines [S] as in `of_view`."""
        towards = place - self.vertices
        cosine = np.einsum("vi,vi->v", towards, self.normals) / np.sqrt(np.einsum("vi,vi->v", towards, towards))
        index = np.flatnonzero(among & (cosine > FLATTEST))
        index = index[~self._blocking.blocked(self._from[index], place)]
        return index, cosine[index]


def framed(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [P, 2] of points [P, 3], and whether they lie within the picture [P]."""
    pixels, depth = view.project(points)
    u, v = pixels.T
    return pixels, (depth > 0) & (u > 1) & (v > 1) & (u < view.width - 1) & (v < view.height - 1)


def look(sight: Visibility, views: Sequence[View], photos_folder: Path, on_progress: Progress = silent) -> PhotoColors:
    """The number of views that see each vertex, and its colour in their photos."""
    vertices = sight.vertices
    count = np.zeros(len(vertices), np.int32)
    color, weight = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for number, view in enumerate(views):
        index, pixels, cosine = sight.of_view(view)
        count[index] += 1
        photo = np.asarray(open_photo(photos_folder, view), np.float32)
        share = cosine**2 / np.linalg.norm(view.center - vertices[index], axis=1) ** 2
        color[index] += share[:, None] * bilinear(photo, pixels - 0.5)
        weight[index] += share
        on_progress((number + 1) / len(views), f"looking from photo {number + 1} of {len(views)}")
    return PhotoColors(count, color / np.maximum(weight, 1e-12)[:, None], weight)


def bilinear(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values [P, C] of an image [H, W, C] at pixel positions [P, 2] (column, row; centres at whole numbers)."""
    channels = [map_coordinates(image[..., c], at.T[::-1], order=1, mode="nearest") for c in range(image.shape[2])]
    return np.stack(channels, -1)


def spread_colors(points: np.ndarray, known: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Colours [P, C] at points [P, 3] from known ones [K, 3] with colours [K, C]: inverse-distance mean of the nearest.
    Points that no photo shows, such as the place where a body stood, get the colours around them."""
    nearest = min(8, len(known))
    away, index = KDTree(known).query(points, k=nearest)
    away, index = away.reshape(len(points), nearest), index.reshape(len(points), nearest)
    share = 1 / np.maximum(away, 1e-9)
    return (colors[index] * share[..., None]).sum(1) / share.sum(1, keepdims=True)


def to_bytes(color: np.ndarray) -> np.ndarray:
    """Colours [..., 3] in 0..255 as bytes."""
    return np.clip(color + 0.5, 0, 255).astype(np.uint8)
