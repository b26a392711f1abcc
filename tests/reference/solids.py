"""Convex solids in closed form, and how far two are apart: the truth of the contact fuzz, in NumPy and qhull.

The width of the gap between A and B as seen along a unit vector n is s(n) = min over A of x.n - max over B of x.n. No n
shows more than the distance, and two points of the solids are never nearer than it: so a normal and two points with
the same number prove it. Of solids that overlap the depth is the least -s(n), which the normals of faces, the crosses
of edges, and of what is round a search beside the best of these find.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

RIM = 32  # directions of a rim, over half a turn
HALF = np.pi * np.arange(RIM) / RIM
RING = 2.0 * np.pi * np.arange(16) / 16  # directions around a normal
KINDS = ("sphere", "capsule", "box", "cylinder", "hull")


def across(axis: np.ndarray) -> np.ndarray:
    """[2, 3] unit vectors across an axis and each other."""
    u = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.6 else [0.0, 1.0, 0.0])
    u /= np.linalg.norm(u)
    return np.stack([u, np.cross(axis, u)])


def circle(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """[K, 3] unit vectors across an axis, at angles [K]."""
    return np.stack([np.cos(angle), np.sin(angle)], 1) @ across(axis)


@dataclass(frozen=True)
class Solid:
    """A core (corners, or two discs) and by how much the solid is larger than it on all sides, in the world."""

    kind: str
    core: np.ndarray  # [V, 3] m, corners; of a cylinder the middles of its ends, of a cone that of its end, and its tip
    axis: np.ndarray  # [3], of a cylinder or cone
    disc: float  # m, radius of a cylinder's ends or a cone's, else 0
    round: float  # m
    planes: np.ndarray  # [F, 4] outward normals and offsets of flat faces: n.x + d <= 0 inside
    edges: np.ndarray  # [E, 3] unit directions, of a rim some tangents
    thickness: float  # m
    extent: float  # m

    def reach(self, along: np.ndarray) -> np.ndarray:
        """[K] how far the core reaches along vectors [K, 3]."""
        most = along @ self.core.T
        if self.disc:
            wide = self.disc * np.linalg.norm(np.cross(along, self.axis), axis=1)
            most[:, : 1 if self.kind == "cone" else 2] += wide[:, None]
        return most.max(1)

    def outside(self, points: np.ndarray) -> np.ndarray:
        """[K] how far points [K, 3] m are from the surface, negative inside; beyond a hull's edge less than that."""
        if self.kind in ("box", "hull"):
            return (points @ self.planes[:, :3].T + self.planes[:, 3]).max(1)
        low, high = self.core[0], self.core[-1]
        side = high - low
        square = side @ side
        if not self.disc:
            share = np.clip((points - low) @ side / square, 0.0, 1.0) if square else np.zeros(len(points))
            return np.linalg.norm(points - low - share[:, None] * side, axis=1) - self.round
        if self.kind == "cone":
            return self._beside_cone(points)
        from_middle = points - 0.5 * (low + high)
        up = from_middle @ self.axis
        beside = np.linalg.norm(from_middle - up[:, None] * self.axis, axis=1) - self.disc
        above = np.abs(up) - 0.5 * np.sqrt(square)
        beyond = np.hypot(np.maximum(beside, 0.0), np.maximum(above, 0.0))
        return np.where((beside > 0) | (above > 0), beyond, np.maximum(beside, above))

    def _beside_cone(self, points: np.ndarray) -> np.ndarray:
        """By the nearest points of the two lines that turn about its axis: those of its disc and its side."""
        up = (points - self.core[0]) @ self.axis
        beside = np.linalg.norm(points - self.core[0] - up[:, None] * self.axis, axis=1)
        tall, place = float((self.core[1] - self.core[0]) @ self.axis), np.stack([beside, up], 1)
        away = []
        for start, end in (((0.0, 0.0), (self.disc, 0.0)), ((self.disc, 0.0), (0.0, tall))):
            line = np.subtract(end, start)
            share = np.clip((place - start) @ line / (line @ line), 0.0, 1.0)
            away.append(np.linalg.norm(place - start - share[:, None] * line, axis=1))
        inside = (up > 0) & (beside / self.disc + up / tall < 1)
        return np.where(inside, -1.0, 1.0) * np.minimum(*away)

    def face(self, along: np.ndarray) -> np.ndarray | None:
        """[K, 3] m, the corners of the flat face whose normal is `along`; None where there is none."""
        if not len(self.planes):
            return None
        facing = self.planes[:, :3] @ along
        best = int(facing.argmax())
        if np.linalg.norm(self.planes[best, :3] - along) > 1e-7:
            return None
        if self.disc:
            middle = self.core[0 if self.kind == "cone" else int((self.core @ along).argmax())]
            return middle + self.disc * circle(along, np.linspace(0.0, 2.0 * np.pi, 256, endpoint=False))
        return self.core[np.abs(self.core @ self.planes[best, :3] + self.planes[best, 3]) < 1e-8 * self.extent]


def placed(kind: str, sizes: np.ndarray, turn: np.ndarray, place: np.ndarray, scale: float) -> Solid:
    """A solid of radii and half extents, or a hull of vertices, turned by [3, 3], scaled, and moved."""
    sizes = scale * np.asarray(sizes, float)
    none, disc, rounded, axis = np.zeros((0, 3)), 0.0, 0.0, turn[:, 2]
    normals = offsets = edges = none
    if kind == "sphere":
        core, rounded, thickness = np.zeros((1, 3)), sizes[0], 2.0 * sizes[0]
    elif kind == "capsule":
        core, rounded, thickness = np.outer([-sizes[1], sizes[1]], [0, 0, 1.0]), sizes[0], 2.0 * sizes[0]
        edges = np.array([[0, 0, 1.0]])
    elif kind == "box":
        signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), -1).reshape(-1, 3)
        core, thickness, edges = signs * sizes, 2.0 * sizes.min(), np.eye(3)
        normals, offsets = np.concatenate([np.eye(3), -np.eye(3)]), -np.concatenate([sizes, sizes])
    elif kind == "cone":
        core, disc = np.outer([-sizes[1], sizes[1]], [0, 0, 1.0]), sizes[0]
        slant = np.hypot(sizes[0], 2.0 * sizes[1])
        thickness = 2.0 * sizes[1] * min(1.0, 2.0 * sizes[0] / slant)
        angle = 2.0 * np.pi * np.arange(2 * RIM) / (2 * RIM)
        rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(2 * RIM)], 1)
        sides = (np.array([0, 0, 2.0 * sizes[1]]) - sizes[0] * rim) / slant
        edges, normals, offsets = np.concatenate([rim[:RIM], sides]), np.array([[0, 0, -1.0]]), np.array([-sizes[1]])
    elif kind == "cylinder":
        core, disc, thickness = np.outer([-sizes[1], sizes[1]], [0, 0, 1.0]), sizes[0], 2.0 * sizes.min()
        rim = np.stack([np.cos(HALF), np.sin(HALF), np.zeros(RIM)], 1)
        edges, normals = np.concatenate([[[0, 0, 1.0]], rim]), np.array([[0, 0, 1.0], [0, 0, -1.0]])
        offsets = np.array([-sizes[1], -sizes[1]])
    else:
        found = ConvexHull(sizes)
        corner = sizes[found.simplices]
        normals, offsets, core = found.equations[:, :3], found.equations[:, 3], sizes[found.vertices]
        edges = (corner - np.roll(corner, 1, axis=1)).reshape(-1, 3)
        edges = edges / np.linalg.norm(edges, axis=1, keepdims=True)
        edges = edges * np.sign(edges[np.arange(len(edges)), np.abs(edges).argmax(1)])[:, None]
        edges = edges[np.unique(edges.round(10), axis=0, return_index=True)[1]]
        thickness = np.ptp(core @ normals.T, axis=0).min()
    core = core @ turn.T + place
    planes = np.zeros((0, 4))
    if len(normals):
        normals = normals @ turn.T
        planes = np.column_stack([normals, offsets - normals @ place])
    extent = np.ptp(core, axis=0).max() + 2.0 * (disc + rounded)
    return Solid(kind, core, axis, disc, rounded, planes, edges @ turn.T, float(thickness), float(extent))


def width(a: Solid, b: Solid, n: np.ndarray) -> np.ndarray:
    """[K] of the gap between two solids as seen along unit vectors [K, 3] from the second to the first."""
    return -a.reach(-n) - b.reach(n) - a.round - b.round


def views(a: Solid, b: Solid) -> tuple[np.ndarray, np.ndarray]:
    """[K, 3] normals, among them those of least depth of flat faces and straight edges, and what each shows [K]."""
    n = [a.planes[:, :3], b.planes[:, :3], np.cross(a.edges[:, None], b.edges[None]).reshape(-1, 3)]
    n += [circle(solid.axis, HALF) for solid in (a, b) if solid.kind in ("capsule", "cylinder", "cone")]
    for solid in (solid for solid in (a, b) if solid.kind == "cone"):
        tall, out = np.linalg.norm(solid.core[1] - solid.core[0]), circle(solid.axis, HALF)
        n += [tall * way + solid.disc * solid.axis for way in (out, -out)]
    n += [[a.core.mean(0) - b.core.mean(0)], [[0.0, 0.0, 1.0]]]
    n = np.concatenate(n)
    length = np.linalg.norm(n, axis=1)
    n = n[length > 1e-9] / length[length > 1e-9, None]
    n = np.concatenate([n, -n])
    return n, width(a, b, n)


def least_depth(a: Solid, b: Solid) -> tuple[float, np.ndarray]:
    """The widest view of two solids whose cores overlap (below 0), and its normal."""
    n, found = views(a, b)
    best = int(found.argmax())
    if not a.disc and not b.disc:
        return float(found[best]), n[best]
    tried = []
    for _ in range(3):
        best = int(found.argmax())
        if found[best] == -np.inf:
            break
        tried.append(_climbed(a, b, n[best]))
        found[n @ n[best] > np.cos(0.2)] = -np.inf
    return max(tried, key=lambda one: one[0])


def _climbed(a: Solid, b: Solid, n: np.ndarray) -> tuple[float, np.ndarray]:
    """The widest view near a normal: a search in narrowing circles."""
    best, step = float(width(a, b, n[None])[0]), 0.1
    for _ in range(120):
        ring = step * circle(n, RING)
        tried = n + np.concatenate([ring, 0.5 * ring])
        tried /= np.linalg.norm(tried, axis=1, keepdims=True)
        found = width(a, b, tried)
        k = int(found.argmax())
        if found[k] > best:
            best, n = float(found[k]), tried[k]
        else:
            step *= 0.4
    return best, n


def is_sharp(a: Solid, b: Solid, n: np.ndarray) -> bool:
    """Whether every little tilt of a face's normal shows less of the gap in proportion: it is then the only one."""
    tilted = n + 1e-4 * circle(n, RING)
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    lost = width(a, b, n[None])[0] - width(a, b, tilted)
    return bool((lost > 1e-6 * min(a.thickness, b.thickness)).all())


def overlap(first: np.ndarray, second: np.ndarray, n: np.ndarray) -> float:
    """m^2, the area that two convex polygons [K, 3] have in common as seen along n."""
    frame = across(n).T
    kept, bounds = ring_of(first @ frame), ring_of(second @ frame)
    for p, q in zip(bounds, np.roll(bounds, -1, axis=0), strict=True):
        if not len(kept):
            return 0.0
        side = (q[0] - p[0]) * (kept[:, 1] - p[1]) - (q[1] - p[1]) * (kept[:, 0] - p[0])
        after, beyond = np.roll(kept, -1, axis=0), np.roll(side, -1)
        cut = (side > 0) != (beyond > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = kept + np.where(cut, side / (side - beyond), 0.0)[:, None] * (after - kept)
        rows = np.stack([kept, crossing], 1).reshape(-1, 2)
        kept = rows[np.stack([side > 0, cut], 1).reshape(-1)]
    return area(kept)


def ring_of(points: np.ndarray) -> np.ndarray:
    """Points [K, 2] around a convex polygon in turn."""
    away = points - points.mean(0)
    return points[np.argsort(np.arctan2(away[:, 1], away[:, 0]), kind="stable")]


def area(ring: np.ndarray) -> float:
    """m^2, of a polygon [K, 2]."""
    if len(ring) < 3:
        return 0.0
    ring = ring - ring[0]
    x, y = ring.T
    return float(0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
