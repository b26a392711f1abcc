"""Surface nodes: the points of a body that carry contact, sampled from its SDF alone."""

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.mesh import Mesh, lattice, normal_frame
from sdfsim.geometry.primitives import spiral
from sdfsim.sdf.mesh_sdf import MeshSdf
from sdfsim.sdf.sdf import Sdf

# The paper's sampling (section 3 and appendix): a grid over this half extent of the normalised frame, projected onto
# the surface, points that did not reach it dropped, one point kept per voxel.
GRID_HALF = 0.7
VOXEL = 0.025
REACHED = 0.005
PROJECTIONS = 3
DEFAULT_GRID = 24
DEFAULT_COUNT = 512  # number with which the bundled model was trained
DIRECTIONS = 1000  # directions in which nodes should reach as far as the surface
CHUNK = 10_000  # points in one product
# Faces that meet at less than this cosine (20 degrees) make an edge worth nodes of its own.
SHARP = 0.94


def sample_nodes(sdf: Sdf, *, grid: int = DEFAULT_GRID, voxel: float = VOXEL) -> np.ndarray:
    """Nodes [K, 3] m on the zero level of an SDF, as in the paper: grid, project, filter, voxel downsample.
    Deterministic.

    The cube [-0.7, 0.7]^3 of the normalised frame has `grid` points a side; the point nearest the middle of each voxel
    of width `voxel` stays. Raises SdfsimError if the SDF is unbounded, or no point reached its surface.
    """
    frame = normal_frame(sdf.bounds)
    axis = np.linspace(-GRID_HALF, GRID_HALF, grid)
    points = project(sdf, frame.outward(lattice(axis, axis, axis)))
    # A network may have a stray zero level in the corners of its box, so nothing outside the solid's bounds counts as
    # surface.
    margin = REACHED * frame.scale
    reached = ((points >= sdf.bounds[0] - margin) & (points <= sdf.bounds[1] + margin)).all(1)
    if not isinstance(sdf, MeshSdf):
        reached &= np.abs(np.asarray(sdf(points)[0])) <= margin
    points = points[reached]
    if len(points) == 0:
        raise SdfsimError("no surface nodes: the SDF has no zero level within its bounds")
    return frame.outward(one_per_voxel(frame.inward(points), voxel))


def project(sdf: Sdf, points: np.ndarray) -> np.ndarray:
    """Move points [P, 3] m to the zero level: exactly for a mesh, else by a few steps x - f grad f / |grad f|^2."""
    if isinstance(sdf, MeshSdf):
        return sdf.closest(points)
    for _ in range(PROJECTIONS):
        distance, gradient = sdf(points)
        # A step is at most twice the distance: slopes below 0.7 are errors of a fit, not geometry.
        squared = np.maximum(np.square(gradient).sum(1), 0.5)
        points = points - (np.asarray(distance) / squared)[:, None] * np.asarray(gradient)
    return points


def one_per_voxel(points: np.ndarray, voxel: float) -> np.ndarray:
    """The point nearest the middle of each occupied voxel; an average would leave the surface where it bends."""
    if len(points) == 0:
        return points
    # Voxels centred on the origin: the faces of a normalised box at 0.5 then run through their middles.
    cell = np.round(points / voxel).astype(np.int64)
    off_centre = np.square(points - cell * voxel).sum(1)
    order = np.argsort(off_centre, kind="stable")
    number = np.ravel_multi_index((cell - cell.min(0)).T, np.ptp(cell, axis=0) + 1)
    return points[order[np.unique(number[order], return_index=True)[1]]]


def thin(points: np.ndarray, count: int, *, keep: np.ndarray | None = None) -> np.ndarray:
    """At most `count` of points [P, 3], by farthest point sampling: first all of `keep` [Q, 3] (thinned if they are
    more than `count`), then again and again the point farthest from those chosen. Without `keep` it starts at the point
    farthest from the centroid."""
    if keep is not None and len(keep) >= count:
        return thin(keep, count) if len(keep) > count else keep.copy()
    chosen: list[np.ndarray] = [] if keep is None else list(keep)
    nearest = np.full(len(points), np.inf)
    columns = np.ascontiguousarray(points.T)  # sums over the short axis of `points` would take thirty times as long

    def squared(point: np.ndarray) -> np.ndarray:
        off = columns - point[:, None]
        off *= off
        return off[0] + off[1] + off[2]

    for point in chosen:
        np.minimum(nearest, squared(point), out=nearest)
    while len(chosen) < count and len(points):
        far = int((nearest if chosen else squared(points.mean(0))).argmax())
        if nearest[far] <= 0:
            break
        chosen.append(points[far])
        np.minimum(nearest, squared(points[far]), out=nearest)
    return np.array(chosen).reshape(-1, 3)


def hull_nodes(vertices: np.ndarray, count: int) -> np.ndarray:
    """At most `count` of a polyhedral body's own vertices [V, 3] m: first those of the convex hull, as only they can
    touch a flat floor, then the others, farthest first."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        outer = np.sort(ConvexHull(vertices).vertices)
    except QhullError:  # all in a plane
        return thin(vertices, count)
    return thin(np.delete(vertices, outer, axis=0), count, keep=vertices[outer])


def edge_nodes(piece: np.ndarray, spacing: float) -> np.ndarray:
    """Points [K, 3] m along the sharp edges of a convex polyhedron, at most `spacing` m apart, without its corners. Two
    polyhedra often touch edge against edge, which corners alone would miss."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(piece)
    normals = hull.equations[:, :3]
    face, corner = np.nonzero(np.arange(len(hull.simplices))[:, None] < hull.neighbors)
    other = hull.neighbors[face, corner]
    bent = (normals[face] * normals[other]).sum(1) < SHARP
    # The neighbour k of a face lies across the edge opposite to its corner k.
    points = [np.empty((0, 3))]
    for f, c in zip(face[bent], corner[bent], strict=True):
        start, end = piece[np.delete(hull.simplices[f], c)]
        parts = int(np.ceil(np.linalg.norm(end - start) / spacing))
        points.append(start + np.arange(1, parts)[:, None] / parts * (end - start))
    return np.concatenate(points)


def surface_nodes(sdf: Sdf, surface: Mesh, count: int) -> np.ndarray:
    """Nodes for contact, at most `count` [K, 3] m: a third of them reach farthest outwards, the others are spread over
    the surface."""
    return thin(sample_nodes(sdf), count, keep=_reaching(surface.vertices, count // 3))


def _reaching(points: np.ndarray, count: int) -> np.ndarray:
    """At most `count` of points [P, 3], chosen so that their convex hull is near that of all points: each is the
    outermost point in the direction in which those before it fall short the most. Evenly spread points would leave gaps
    of a tenth of a body along a rim, through which it sinks into a floor."""
    directions = spiral(DIRECTIONS)
    best, most = np.zeros(DIRECTIONS, np.int64), np.full(DIRECTIONS, -np.inf)
    for start in range(0, len(points), CHUNK):
        along = directions @ points[start : start + CHUNK].T
        best = np.where(along.max(1) > most, start + along.argmax(1), best)
        most = np.maximum(most, along.max(1))
    outer = points[np.unique(best)]
    along = directions @ outer.T
    farthest, reached = along.max(1), np.full(DIRECTIONS, -np.inf)
    tolerance = 1e-6 * float(np.ptp(points, axis=0).max())
    chosen: list[int] = []
    while len(chosen) < count and (farthest - reached).max() > tolerance:
        chosen.append(int(along[(farthest - reached).argmax()].argmax()))
        reached = np.maximum(reached, along[:, chosen[-1]])
    return outer[chosen]
