"""Triangle meshes: loading, cleaning, and points on them."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.errors import SdfsimError
from sdfsim.shape.mesh import check_gltf, check_rows, counted_forwards
from sdfsim.shape.watertight import without_doubles

# Its readers log what they pass over, some with tracebacks; who wants to see that can still listen.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

MESH_SUFFIXES = (".obj", ".ply", ".glb", ".gltf", ".stl", ".off")
MOST_BYTES = 2 * 2**30  # of a file
FARTHEST = 1e12  # from the origin: beyond, not even double precision tells the vertices of a room-sized mesh apart
TEXTURES = ("JPEG", "PNG", "WEBP", "BMP", "TIFF")  # others would start programs that draw them


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: [V, 3] float64 m.
        faces: [F, 3] int64 vertex indices, counter-clockwise seen from outside.
        colors: [V, 3] uint8 RGB, or None.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None

    def digest(self) -> str:
        """SHA-256 of vertices, faces and colours, in hexadecimal."""
        digest = hashlib.sha256()
        for array in (self.vertices, self.faces, self.colors):
            if array is not None:
                digest.update(f"{array.dtype}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class Frame:
    """The normalised frame of a shape: `normalised = (metres - centre) / scale`, the solid within [-0.5, 0.5].

    Attributes:
        centre: [3] float64 m, centre of the bounding box.
        scale: m, its largest extent.
    """

    centre: np.ndarray
    scale: float

    def inward(self, points: np.ndarray) -> np.ndarray:
        """Metres -> normalised, [P, 3]."""
        return (points - self.centre) / self.scale

    def outward(self, points: np.ndarray) -> np.ndarray:
        """Normalised -> metres, [P, 3]."""
        return points * self.scale + self.centre


def normal_frame(bounds: np.ndarray) -> Frame:
    """The frame in which a box `bounds` [2, 3] m becomes [-0.5, 0.5] along its largest extent.

    Raises:
        SdfsimError: the box has no extent, or is not finite.
    """
    extent = float((bounds[1] - bounds[0]).max())
    if not np.isfinite(extent) or extent <= 0:
        raise SdfsimError("the shape has no extent", "all of its vertices are at one point")
    return Frame(centre=bounds.mean(0), scale=extent)


def load_mesh(path: str | Path) -> Mesh:
    """Read a triangle mesh (obj, ply, glb, gltf, stl, off), cleaned by `clean`.

    Raises:
        SdfsimError: missing file, not a mesh, no faces, vertices that are not finite, indices out of range, or an
            absurd size.
    """
    import trimesh
    from trimesh.resolvers import FilePathResolver

    path = Path(path)
    if not path.is_file():
        raise SdfsimError(f"{path}: no such mesh file")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise SdfsimError(f"{path}: not a mesh file ({path.suffix or 'no suffix'})", "use " + " ".join(MESH_SUFFIXES))
    if (size := path.stat().st_size) > MOST_BYTES:
        told = f"{size / 2**30:.1f} GiB, at most {MOST_BYTES // 2**30}"
        raise SdfsimError(f"{path}: too large ({told})", "export it with fewer faces")
    if path.suffix.lower() in (".glb", ".gltf"):
        check_gltf(path)
    if path.suffix.lower() in (".off", ".ply"):
        check_rows(path)
    text = counted_forwards(path) if path.suffix.lower() == ".obj" else None
    try:
        if text is None:
            loaded: Any = trimesh.load(path, force="mesh", process=False)
        else:
            loaded = trimesh.load(
                BytesIO(text), "obj", resolver=FilePathResolver(str(path)), force="mesh", process=False
            )
        vertices = np.array(loaded.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.array(getattr(loaded, "faces", []), dtype=np.int64).reshape(-1, 3)
        colors = _vertex_colors(loaded, len(vertices))
    except Exception as error:  # the readers raise whatever their format made them stumble over
        reason = str(error).strip().splitlines()
        raise SdfsimError(f"{path}: not a readable mesh ({reason[0] if reason else type(error).__name__})") from error
    return clean(Mesh(vertices, faces, colors), name=str(path))


def _vertex_colors(loaded: Any, count: int) -> np.ndarray | None:
    """[V, 3] uint8 when the file carries colours; a texture is looked up at each vertex."""
    visual: Any = getattr(loaded, "visual", None)
    kind = getattr(visual, "kind", None)
    if kind == "texture":
        material = getattr(visual, "material", None)
        image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
        if image is None or image.format not in TEXTURES or getattr(visual, "uv", None) is None:
            return None
        visual = visual.to_color()
    elif kind not in ("vertex", "face"):
        return None
    colors = np.asarray(visual.vertex_colors)
    return colors[:, :3].astype(np.uint8) if colors.shape[:1] == (count,) else None


def clean(mesh: Mesh, *, name: str = "mesh") -> Mesh:
    """Merge equal vertices, drop degenerate and doubled faces and unused vertices, turn a closed mesh right side out.

    Of two faces back to back none stays where the rest is closed without them (a wall between touching cells).

    Args:
        mesh: metres.
        name: how messages call it.

    Raises:
        SdfsimError: no faces (before or after), vertices that are not finite or absurdly far, or indices out of range.
    """
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    if len(faces) == 0:
        raise SdfsimError(f"{name}: mesh has no faces", "a point cloud is not enough: export triangles")
    if not np.isfinite(vertices).all():
        bad = int((~np.isfinite(vertices)).any(1).sum())
        raise SdfsimError(f"{name}: {bad} of {len(vertices)} vertices are not finite")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise SdfsimError(f"{name}: face indices out of range (0 to {len(vertices) - 1} allowed)")

    if (farthest := float(np.abs(vertices).max())) > FARTHEST:
        raise SdfsimError(f"{name}: a coordinate of {farthest:.3g} is too large (at most {FARTHEST:g})")

    extent = float(np.ptp(vertices[np.unique(faces)], axis=0).max())
    # Files round to about seven digits: what agrees to a millionth of the size is one vertex.
    keys = np.round((vertices - vertices.min(0)) / max(1e-6 * extent, 1e-300)).astype(np.int64)
    _, first, label = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces = label.reshape(-1)[faces]
    vertices = vertices[first]
    colors = None if mesh.colors is None else mesh.colors[first]

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


def is_closed(mesh: Mesh) -> bool:
    """Whether every directed edge has exactly one opposite: watertight, with one consistent winding."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    forward = edges[:, 0] * len(mesh.vertices) + edges[:, 1]
    backward = edges[:, 1] * len(mesh.vertices) + edges[:, 0]
    forward.sort()
    backward.sort()
    return bool(np.array_equal(forward, backward))


def signed_volume(mesh: Mesh) -> float:
    """Volume enclosed, m^3; negative when the faces are wound inwards. Meaningful for closed meshes only."""
    corners = mesh.vertices[mesh.faces] - mesh.vertices.mean(0)
    return float(np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0)


def load_pieces(path: str | Path) -> list[Mesh]:
    """The convex pieces of a collision geometry in Wavefront OBJ: the convex hull of each `o` group's vertices.

    Raises:
        SdfsimError: missing or unreadable file, no pieces, or a piece that is flat.
    """
    path = Path(path)
    if not path.is_file():
        raise SdfsimError(f"{path}: no such mesh file")
    groups: list[list[list[float]]] = [[]]
    try:
        for line in path.read_text(encoding="utf-8").splitlines():
            key, _, rest = line.strip().partition(" ")
            if key == "o":
                groups.append([])
            elif key == "v":
                groups[-1].append([float(number) for number in rest.split()[:3]])
    except (UnicodeDecodeError, ValueError) as error:
        raise SdfsimError(f"{path}: not a readable OBJ file ({error})") from error
    pieces = []
    for number, group in enumerate(group for group in groups if group):
        try:
            pieces.append(convex_hull(np.array(group)))
        except (SdfsimError, ValueError) as error:
            raise SdfsimError(f"{path}: piece {number}: {error}") from error
    if not pieces:
        raise SdfsimError(f"{path}: no vertices, so no convex pieces")
    return pieces


def convex_hull(points: np.ndarray) -> Mesh:
    """Convex hull of `points` [P, 3] m, outward faces.

    Raises:
        SdfsimError: fewer than four points, not finite, or all in one plane.
    """
    from scipy.spatial import ConvexHull, QhullError

    if len(points) < 4 or not np.isfinite(points).all():
        raise SdfsimError("a convex piece needs four finite points")
    try:
        hull = ConvexHull(points)
    except QhullError as error:
        raise SdfsimError("a convex piece is flat") from error
    faces = hull.simplices.astype(np.int64)
    corners = points[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("fi,fi->f", normal, hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    used, label = np.unique(faces, return_inverse=True)
    return Mesh(np.asarray(points, dtype=np.float64)[used], label.reshape(-1, 3))


def sample_surface(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly by area: [P, 3] m, with the unit normals [P, 3] of their faces."""
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    face = rng.choice(len(area), size=count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    first, second, third = corners[face, 0], corners[face, 1], corners[face, 2]
    return first + u * (second - first) + v * (third - first), normal[face] / area[face, None]
