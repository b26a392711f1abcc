"""The convex pieces of a shape that contacts use: closed forms, and hulls with flat faces."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from sdfsim.base.lazy import made_once
from sdfsim.geometry.mesh import Mesh
from sdfsim.sdf.closed_forms import BoxSdf, CapsuleSdf, ConeSdf, CylinderSdf, SphereSdf
from sdfsim.sdf.sdf import Sdf

FLAT = 1e-6  # faces whose unit normals differ by less are one face
DENT = 5e-4  # relative to the largest extent: a mesh with shallower dents counts as convex
HOLLOW = 1e-3  # relative: how much less volume than its hull a convex mesh may have
CORNERS = 64  # corners of a face at most; of a face with more, this many evenly chosen ones bound the contact


@dataclass(frozen=True, eq=False)
class ConvexPiece:
    """One convex solid in the frame of its shape, at scale 1."""

    kind: str  # "sphere", "capsule", "box", "cylinder", "cone" or "hull"
    sizes: tuple[float, ...]  # m, as the closed form has them; empty for a hull
    ball: np.ndarray  # [4] m, centre and radius of a ball around it
    thickness: float  # m, the least distance of two parallel planes that enclose it, among face normals
    vertices: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # [V, 3] m, for a hull
    normals: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # [F, 3] outward, one for each flat face
    loops: tuple[np.ndarray, ...] = ()  # [F] the vertices of each face, counter-clockwise as seen from outside
    beside: tuple[np.ndarray, ...] = ()  # [V] the vertices at the other ends of each one's edges
    around: tuple[np.ndarray, ...] = ()  # [V] the faces that meet there


def closed_form(sdf: Sdf) -> ConvexPiece | None:
    """The convex piece of a closed form; None for a plane, a torus and other SDFs."""
    if isinstance(sdf, SphereSdf):
        return ConvexPiece("sphere", sdf.sizes, np.array([0, 0, 0, sdf.radius]), 2.0 * sdf.radius)
    if isinstance(sdf, CapsuleSdf):
        return ConvexPiece("capsule", sdf.sizes, np.array([0, 0, 0, sdf.radius + sdf.half]), 2.0 * sdf.radius)
    if isinstance(sdf, BoxSdf):
        return ConvexPiece("box", sdf.sizes, np.array([0, 0, 0, np.linalg.norm(sdf.half)]), 2.0 * min(sdf.half))
    if isinstance(sdf, CylinderSdf):
        ball = np.array([0, 0, 0, np.hypot(sdf.radius, sdf.half)])
        return ConvexPiece("cylinder", sdf.sizes, ball, 2.0 * min(sdf.radius, sdf.half))
    if isinstance(sdf, ConeSdf):
        ball = np.array([0, 0, 0, np.hypot(sdf.radius, sdf.half)])
        across = 2.0 * sdf.radius / np.hypot(sdf.radius, 2.0 * sdf.half)
        return ConvexPiece("cone", sdf.sizes, ball, 2.0 * sdf.half * min(1.0, across))
    return None


def hull(vertices: np.ndarray) -> ConvexPiece:
    """The convex hull of vertices [V, 3] m that are not all in one plane."""
    from scipy.spatial import ConvexHull

    found = ConvexHull(vertices)
    corners, planes = vertices[found.vertices], found.equations[:, :3]
    number = np.full(len(vertices), -1)
    number[found.vertices] = np.arange(len(corners))
    triangles = number[found.simplices]
    sides = np.diff(corners[triangles], axis=1)
    facing = (np.cross(sides[:, 0], sides[:, 1]) * planes).sum(1) > 0.0
    triangles[~facing] = triangles[~facing][:, ::-1]
    first, owner = np.unique(_flat(planes), return_inverse=True)
    normals = planes[first]
    of_face = _grouped(owner, np.arange(len(triangles)), len(first))
    loops = tuple(
        triangles[one[0]] if len(one) == 1 else _around(corners, np.unique(triangles[one]), normal)
        for one, normal in zip(of_face, normals, strict=True)
    )
    parts = np.array_split(normals, max(1, normals.size * len(corners) // 2**23))  # so that tables stay small
    thickness = min(float(np.ptp(corners @ part.T, axis=0).min()) for part in parts)
    middle = 0.5 * (corners.min(0) + corners.max(0))
    ball = np.array([*middle, np.linalg.norm(corners - middle, axis=1).max()])
    sides = np.concatenate([triangles[:, [i, j]] for i, j in ((0, 1), (1, 2), (2, 0), (1, 0), (2, 1), (0, 2))])
    beside = _grouped(sides[:, 0], sides[:, 1], len(corners))
    around = _grouped(triangles.reshape(-1), np.repeat(owner, 3), len(corners))
    return ConvexPiece("hull", (), ball, thickness, corners, normals, loops, beside, around)


def _flat(normals: np.ndarray) -> np.ndarray:
    """[F] for each triangle of a hull, with unit normals [F, 3], the first one that is in the same flat face."""
    from scipy.spatial import KDTree

    # Qhull gives most triangles of a flat face exactly the same normal; those that differ by less than FLAT are rare.
    _, first, same = np.unique(normals, axis=0, return_index=True, return_inverse=True)
    near = first[KDTree(normals[first]).query_pairs(FLAT, 1, output_type="ndarray")]
    leader = np.arange(len(normals))
    for one, other in sorted(np.sort(near, axis=1).tolist()):
        if leader[one] == one and leader[other] == other:
            leader[other] = one
    return leader[first[same]]


def _grouped(owner: np.ndarray, value: np.ndarray, count: int) -> tuple[np.ndarray, ...]:
    """The different values that belong to each of `count` owners."""
    most = int(value.max()) + 1
    pairs = np.unique(owner * most + value)
    ends = np.searchsorted(pairs, most * np.arange(count + 1))
    pairs %= most
    return tuple(pairs[i:j] for i, j in pairwise(ends))


def _around(corners: np.ndarray, chosen: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The vertices of a flat face in order around it."""
    places = corners[chosen] - corners[chosen].mean(0)
    one = places[np.argmax(np.linalg.norm(places, axis=1))]
    one = one - (one @ normal) * normal
    x, y, z = normal
    two = np.array([y * one[2] - z * one[1], z * one[0] - x * one[2], x * one[1] - y * one[0]])
    loop = chosen[np.argsort(np.arctan2(places @ two, places @ one), kind="stable")]
    return loop if len(loop) <= CORNERS else loop[np.linspace(0, len(loop), CORNERS, endpoint=False).astype(int)]


def convex_vertices(mesh: Mesh) -> np.ndarray:
    """[V, 3] m, the vertices of a mesh that is convex except for small dents and rounding; empty for other meshes."""
    return mesh.vertices if made_once(mesh, _is_convex) else np.zeros((0, 3))


def _is_convex(mesh: Mesh) -> bool:
    from scipy.spatial import ConvexHull, QhullError

    if len(mesh.faces) < 4:
        return False
    try:
        found = ConvexHull(mesh.vertices)
    except QhullError:
        return False  # flat
    corners = mesh.vertices[mesh.faces]
    volume = abs(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))) / 6.0
    if not abs(volume - found.volume) <= HOLLOW * found.volume:
        return False
    # The deepest point of a dent is close enough to a corner, or to the middle of an edge or a face.
    middles = 0.5 * (corners + np.roll(corners, 1, axis=1))
    places = np.concatenate([mesh.vertices, corners.mean(1), middles.reshape(-1, 3)])
    planes, deep = np.unique(found.equations.round(9), axis=0), DENT * np.ptp(mesh.vertices, axis=0).max()
    parts = np.array_split(places, max(1, len(places) * len(planes) // 2**22))
    return all((part @ planes[:, :3].T + planes[:, 3]).max(1).min() >= -deep for part in parts)
