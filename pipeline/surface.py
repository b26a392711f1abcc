"""Field -> meshes: a closed solid for physics, and the part of its surface that the photos show, with colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from pipeline.cameras import View
from pipeline.cleaning import drop_small, face_normals, keep_faces, vertex_normals
from pipeline.field import GridField
from sdfsim.errors import EXIT_QUALITY, SdfsimError
from sdfsim.shape.mesh import Mesh

Progress = Callable[[float, str], None]

# The solid ends at this radius of normalised space: beyond it the field was never trained.
RIM = 0.99
MIN_SEEN = 2
# Farther than this from every point of structure-from-motion (normalised units) a surface is a guess: on the rendered
# set the median error there is ten times that within.
MAX_FROM_POINTS = 0.1
# A component smaller than this share of all the surface is a floater.
FLOATER = 0.01
PRESET_RESOLUTION = {"quick": 192, "standard": 288, "fine": 448}


@dataclass(frozen=True)
class Surface:
    """What was extracted, in normalised space.

    Attributes:
        solid: closed mesh; where the solid leaves the unit sphere it is capped there.
        shown: the part of it that at least two photos show, with colours.
        report: counts of what was dropped, and why.
    """

    solid: Mesh
    shown: Mesh
    report: dict


def sample_volume(
    sdf: Callable[[np.ndarray], np.ndarray], resolution: int, *, extent: float = 1.02,
    coarse: int = 4, on_progress: Progress | None = None,
) -> np.ndarray:  # fmt: skip
    """SDF values [n, n, n] (x, y, z order) over [-extent, extent]^3, fine only near the surface.

    Evaluates every `coarse`-th point first and all points only in blocks that can hold the surface, since an SDF
    changes by no more than the distance moved (a factor of 2 is left for fields that are not quite SDFs). Elsewhere
    values are interpolated.

    Args:
        sdf: distance [P] at points [P, 3], float32.
        resolution: n, rounded up to a multiple of `coarse` plus 1.
        extent: half the side.
        coarse: see above.
        on_progress: called with (fraction, message).
    """
    blocks = -(-(resolution - 1) // coarse)
    n = blocks * coarse + 1
    line = np.linspace(-extent, extent, n, dtype=np.float32)
    knots = line[::coarse]
    grid = np.stack(np.meshgrid(knots, knots, knots, indexing="ij"), -1).reshape(-1, 3)
    values = np.concatenate([sdf(part) for part in np.array_split(grid, max(1, len(grid) >> 17))])
    values = values.reshape(blocks + 1, blocks + 1, blocks + 1)
    from scipy.ndimage import zoom

    volume = np.asarray(zoom(values, n / (blocks + 1), order=1, grid_mode=False, mode="nearest"), np.float32)
    reach = 2.0 * np.sqrt(3) * (knots[1] - knots[0])
    corners = np.stack(
        [values[a : a + blocks, b : b + blocks, c : c + blocks] for a in (0, 1) for b in (0, 1) for c in (0, 1)]
    )
    low, high = corners.min(0), corners.max(0)
    near = np.argwhere((np.abs(corners).min(0) < reach) | (low * high < 0))
    step = np.arange(coarse + 1)
    local = np.stack(np.meshgrid(step, step, step, indexing="ij"), -1).reshape(1, -1, 3)
    parts = np.array_split(near, max(1, len(near) * local.shape[1] >> 17))
    for number, part in enumerate(parts):
        index = (part[:, None] * coarse + local).reshape(-1, 3)
        volume[tuple(index.T)] = sdf(line[index])
        if on_progress and number % 4 == 0:
            on_progress((number + 1) / len(parts), f"sampling the field, {number + 1} of {len(parts)} parts")
    return volume


def marching_cubes(volume: np.ndarray, extent: float) -> Mesh:
    """Zero surface of SDF values [n, n, n] over [-extent, extent]^3, faces counter-clockwise from outside.

    Raises:
        SdfsimError: (exit code 3) the values have one sign everywhere.
    """
    if not volume.min() < 0 < volume.max():
        raise SdfsimError("mesh: the field holds no surface", "try --preset standard", exit_code=EXIT_QUALITY)
    from skimage.measure import marching_cubes as cubes

    # A surface through a grid point makes several vertices in one place; merged later, they would pinch a closed mesh.
    least = 0.02 * 2 * extent / (volume.shape[0] - 1)
    volume = np.where(np.abs(volume) < least, np.where(volume < 0, -least, least), volume)
    vertices, faces, _, _ = cubes(volume, 0.0)
    vertices = vertices * (2 * extent / (volume.shape[0] - 1)) - extent
    return Mesh(vertices.astype(np.float64), faces.astype(np.int64))


class Visibility:
    """Which vertices of a mesh which views see.

    Args:
        mesh: what can stand in the way.
        views: cameras in the space of the mesh.
        offset: how far along its normal a vertex is lifted before looking from it.
    """

    def __init__(self, mesh: Mesh, views: list[View], offset: float) -> None:
        import open3d as o3d

        self.mesh, self.views = mesh, views
        self._tensor: Any = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(mesh.vertices.astype(np.float32)), self._tensor(mesh.faces.astype(np.uint32))
        )
        self.normals = vertex_normals(mesh)
        self._from = mesh.vertices + offset * self.normals

    def of_view(self, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices [S] that a view sees, their pixels [S, 2], and the cosines [S] between normal and line of sight."""
        pixels, depth = view.project(self.mesh.vertices)
        towards = view.center - self.mesh.vertices
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        cosine = (towards * self.normals).sum(1)
        inside = (depth > 0) & (pixels > 1).all(1) & (pixels < [view.width - 1, view.height - 1]).all(1)
        index = np.flatnonzero(inside & (cosine > 0.08))
        ray = np.concatenate([self._from[index], view.center - self._from[index]], 1).astype(np.float32)
        blocked = self._scene.test_occlusions(self._tensor(ray), tnear=0.0, tfar=1.0).numpy()
        index = index[~blocked]
        return index, pixels[index], cosine[index]


def look(
    solid: Mesh, views: list[View], photos_folder: Path, offset: float, on_progress: Progress | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How many views see each vertex of a mesh, and its colour in the photos.

    Returns:
        Views that see it [V], colour [V, 3] float in 0..255 (mean over photos, weighted towards those that look
        straight at it), and the weight behind the colour [V] (0: no photo shows it).
    """
    sight = Visibility(solid, views, offset)
    count = np.zeros(len(solid.vertices), np.int32)
    color, weight = np.zeros((len(solid.vertices), 3)), np.zeros(len(solid.vertices))
    for number, view in enumerate(views):
        index, pixels, cosine = sight.of_view(view)
        count[index] += 1
        with Image.open(Path(photos_folder) / "images" / view.name) as image:
            photo = np.asarray(image.convert("RGB"), np.float32)
        share = cosine**2 / np.linalg.norm(view.center - solid.vertices[index], axis=1) ** 2
        color[index] += share[:, None] * bilinear(photo, pixels - 0.5)
        weight[index] += share
        if on_progress:
            on_progress((number + 1) / len(views), f"looking from photo {number + 1} of {len(views)}")
    return count, color / np.maximum(weight, 1e-12)[:, None], weight


def bilinear(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values [P, C] of an image [H, W, C] at pixel positions [P, 2] (column, row; centres at whole numbers)."""
    limit = np.array([image.shape[1] - 2, image.shape[0] - 2])
    low = np.clip(np.floor(at).astype(int), 0, limit)
    part = np.clip(at - low, 0, 1)
    (x, y), (u, v) = low.T, part.T[..., None]
    top = image[y, x] * (1 - u) + image[y, x + 1] * u
    return top * (1 - v) + (image[y + 1, x] * (1 - u) + image[y + 1, x + 1] * u) * v


def trusted_vertices(mesh: Mesh, count: np.ndarray, cell: float) -> np.ndarray:
    """Vertices [V] that enough views see and that are not on the cap of the unit sphere; small gaps are closed."""
    on_cap = np.linalg.norm(mesh.vertices, axis=1) > RIM - 1.5 * cell
    trusted = (count >= MIN_SEEN) & ~on_cap
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    degree = np.maximum(np.bincount(edges[:, 0], minlength=len(trusted)), 1)
    for _ in range(4):
        neighbours = np.bincount(edges[:, 0], trusted[edges[:, 1]], minlength=len(trusted))
        trusted |= (neighbours > 0.6 * degree) & ~on_cap
    return trusted


def extract(
    field: GridField, views: list[View], points: np.ndarray, photos_folder: Path, *, resolution: int = 192,
    on_progress: Progress | None = None,
) -> Surface:  # fmt: skip
    """Extracts the solid and its visible surface from a trained field.

    Args:
        field: trained.
        views: cameras in normalised space.
        points: [P, 3] sparse points in normalised space.
        photos_folder: of the photos stage.
        resolution: grid points a side over the unit sphere.
        on_progress: called with (fraction, message).

    Raises:
        SdfsimError: (exit code 3) the field has no surface, or hardly any of it is in the photos.
    """

    def tell(start: float, share: float) -> Progress:
        return lambda fraction, message: on_progress(start + share * fraction, message) if on_progress else None

    @torch.no_grad()
    def solid_sdf(points: np.ndarray) -> np.ndarray:
        inner = field.sdf(torch.from_numpy(np.ascontiguousarray(points))).numpy()
        return np.maximum(inner, np.linalg.norm(points, axis=1) - RIM)

    extent = 1.02
    volume = sample_volume(solid_sdf, resolution, extent=extent, on_progress=tell(0.0, 0.5))
    cell = 2 * extent / (volume.shape[0] - 1)
    raw = marching_cubes(volume, extent)
    count, color, weight = look(raw, views, photos_folder, 0.75 * cell, tell(0.5, 0.45))
    from scipy.spatial import KDTree

    far = KDTree(points).query(raw.vertices, distance_upper_bound=MAX_FROM_POINTS)[0] > MAX_FROM_POINTS
    shown_at_all = trusted_vertices(raw, count, cell)
    trusted = shown_at_all & ~far
    seen = trusted[raw.faces].sum(1) >= 2
    solid, kept, solid_counts = drop_small(raw, seen, FLOATER / 4)
    rgb = np.where(weight[:, None] > 0, color, 255 * field_colors(field, raw))
    shown = keep_faces(Mesh(raw.vertices, raw.faces, np.clip(rgb + 0.5, 0, 255).astype(np.uint8)), seen & kept)
    if len(shown.faces) < 100:
        raise SdfsimError(
            "mesh: hardly any of the surface is visible in the photos", "check the poses; try --preset standard",
            exit_code=EXIT_QUALITY,
        )  # fmt: skip
    shown, _, shown_counts = drop_small(shown, None, FLOATER)
    report = {
        "resolution": volume.shape[0], "cell": cell, "solid_faces": len(solid.faces), "shown_faces": len(shown.faces),
        "solid": solid_counts, "shown": {**shown_counts, "smallest_share_kept": FLOATER},
        "dropped_far_from_points_share": round(float((shown_at_all & far).sum() / max(shown_at_all.sum(), 1)), 4),
        "unseen_share": round(float(1 - face_normals(shown)[1].sum() / face_normals(solid)[1].sum()), 4),
    }  # fmt: skip
    if on_progress:
        on_progress(1.0, f"{len(shown.faces)} faces")
    return Surface(solid, shown, report)


@torch.no_grad()
def field_colors(field: GridField, mesh: Mesh) -> np.ndarray:
    """The field's colour [V, 3] in 0..1 of each vertex, seen straight on."""
    points = torch.tensor(mesh.vertices, dtype=torch.float32)
    against = -torch.tensor(vertex_normals(mesh), dtype=torch.float32)
    parts = []
    for p, d in zip(points.split(1 << 16), against.split(1 << 16), strict=True):
        _, geometry, features = field.geometry_at(p)
        parts.append(field.color_of(geometry, features, d))
    return torch.cat(parts).numpy()
