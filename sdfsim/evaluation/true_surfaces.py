"""Distance or overlap depth of bodies, measured on their true surfaces.

This does not use the contact search, baked grids or surface nodes. A surface is cut into triangles that lie on it, and
those that may hold the nearest (or deepest) point are cut further. A distance function is 1-Lipschitz, and convex if
the solid is convex, so its lowest value on a triangle has a bound. So crossing sticks, which have no vertex in each
other, are measured like everything else.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sdfsim.geometry.bvh import Winding
from sdfsim.geometry.mesh import Mesh, area_vectors, convex_hull, halves
from sdfsim.geometry.primitives import box
from sdfsim.sdf.closed_forms import COMMON_FORMS, BoxSdf, CapsuleSdf, ClosedForm, CylinderSdf, PlaneSdf, SphereSdf
from sdfsim.sdf.reference import PiecesDistance
from sdfsim.shape.shape import Shape

CLUSTER = 32  # triangles that are tested together at first
MOST = 384  # triangles of a pair that are cut further at once; the others make the answer less sure
ROUNDS = 26  # rounds of cutting
FINE = 2e-4  # relative to the smaller thickness: precision of a distance
ROUGH = 4e-3  # likewise, for a body that is not convex: bounds are weaker there, and there are many triangles
AROUND = 16  # corners of the circles with which cutting of round surfaces starts
TURN = 0.05  # largest winding number of a point that is outside everything
FLAT = 1e-7  # relative to a mesh's size: how far beyond a face's plane a vertex of a convex mesh may be
MOST_CONVEX = 6000  # faces: larger meshes are not tested for this

Distance = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class TrueSurface:
    """A shape's exact geometry in its own frame, at scale 1."""

    corner: np.ndarray  # [F, 3, 3] m, triangles with their corners on the surface, in clusters (empty for a plane)
    bend: np.ndarray  # [F] m, the surface's smaller radius of curvature (infinite if it is flat)
    start: np.ndarray  # [C + 1], where the clusters start
    ball: np.ndarray  # [C, 4] m, centres and radii of balls around the surface of each cluster
    bounds: np.ndarray  # [2, 3] m (infinite for a plane)
    distance: Distance  # [P, 3] m -> distance [P] m, negative inside, and gradient [P, 3]
    onto: Callable[[np.ndarray], np.ndarray]  # [P, 3] m near the surface -> the nearest point of a curved surface
    convex: bool
    turns_into_itself: int  # symmetry: 2 under every rotation (a ball), 1 under rotations about z, 0 none
    straight: float  # m, half length along z of a round side that is straight; 0 if there is none

    @property
    def thickness(self) -> float:
        """m, the smallest side of its box (infinite for a plane)."""
        return float(np.ptp(self.bounds, axis=0).min()) if np.isfinite(self.bounds).all() else np.inf


def true_surface(shape: Shape) -> TrueSurface:
    """The exact geometry of a shape: its closed form, its convex pieces, or its mesh. A cone and a torus are finely
    faceted."""
    if isinstance(shape.sdf, COMMON_FORMS):
        return _closed_form(shape.sdf)
    if shape.pieces:
        pieces = [convex_hull(points) for points in shape.pieces]
        if len(pieces) == 1:
            return of_mesh(pieces[0])
        return _of_pieces(PiecesDistance(pieces))
    return of_mesh(shape.mesh)


def _same(points: np.ndarray) -> np.ndarray:
    return points


def _closed_form(sdf: ClosedForm) -> TrueSurface:
    bounds = np.asarray(sdf.bounds)
    if isinstance(sdf, PlaneSdf):
        none = np.zeros((0, 3, 3))
        return TrueSurface(none, np.zeros(0), np.zeros(1, int), np.zeros((0, 4)), bounds, sdf, _same, True, 1, 0.0)
    if isinstance(sdf, BoxSdf):
        corners = box(tuple(np.ptp(bounds, axis=0)))
        corner = corners.vertices[corners.faces]
        return _clustered(corner, np.full(len(corner), np.inf), bounds, sdf, _same, turns=0)
    turn = 2 * np.pi * np.arange(AROUND) / AROUND
    circle = np.stack([np.cos(turn), np.sin(turn)], 1)
    if isinstance(sdf, CylinderSdf):
        radius, half = sdf.radius, sdf.half
        rings = [(radius, -half), (radius, half)]
    else:
        assert isinstance(sdf, SphereSdf | CapsuleSdf)
        radius, half = sdf.radius, sdf.half if isinstance(sdf, CapsuleSdf) else 0.0
        tilts = np.linspace(-np.pi / 2, np.pi / 2, AROUND // 2 + 1)
        lower, upper = tilts[tilts < 1e-9], tilts[tilts > (-1e-9 if half else 1e-9)]
        rings = [(radius * np.cos(t), -half + radius * np.sin(t)) for t in lower]
        rings += [(radius * np.cos(t), half + radius * np.sin(t)) for t in upper]
    corner, bend = [], []
    level = [np.column_stack([r * circle, np.full(AROUND, z)]) for r, z in rings]
    for below, above in pairwise(level):
        b, a, nb, na = below, above, np.roll(below, -1, 0), np.roll(above, -1, 0)
        corner += [np.stack([b, nb, na], 1), np.stack([b, na, a], 1)]
    bend = [np.full(len(part), radius) for part in corner]
    if isinstance(sdf, CylinderSdf):
        for ring, z in ((level[0], -half), (level[-1], half)):
            middle = np.broadcast_to([0.0, 0.0, z], ring.shape)
            corner.append(np.stack([ring, np.roll(ring, -1, 0), middle], 1))
            bend.append(np.full(AROUND, -radius))  # flat, with a round rim
    triangles, bent = np.concatenate(corner), np.concatenate(bend)
    area = np.linalg.norm(area_vectors(triangles), axis=1)
    kept = area > 1e-12 * radius * radius

    def onto(points: np.ndarray) -> np.ndarray:
        axis = np.zeros_like(points)
        if isinstance(sdf, CylinderSdf):
            axis[:, 2] = points[:, 2]
        else:
            axis[:, 2] = points[:, 2].clip(-half, half)
        away = points - axis
        length = np.linalg.norm(away, axis=1, keepdims=True)
        return axis + away * (radius / np.maximum(length, 1e-300))

    turns = 2 if isinstance(sdf, SphereSdf) else 1
    return _clustered(triangles[kept], bent[kept], bounds, sdf, onto, turns=turns, straight=half)


def of_mesh(mesh: Mesh) -> TrueSurface:
    import igl  # a third of what open3d takes to load, and in double precision

    size = float(np.ptp(mesh.vertices, axis=0).max())
    vertices, faces = np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces, dtype=np.int64)
    corner = vertices[faces]
    across = area_vectors(corner)
    area = np.linalg.norm(across, axis=1)
    normals = across / np.maximum(area, 1e-300)[:, None]
    planes = normals[area > 1e-12 * size * size]
    offset = (planes * corner[area > 1e-12 * size * size, 0]).sum(1)
    used = vertices[np.unique(faces)]
    convex = len(faces) <= MOST_CONVEX and all(
        (used @ planes[k : k + 256].T - offset[k : k + 256]).max() <= FLAT * size for k in range(0, len(planes), 256)
    )
    tree, winding = igl.AABB(), Winding(mesh)
    tree.init(vertices, faces)

    def distance(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        answer = tree.squared_distance(vertices, faces, np.ascontiguousarray(points))
        squared, face, closest = (np.asarray(part) for part in answer)
        length, normal, away = np.sqrt(squared), normals[face], points - closest
        # Wherever the nearest point is within a face, the way to the surface is along the normal. At edges the winding
        # number gives the sign; of a convex solid the planes of its faces, where one looks away.
        height = (away * normal).sum(1)
        inside = height < -0.5 * length
        a, b, c = (corner[face, k] for k in range(3))
        parts = [(np.cross(q - p, closest - p) * normal).sum(1) for p, q in ((a, b), (b, c), (c, a))]
        unclear = (np.min(parts, axis=0) <= 1e-6 * area[face]) & (length > 0) & (inside | (not convex))
        if unclear.any() and convex:
            parts = np.array_split(points[unclear], 1 + unclear.sum() * len(planes) // 2**22)
            inside[unclear] = np.concatenate([(part @ planes.T - offset).max(1) < 0 for part in parts])
        elif unclear.any():
            inside[unclear] = winding(points[unclear]) > 0.5
        # If a surface is folded flat, the nearest layer may face the other way. Behind an open surface the winding
        # number is a fraction.
        behind = inside & ~unclear
        if not convex and behind.any():
            inside[behind] = winding(points[behind]) > TURN
        found = np.where(inside, -length, length)
        near = length < 1e-9 * size
        return found, np.where(near[:, None], normal, away / np.where(near, 1.0, found)[:, None])

    return _triangles(mesh, distance, convex=convex)


def _of_pieces(oracle: PiecesDistance) -> TrueSurface:
    def distance(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = oracle(points)
        away = points - found.closest
        return found.distance, away / np.where(found.distance == 0, 1.0, found.distance)[:, None]

    return _triangles(oracle.surface, distance, convex=False)


def _triangles(mesh: Mesh, distance: Distance, *, convex: bool) -> TrueSurface:
    corner = mesh.vertices[mesh.faces]
    bounds = np.stack([corner.min((0, 1)), corner.max((0, 1))])
    return _clustered(corner, np.full(len(corner), np.inf), bounds, distance, _same, turns=0, convex=convex)


def _clustered(
    corner: np.ndarray, bend: np.ndarray, bounds: np.ndarray, distance: Distance,
    onto: Callable[[np.ndarray], np.ndarray], *, turns: int, convex: bool = True, straight: float = 0.0,
) -> TrueSurface:  # fmt: skip
    parts = halves(corner.mean(1), CLUSTER)
    order = np.concatenate(parts)
    start = np.concatenate([[0], np.cumsum([len(p) for p in parts])])
    corner, bend = corner[order], bend[order]
    balls = []
    for first, last in pairwise(start):
        points = corner[first:last].reshape(-1, 3)
        centre = 0.5 * (points.min(0) + points.max(0))
        radius = np.linalg.norm(points - centre, axis=1).max()
        curved = np.abs(bend[first:last])
        # How far a round surface extends beyond triangles with their corners on it.
        out = radius if not np.isfinite(curved).all() else curved.min() * (1 - np.cos(np.pi / AROUND)) * 2.5
        balls.append([*centre, radius + (out if np.isfinite(curved).any() else 0.0)])
    return TrueSurface(corner, bend, start, np.array(balls), bounds, distance, onto, convex, turns, straight)


class Gaps(NamedTuple):
    """The distance between the surfaces of P pairs, negative if the bodies overlap."""

    apart: np.ndarray  # [P] m, at the best point that was found: never too low
    surely: np.ndarray  # [P] m, a lower bound of the distance
    point: np.ndarray  # [P, 3] m, the best point, world
    normal: np.ndarray  # [P, 3] from the second body to the first, or the other way round: see `sign`
    sign: np.ndarray  # [P], 1 if the point is on the first body, -1 if it is on the second


@dataclass(frozen=True)
class Placed:
    """K bodies with poses."""

    solid: np.ndarray  # [K] int, which solid
    scale: np.ndarray  # [K]
    origin: np.ndarray  # [K, 3] m, origins of the solids' frames
    turn: np.ndarray  # [K, 3, 3], solid -> world

    def __getitem__(self, rows: np.ndarray) -> "Placed":
        return Placed(self.solid[rows], self.scale[rows], self.origin[rows], self.turn[rows])


def gaps(solids: Sequence[TrueSurface], first: Placed, second: Placed, most: np.ndarray) -> Gaps:
    """Distances or overlap depths of P pairs (the depth is that of the deepest point of either surface in the other
    body). Distances beyond `most` [P] m are not computed exactly."""
    count = len(first.solid)
    smooth = np.array([s.convex for s in solids])
    empty = np.array([len(s.corner) == 0 for s in solids])
    # Cut the surface whose other body is convex; a plane's surface cannot be cut.
    swap = (empty[first.solid] | (~smooth[second.solid] & smooth[first.solid])) & ~empty[second.solid]
    thin = np.minimum(*(p.scale * np.array([s.thickness for s in solids])[p.solid] for p in (first, second)))
    apart, surely = np.full(count, np.inf), np.full(count, -np.inf)
    point, normal, sign = np.zeros((count, 3)), np.zeros((count, 3)), np.ones(count)

    def take(rows: np.ndarray, backwards: np.ndarray) -> None:
        for flag in (False, True):
            mine, other = (second, first) if flag else (first, second)
            one = rows[(backwards[rows] == flag) & ~empty[mine.solid[rows]]]
            if len(one):
                fine = np.where(smooth[other.solid[one]], FINE, ROUGH) * thin[one]
                low, at_least, where, slope = _lowest(solids, mine[one], other[one], most[one], fine, apart[one])
                better = low < apart[one]
                apart[one[better]], point[one[better]], normal[one[better]] = low[better], where[better], slope[better]
                surely[one], sign[one[better]] = np.maximum(surely[one], at_least), -1.0 if flag else 1.0

    every = np.arange(count)
    take(every, swap)
    inside = surely <= 0
    # If a body is swallowed, its whole surface is inside the other, and the other's surface is far.
    for k in np.unique(first.solid) if count else ():
        rows = every[(first.solid == k) & ~inside]
        inside[rows] = _holds(solids, first, second, rows) | _holds(solids, second, first, rows)
    take(every[inside], ~swap)
    return Gaps(apart, np.where(apart > 0, np.minimum(surely, apart), apart), point, normal, sign)


def _holds(solids: Sequence[TrueSurface], one: Placed, other: Placed, rows: np.ndarray) -> np.ndarray:
    """[R] whether a point of `other`'s surface is inside `one`."""
    found = np.zeros(len(rows), bool)
    for a in np.unique(one.solid[rows]):
        for b in np.unique(other.solid[rows]):
            some = (one.solid[rows] == a) & (other.solid[rows] == b)
            r = rows[some]
            if not len(r) or not len(solids[b].corner):
                continue
            world = other.origin[r] + other.scale[r, None] * (other.turn[r] @ solids[b].corner[0, 0])
            local = np.einsum("pji,pj->pi", one.turn[r], world - one.origin[r]) / one.scale[r, None]
            found[some] = solids[a].distance(local)[0] < 0
    return found


def _lowest(
    solids: Sequence[TrueSurface], mine: Placed, other: Placed, most: np.ndarray, fine: np.ndarray, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The lowest distance to another body over the surfaces of P bodies, if it is lower than what is `known`: the
    distance that was found, its lower bound, the point (world) and the gradient."""
    count = len(mine.solid)
    best, missed = known.copy(), np.full(count, np.inf)
    where, slope = np.zeros((count, 3)), np.zeros((count, 3))
    smooth = np.array([s.convex for s in solids])[other.solid]
    straight = np.array([s.straight for s in solids])

    def world(pair: np.ndarray, points: np.ndarray) -> np.ndarray:
        turned = np.einsum("pij,p...j->p...i", mine.turn[pair], points)
        shape = (-1,) + (1,) * (points.ndim - 1)
        origin = mine.origin[pair].reshape((len(pair),) + (1,) * (points.ndim - 2) + (3,))
        return origin + mine.scale[pair].reshape(shape) * turned

    def ask(pair: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances m and gradients (world) at points of the world."""
        found, gradient = np.empty(len(pair)), np.empty((len(pair), 3))
        local = np.einsum("pji,pj->pi", other.turn[pair], at - other.origin[pair]) / other.scale[pair, None]
        kind = other.solid[pair]
        for k in np.unique(kind):
            rows = kind == k
            d, g = solids[k].distance(local[rows])
            found[rows], gradient[rows] = d, g
        return found * other.scale[pair], np.einsum("pij,pj->pi", other.turn[pair], gradient)

    def keep_lowest(pair: np.ndarray, found: np.ndarray, at: np.ndarray, gradient: np.ndarray) -> None:
        order = np.lexsort((found, pair))
        first = order[np.concatenate([[True], pair[order][1:] != pair[order][:-1]])]
        better = first[found[first] < best[pair[first]]]
        best[pair[better]], where[pair[better]], slope[pair[better]] = found[better], at[better], gradient[better]

    # Clusters first.
    pairs, corners, bends = [], [], []
    for k in np.unique(mine.solid):
        body, rows = solids[k], np.flatnonzero(mine.solid == k)
        clusters = len(body.ball)
        pair, cluster = np.repeat(rows, clusters), np.tile(np.arange(clusters), len(rows))
        if clusters > 1:
            at, reach = world(pair, body.ball[cluster, :3]), mine.scale[pair] * body.ball[cluster, 3]
            local = np.einsum("pji,pj->pi", other.turn[pair], at - other.origin[pair])
            box = np.stack([s.bounds for s in solids])[other.solid[pair]] * other.scale[pair, None, None]
            beyond = np.maximum(np.maximum(box[:, 0] - local, local - box[:, 1]), 0.0)
            near = np.linalg.norm(beyond, axis=1) - reach <= most[pair]
            pair, cluster, at, reach = pair[near], cluster[near], at[near], reach[near]
            found, _ = ask(pair, at)
            upper = np.full(count, np.inf)
            np.minimum.at(upper, pair, found + reach)
            near = found - reach <= np.minimum(upper, most)[pair]
            pair, cluster = pair[near], cluster[near]
        size = (body.start[1:] - body.start[:-1])[cluster]
        triangle = np.repeat(body.start[cluster] - np.cumsum(size) + size, size) + np.arange(size.sum())
        pairs.append(np.repeat(pair, size))
        corners.append(body.corner[triangle])
        bends.append(body.bend[triangle])
    pair, corner, bend = np.concatenate(pairs), np.concatenate(corners), np.concatenate(bends)
    lower = np.full(len(pair), -np.inf)

    for _ in range(ROUNDS):
        if not len(pair):
            break
        middle = corner.mean(1)
        for k in np.unique(mine.solid[pair]):  # the midpoint on a curved surface is moved onto it
            rows = np.flatnonzero((mine.solid[pair] == k) & (bend > 0) & np.isfinite(bend))
            if len(rows):
                middle[rows] = solids[k].onto(middle[rows])
        at, corners_at = world(pair, middle), world(pair, corner)
        found, gradient = ask(pair, at)
        keep_lowest(pair, found, at, gradient)
        offset = corners_at - at[:, None]
        reach = np.linalg.norm(offset, axis=2).max(1)
        scale = mine.scale[pair]
        # How far a curved surface extends beyond the triangle: its sagitta, or that of the rim for a flat end with a
        # round rim.
        side = np.abs(corner[..., 2]).max(1) <= straight[mine.solid[pair]] * (1 + 1e-9)
        chord = np.where(side, scale * np.linalg.norm((corner - middle[:, None])[..., :2], axis=2).max(1), reach)
        out = np.where(np.isfinite(bend), np.minimum(chord**2 / (np.abs(bend) * scale), 2 * chord), 0.0)
        along = np.einsum("pki,pi->pk", offset, gradient)
        lowest = along.argmin(1)
        lower = np.where(smooth[pair], np.maximum(found + along.min(1), found - reach) - out, found - reach - out)
        ahead = np.arange(len(pair))
        tip = corners_at[ahead, lowest]
        worth = lower < best[pair] - fine[pair]
        if worth.any():
            rows = np.flatnonzero(worth)
            value, tilt = ask(pair[rows], tip[rows])
            keep_lowest(pair[rows], value, tip[rows], tilt)
        left = (lower < best[pair] - fine[pair]) & (lower <= most[pair])
        # Triangles that are no longer cut are at least this far.
        np.minimum.at(missed, pair[~left], lower[~left])
        pair, corner, bend, lower = pair[left], corner[left], bend[left], lower[left]
        order = np.lexsort((lower, pair))
        pair, corner, bend, lower = pair[order], corner[order], bend[order], lower[order]
        rank = np.arange(len(pair)) - np.searchsorted(pair, pair)
        np.minimum.at(missed, pair[rank >= MOST], lower[rank >= MOST])
        kept = rank < MOST
        pair, corner, bend, lower = pair[kept], corner[kept], bend[kept], lower[kept]
        for _ in range(2):
            side = np.abs(corner[..., 2]).max(1) <= straight[mine.solid[pair]] * (1 + 1e-9)
            pair, corner, bend, lower = _halved(solids, mine, pair, corner, bend, lower, side & smooth[pair])
    np.minimum.at(missed, pair, lower)
    return best, np.minimum(best, missed), where, slope


def _halved(
    solids: Sequence[TrueSurface],
    mine: Placed,
    pair: np.ndarray,
    corner: np.ndarray,
    bend: np.ndarray,
    lower: np.ndarray,
    side: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cut every triangle across its longest edge, with new corners on the round surface or rim. On the straight `side`
    of a round body that meets a convex one, only the extent around it makes the bound worse."""
    edge = np.roll(corner, -1, 1) - corner
    edge[side, :, 2] *= 0.05
    edge = np.linalg.norm(edge, axis=2)
    longest, row = edge.argmax(1), np.arange(len(pair))
    a, b, c = (corner[row, (longest + k) % 3] for k in range(3))
    middle = 0.5 * (a + b)
    for k in np.unique(mine.solid[pair]):
        rows = np.flatnonzero((mine.solid[pair] == k) & np.isfinite(bend))
        if not len(rows):
            continue
        # In the flat triangles of an end only edges along the rim are curved.
        radius = np.abs(bend[rows])
        rim = np.minimum(*(np.linalg.norm(p[rows, :2], axis=1) for p in (a, b))) > radius * (1 - 1e-9)
        rows = rows[(bend[rows] > 0) | rim]
        middle[rows] = solids[k].onto(middle[rows])
    one, two = np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)
    return np.tile(pair, 2), np.concatenate([one, two]), np.tile(bend, 2), np.tile(lower, 2)
