"""The contents of mesh files: PLY and OFF as arrays, and OBJ and STL in a form that trimesh reads correctly.

trimesh refuses a binary PLY whose faces differ in their number of corners, and an OFF with its counts on the first
line; Open3D reads both, but rejects a whole file for one polygon with three corners in a line. So these two are read
here. All readers raise ValueError for a file that is damaged or cut short.
"""

import io
import re
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sdfsim.geometry.skins import Painted

KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "int64": "i8", "uint64": "u8",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
CORNERS = ("vertex_indices", "vertex_index")
PLACES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
# Number of corners of a polygon from which a fan is tried.
TRIED = 64
# A triangle of a fan may be turned over by at most this part of its polygon's area.
FLAT = 1e-9
TEXTURES = ("JPEG", "PNG", "WEBP", "BMP", "TIFF")  # Pillow starts other programs for some of the other formats
FACET = 50  # bytes of a triangle in a binary STL; the header has 84


class Ragged(NamedTuple):
    """A column of lists, one for each row."""

    length: np.ndarray  # [N] int64
    values: np.ndarray  # [sum of them]


class FileMesh(NamedTuple):
    """The triangles of a file, unchanged."""

    vertices: np.ndarray  # [V, 3] float64
    faces: np.ndarray  # [F, 3] int64
    colors: np.ndarray | None = None  # [V, 3] uint8 RGB
    # [F, 3, 2] texture coordinates of face corners, upper left (0, 0), and the name of the texture's file
    places: np.ndarray | None = None
    texture: str = ""
    # Parts, each with an image or a plain colour, None if a part has neither; empty if no part has an image
    painted: tuple[Painted | None, ...] = ()


Element = dict[str, Any]  # columns [N] by their names, or `Ragged`


def read_ply(content: bytes) -> tuple[dict[str, Element], dict[str, dict[str, str]], str]:
    """Elements of a PLY file by name, the NumPy types of their columns, and the name of a texture file if a comment
    gives it."""
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", content)
    line = re.escape(first[1]) if first else b""
    end = re.search(line + rb"end_header[ \t]*(?:" + line + rb"|\Z)", content)
    if first is None or end is None:
        raise ValueError("it has no complete PLY header")
    order, texture = "", ""
    counts: dict[str, int] = {}
    columns: dict[str, list[tuple[str, str, str]]] = {}  # name, type of the list's length or nothing, type
    for row in content[first.end() : end.start()].decode("latin-1").splitlines():
        match row.split():
            case ["format", way, *_] if way in ORDERS:
                order = way
            case ["element", name, count] if count.isdecimal() and name not in counts:
                counts[name], columns[name] = int(count), []
            case ["property", "list", length, kind, name] if counts and {length, kind} <= KINDS.keys():
                columns[next(reversed(columns))].append((name, KINDS[length], KINDS[kind]))
            case ["property", kind, name] if counts and kind in KINDS:
                columns[next(reversed(columns))].append((name, "", KINDS[kind]))
            case ["comment", word, *rest] if word.lower() == "texturefile":
                texture = " ".join(rest)
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"its header has a line that is not PLY:  {row.strip()[:60]}")
    if not order:
        raise ValueError("its header has no PLY format")
    body, text = content[end.end() :], order == "ascii"
    if text:  # convert every number to eight bytes, and continue as with a binary file
        try:
            body = np.array(body.split(), dtype="S").astype("<f8").tobytes() if body.strip() else b""
        except ValueError as error:
            raise ValueError("its rows hold something that is not a number") from error
    found: dict[str, Element] = {}
    start = 0
    for name, rows in counts.items():
        layout = [(key, length and "f8", "f8") if text else (key, length, kind) for key, length, kind in columns[name]]
        found[name], start = _element(body, start, name, rows, layout, ORDERS[order])
    kinds = {name: {key: kind for key, _, kind in of} for name, of in columns.items()}
    return found, kinds, texture


def _element(
    body: bytes, start: int, name: str, rows: int, layout: list[tuple[str, str, str]], order: str
) -> tuple[Element, int]:
    """The columns of an element whose `rows` rows begin at byte `start`, and the byte at which they end."""
    kinds = [np.dtype(order + kind) for _, _, kind in layout]
    counters = [struct.Struct(order + np.dtype(length).char) if length else None for _, length, _ in layout]
    if not rows or not layout:
        empty = np.zeros(0, dtype=np.int64)
        return {
            key: Ragged(empty, np.zeros(0, kind)) if length else np.zeros(0, kind)
            for (key, length, _), kind in zip(layout, kinds, strict=True)
        }, start

    def lengths(at: int) -> tuple[list[int], int]:
        """Items in each column of the row that begins at a byte, and its end."""
        items = []
        for counter, kind in zip(counters, kinds, strict=True):
            count = 1
            if counter is not None:
                count = int(counter.unpack_from(body, at)[0])
                at += counter.size
            if count < 0:
                raise ValueError(f"a list of element {name} has {count} items")
            items.append(count)
            at += count * kind.itemsize
        return items, at

    def short(row: int) -> ValueError:
        return ValueError(f"cut short: {row} of {rows} rows of element {name}")

    least = sum(
        kind.itemsize if counter is None else counter.size for counter, kind in zip(counters, kinds, strict=True)
    )
    if rows * least > len(body) - start:  # before memory is allocated
        raise short((len(body) - start) // least)
    try:
        items, after = lengths(start)
    except struct.error as error:
        raise short(0) from error
    # In most files all rows have the same length.
    stop = start + rows * (after - start)
    if stop <= len(body):
        fields = []
        for k, (counter, kind, count) in enumerate(zip(counters, kinds, items, strict=True)):
            fields += [(f"n{k}", order + layout[k][1])] if counter is not None else []
            fields += [(f"v{k}", kind, (count,))]
        table = np.frombuffer(body, np.dtype(fields), rows, start)
        if all((table[f"n{k}"] == items[k]).all() for k in range(len(layout)) if counters[k] is not None):
            plain: Element = {}
            for k, (key, length, _) in enumerate(layout):
                values = table[f"v{k}"].reshape(-1)
                plain[key] = Ragged(np.full(rows, items[k], dtype=np.int64), values) if length else values
            return plain, stop

    counts = np.empty((rows, len(layout)), dtype=np.int64)
    starts = np.empty(rows, dtype=np.int64)
    at = start
    for row in range(rows):
        starts[row] = at
        try:
            counts[row], at = lengths(at)
        except struct.error as error:
            raise short(row) from error
        if at > len(body):
            raise short(row)
    data = np.frombuffer(body, np.uint8)
    made: Element = {}
    place = starts
    for (key, length, _), counter, kind, count in zip(layout, counters, kinds, counts.T, strict=True):
        place = place + (counter.size if counter is not None else 0)
        nth = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        where = np.repeat(place, count) + kind.itemsize * nth
        values = data[where[:, None] + np.arange(kind.itemsize)].reshape(-1).view(kind)
        made[key] = Ragged(count.copy(), values) if length else values
        place = place + kind.itemsize * count
    return made, at


def ply_surface(content: bytes) -> FileMesh:
    """The triangles of a PLY file (polygons and strips are cut into triangles), with colours of vertices or faces."""
    elements, kinds, texture = read_ply(content)
    vertex = elements.get("vertex", {})
    if not {"x", "y", "z"} <= vertex.keys():
        raise ValueError("it has no vertices with x, y and z")
    vertices = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float64)
    face = elements.get("face", {})
    polygons = next((face[name] for name in CORNERS if name in face), Ragged(*np.zeros((2, 0), dtype=np.int64)))
    if not isinstance(polygons, Ragged):
        raise ValueError("its faces have no list of corners")
    corners = whole(polygons.values)
    cuts = triangles(polygons.length, corners, vertices)
    faces = corners[cuts]
    if "tristrips" in elements:
        strips = next((elements["tristrips"][name] for name in CORNERS if name in elements["tristrips"]), None)
        if isinstance(strips, Ragged):
            faces = np.concatenate([faces, *_strips(strips)])
    colors = _colors(vertex, kinds.get("vertex", {}))
    if colors is None and len(faces) == len(cuts) and (by_face := _colors(face, kinds.get("face", {}))) is not None:
        owner = np.repeat(np.arange(len(polygons.length)), polygons.length)
        colors = averaged(by_face[owner[cuts]], faces, len(vertices))
    places = None
    if texture and len(faces) == len(cuts):
        own, names = face.get("texcoord"), next((two for two in PLACES if vertex.keys() >= set(two)), None)
        if isinstance(own, Ragged) and np.array_equal(own.length, 2 * polygons.length):
            places = own.values.reshape(-1, 2).astype(np.float64)[cuts]
        elif names is not None:
            places = np.stack([vertex[name] for name in names], axis=1).astype(np.float64)[faces]
        if places is not None:  # PLY counts from the lower edge
            places = places * [1.0, -1.0] + [0.0, 1.0]
    return FileMesh(vertices, faces, colors, places, texture)


def _strips(strips: Ragged) -> list[np.ndarray]:
    """Triangles [F, 3] of strips of vertices; -1 or its length ends each strip."""
    corners = whole(strips.values)
    ends = np.cumsum(strips.length)
    pieces = np.split(corners, np.union1d(np.flatnonzero(corners < 0), ends[:-1]))
    return [strip(piece[piece >= 0]) for piece in pieces]


def strip(corners: np.ndarray) -> np.ndarray:
    """Triangles [N - 2, 3] of a strip of N corners; every other one is turned over."""
    faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1) if len(corners) > 2 else np.zeros((0, 3), int)
    faces[1::2] = faces[1::2, ::-1]
    return faces


def _colors(columns: Element, kinds: dict[str, str]) -> np.ndarray | None:
    """[N, 3] uint8 from columns red, green and blue: floats are fractions, integers are relative to the largest of
    their type."""
    names = ("red", "green", "blue")
    if not columns.keys() >= set(names) or any(isinstance(columns[name], Ragged) for name in names):
        return None
    values = np.stack([columns[name] for name in names], axis=1).astype(np.float64)
    kind = np.dtype(kinds["red"])
    most = np.iinfo(kind).max if kind.kind in "iu" else 1.0
    # Some programs write 0 to 255 in any type.
    most = 255.0 if most > 65535 or (most == 1.0 and values.max(initial=0.0) > 1.0) else most
    return np.clip(np.round(255.0 / most * np.nan_to_num(values)), 0, 255).astype(np.uint8)


def averaged(of_corners: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """[count, 3] uint8 colours of vertices: means over the colours [F, 3, 3] of the corners of faces [F, 3]."""
    corner = faces.reshape(-1)
    weight = np.maximum(np.bincount(corner, minlength=count), 1)
    sums = [np.bincount(corner, of_corners[..., k].reshape(-1), count) for k in range(3)]
    return np.round(np.stack(sums, axis=1) / weight[:, None]).astype(np.uint8)


def looked_up(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """[..., 3] uint8 pixels of an image [H, W, 3] at places [..., 2] from its upper left (0, 0) to its lower right
    (1, 1); the image repeats beyond."""
    size = np.array(image.shape[1::-1])
    pixel = np.floor(np.mod(np.nan_to_num(places), 1.0) * size).astype(np.int64)
    x, y = np.moveaxis(np.clip(pixel, 0, size - 1), -1, 0)
    return image[y, x]


def read_image(content: bytes) -> np.ndarray | None:
    """[H, W, 3] uint8, or None if it is not an image in one of the formats `TEXTURES`."""
    from PIL import Image, UnidentifiedImageError

    try:
        return np.asarray(Image.open(io.BytesIO(content), formats=TEXTURES).convert("RGB"))
    except (OSError, ValueError, UnidentifiedImageError, Image.DecompressionBombError):
        return None


def side_file(path: Path, name: str) -> bytes:
    """The content of a file that a mesh file names, from its folder. Raises ValueError if that is outside the folder or
    missing."""
    from trimesh.resolvers import FilePathResolver

    try:
        return FilePathResolver(str(path)).get(name)
    except OSError as error:
        raise ValueError(f"{name} is missing beside it") from error


def whole(values: np.ndarray) -> np.ndarray:
    """Indices as int64. Raises ValueError for fractions and values that are not finite."""
    if values.dtype.kind == "f" and not (np.isfinite(values) & (np.round(values) == values)).all():
        raise ValueError("indices that are not whole numbers")
    return values.astype(np.int64)


def triangles(length: np.ndarray, corners: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Cut polygons into triangles [F, 3] of indices into `corners`. The polygons have `length` [P] corners, which
    follow one another in `corners` [sum]. Raises ValueError for corners that are not in `vertices` [V, 3].

    Each becomes a fan around the first corner from which no triangle lies outside the polygon. If there is no such
    corner, its ears are cut off one by one.
    """
    if len(corners) and not (corners.min() >= 0 and corners.max() < len(vertices)):
        raise ValueError(f"face indices out of range (0 to {len(vertices) - 1} allowed)")
    start = np.cumsum(length) - length
    # Back to the order of the file, polygon by polygon.
    before = np.cumsum(np.maximum(length - 2, 0)) - np.maximum(length - 2, 0)
    cuts = np.empty((int(np.maximum(length - 2, 0).sum()), 3), dtype=np.int64)
    for count in np.unique(length[length > 2]).tolist():
        some = np.flatnonzero(length == count)
        apex = np.zeros(len(some), dtype=np.int64)
        if count > 3:
            points = vertices[corners[start[some][:, None] + np.arange(count)]]
            apex, fine = _apexes(points)
            for polygon, where in zip(points[~fine], some[~fine], strict=True):
                cuts[before[where] + np.arange(count - 2)] = start[where] + _ears(polygon)
            some, apex = some[fine], apex[fine]
        fan = np.stack([np.zeros(count - 2, int), np.arange(1, count - 1), np.arange(2, count)], axis=1)
        turned = (fan + apex[:, None, None]) % count
        cuts[before[some][:, None] + np.arange(count - 2)] = start[some][:, None, None] + turned
    return cuts


def _apexes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each polygon [P, N, 3] the corner [P] around which its fan is drawn, and whether there is one [P]."""

    def crosses(some: np.ndarray) -> np.ndarray:
        legs = some[:, 1:] - some[:, :1]
        return np.cross(legs[:, :-1], legs[:, 1:])

    best = np.zeros(len(points), dtype=np.int64)
    normal = crosses(points).sum(1)
    least = -FLAT * np.square(normal).sum(1)
    todo = np.arange(len(points))
    for apex in range(min(points.shape[1], TRIED)):
        along = np.einsum("pfi,pi->pf", crosses(np.roll(points[todo], -apex, axis=1)), normal[todo])
        fine = (along >= least[todo][:, None]).all(1)
        best[todo[fine]] = apex
        todo = todo[~fine]
        if not len(todo):
            break
    found = np.ones(len(points), dtype=bool)
    found[todo] = False
    return best, found


def _ears(points: np.ndarray) -> np.ndarray:
    """Triangles [N - 2, 3] of a polygon [N, 3], seen along its normal."""
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(0)
    away = int(np.abs(normal).argmax())
    flat = np.roll(points, -away - 1, axis=1)[:, :2] * [1.0, np.sign(normal[away]) or 1.0]
    least = FLAT * np.square(np.ptp(flat, axis=0)).sum()

    def area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        (ux, uy), (vx, vy) = (b - a).T, (c - a).T
        return ux * vy - uy * vx

    def is_ear(k: int) -> bool:
        corners = [rest[k - 1], rest[k], rest[(k + 1) % len(rest)]]
        a, b, c = flat[corners]
        if area(a, b, c) <= least:
            return False
        others = flat[np.setdiff1d(rest, corners)]
        # A point that lies on a corner is the other end of a bridge to a hole.
        others = others[~(others[:, None] == np.stack([a, b, c])).all(2).any(1)]
        within = (area(a, b, others) >= 0) & (area(b, c, others) >= 0) & (area(c, a, others) >= 0)
        return not within.any()

    rest, cut = list(range(len(points))), []
    while len(rest) > 3:
        # Without an ear the polygon crosses itself; then any corner will do.
        k = next((k for k in range(len(rest)) if is_ear(k)), 0)
        cut.append([rest[k - 1], rest[k], rest[(k + 1) % len(rest)]])
        del rest[k]
    return np.array([*cut, rest], dtype=np.int64)


def off_surface(content: bytes) -> FileMesh:
    """The triangles of an OFF file (also COFF, NOFF, STOFF and their mixtures); polygons are cut into triangles."""
    lines = re.sub(r"#[^\r\n]*", "", content.decode("latin-1").lstrip("\ufeff\xef\xbb\xbf")).splitlines()
    rows = [words for line in lines if (words := line.split())]
    kind = re.fullmatch(r"(ST)?(C)?(N)?(4)?(n)?OFF", rows[0][0]) if rows else None
    if kind is None:
        raise ValueError("it does not begin with OFF")
    if kind[4] or kind[5]:
        raise ValueError(f"vertices of {kind[0]} do not have three coordinates")
    if "BINARY" in rows[0]:
        raise ValueError("binary OFF is not supported: export it as text, or as PLY")
    rows = [rows[0][1:], *rows[1:]] if len(rows[0]) > 1 else rows[1:]
    if not rows or len(rows[0]) < 2 or not all(word.isdecimal() for word in rows[0][:2]):
        raise ValueError("its numbers of vertices and faces are missing")
    count, polygons = int(rows[0][0]), int(rows[0][1])
    points, rest = rows[1 : count + 1], rows[count + 1 : count + 1 + polygons]
    for what, found, wanted in (("vertices", points, count), ("faces", rest, polygons)):
        if len(found) < wanted:
            raise ValueError(f"cut short: {len(found)} of {wanted} {what}")
    shades = 6 if kind[3] else 3  # after the normals
    has_shades = bool(kind[2]) and bool(points) and all(len(row) >= shades + 3 for row in points)
    taken = [row[:3] + row[shades : shades + 3] if has_shades else row[:3] for row in points]
    if any(len(row) < 3 for row in points):
        raise ValueError("a vertex has fewer than three coordinates")
    table = np.array(taken, dtype=np.float64).reshape(count, -1) if count else np.zeros((0, 3))
    colors = None
    if has_shades:
        fractions = table[:, 3:].max() <= 1.0
        colors = np.clip(np.round(table[:, 3:] * (255.0 if fractions else 1.0)), 0, 255).astype(np.uint8)
    length = np.array([int(row[0]) for row in rest], dtype=np.int64)
    if any(not 0 <= n < len(row) for n, row in zip(length.tolist(), rest, strict=True)):
        raise ValueError("cut short: a face has fewer corners than it announces")
    corners = np.array(
        [word for n, row in zip(length.tolist(), rest, strict=True) for word in row[1 : n + 1]], dtype="U"
    )
    corners = corners.astype(np.int64) if len(corners) else np.zeros(0, dtype=np.int64)
    return FileMesh(table[:, :3], corners[triangles(length, corners, table[:, :3])], colors)


def plain_obj(content: bytes) -> bytes:
    """An OBJ file without what trimesh misreads: comments behind faces, lines that begin with a blank, indices that
    count back from the end of the rows so far, and polygons of five corners or more, which are cut into triangles
    here."""
    text = content.replace(b"\r\n", b"\n").replace(b"\\\n", b" ")
    text = text if b"\n" in text else text.replace(b"\r", b"\n")
    text = re.sub(rb"^[ \t]*((?:v|vt|vn|f)[ \t][^#\n]*)(?:#[^\n]*)?", rb"\1", text, flags=re.MULTILINE)
    odd = re.compile(rb"^f[ \t](?:[^\n]*[ \t/])?(?:-\d+|0+)(?![\d.])|^f(?:[ \t]+[^ \t\n]+){5}", re.MULTILINE)
    if odd.search(text) is None:
        return text
    kinds = (b"v", b"vt", b"vn")
    counts = dict.fromkeys(kinds, 0)
    vertices: list[list[bytes]] = []
    polygons: dict[int, list[list[bytes]]] = {}
    lines = text.split(b"\n")
    for number, line in enumerate(lines):
        key = line.split(None, 1)[0] if line.strip() else b""
        if key in counts:
            counts[key] += 1
            if key == b"v":
                vertices.append(line.split()[1:4])
        elif key == b"f" and odd.match(line):
            corners = [corner.split(b"/") for corner in line.split()[1:]]
            try:
                corners = [[_index(word, counts[kind]) for word, kind in zip(c, kinds, strict=False)] for c in corners]
            except ValueError as error:
                raise ValueError(f"line {number + 1}: {error}") from error
            lines[number] = _face_line(corners)
            if len(corners) > 4:
                polygons[number] = corners
    if polygons:
        length = np.array([len(corners) for corners in polygons.values()])
        first = np.array([int(corner[0]) - 1 for corners in polygons.values() for corner in corners])
        cuts = triangles(length, first, np.array(vertices, dtype=np.float64))
        flat = [corner for corners in polygons.values() for corner in corners]
        ends = np.cumsum(length - 2)
        for (number, _), some in zip(polygons.items(), np.split(cuts, ends[:-1]), strict=True):
            lines[number] = b"\n".join(_face_line([flat[k] for k in three]) for three in some.tolist())
    return b"\n".join(lines)


def _face_line(corners: list[list[bytes]]) -> bytes:
    return b"f " + b" ".join(b"/".join(corner) for corner in corners)


def _index(word: bytes, count: int) -> bytes:
    """An index that counts from 1, when there are `count` rows so far."""
    if not word or int(word) > 0:
        return word
    if int(word) == 0 or -int(word) > count:
        raise ValueError(f"a face has the index {int(word)}, {count} rows come before it")
    return str(count + 1 + int(word)).encode()


def plain_stl(content: bytes) -> bytes:
    """An STL file without the bytes that follow the triangles of a binary one."""
    count = int.from_bytes(content[80:84], "little") if len(content) >= 84 else 0
    needed = 84 + FACET * count
    if len(content) == needed:
        return content
    if b"facet" in content and content.lstrip()[:5].lower() == b"solid" and b"\0" not in content[:512]:
        if b"endsolid" not in content.lower():
            raise ValueError("cut short: it has no endsolid")
        return content
    if len(content) < 84:
        raise ValueError("it is not an STL file, or cut short")
    # The last triangle's last two bytes are an attribute, which some programs leave out.
    if len(content) < needed - 2:
        raise ValueError(f"cut short: {(len(content) - 84) // FACET} of {count} faces")
    if not count:
        raise ValueError(f"its header announces no faces, and {len(content) - 84} bytes follow")
    return content[:needed].ljust(needed, b"\0")


def by_trimesh(path: Path, content: bytes) -> Any:
    """A trimesh mesh of `content`; files that it names are read from the folder of `path` only."""
    import trimesh

    return trimesh.load(io.BytesIO(content), **_how(path), force="mesh")


def scene_by_trimesh(path: Path, content: bytes) -> Any:
    """Likewise a trimesh scene, with a mesh for each material."""
    import trimesh

    return trimesh.load_scene(io.BytesIO(content), **_how(path))


def _how(path: Path) -> dict[str, Any]:
    from trimesh.resolvers import FilePathResolver

    return {"file_type": path.suffix.lower()[1:], "resolver": FilePathResolver(str(path)), "process": False}
