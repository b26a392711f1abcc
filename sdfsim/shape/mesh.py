"""Triangle meshes: loading, cleaning, and points on them."""

from __future__ import annotations

import hashlib
import json
import logging
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.errors import SdfsimError

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


MOST_NUMBERS = 500_000_000  # vertices and corners of faces, all placed copies of a mesh together
_STRIDES = range(4, 253)  # bytes between the elements of a buffer, as the format has it


def check_gltf(path: Path) -> None:
    """Refuse a `.glb` or `.gltf` whose geometry is not in its buffers, or is of an absurd size.

    Accessors without data stand for zeros, or for what only a decompressor can fill: read as they are they would
    silently be points at the origin.

    Raises:
        SdfsimError: that, or a header that is not JSON.
    """
    try:
        header = _header(path)
        accessors, views = header.get("accessors", []), header.get("bufferViews", [])
        if any("bufferView" not in accessor or "sparse" in accessor for accessor in accessors):
            raise SdfsimError(f"{path}: geometry that is compressed or sparse is not read", "export it without either")
        if any(view.get("byteStride", 4) not in _STRIDES for view in views):
            raise SdfsimError(f"{path}: a byteStride that glTF does not have (4 to 252 allowed)")
        sizes = [_size(mesh, accessors) for mesh in header.get("meshes", [])]
        placed = sum(sizes[node["mesh"]] for node in header.get("nodes", []) if "mesh" in node)
    except (OSError, ValueError, TypeError, AttributeError, LookupError, RecursionError, struct.error) as error:
        raise SdfsimError(f"{path}: not a readable mesh (glTF header: {type(error).__name__}: {error})") from error
    if placed > MOST_NUMBERS:
        raise SdfsimError(f"{path}: too large ({placed} vertices and corners of faces, at most {MOST_NUMBERS})")


def _header(path: Path) -> dict[str, Any]:
    if path.suffix.lower() == ".gltf":
        return json.loads(path.read_text(encoding="utf-8"))
    with open(path, "rb") as file:
        magic, _, _, length, _ = struct.unpack("<4s4I", file.read(20))
        if magic != b"glTF":
            raise ValueError("it does not begin with glTF")
        return json.loads(file.read(length).decode("utf-8"))


def _size(mesh: dict[str, Any], accessors: list[dict[str, Any]]) -> int:
    """Vertices and corners of faces of one mesh."""
    total = 0
    for part in mesh["primitives"]:
        named = [part["attributes"]["POSITION"], part.get("indices")]
        total += sum(int(accessors[index]["count"]) for index in named if index is not None)
    return total


def check_rows(path: Path) -> None:
    """Refuse an `.off`, or a `.ply` in text, of fewer rows than its header announces.

    A header that is not understood is left to the reader of the format, which tells more.

    Raises:
        SdfsimError: rows are missing.
    """
    try:
        with open(path, "rb") as file:
            rows = (row for line in file if (row := line.partition(b"#")[0].strip()))
            wanted = _announced_off(rows) if path.suffix.lower() == ".off" else _announced_ply(rows)
            found = sum(1 for _ in islice(rows, wanted))
    except (ValueError, IndexError, StopIteration):
        return
    if found < wanted:
        raise SdfsimError(f"{path}: cut short ({found} of {wanted} rows)", "copy or export it again")


def _announced_off(rows: Iterator[bytes]) -> int:
    """Vertices and faces of an OFF file; `rows` stand at the first of them afterwards."""
    counts = next(rows).upper().rpartition(b"OFF")[2].split() or next(rows).split()
    return int(counts[0]) + int(counts[1])


def _announced_ply(rows: Iterator[bytes]) -> int:
    """Rows of all elements of a PLY file in text, 0 for a binary one."""
    wanted = 0
    for row in rows:
        words = row.split()
        if words[0] == b"format" and words[1] != b"ascii":
            return 0
        if words[0] == b"element":
            wanted += int(words[2])
        if words[0] == b"end_header":
            return wanted
    return 0


# A face with an index below 1.
_SUSPECT = re.compile(rb"^[ \t]*f(?=[ \t])[^\n]*?[ \t/](?:-|0+(?![0-9]))", re.MULTILINE)
_KINDS = {b"v": 0, b"vt": 1, b"vn": 2}


def counted_forwards(path: Path) -> bytes | None:
    """The content of an OBJ file with every index of its faces counted from the first row, or None if they are so.

    A negative index counts back from the rows that were read before its face; there is no index 0.

    Raises:
        SdfsimError: an index that is 0 or before the first row.
    """
    text = path.read_bytes()
    if not _SUSPECT.search(text):
        return None
    seen, lines = [0, 0, 0], text.split(b"\n")
    for number, line in enumerate(lines):
        words = line.split()
        if not words:
            continue
        if words[0] in _KINDS:
            seen[_KINDS[words[0]]] += 1
        elif words[0] == b"f":
            corners = (b"/".join(_forwards(path, number, part, seen) for part in _parts(word)) for word in words[1:])
            lines[number] = b" ".join([b"f", *corners])
    return b"\n".join(lines)


def _parts(corner: bytes) -> list[tuple[int, bytes]]:
    """Which list an index of a corner v/vt/vn is of, and the index."""
    return list(enumerate(corner.split(b"/")))


def _forwards(path: Path, number: int, part: tuple[int, bytes], seen: list[int]) -> bytes:
    kind, index = part
    if not re.fullmatch(rb"-?[0-9]+", index) or kind >= len(seen):
        return index
    value = int(index)
    place = value if value > 0 else seen[kind] + 1 + value
    if value == 0 or place < 1:
        raise SdfsimError(
            f"{path}: line {number + 1}: a face has the index {value} (they count from 1, or back from -1)"
        )
    return str(place).encode()


def write_ply(mesh: Mesh) -> bytes:
    """A mesh as binary PLY, vertices in double precision: what is read back is what was written, to the last bit."""
    columns: list[tuple[str, str]] = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    header += [f"property double {axis}" for axis in "xyz"]
    if mesh.colors is not None:
        columns += [(channel, "u1") for channel in ("red", "green", "blue")]
        header += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header", ""]
    vertices = np.empty(len(mesh.vertices), dtype=columns)
    for column, axis in enumerate("xyz"):
        vertices[axis] = mesh.vertices[:, column]
    if mesh.colors is not None:
        for column, channel in enumerate(("red", "green", "blue")):
            vertices[channel] = mesh.colors[:, column]
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corner", "<i4", 3)])
    faces["count"], faces["corner"] = 3, mesh.faces
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()


def read_mesh(path: Path) -> Mesh:
    """The mesh of a shape folder as it was written: not cleaned, not reordered.

    Raises:
        SdfsimError: not readable.
    """
    import trimesh

    try:
        loaded: Any = trimesh.load(path, force="mesh", process=False)
        vertices = np.array(loaded.vertices, dtype=np.float64)
        faces = np.array(loaded.faces, dtype=np.int64).reshape(-1, 3)
        colors = None
        if loaded.visual.kind == "vertex":
            colors = np.array(loaded.visual.vertex_colors)[:, :3].astype(np.uint8)
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise ValueError("face indices out of range")
        if not np.isfinite(vertices).all():
            raise ValueError("vertices that are not finite")
    except Exception as error:  # the readers raise whatever their format made them stumble over
        raise SdfsimError(f"{path}: damaged or cut short ({error})") from error
    return Mesh(vertices, faces, colors)


def without_doubles(faces: np.ndarray) -> np.ndarray:
    """One face [F', 3] for each set of three corners in `faces` [F, 3].

    Two faces back to back are either a wall between two touching cells, which is inside the solid, or a surface that
    was drawn from both sides. Without a wall the rest is still closed; then both go. Otherwise one stays.
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


def components(faces: np.ndarray) -> np.ndarray:
    """[F] labels: faces that share an edge, with whatever others, are of one component."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edge, _ = directed_edges(faces)
    face = np.tile(np.arange(len(faces)), 3)
    links = coo_matrix((np.ones(len(edge)), (face, len(faces) + edge)), shape=(len(faces) + edge.max() + 1,) * 2)
    _, label = np.unique(connected_components(links, directed=False)[1][: len(faces)], return_inverse=True)
    return label


def directed_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For the 3 F directed edges (first ones, second, third): the undirected edge's number, and its sense +1 or -1."""
    start = np.concatenate([faces[:, 0], faces[:, 1], faces[:, 2]]).astype(np.int64)
    end = np.concatenate([faces[:, 1], faces[:, 2], faces[:, 0]]).astype(np.int64)
    key = np.minimum(start, end) * (int(faces.max()) + 1) + np.maximum(start, end)
    _, edge = np.unique(key, return_inverse=True)
    return edge, np.where(start < end, 1, -1)
