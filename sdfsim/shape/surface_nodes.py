"""Surface nodes: the points of a body that carry contact, sampled from its SDF alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.mesh import Mesh, convex_hull, lattice, normal_frame
from sdfsim.geometry.primitives import spiral
from sdfsim.sdf.baked_grid import BakedGrid, surface_samples
from sdfsim.sdf.closed_forms import BoxSdf, CylinderSdf
from sdfsim.sdf.reference import PiecesDistance, unique_planes
from sdfsim.sdf.sdf import Sdf

# The paper's sampling (section 3 and appendix): a grid over this half extent of the normalised frame, projected onto
# the surface, points that did not reach it dropped, one point kept per voxel.
GRID_HALF = 0.7
VOXEL = 0.025
REACHED = 0.005
PROJECTIONS = 3
DEFAULT_GRID = 24
DEFAULT_COUNT = 512  # what the bundled model was trained with; docs/tradeoff.md has what fewer cost
DIRECTIONS = 1000  # in which nodes are to reach as far as the surface
CHUNK = 10_000  # points looked at together
# Faces that meet at less than this cosine (20 degrees) make an edge worth nodes of its own.
SHARP = 0.94
DENSEST = 4000  # nodes that a closed form has about at most
LATTICE = 40  # of the lattice that holds the nearest patch, along the largest extent
MOST_PATCHES = 1024  # of a shape: the most that the contact solve distinguishes
OUTSIDE = 1e-3  # of the extent: vertices that lie deeper in the union are not on its surface


def sample_nodes(sdf: Sdf, *, grid: int = DEFAULT_GRID, voxel: float = VOXEL) -> np.ndarray:
    """Nodes [K, 3] m on the zero level of an SDF, as in the paper: grid, project, filter, voxel downsample.
    Deterministic.

    The cube [-0.7, 0.7]^3 of the normalised frame has `grid` points a side; the point nearest the middle of each voxel
    of width `voxel` stays. Raises SdfsimError where the SDF is unbounded, or no point reached its surface.
    """
    frame = normal_frame(sdf.bounds)
    axis = np.linspace(-GRID_HALF, GRID_HALF, grid)
    points = project(sdf, frame.outward(lattice(axis, axis, axis)))
    distance = np.asarray(sdf(points)[0])
    reached = np.abs(distance) <= REACHED * frame.scale
    # A network may have a stray zero level in the corners of its box: nothing outside the solid's bounds is surface.
    margin = REACHED * frame.scale
    reached &= ((points >= sdf.bounds[0] - margin) & (points <= sdf.bounds[1] + margin)).all(1)
    points = points[reached]
    if len(points) == 0:
        raise SdfsimError("no surface nodes: the SDF has no zero level within its bounds")
    return frame.outward(_one_per_voxel(frame.inward(points), voxel))


def project(sdf: Sdf, points: np.ndarray) -> np.ndarray:
    """Move points [P, 3] m to the zero level by a few steps x - f grad f / |grad f|^2."""
    for _ in range(PROJECTIONS):
        distance, gradient = sdf(points)
        # A step never gets longer than twice the distance: slopes below 0.7 are errors of a fit, not geometry.
        squared = np.maximum(np.square(gradient).sum(1), 0.5)
        points = points - (np.asarray(distance) / squared)[:, None] * np.asarray(gradient)
    return points


def _one_per_voxel(points: np.ndarray, voxel: float) -> np.ndarray:
    """The point nearest the middle of each occupied voxel; an average would leave the surface where it bends."""
    # Voxels centred on the origin: the faces of a normalised box at 0.5 then run through their middles.
    cell = np.round(points / voxel).astype(np.int64)
    off_centre = np.square(points - cell * voxel).sum(1)
    order = np.argsort(off_centre, kind="stable")
    return points[order[np.unique(cell[order], axis=0, return_index=True)[1]]]


def thin(points: np.ndarray, count: int, *, keep: np.ndarray | None = None) -> np.ndarray:
    """At most `count` of points [P, 3]: all of `keep` [Q, 3], which are thinned themselves where they are more, then
    the farthest remaining point again and again, starting (without `keep`) at that farthest from the centroid."""
    if keep is not None and len(keep) >= count:
        return thin(keep, count) if len(keep) > count else keep.copy()
    chosen: list[np.ndarray] = [] if keep is None else list(keep)
    nearest = np.full(len(points), np.inf)
    for point in chosen:
        np.minimum(nearest, np.square(points - point).sum(1), out=nearest)
    while len(chosen) < count and len(points):
        far = int((nearest if chosen else np.square(points - points.mean(0)).sum(1)).argmax())
        if nearest[far] <= 0:
            break
        chosen.append(points[far])
        np.minimum(nearest, np.square(points - points[far]).sum(1), out=nearest)
    return np.array(chosen).reshape(-1, 3)


def hull_nodes(vertices: np.ndarray, count: int) -> np.ndarray:
    """At most `count` of a polyhedral body's own vertices [V, 3] m: first those of the convex hull, for only they can
    touch a flat floor; the others farthest first."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        outer = np.sort(ConvexHull(vertices).vertices)
    except QhullError:  # all in a plane
        return thin(vertices, count)
    return thin(np.delete(vertices, outer, axis=0), count, keep=vertices[outer])


def edge_nodes(piece: np.ndarray, spacing: float) -> np.ndarray:
    """Points [K, 3] m along the sharp edges of a convex polyhedron, at most `spacing` m apart, its corners left out:
    two polyhedra often touch edge against edge, which their corners alone do not see."""
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


@dataclass(frozen=True, eq=False)
class ContactSurface:
    """Nodes of one shape and its patches, in the shape's own frame at scale 1."""

    nodes: np.ndarray  # [K, 3] m
    patch: np.ndarray  # [K] int64, the patch of each
    # [X, Y, Z] int16, the patch that is nearest to the places of a lattice; None for a single patch
    nearest: np.ndarray | None
    low: np.ndarray  # [3] m, the first of these places
    cell: float  # m between two


def contact_surface(
    sdf: Sdf, nodes: np.ndarray, pieces: Sequence[np.ndarray], grid: BakedGrid | None
) -> tuple[ContactSurface, np.ndarray]:
    """The nodes that carry contact where a shape is met as a surface, and how far the surface around each goes that is
    nearer to it than to others: [K] m. Closed forms have nodes that are as dense as the solid is thin."""
    if len(nodes) == 0:
        return ContactSurface(nodes, np.zeros(0, np.int64), None, np.zeros(3), 1.0), np.zeros(0)
    if isinstance(sdf, BoxSdf | CylinderSdf):
        area = _area(sdf)
        spacing = max(0.5 * min(sdf.sizes), np.sqrt(area / DENSEST))
        nodes = _on_box(np.array(sdf.half), spacing) if isinstance(sdf, BoxSdf) else _on_cylinder(sdf, spacing)
        return surface_of(sdf, nodes, ()), np.full(len(nodes), 0.75 * spacing)
    surface = surface_of(sdf, nodes, pieces)
    if grid is None or len(surface.nodes) == 0:
        return surface, np.zeros(len(surface.nodes))
    from scipy.spatial import KDTree

    away, nearest = KDTree(surface.nodes).query(surface_samples(grid))
    cover = np.zeros(len(surface.nodes))
    np.maximum.at(cover, nearest, away)
    return surface, cover + grid.cell


def _area(sdf: BoxSdf | CylinderSdf) -> float:
    if isinstance(sdf, BoxSdf):
        a, b, c = sdf.half
        return 8.0 * (a * b + b * c + c * a)
    return 2.0 * np.pi * sdf.radius * (sdf.radius + 2.0 * sdf.half)


def _on_box(half: np.ndarray, spacing: float) -> np.ndarray:
    """Points all over a box at most `spacing` m apart along its sides, corners and edges among them."""
    axes = [np.linspace(-h, h, 1 + max(1, int(np.ceil(2.0 * h / spacing)))) for h in half]
    points = [axes[0][[0, -1]], axes[1][[0, -1]], axes[2][[0, -1]]]
    sides = [lattice(*(points[k] if k == axis else axes[k] for k in range(3))) for axis in range(3)]
    return np.unique(np.concatenate(sides), axis=0)


def _on_cylinder(sdf: CylinderSdf, spacing: float) -> np.ndarray:
    """Points all over a cylinder at most `spacing` m apart, its rims among them."""
    around = 2.0 * np.pi * np.arange(count := max(8, int(np.ceil(2.0 * np.pi * sdf.radius / spacing)))) / count
    circle = np.stack([np.cos(around), np.sin(around)], axis=1)
    heights = np.linspace(-sdf.half, sdf.half, 1 + max(1, int(np.ceil(2.0 * sdf.half / spacing))))
    radii = np.linspace(0.0, sdf.radius, 1 + max(1, int(np.ceil(sdf.radius / spacing))))[:-1]
    side = [np.column_stack([sdf.radius * circle, np.full(count, z)]) for z in heights]
    ends = [np.column_stack([r * circle, np.full(count, z)]) for z in (-sdf.half, sdf.half) for r in radii[1:]]
    tips = [np.array([[0.0, 0.0, -sdf.half], [0.0, 0.0, sdf.half]])]
    return np.concatenate([*side, *ends, *tips])


def surface_of(sdf: Sdf, nodes: np.ndarray, pieces: Sequence[np.ndarray]) -> ContactSurface:
    """The nodes that carry contact, [K, 3] m, with the vertices [V, 3] m of convex pieces, where the shape has some,
    and their patches. Raises SdfsimError for more than `MOST_PATCHES` pieces."""
    if len(pieces) == 0:
        return ContactSurface(nodes, np.zeros(len(nodes), np.int64), None, np.zeros(3), 1.0)
    check_pieces("a shape", pieces)
    extent = float(np.ptp(sdf.bounds, axis=0).max())
    vertices, union = np.concatenate(pieces), PiecesDistance([convex_hull(piece) for piece in pieces])
    bare = union(vertices).distance > -OUTSIDE * extent
    nodes = union(nodes).closest  # those of a fitted surface lie beside it
    owner = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    cell = extent / LATTICE
    low = sdf.bounds[0] - cell
    count = np.ceil((sdf.bounds[1] + cell - low) / cell).astype(int) + 1
    places = lattice(*(low[axis] + cell * np.arange(count[axis]) for axis in range(3)))
    nearest = _nearest_piece(pieces, np.concatenate([places, nodes]))
    return ContactSurface(
        nodes=np.concatenate([vertices[bare], nodes]),
        patch=np.concatenate([owner[bare], nearest[len(places) :]]),
        nearest=nearest[: len(places)].astype(np.int16).reshape(count),
        low=low,
        cell=cell,
    )


def check_pieces(what: str, pieces: Sequence[np.ndarray]) -> None:
    """Raises SdfsimError, which names `what`, for more than `MOST_PATCHES` convex pieces."""
    if len(pieces) > MOST_PATCHES:
        fault = f"{what} is made of {len(pieces):,} convex pieces (at most {MOST_PATCHES:,})"
        raise SdfsimError(fault, "cut it into fewer ones, or fit its mesh without pieces")


def _nearest_piece(pieces: Sequence[np.ndarray], places: np.ndarray) -> np.ndarray:
    """[P] int64: the convex hull whose farthest face plane is least far from a place."""
    from scipy.spatial import ConvexHull

    least, nearest = np.full(len(places), np.inf), np.zeros(len(places), np.int64)
    size = float(np.ptp(np.concatenate(pieces), axis=0).max())
    for k, piece in enumerate(pieces):
        far = np.full(len(places), -np.inf)
        for plane in unique_planes(ConvexHull(piece).equations, size, 6):
            np.maximum(far, places @ plane[:3] + plane[3], out=far)
        nearest[far < least] = k
        np.minimum(least, far, out=least)
    return nearest


def surface_nodes(sdf: Sdf, surface: Mesh, count: int) -> np.ndarray:
    """Nodes for contact, at most `count` [K, 3] m: a third that reach farthest outwards, then points all over `sdf`."""
    return thin(sample_nodes(sdf), count, keep=_reaching(surface.vertices, count // 3))


def _reaching(points: np.ndarray, count: int) -> np.ndarray:
    """At most `count` of points [P, 3] whose convex hull comes nearest to that of all: in turn the outermost in the
    direction in which those before fall short the most. Evenly spread points leave gaps of a tenth of a body along a
    rim, through which it sinks into a floor."""
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
