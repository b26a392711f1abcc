"""The room around the trained ball: a coarse mesh, with planes where walls and floors are.

Everything here is in normalised space; heights are above the floor of the scenery.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull, Delaunay, KDTree

from pipeline.cameras import View, frame_of
from pipeline.mesh.extraction import RIM, Volume, islands, keep_faces, trusted_vertices
from pipeline.mesh.placement import LEVEL_NORMAL
from pipeline.mesh.trust import FEW
from pipeline.mesh.visibility import Visibility, look, spread_colors, to_bytes
from pipeline.stereo.fusion import Far
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, joined, vertex_normals

OVERLAP = 0.02  # by which the surroundings reach into the ball, so that no gap is seen
NEAR = 2.0  # cells from a plane within which a surface is the plane, or noise about it
FACING = (
    0.7  # cosine of the angle between the normals of a surface and its plane, at least; of different planes, at most
)
PLANES, SHARE = 8, 0.03  # planes at most, and the least share of the seen surface on one
# FILLED and THROUGH were chosen on the bundled room and on 25 photos of a kitchen.
FILLED = 0.36  # share of a plane, within the hull of what is seen of it, that has to be seen
BELOW = 0.05  # cells, of the room's floor below the scenery's
THROUGH = 4.0  # cells of air on both sides, from which on a plane is not there
FURNITURE = 0.1  # of the surface that lies on no plane: smaller patches are ignored
FEWEST = 100  # vertices that photos show: less is not worth showing


@dataclass(frozen=True)
class Surroundings:
    """The room around the trained ball."""

    shown: Mesh  # what photos show, with colours
    solid: Mesh  # closed: what bodies meet, without the floor, which is a plane of its own
    cell: float  # of the samples


def surroundings_of(
    far: Far, height: Callable[[np.ndarray], np.ndarray], within: Sequence[Mesh], views: Sequence[View],
    photos_folder: Path,
) -> Surroundings | None:  # fmt: skip
    """The surroundings from the signed distance there, the height [P] of points [P, 3] above the floor, and the meshes
    within the ball, which stand before them; None if photos show too little of them."""
    cell, up = 2 * far.reach / (len(far.values) - 1), up_of(height)
    volume = Volume(far.values, np.full(3, -far.reach), cell)
    outside = volume.limited(lambda points: RIM - OVERLAP - np.linalg.norm(points, axis=1))
    # Closed at the border of the cube, where nothing is seen.
    outside = Volume(np.pad(outside.values, 1, constant_values=cell), outside.low - cell, cell)
    if not (outside.values < 0).any():
        return None
    raw = outside.mesh()
    limit = np.linalg.norm(raw.vertices, axis=1) < RIM - OVERLAP + 0.5 * cell
    limit |= np.abs(raw.vertices).max(1) > far.reach - cell
    found = look(Visibility(raw, cell, Caster(joined([raw, *within]))), views, photos_folder)
    seen = trusted_vertices(raw, found.count, limit)
    if seen.sum() < FEWEST:
        return None
    planes = find_planes(raw.vertices[seen], vertex_normals(raw)[seen], cell)
    flat = [k for k, plane in enumerate(planes) if abs(plane.normal @ up) > LEVEL_NORMAL]
    floor = min(flat, key=lambda k: np.abs(height(planes[k].middle[None])[0]), default=None)
    if floor is not None and abs(height(planes[floor].middle[None])[0]) < NEAR * cell:
        # Just below the scenery's floor, so that both are not in one plane.
        planes[floor] = Plane(up, -(height(np.zeros((1, 3)))[0] + BELOW * cell) * up)
    planes = [plane for plane in planes if filled_share(plane, raw.vertices[seen], cell) > FILLED]
    on = np.any([plane.near(raw.vertices, cell) for plane in planes] or [np.zeros(len(seen), bool)], axis=0)
    # Noise at the rims of what photos show floats before the walls: fewer photos agree on it.
    sure = seen & ~on & (found.count >= FEW)
    rest = islands(raw, sure[raw.faces].all(1), FURNITURE)
    parts = [keep_faces(raw, rest)] if rest.any() else []
    parts += [sheet(plane, planes, raw.vertices[seen], volume) for plane in planes]
    shown = joined(parts)
    colored = found.weight > 0
    shown = replace(shown, colors=to_bytes(spread_colors(shown.vertices, raw.vertices[colored], found.color[colored])))
    if floor is None:
        return Surroundings(shown, outside.mesh(), cell)
    # Bodies meet the floor's plane, not its noise: what is near it goes, but for the ground well below.
    above = height(outside.points().reshape(-1, 3)).reshape(outside.values.shape)
    values = np.minimum(np.maximum(outside.values, NEAR * cell - above), above + cell)
    values = np.pad(values[1:-1, 1:-1, 1:-1], 1, constant_values=cell).astype(np.float32)
    return Surroundings(shown, replace(outside, values=values).mesh(), cell)


@dataclass(frozen=True)
class Plane:
    """A wall, a floor or a ceiling."""

    normal: np.ndarray  # [3] unit, towards the photos
    middle: np.ndarray  # [3] a point on it

    def above(self, points: np.ndarray) -> np.ndarray:
        """Distance [P] of points [P, 3] from it, towards the photos."""
        return (points - self.middle) @ self.normal

    def near(self, points: np.ndarray, cell: float) -> np.ndarray:
        """Whether points [P, 3] belong to it, or to the noise about it [P]."""
        return np.abs(self.above(points)) < NEAR * cell


def find_planes(points: np.ndarray, normals: np.ndarray, cell: float) -> list[Plane]:
    """Large planes through seen points [P, 3] with normals [P, 3], the largest first (RANSAC)."""
    import open3d as o3d

    o3d.utility.random.seed(0)
    found: list[Plane] = []
    left = np.arange(len(points))
    while len(found) < PLANES and len(left) > SHARE * len(points):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[left]))
        equation, _ = cloud.segment_plane(cell, 3, 1000)
        normal = np.asarray(equation[:3]) / np.linalg.norm(equation[:3])
        away = points[left] @ normal + equation[3] / np.linalg.norm(equation[:3])
        along = normals[left] @ normal
        mine = (np.abs(away) < cell) & (np.abs(along) > FACING)
        if mine.sum() < SHARE * len(points):
            break
        plane = Plane(normal * np.sign(np.median(along[mine])), points[left][mine].mean(0))
        found.append(plane)
        left = left[~plane.near(points[left], cell)]
    return found


def filled_share(plane: Plane, seen: np.ndarray, cell: float) -> float:
    """The share of the convex hull of a plane's points, among points [P, 3], that these fill: clutter through which a
    plane can be laid leaves gaps."""
    flat = (seen[plane.near(seen, cell)] - plane.middle) @ frame_of(plane.normal)[:2].T
    places = np.unique(np.floor(flat / (2 * cell)).astype(int), axis=0)
    return len(places) * (2 * cell) ** 2 / ConvexHull(flat).volume


def sheet(plane: Plane, planes: Sequence[Plane], seen: np.ndarray, volume: Volume) -> Mesh:
    """A plane as far as points [P, 3] of it are seen, and between them: behind and below what stands before it, up to
    the other planes; not where the photos see far past it."""
    cell = volume.cell
    across = frame_of(plane.normal)[:2]
    flat = (seen[plane.near(seen, cell)] - plane.middle) @ across.T
    hull = Delaunay(flat)
    low, high = flat.min(0) - cell, flat.max(0) + cell
    a, b = (np.arange(first, last, cell) for first, last in zip(low, high, strict=True))
    corners = plane.middle + np.stack(np.meshgrid(a, b, indexing="ij"), -1) @ across
    middles = (corners[:-1, :-1] + corners[1:, 1:]) / 2
    at = middles.reshape(-1, 3)
    wanted = hull.find_simplex((at - plane.middle) @ across.T) >= 0
    for other in planes:
        if other is not plane and abs(other.normal @ plane.normal) < FACING:
            wanted &= other.above(at) > -0.5 * cell
    known = KDTree(flat).query((at - plane.middle) @ across.T)[0] < cell
    wanted &= known | (volume.at(at) < THROUGH * cell)
    wanted &= np.linalg.norm(at, axis=1) > RIM - cell
    rows, columns = np.nonzero(wanted.reshape(middles.shape[:2]))
    first = rows * len(b) + columns
    quads = np.stack([first, first + len(b), first + len(b) + 1, first + 1], 1)
    made = Mesh(corners.reshape(-1, 3), quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3))
    return keep_faces(made, np.ones(len(made.faces), bool))


def up_of(height: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The unit direction [3] in which a height above a plane grows."""
    slope = height(np.eye(3)) - height(np.zeros((1, 3)))
    return slope / np.linalg.norm(slope)
