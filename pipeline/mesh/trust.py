"""How far each place of a surface can be trusted: how many photos see it, and how exactly they tell where it is.

A photo tells where a point is across its line of sight, to about a pixel, and nothing along it. Lines of sight from
several directions together tell the rest. What fewer than two photos see is a guess of the field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.cameras import View
from pipeline.mesh.visibility import Visibility
from sdfsim.shape.mesh import Mesh, face_normals

FEW = 3  # photos: what fewer see is weak
PARALLEL = 1e-12  # of lines of sight: least determinant of their information, with its trace as unit
# Colours from the surest to the least sure place (anchors of viridis), and of what is guessed.
SCALE = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], float)
GUESSED = np.array([255.0, 45, 45])


@dataclass(frozen=True)
class Support:
    """What photos tell of the places of some points."""

    vertices: np.ndarray  # [V, 3] m, the points
    normals: np.ndarray  # [V, 3] unit, of the surface there
    views: np.ndarray  # [V] int, photos that see each
    information: np.ndarray  # [V, 3, 3] 1/m^2, see `information`; summed over these photos

    @property
    def uncertainty(self) -> np.ndarray:
        """[V] m, see `sigma_along`; infinite: guessed, as fewer than two photos see the point."""
        return np.where(self.views > 1, sigma_along(self.information, self.normals), np.inf)

    def at(self, index: np.ndarray) -> Support:
        """The same of some of the points."""
        return Support(self.vertices[index], self.normals[index], self.views[index], self.information[index])

    def nearest(self, points: np.ndarray) -> Support:
        """That of the nearest vertex to each of other points [P, 3] m."""
        from scipy.spatial import KDTree

        return self.at(np.asarray(KDTree(self.vertices).query(points)[1]))

    def attributes(self) -> dict[str, np.ndarray]:
        """What a mesh file holds of it: `views` [V] int32 and `uncertainty` [V] float32 m."""
        return {"views": self.views.astype(np.int32), "uncertainty": self.uncertainty.astype(np.float32)}


def information(view: View, points: np.ndarray) -> np.ndarray:
    """How exactly one photo tells where points [P, 3] in front of it are: the inverse [P, 3, 3] of the covariance of
    the place, in 1 / (unit of the points)^2, of rank two.

    The photo is taken to be off by a standard deviation of 1 px on both axes, its camera to be exact: J^T J of the
    projection's Jacobian J (Hartley and Zisserman, Multiple View Geometry, 5.2). Lens distortion is left out.
    """
    local = points @ view.rotation.T + view.translation
    depth = local[:, 2, None, None]
    rows = view.focal / depth * (view.rotation[:2] - local[:, :2, None] / depth * view.rotation[2])
    return np.einsum("pki,pkj->pij", rows, rows)


def sigma_along(information: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Standard deviation [P] of places along unit directions [P, 3], from information [P, 3, 3]; else infinite."""
    a, b, c = np.moveaxis(information, 1, 0)
    crossed = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], 1)  # the inverse, times the determinant
    size = np.einsum("pi,pi->p", a, crossed[:, 0])
    known = size > PARALLEL * np.trace(information, axis1=1, axis2=2) ** 3
    variance = np.einsum("pi,pij,pj->p", normals, crossed, normals) / np.where(known, size, 1.0)
    return np.where(known, np.sqrt(np.maximum(variance, 0)), np.inf)


def support_of(sight: Visibility, views: Sequence[View]) -> Support:
    """What views tell of the vertices of a mesh, all in metres."""
    count = len(sight.vertices)
    seen, total = np.zeros(count, np.int64), np.zeros((count, 3, 3))
    for view in views:
        index = sight.of_view(view)[0]
        seen[index] += 1
        total[index] += information(view, sight.vertices[index])
    return Support(sight.vertices, sight.normals, seen, total)


def vertex_areas(mesh: Mesh) -> np.ndarray:
    """Area [V] m^2 of the surface that each vertex stands for: a third of its faces'."""
    area = np.repeat(face_normals(mesh)[1] / 3, 3)
    return np.bincount(mesh.faces.ravel(), area, minlength=len(mesh.vertices))


def summary(mesh: Mesh, support: Support) -> dict:
    """Of a mesh's area: `area_m2`; `seen_by`, the shares of 0, 1, 2, and 3 or more photos; `guessed`, that of fewer
    than two or of lines of sight that are parallel; `uncertainty_m`, the median of the rest, None where all is guessed.
    """
    area, uncertainty = vertex_areas(mesh), support.uncertainty
    known = np.isfinite(uncertainty)
    median = None
    if known.any():
        median = float(np.quantile(uncertainty[known], 0.5, weights=area[known], method="inverted_cdf"))
    seen_by = np.bincount(np.minimum(support.views, FEW), area, minlength=FEW + 1) / area.sum()
    return {
        "area_m2": float(area.sum()), "seen_by": [round(float(share), 4) for share in seen_by],
        "guessed": round(float(area[~known].sum() / area.sum()), 4),
        "uncertainty_m": median,
    }  # fmt: skip


def color_range(mesh: Mesh, uncertainty: np.ndarray) -> tuple[float, float]:
    """Uncertainties (m) of the first and the last colour: between them lie nine tenths of the area that is known."""
    known = np.isfinite(uncertainty)
    if not known.any():
        return 1e-3, 1e-2
    areas = vertex_areas(mesh)[known]
    low, high = np.quantile(uncertainty[known], [0.05, 0.95], weights=areas, method="inverted_cdf").tolist()
    return low, max(high, 1.01 * low)


def colors_of(uncertainty: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """Colours [V, 3] in 0..255 of uncertainties [V] m: violet is surest, yellow least sure, red is guessed."""
    known = np.isfinite(uncertainty)
    position = np.log(np.where(known, uncertainty, 1.0) / limits[0]) / np.log(limits[1] / limits[0])
    place = np.clip(position, 0, 1) * (len(SCALE) - 1)
    color = np.stack([np.interp(place, np.arange(len(SCALE)), channel) for channel in SCALE.T], -1)
    return np.where(known[:, None], color, GUESSED)
