"""Field -> meshes: a closed solid for physics, and the part of its surface that the photos show, with colours."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from pipeline.cameras import View
from pipeline.cleaning import Piece, face_normals, islands, judge, keep_faces, vertex_normals
from pipeline.field import Field
from pipeline.visibility import Visibility, look, to_bytes
from pipeline.volume import Distance, Volume, sample_volume
from sdfsim.errors import EXIT_QUALITY, SdfsimError
from sdfsim.shape.mesh import Mesh

Progress = Callable[[float, str], None]

# The solid ends at this radius of normalised space: beyond it the field was never trained.
RIM = 0.99
EXTENT = 1.02
MIN_SEEN = 2
# Farther than this from every point of structure-from-motion (normalised units) a surface is a guess: on the rendered
# set the median error there is ten times that within.
MAX_FROM_POINTS = 0.1
# A patch of the visible surface smaller than this share of it says nothing; of the closed solid a quarter of that.
FLOATER = 0.01
# What is left out is named from this size on, normalised units.
SPECK = 0.02
PRESET_RESOLUTION = {"quick": 192, "standard": 288, "fine": 448, "paper": 448}


@dataclass(frozen=True)
class Surface:
    """What was extracted, in normalised space.

    Attributes:
        volume: the signed distance it comes from.
        raw: all of the closed surface, with colours.
        seen: [V] bool, vertices of it that photos show well enough.
        kept: [F] bool, faces of it that belong.
        shown: [F] bool, faces of it that belong and that photos show.
        pieces: components that do not belong.
        report: counts of what was left out, and why.
    """

    volume: Volume
    raw: Mesh
    seen: np.ndarray
    kept: np.ndarray
    shown: np.ndarray
    pieces: tuple[Piece, ...]
    report: dict

    @property
    def visible(self) -> Mesh:
        """What photos show, an open mesh with colours."""
        return keep_faces(self.raw, self.shown)

    @property
    def solid(self) -> Mesh:
        """The closed surface of what belongs."""
        return keep_faces(self.raw, self.kept)

    @property
    def reaches_rim(self) -> bool:
        """Whether what belongs goes on beyond the trained space."""
        return bool((ball(self.solid.vertices) > -2 * self.volume.cell).any())


def ball(points: np.ndarray) -> np.ndarray:
    """Distance [P] from the ball that the field was trained in, at points [P, 3]."""
    return np.linalg.norm(points, axis=1) - RIM


def field_distance(field: Field) -> Distance:
    """The field's signed distance as a function of points [P, 3] float in normalised space."""

    @torch.no_grad()
    def distance(points: np.ndarray) -> np.ndarray:
        there = torch.from_numpy(np.ascontiguousarray(points, np.float32)).to(field.background.device)
        return field.sdf(there).cpu().numpy()

    return distance


def trusted_vertices(mesh: Mesh, count: np.ndarray, at_limit: np.ndarray) -> np.ndarray:
    """Vertices [V] that enough views see and that are not where the solid was cut off; small gaps are closed.

    Args:
        mesh: closed.
        count: [V] how many views see each.
        at_limit: [V] bool, vertices where the solid was cut off.
    """
    trusted = (count >= MIN_SEEN) & ~at_limit
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    degree = np.maximum(np.bincount(edges[:, 0], minlength=len(trusted)), 1)
    for _ in range(4):
        neighbours = np.bincount(edges[:, 0], trusted[edges[:, 1]], minlength=len(trusted))
        trusted |= (neighbours > 0.6 * degree) & ~at_limit
    return trusted


def extract(
    field: Field, views: list[View], points: np.ndarray, photos_folder: Path, *, resolution: int = 192,
    on_progress: Progress | None = None,
) -> Surface:  # fmt: skip
    """Extracts the solid and its visible surface from a trained field.

    Args:
        field: trained.
        views: cameras in normalised space.
        points: [P, 3] sparse points in normalised space.
        photos_folder: of the photos stage.
        resolution: samples a side over the unit sphere.
        on_progress: called with (fraction, message).

    Raises:
        SdfsimError: (exit code 3) the field has no surface, or hardly any of it is in the photos.
    """

    def tell(start: float, share: float) -> Progress:
        return lambda fraction, message: on_progress(start + share * fraction, message) if on_progress else None

    inner = field_distance(field)
    volume = sample_volume(
        lambda p: np.maximum(inner(p), ball(p)), resolution, extent=EXTENT, on_progress=tell(0.0, 0.5)
    )
    return of_volume(volume, field, views, points, photos_folder, ball, on_progress=tell(0.5, 0.5))


def of_volume(
    volume: Volume, field: Field, views: list[View], points: np.ndarray, photos_folder: Path, limit: Distance, *,
    keep: Collection[str] = (), on_progress: Progress | None = None,
) -> Surface:  # fmt: skip
    """The surface of a volume already sampled.

    Args:
        volume: within `limit`.
        field, views, points, photos_folder, on_progress: see `extract`.
        limit: distance [P] from the body that the solid was cut off at.
        keep: names of pieces to keep, see `judge`.
    """
    from scipy.spatial import KDTree

    raw = volume.mesh()
    cell = volume.cell
    found = look(Visibility(raw, 0.75 * cell), views, photos_folder, on_progress)
    far = KDTree(points).query(raw.vertices, distance_upper_bound=MAX_FROM_POINTS)[0] > MAX_FROM_POINTS
    shown_at_all = trusted_vertices(raw, found.count, np.abs(limit(raw.vertices)) < 1.5 * cell)
    seen = shown_at_all & ~far
    faces_seen = seen[raw.faces].sum(1) >= 2
    judged = judge(raw, faces_seen, FLOATER / 4, SPECK, keep)
    shown = islands(raw, faces_seen & judged.kept, FLOATER)
    if shown.sum() < 100:
        raise SdfsimError(
            "mesh: hardly any of the surface is visible in the photos", "check the poses; try --preset standard",
            exit_code=EXIT_QUALITY,
        )  # fmt: skip
    rgb = np.where(found.weight[:, None] > 0, found.color, 255 * field_colors(field, raw))
    area = face_normals(raw)[1]
    report = {
        "resolution": max(volume.values.shape), "cell": cell, "solid_faces": int(judged.kept.sum()),
        "shown_faces": int(shown.sum()), "solid": {**judged.counts, "smallest_share_kept": FLOATER / 4},
        "dropped_far_from_points_share": round(float((shown_at_all & far).sum() / max(shown_at_all.sum(), 1)), 4),
        "unseen_share": round(float(1 - area[shown].sum() / area[judged.kept].sum()), 4),
    }  # fmt: skip
    return Surface(volume, replace(raw, colors=to_bytes(rgb)), seen, judged.kept, shown, judged.pieces, report)


@torch.no_grad()
def field_colors(field: Field, mesh: Mesh) -> np.ndarray:
    """The field's colour [V, 3] in 0..1 of each vertex, seen straight on."""
    device = field.background.device
    points = torch.tensor(mesh.vertices, dtype=torch.float32, device=device)
    against = -torch.tensor(vertex_normals(mesh), dtype=torch.float32, device=device)
    parts = []
    for p, d in zip(points.split(1 << 16), against.split(1 << 16), strict=True):
        _, geometry, features = field.geometry_at(p)
        parts.append(field.color_of(geometry, features, d))
    return torch.cat(parts).cpu().numpy()
