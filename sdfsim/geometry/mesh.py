"""Triangle meshes: cleaning, convex hulls, normals, and points on surfaces."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sdfsim.base.errors import SdfsimError

FAR = 100.0  # sizes from the origin: beyond, single precision is coarser than a hundred thousandth of the size
FARTHEST = 1e12  # m from the origin: beyond, double precision cannot separate the vertices of a room-sized mesh


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: [V, 3] float64 m.
        faces: [F, 3] int64 vertex indices, counter-clockwise seen from outside.
        colors: [V, 3] uint8 RGB, or None.
        uv: [V, 2] place of each vertex in the texture, from its upper left (0, 0) to its lower right (1, 1), or None.
        texture: [H, W, 3] uint8 RGB, or None.
        maps: [H, W, 5] uint8, as large as the texture, or None: roughness, metal (both 0 to 255), and the normal map of
            glTF (x, y, z). Only exports use them.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None
    uv: np.ndarray | None = None
    texture: np.ndarray | None = None
    maps: np.ndarray | None = None

    def digest(self) -> str:
        """SHA-256 of its content, in hexadecimal."""
        digest = hashlib.sha256()
        for array in (self.vertices, self.faces, self.colors, self.uv, self.texture, self.maps):
            if array is not None:
                digest.update(f"{array.dtype}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class Frame:
    """The normalised frame of a shape: `normalised = (metres - centre) / scale`, the solid within [-0.5, 0.5]."""

    centre: np.ndarray  # [3] float64 m, centre of the bounding box
    scale: float  # m, its largest extent

    def inward(self, points: np.ndarray) -> np.ndarray:
        """Metres -> normalised, [P, 3]."""
        return (points - self.centre) / self.scale

    def outward(self, points: np.ndarray) -> np.ndarray:
        """Normalised -> metres, [P, 3]."""
        return points * self.scale + self.centre

    def scaled(self, factor: float) -> "Frame":
        """The frame of the solid scaled by `factor` about the origin."""
        return Frame(self.centre * factor, self.scale * factor)


def normal_frame(bounds: np.ndarray) -> Frame:
    """The frame in which a box `bounds` [2, 3] m becomes [-0.5, 0.5] along its largest extent. Raises SdfsimError if
    it has no extent or is not finite."""
    extent = float((bounds[1] - bounds[0]).max())
    if not np.isfinite(extent) or extent <= 0:
        raise SdfsimError("the shape has no extent", "all its vertices are at one point")
    return Frame(centre=bounds.mean(0), scale=extent)


def far_middle(points: np.ndarray) -> np.ndarray:
    """The middle [3] of the box around points [P, 3] if the origin is more than `FAR` times its size away; else
    zeros."""
    if not len(points):
        return np.zeros(3)
    low, high = points.min(0), points.max(0)
    middle = (low + high) / 2
    return middle if np.linalg.norm(middle) > FAR * np.linalg.norm(high - low) else np.zeros(3)


def require_whole(mesh: Mesh) -> None:
    """Raise ValueError if vertices are not finite or faces have corners that do not exist."""
    if not np.isfinite(mesh.vertices).all() or (mesh.uv is not None and not np.isfinite(mesh.uv).all()):
        raise ValueError("vertices that are not finite")
    if len(mesh.faces) and (mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices)):
        raise ValueError(f"face indices out of range (0 to {len(mesh.vertices) - 1} allowed)")


def clean(mesh: Mesh, *, name: str = "mesh") -> Mesh:
    """Merge equal vertices, drop degenerate and doubled faces and unused vertices, and turn a closed mesh right side
    out.

    Two faces back to back are both dropped if the rest is closed without them (a wall between touching cells). Raises
    SdfsimError if there are no faces, vertices are not finite or too far away, or indices are out of range.
    """
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    if len(faces) == 0:
        raise SdfsimError(f"{name}: mesh has no faces", "a point cloud is not enough: export triangles")
    try:
        require_whole(mesh)
    except ValueError as error:
        raise SdfsimError(f"{name}: {error}") from error
    if (farthest := float(np.abs(vertices).max())) > FARTHEST:
        raise SdfsimError(f"{name}: a coordinate of {farthest:.3g} is too large (at most {FARTHEST:g})")
    used, label = np.unique(faces, return_inverse=True)
    faces, vertices = label.reshape(-1, 3), vertices[used]
    colors = None if mesh.colors is None else mesh.colors[used]
    solid = _has_area(vertices, faces)
    if not solid.any():
        raise SdfsimError(f"{name}: mesh has no faces with an area")
    # Files round to about seven digits: vertices that agree to a millionth of the size are one. A face without area may
    # lie anywhere, so it does not count for the size.
    low, high = (fold(vertices[np.unique(faces[solid])], axis=0) for fold in (np.min, np.max))
    keys = np.round((vertices - low) / max(1e-6 * float((high - low).max()), 1e-300))
    _, first, label = np.unique(keys + 0.0, axis=0, return_index=True, return_inverse=True)
    faces = label.reshape(-1)[faces]
    vertices = vertices[first]
    colors = None if colors is None else colors[first]

    # A face without area may still join its neighbours, if all its corners are theirs.
    held = np.zeros(len(vertices), dtype=bool)
    held[faces[solid]] = True
    faces = faces[solid | held[faces].all(1)]
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces = faces[distinct]
    if len(faces):
        faces = without_doubles(faces)
    if len(faces) == 0:
        raise SdfsimError(f"{name}: mesh has no faces with an area")
    used, label = np.unique(faces, return_inverse=True)
    result = Mesh(vertices[used], label.reshape(-1, 3), None if colors is None else colors[used])
    if is_closed(result) and signed_volume(result) < 0:
        result = Mesh(result.vertices, result.faces[:, ::-1].copy(), result.colors)
    return result


def _has_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[F] bool: whether the corners of a face are not in a line, to rounding."""
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    return np.linalg.norm(area_vectors(corners), axis=1) > 1e-10 * longest**2


def without_doubles(faces: np.ndarray) -> np.ndarray:
    """One face [F', 3] for each set of three corners in `faces` [F, 3].

    Two faces back to back are either a wall between two touching cells, which is inside the solid, or a surface that
    was drawn from both sides. If it is a wall, the rest is closed without it, and both go. Otherwise one stays.
    """
    order = np.argsort(faces, axis=1)
    # The sorted corners' permutation is even exactly when its inversions are.
    odd = ((order[:, 0] > order[:, 1]) ^ (order[:, 0] > order[:, 2]) ^ (order[:, 1] > order[:, 2])).astype(bool)
    _, first, label = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True)
    label = label.reshape(-1)
    both = (np.bincount(label, weights=odd) > 0) & (np.bincount(label, weights=~odd) > 0)
    kept = np.sort(first)
    single, wall = faces[kept], both[label[kept]]
    if not wall.any():
        return single
    edge, _ = directed_edges(single)
    component = components(single)
    uneven = np.bincount(edge[~np.tile(wall, 3)], minlength=edge.max() + 1) % 2 == 1
    broken = np.zeros(component.max() + 1, dtype=bool)
    broken[np.tile(component, 3)[uneven[edge]]] = True
    emptied = np.bincount(component[~wall], minlength=component.max() + 1) == 0
    return single[~(wall & ~(broken | emptied)[component])]


def is_closed(mesh: Mesh) -> bool:
    """Whether every directed edge has its opposite: watertight, with one winding, so that winding numbers are whole."""
    edge, sign = directed_edges(mesh.faces)
    return not np.bincount(edge, weights=sign).any()


def signed_volume(mesh: Mesh) -> float:
    """Volume enclosed, m^3; negative when the faces are wound inwards. Meaningful for closed meshes only."""
    corners = mesh.vertices[mesh.faces] - mesh.vertices.mean(0)
    return float(np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0)


def components(faces: np.ndarray) -> np.ndarray:
    """[F] labels: faces that share an edge belong to one component."""
    import igl

    return np.asarray(igl.facet_components(np.ascontiguousarray(faces, dtype=np.int64))[1])


def directed_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For the 3 F directed edges (the first of each face, then the second, then the third): the number of the
    undirected edge, and its sense, +1 or -1."""
    start = np.concatenate([faces[:, 0], faces[:, 1], faces[:, 2]]).astype(np.int64)
    end = np.concatenate([faces[:, 1], faces[:, 2], faces[:, 0]]).astype(np.int64)
    key = np.minimum(start, end) * (int(faces.max()) + 1) + np.maximum(start, end)
    _, edge = np.unique(key, return_inverse=True)
    return edge, np.where(start < end, 1, -1)


def convex_hull(points: np.ndarray) -> Mesh:
    """Convex hull of `points` [P, 3] m, with outward faces. Raises SdfsimError if there are fewer than four points, or
    if they are not finite or all in one plane."""
    from scipy.spatial import ConvexHull, QhullError

    if len(points) < 4 or not np.isfinite(points).all():
        raise SdfsimError("a convex piece needs four finite points")
    try:
        hull = ConvexHull(points)
    except QhullError as error:
        raise SdfsimError("a convex piece is flat") from error
    faces = hull.simplices.astype(np.int64)
    inward = np.einsum("fi,fi->f", face_normals(Mesh(points, faces))[0], hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    used, label = np.unique(faces, return_inverse=True)
    return Mesh(np.asarray(points, dtype=np.float64)[used], label.reshape(-1, 3))


def area_vectors(corners: np.ndarray) -> np.ndarray:
    """[F, 3] vectors along the normals of triangles [F, 3, 3 or more], of which the first three columns are positions.
    Each is as long as twice the triangle's area."""
    points = corners[..., :3]
    return np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])


def face_normals(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals [F, 3] and areas [F]."""
    cross = area_vectors(mesh.vertices[mesh.faces])
    double = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(double, 1e-30)[:, None], double / 2


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """Area-weighted unit normals [V, 3]."""
    normals, areas = face_normals(mesh)
    total = np.zeros_like(mesh.vertices)
    for k in range(3):
        np.add.at(total, mesh.faces[:, k], normals * areas[:, None])
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def joined(meshes: Sequence[Any]) -> Mesh:
    """One mesh of several (or of any objects with vertices and faces), without colours."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def lattice(*axes: Sequence[float] | np.ndarray) -> np.ndarray:
    """All points [P, 3] of the grid of three axes, with z running fastest."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def halves(places: np.ndarray, most: int, chosen: np.ndarray | None = None) -> list[np.ndarray]:
    """Split places [P, D], or those `chosen`, into groups that lie together, at most `most` in each: their indices.
    Each split halves a group along its longest side."""
    chosen = np.arange(len(places)) if chosen is None else chosen
    if len(chosen) <= most:
        return [chosen]
    some = places[chosen]
    order = chosen[np.argsort(some[:, np.ptp(some, axis=0).argmax()], kind="stable")]
    middle = len(order) // 2
    return halves(places, most, order[:middle]) + halves(places, most, order[middle:])


def sample_surface(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly by area: [P, 3] m, with the unit normals [P, 3] of their faces."""
    normal, area = face_normals(mesh)
    face = rng.choice(len(area), size=count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    first, second, third = (mesh.vertices[mesh.faces[face, k]] for k in range(3))
    return first + u * (second - first) + v * (third - first), normal[face]
