"""What lies outside of the trained ball: a coarse mesh of the room around, from the depth of the same photos.

The field describes the unit sphere only. Photos also show the floor, the walls and the furniture around it. Their depth
gives a coarse signed distance there, whose cells are as wide as a hundredth of the room. Everything here is in
normalised space; heights are above the floor of the scenery.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import Delaunay, KDTree

from pipeline.cameras import Similarity, View, frame_of
from pipeline.mesh.extraction import FLOATER, MIN_SEEN, RIM, Volume, islands, keep_faces, trusted_vertices
from pipeline.mesh.placement import LEVEL_NORMAL
from pipeline.mesh.visibility import Visibility, look, spread_colors, to_bytes
from pipeline.stereo.depth import DepthMap
from pipeline.stereo.fusion import coarse_distance
from sdfsim.base.files import read_arrays, write_arrays
from sdfsim.base.parallel import Progress, silent
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, joined, vertex_normals

FILE = "surroundings.npz"  # in the folder of the field: the signed distance
SIDE = 128  # samples a side
FARTHEST = 10.0  # radii of the ball: what is farther away is not solid enough to be met
MOST = 0.98  # of the places outside of the ball lie within the sampled cube
LEAST = 0.02  # share of the photos' depth that lies outside: with less there is nothing to show
OVERLAP = 0.02  # by which the surroundings reach into the ball, so that no gap is seen
NEAR = 2.0  # cells from a plane within which a surface is the plane, or noise about it
FACING = 0.7  # cosine of the angle between the normals of a surface and its plane, at least; of different planes, at most
PLANES, SHARE = 8, 0.03  # planes at most, and the least share of the seen surface on one
THROUGH = 2.0  # cells of air on both sides, from which on a plane is not there
FEWEST = 100  # vertices that photos show: less is not worth showing


@dataclass(frozen=True)
class Surroundings:
    """The room around the trained ball."""

    shown: Mesh  # what photos show, with colours
    solid: Mesh | None  # closed: what bodies meet, without the floor, which is a plane; None if there is only floor


def surrounding_distance(maps: Sequence[DepthMap], on_progress: Progress = silent) -> Volume | None:
    """The signed distance outside of the ball, within the cube that holds nearly all that photos show there; None if
    they show hardly anything there."""
    away = np.linalg.norm(np.concatenate([one.points() for one in maps]), axis=1)
    if not len(away) or (away > 1).mean() < LEAST:
        return None
    reach = min(float(np.quantile(away[away > 1], MOST)), FARTHEST) * (1 + OVERLAP)
    shrink = Similarity(1 / reach, np.eye(3), np.zeros(3))
    # The same photos of a smaller world, which fits into the unit sphere.
    small = [replace(one, view=shrink.view(one.view), inverse=one.inverse * np.float32(reach)) for one in maps]
    coarse = coarse_distance(small, SIDE, on_progress)
    if coarse is None:
        return None
    return Volume(reach * coarse.transpose(2, 1, 0), np.full(3, -reach), 2 * reach / (SIDE - 1))


def save(volume: Volume, folder: Path) -> None:
    arrays = {"values": volume.values.astype(np.float16), "low": volume.low, "cell": np.array(volume.cell)}
    write_arrays(folder / FILE, arrays)


def load(folder: Path) -> Volume | None:
    """The signed distance that the training has left; None if photos show nothing outside of the ball."""
    if not (folder / FILE).exists():
        return None
    kept = read_arrays(folder / FILE, "surroundings", "run the distill stage again")
    return Volume(kept["values"].astype(np.float32), kept["low"], float(kept["cell"]))


def surroundings_of(
    volume: Volume, height: Callable[[np.ndarray], np.ndarray], within: Sequence[Mesh], views: Sequence[View],
    photos_folder: Path,
) -> Surroundings | None:  # fmt: skip
    """The surroundings from their signed distance, the height [P] of points [P, 3] above the floor, and the meshes
    within the ball, which stand before them; None if photos show too little of them."""
    cell, up = volume.cell, up_of(height)
    outside = volume.limited(lambda points: RIM - OVERLAP - np.linalg.norm(points, axis=1))
    # Closed at the border of the cube, where nothing is seen.
    outside = Volume(np.pad(outside.values, 1, constant_values=cell), outside.low - cell, cell)
    if not (outside.values < 0).any():
        return None
    raw = outside.mesh()
    limit = np.linalg.norm(raw.vertices, axis=1) < RIM - OVERLAP + 0.5 * cell
    limit |= np.abs(raw.vertices).max(1) > -volume.low.max() - cell
    found = look(Visibility(raw, cell, Caster(joined([raw, *within]))), views, photos_folder)
    seen = trusted_vertices(raw, found.count, limit)
    if seen.sum() < FEWEST:
        return None
    planes = find_planes(raw.vertices[seen], vertex_normals(raw)[seen], cell)
    flat = [k for k, plane in enumerate(planes) if abs(plane.normal @ up) > LEVEL_NORMAL]
    floor = min(flat, key=lambda k: np.abs(height(planes[k].middle[None])[0]), default=None)
    if floor is not None and abs(height(planes[floor].middle[None])[0]) < NEAR * cell:
        # The same plane as the scenery's floor, so that none lies above the other.
        planes[floor] = Plane(up, -height(np.zeros((1, 3)))[0] * up)
    on = np.any([plane.near(raw.vertices, cell) for plane in planes] or [np.zeros(len(seen), bool)], axis=0)
    rest = islands(raw, (seen & ~on)[raw.faces].sum(1) >= MIN_SEEN, FLOATER)
    parts = [keep_faces(raw, rest)] if rest.any() else []
    parts += [sheet(plane, planes, raw.vertices[seen], volume) for plane in planes]
    shown = joined(parts)
    colored = found.weight > 0
    shown = replace(shown, colors=to_bytes(spread_colors(shown.vertices, raw.vertices[colored], found.color[colored])))
    points = outside.points().reshape(-1, 3)
    values = np.maximum(outside.values.ravel(), NEAR * cell - height(points)) if floor is not None else outside.values
    solid = replace(outside, values=np.asarray(values, np.float32).reshape(outside.values.shape))
    return Surroundings(shown, solid.mesh() if (solid.values < 0).any() else None)


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
    wanted &= np.linalg.norm(at, axis=1) > RIM - OVERLAP
    rows, columns = np.nonzero(wanted.reshape(middles.shape[:2]))
    first = rows * len(b) + columns
    quads = np.stack([first, first + len(b), first + len(b) + 1, first + 1], 1)
    return keep_faces(Mesh(corners.reshape(-1, 3), quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)), slice(None))


def up_of(height: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The unit direction [3] in which a height above a plane grows."""
    slope = height(np.eye(3)) - height(np.zeros((1, 3)))
    return slope / np.linalg.norm(slope)
