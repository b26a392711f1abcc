"""The geometry that contacts need of a shape, in its own frame at scale 1: made once, and cached beside the baked grids
on disk.

A shape that is convex, or made of convex pieces, collides as solids. Any other collides as a surface: its points are
tested against the distances of other shapes. A thousand bodies of one shape share one geometry.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import cached_arrays, digest, user_cache
from sdfsim.geometry.mesh import (
    Mesh,
    convex_hull,
    directed_edges,
    face_normals,
    halves,
    lattice,
    sample_surface,
)
from sdfsim.sdf.baked_grid import (
    BAKE_VERSION,
    CELLS,
    BakedGrid,
    baked,
    interpolated,
    inwards,
    surface_samples,
    unseen_wall,
)
from sdfsim.sdf.closed_forms import BoxSdf, ClosedForm, ConeSdf, CylinderSdf, PlaneSdf, TorusSdf
from sdfsim.sdf.mesh_sdf import MeshSdf
from sdfsim.sdf.mlp import MlpSdf
from sdfsim.sdf.reference import PiecesDistance
from sdfsim.sdf.sdf import Sdf
from sdfsim.shape.convex_pieces import ConvexPiece, closed_form, convex_vertices, hull
from sdfsim.shape.surface_nodes import SHARP, one_per_voxel
from sdfsim.shape.triangle_tree import TriangleTree, triangle_tree

VERSION = 11  # version of the cache files, in addition to that of the baked grid
DENSEST = 4000  # largest number of nodes of a closed form, roughly
LATTICE = 40  # cells, along the largest extent, of the lattice that says which patch is nearest
MOST_PATCHES = 1024  # patches of a shape: the contact solve cannot distinguish more
OUTSIDE = 1e-3  # relative to the extent: vertices deeper in the union are not on its surface
MANY = 2  # samples of a mesh in a square of one cell
APART, DENSEST_ON_GRID = 2.0, 3000  # least distance of nodes on a grid, cells, and their largest number
LEAF, CLUMP = 16, 256  # largest number of nodes in a leaf, and in a clump of leaves
ROUNDED = 0.1  # cells: an edge of the mesh counts as rounded off if the grid is off by this much there
ALONG_EDGE, MOST_ON_EDGES = 2.0, 4000  # distance of nodes on such edges, cells, and their largest number

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class ContactSurface:
    """The surface of a shape as K nodes in L leaves, and the leaves in C clumps, so that neighbours are searched
    together.

    The balls of leaves and clumps hold the surface around their nodes, not the nodes alone. So a body that is too far
    from a ball for a contact cannot touch, whatever the shape and however few its nodes.
    """

    node: np.ndarray  # [K, 3] m, leaf by leaf
    cover: np.ndarray  # [K] m, radius of the part of the surface that is nearer to this node than to others
    leaf_node: np.ndarray  # [L + 1] int64, leaf l holds nodes leaf_node[l] : leaf_node[l + 1]
    leaf_ball: np.ndarray  # [L, 4] m, centre and radius
    leaf_patch: np.ndarray  # [L] int64, the patch of the surface to which a leaf's nodes belong
    clump_leaf: np.ndarray  # [C + 1] int64, clump c holds leaves clump_leaf[c] : clump_leaf[c + 1]
    clump_ball: np.ndarray  # [C, 4] m
    # [X, Y, Z] int16, the nearest patch at the places of a lattice; empty for a single patch
    label: np.ndarray
    label_low: np.ndarray  # [3] m, the first of these places
    label_cell: np.ndarray  # [] m, their distance


NO_LABELS = {"label": np.zeros((0, 0, 0), np.int16), "label_low": np.zeros(3), "label_cell": np.ones(())}


@dataclass(frozen=True, eq=False)
class ContactGeometry:
    """The geometry that contacts need of one shape; each part is made on first use."""

    sdf: Sdf
    nodes: np.ndarray
    pieces: Sequence[np.ndarray]
    mesh: Mesh

    @cached_property
    def grid(self) -> BakedGrid | None:
        """The baked distance of a shape without a closed form, else None. Logs a warning if a wall is too thin for
        it."""
        if isinstance(self.sdf, ClosedForm):
            return None
        if self._exact is not None and self._exact.simple:
            return baked(self.sdf, self.nodes, finest=CELLS)  # it only says where triangles have to be asked
        grid = baked(self.sdf, self.nodes, self.pieces)
        if not self.solids and (wall := unseen_wall(self.sdf, grid)) is not None:
            extent = np.ptp(self.sdf.bounds, axis=0).max()
            _log.warning("a shape of %.2g m has walls of at most %.2g m: bodies may pass through them", extent, wall)
        return grid

    @cached_property
    def solids(self) -> tuple[ConvexPiece, ...]:
        """The convex solids that the shape collides as: its pieces, its closed form, or its own hull. Empty for a
        plane or torus, and for a shape that is not convex and has no pieces."""
        if self.pieces:
            return tuple(hull(piece) for piece in self.pieces)
        if isinstance(self.sdf, ClosedForm):
            found = closed_form(self.sdf)
            return () if found is None else (found,)
        whole = convex_vertices(self.mesh)
        return (hull(whole),) if len(whole) else ()

    @property
    def _exact(self) -> MeshSdf | None:
        return self.sdf if isinstance(self.sdf, MeshSdf) and not self.solids else None

    @cached_property
    def triangles(self) -> TriangleTree | None:
        """The true surface of a shape that has the exact distance of a mesh and does not collide as solids."""
        return None if self._exact is None else triangle_tree(self._exact.mesh)

    @property
    def thickness(self) -> float:
        """m, of the thinnest walls, or of the thinnest solid; infinite for a plane."""
        if isinstance(self.sdf, PlaneSdf):
            return np.inf
        if self.solids and not isinstance(self.sdf, ClosedForm):
            return min(piece.thickness for piece in self.solids)
        return float(np.ptp(self.sdf.bounds, axis=0).min()) if self.grid is None else self.grid.thickness

    @cached_property
    def surface(self) -> ContactSurface:
        """The surface nodes for contacts; a plane has none. Raises SdfsimError for more than `MOST_PATCHES` pieces."""
        if isinstance(self.sdf, ClosedForm):
            return ContactSurface(**self._surface())
        faces = () if self.pieces else (self.mesh.vertices, self.mesh.faces)
        known = digest(self.sdf, self.nodes, [*self.pieces], *faces, LEAF, CLUMP, ROUNDED, APART, DENSEST_ON_GRID)
        path = user_cache("contact") / f"{known}-{BAKE_VERSION}-{VERSION}.npz"
        return ContactSurface(**cached_arrays(path, "the contact surface of a shape", self._surface))

    def _surface(self) -> dict[str, np.ndarray]:
        sdf, grid = self.sdf, self.grid
        if isinstance(sdf, BoxSdf | CylinderSdf | ConeSdf | TorusSdf) and len(self.nodes):
            spacing = max(0.5 * min(sdf.sizes), np.sqrt(_area(sdf) / DENSEST))
            if isinstance(sdf, BoxSdf):
                nodes = _on_box(np.array(sdf.half), spacing)
            else:
                nodes = _on_cylinder(sdf, spacing) if isinstance(sdf, CylinderSdf) else _revolved(sdf, spacing)
            patches, cover = patches_of(sdf, nodes, ()), np.full(len(nodes), 0.75 * spacing)
        else:
            nodes, samples = self.nodes, self.nodes[:0]
            if grid is not None:
                exact = self._exact is not None
                samples = _all_over(self.mesh, grid.cell) if exact else surface_samples(grid)
                if not self.pieces:
                    edges = on_edges(self.mesh, grid) if exact or isinstance(sdf, MlpSdf) else nodes[:0]
                    nodes = np.concatenate([nodes, edges])
                    nodes = np.concatenate([nodes, between(nodes, samples, APART * grid.cell)])
            patches = patches_of(sdf, nodes, self.pieces)
            cover = np.zeros(len(patches["node"]))
            if grid is not None and len(cover):
                from scipy.spatial import KDTree

                away, nearest = KDTree(patches["node"]).query(samples)
                np.maximum.at(cover, nearest, away)
                cover += grid.cell
        node, patch = patches.pop("node"), patches.pop("patch")
        return {**in_leaves(node, patch, cover, inwards(sdf, node)), **patches}


def _all_over(mesh: Mesh, spacing: float) -> np.ndarray:
    """Points [P, 3] m all over a mesh, closer than `spacing` m to each other."""
    count = int(MANY * face_normals(mesh)[1].sum() / spacing**2) + 1
    return sample_surface(mesh, count, np.random.default_rng(0))[0]


def between(nodes: np.ndarray, samples: np.ndarray, spacing: float) -> np.ndarray:
    """Those of the samples [P, 3] m of a surface that lie between its nodes [K, 3], at least `spacing` m apart.

    A network's shape has few nodes. A body that rolls from one to the next would sink in between them, until descent
    along the distance finds the contact, and lifting it out again would create energy. Shapes that already have as many
    nodes as a grid may have need no others.
    """
    from scipy.spatial import KDTree

    if len(nodes) >= DENSEST_ON_GRID:
        return nodes[:0]
    while len(kept := one_per_voxel(samples, spacing)) > DENSEST_ON_GRID:
        spacing *= 1.25
    return kept[KDTree(nodes).query(kept)[0] > 0.5 * spacing] if len(nodes) else kept


def on_edges(mesh: Mesh, grid: BakedGrid) -> np.ndarray:
    """Points [K, 3] m along the sharp edges of a fit's mesh that its grid rounds off. Between distant nodes such an
    edge would sink into the ground: descent along the distance ends on the rounded surface. For grids sampled from the
    mesh itself this is not used, as such nodes would throw up a rolling hoop."""
    spacing, normal = ALONG_EDGE * grid.cell, face_normals(mesh)[0]
    number, _ = directed_edges(mesh.faces)
    order = np.argsort(number, kind="stable")
    one, other = order[:-1], order[1:]
    bent = (number[one] == number[other]) & ((normal[one % len(normal)] * normal[other % len(normal)]).sum(1) < SHARP)
    edge = np.concatenate([mesh.faces[:, [k, (k + 1) % 3]] for k in range(3)])[one[bent]]
    start, way = mesh.vertices[edge[:, 0]], mesh.vertices[edge[:, 1]] - mesh.vertices[edge[:, 0]]
    parts = np.maximum(1, np.ceil(np.linalg.norm(way, axis=1) / spacing).astype(np.int64))
    row = np.repeat(np.arange(len(edge)), parts)
    part = np.arange(len(row)) - np.repeat(np.cumsum(parts) - parts, parts)
    points = np.concatenate([start[row] + (part / parts[row])[:, None] * way[row], start + way])
    points = points[interpolated(grid, points) > ROUNDED * grid.cell]
    while len(kept := one_per_voxel(points, spacing)) > MOST_ON_EDGES:
        spacing *= 1.5
    return kept


def patches_of(sdf: Sdf, nodes: np.ndarray, pieces: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """The `node`s that carry contact (with the vertices [V, 3] m of convex pieces, if the shape has any), the `patch`
    of each, and the labels of a `ContactSurface`. Raises SdfsimError for more than `MOST_PATCHES` pieces."""
    if len(pieces) == 0:
        return {"node": nodes, "patch": np.zeros(len(nodes), np.int64), **NO_LABELS}
    check_pieces("a shape", pieces)
    extent = float(np.ptp(sdf.bounds, axis=0).max())
    vertices, union = np.concatenate(pieces), PiecesDistance([convex_hull(piece) for piece in pieces])
    bare = union(vertices).distance > -OUTSIDE * extent
    nodes = union(nodes).closest  # nodes of a fitted surface lie slightly beside the pieces
    owner = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    cell = extent / LATTICE
    low = sdf.bounds[0] - cell
    count = np.ceil((sdf.bounds[1] + cell - low) / cell).astype(int) + 1
    places = lattice(*(low[axis] + cell * np.arange(count[axis]) for axis in range(3)))
    nearest = _nearest_piece(union, np.concatenate([places, nodes]))
    return {
        "node": np.concatenate([vertices[bare], nodes]),
        "patch": np.concatenate([owner[bare], nearest[len(places) :]]),
        "label": nearest[: len(places)].astype(np.int16).reshape(count),
        "label_low": low,
        "label_cell": np.array(cell),
    }


def check_pieces(what: str, pieces: Sequence[np.ndarray]) -> None:
    """Raises SdfsimError if `what` has more than `MOST_PATCHES` convex pieces."""
    if len(pieces) > MOST_PATCHES:
        message = f"{what} is made of {len(pieces):,} convex pieces (at most {MOST_PATCHES:,})"
        raise SdfsimError(message, "cut it into fewer pieces, or fit its mesh without pieces")


def _nearest_piece(union: PiecesDistance, places: np.ndarray) -> np.ndarray:
    """[P] int64: for each place the convex piece whose farthest face plane is nearest."""
    least, nearest = np.full(len(places), np.inf), np.zeros(len(places), np.int64)
    for k, planes in enumerate(union.planes):
        far = np.full(len(places), -np.inf)
        for plane in planes:
            np.maximum(far, places @ plane[:3] + plane[3], out=far)
        nearest[far < least] = k
        np.minimum(least, far, out=least)
    return nearest


def in_leaves(node: np.ndarray, patch: np.ndarray, cover: np.ndarray, facing: np.ndarray) -> dict[str, np.ndarray]:
    """Sort nodes [K, 3] into leaves, and leaves into clumps. A leaf has nodes of one patch and one side of a wall only:
    its deepest node stands for the whole leaf, and the descent from it cannot reach the other side of a wall."""
    leaves: list[np.ndarray] = []
    clump_leaf, clump_ball = [0], [np.zeros((0, 4))]
    for clump in halves(node, CLUMP) if len(node) else []:
        sided = np.column_stack([node, 0.5 * np.ptp(node[clump], axis=0).max() * facing])
        leaves += [leaf for p in np.unique(patch[clump]) for leaf in halves(sided, LEAF, clump[patch[clump] == p])]
        clump_leaf.append(len(leaves))
        clump_ball.append(_ball(node[clump], cover[clump]))
    order = np.concatenate([np.zeros(0, np.int64), *leaves])
    return {
        "node": node[order], "cover": cover[order],
        "leaf_node": np.cumsum([0, *map(len, leaves)], dtype=np.int64),
        "leaf_ball": np.concatenate([np.zeros((0, 4)), *(_ball(node[leaf], cover[leaf]) for leaf in leaves)]),
        "leaf_patch": np.array([patch[leaf[0]] for leaf in leaves], dtype=np.int64),
        "clump_leaf": np.array(clump_leaf, dtype=np.int64), "clump_ball": np.concatenate(clump_ball),
    }  # fmt: skip


NO_SURFACE = ContactSurface(
    **in_leaves(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3))), **NO_LABELS
)


def _ball(places: np.ndarray, around: np.ndarray) -> np.ndarray:
    """[1, 4] centre and radius of a ball around the part of the surface that nodes stand for."""
    middle = 0.5 * (places.min(0) + places.max(0))
    return np.array([[*middle, (np.linalg.norm(places - middle, axis=1) + around).max()]])


def _area(sdf: BoxSdf | CylinderSdf | ConeSdf | TorusSdf) -> float:
    if isinstance(sdf, BoxSdf):
        a, b, c = sdf.half
        return 8.0 * (a * b + b * c + c * a)
    if isinstance(sdf, TorusSdf):
        return 4.0 * np.pi**2 * sdf.radius * sdf.tube
    if isinstance(sdf, ConeSdf):
        return np.pi * sdf.radius * (sdf.radius + float(np.hypot(sdf.radius, 2.0 * sdf.half)))
    return 2.0 * np.pi * sdf.radius * (sdf.radius + 2.0 * sdf.half)


def _on_box(half: np.ndarray, spacing: float) -> np.ndarray:
    """Points all over a box, at most `spacing` m apart along its sides, corners and edges included."""
    axes = [np.linspace(-h, h, 1 + max(1, int(np.ceil(2.0 * h / spacing)))) for h in half]
    points = [axes[0][[0, -1]], axes[1][[0, -1]], axes[2][[0, -1]]]
    sides = [lattice(*(points[k] if k == axis else axes[k] for k in range(3))) for axis in range(3)]
    return np.unique(np.concatenate(sides), axis=0)


def _on_cylinder(sdf: CylinderSdf, spacing: float) -> np.ndarray:
    """Points all over a cylinder, at most `spacing` m apart, rims included."""
    turns = _turns(2.0 * np.pi * sdf.radius, spacing)
    circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    heights = np.linspace(-sdf.half, sdf.half, 1 + max(1, int(np.ceil(2.0 * sdf.half / spacing))))
    radii = np.linspace(0.0, sdf.radius, 1 + max(1, int(np.ceil(sdf.radius / spacing))))[:-1]
    side = [np.column_stack([sdf.radius * circle, np.full(len(circle), z)]) for z in heights]
    ends = [np.column_stack([r * circle, np.full(len(circle), z)]) for z in (-sdf.half, sdf.half) for r in radii[1:]]
    tips = [np.array([[0.0, 0.0, -sdf.half], [0.0, 0.0, sdf.half]])]
    return np.concatenate([*side, *ends, *tips])


def _revolved(sdf: ConeSdf | TorusSdf, spacing: float) -> np.ndarray:
    """Points all over a cone or torus, its rim and tip included: rings of points at most `spacing` m apart around
    places on its outline that are as close."""
    if isinstance(sdf, TorusSdf):
        turns = _turns(2.0 * np.pi * sdf.tube, spacing)
        outline = np.stack([sdf.radius + sdf.tube * np.cos(turns), sdf.tube * np.sin(turns)], axis=1)
    else:
        corners = np.array([[0.0, -sdf.half], [sdf.radius, -sdf.half], [0.0, sdf.half]])
        outline = corners[:1]
        for start, end in pairwise(corners):
            parts = int(np.ceil(np.linalg.norm(end - start) / spacing))
            outline = np.concatenate([outline, start + np.arange(1, parts + 1)[:, None] / parts * (end - start)])
    turns = _turns(2.0 * np.pi * float(outline[:, 0].max()), spacing)
    rings = [
        np.column_stack([r * np.cos(some), r * np.sin(some), np.full(len(some), z)])
        for r, z in outline
        for some in (turns if r > 0.0 else turns[:1],)
    ]
    return np.concatenate(rings)


def _turns(length: float, spacing: float) -> np.ndarray:
    """Angles, rad, of points around a circle of `length` m."""
    count = max(8, int(np.ceil(length / spacing)))
    return 2.0 * np.pi * np.arange(count) / count
