"""The contents of mesh files: PLY, OFF, OBJ, STL and COLLADA as arrays.

trimesh refuses a binary PLY whose faces differ in their number of corners, and an OFF with its counts on the first
line; it misreads many ways to write OBJ and STL, and drops their materials without a word. Open3D rejects a whole file
for one polygon with three corners in a line. So the first four are read here; pycollada reads COLLADA. The readers of
the four raise ValueError for a file that is damaged or cut short.
"""

import importlib
import io
import re
import struct
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sdfsim.geometry.skins import Painted, plain_parts

KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "int64": "i8", "uint64": "u8",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
CORNERS = ("vertex_indices", "vertex_index")
PLACES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
# A triangle of a fan may be turned over by at most this part of its polygon's area.
FLAT = 1e-9
# Pillow starts other programs for some of the other formats.
TEXTURES = ("JPEG", "PNG", "WEBP", "BMP", "TIFF", "TGA", "DDS", "GIF", "PPM")
FACET = 50  # bytes of a triangle in a binary STL; the header has 84
OBJ_ROWS = (b"v", b"vt", b"vn", b"f")
OBJ_BUMPS = {"map_bump", "bump", "norm", "map_norm", "map_kn"}
# Options of a texture in an MTL file, with the number of words that follow them; three of them have one to three
# numbers.
MAP_OPTIONS: dict[str, int] = {"-mm": 2, "-s": 3, "-o": 3, "-t": 3}
MAP_OPTIONS |= dict.fromkeys(
    ("-blendu", "-blendv", "-cc", "-clamp", "-boost", "-bm", "-imfchan", "-texres", "-type"), 1
)
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
# Of COLLADA (.dae), in which most robots have their looks: flat colours.
WHITE = (255, 255, 255)
# The axes of a file that become x, y and z, by its `up_axis`: right, in, with the sign turned, and up.
UPRIGHT = {"X_UP": ((1, 2, 0), (-1, -1, 1)), "Y_UP": ((0, 2, 1), (1, -1, 1)), "Z_UP": ((0, 1, 2), (1, 1, 1))}


class Ragged(NamedTuple):
    """A column of lists, one for each row."""

    length: np.ndarray  # [N] int64
    values: np.ndarray  # [sum of them]


class FileMesh(NamedTuple):
    """The triangles of a file, unchanged."""

    vertices: np.ndarray  # [V, 3] float64
    faces: np.ndarray  # [F, 3] int64
    colors: np.ndarray | None = None  # uint8 RGB of the vertices [V, 3], or of the corners of faces [F, 3, 3]
    # [F, 3, 2] texture coordinates of face corners, upper left (0, 0), and the name of the texture's file
    places: np.ndarray | None = None
    texture: str = ""
    # Parts, each with an image or a plain colour, None if a part has neither; empty if no part has an image
    painted: tuple[Painted | None, ...] = ()
    notes: tuple[str, ...] = ()  # what is lost on reading, one line each

    def corner_colors(self) -> np.ndarray | None:
        """[F, 3, 3] uint8."""
        return self.colors if self.colors is None or self.colors.ndim == 3 else self.colors[self.faces]


def plain_text(content: bytes) -> bytes:
    """A text with the line ends of Unix and without a byte order mark; UTF-16 becomes UTF-8."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        content = content.decode("utf-16", "replace").encode()
    return content.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def numbers(words: Sequence[bytes], text: bytes, kind: type = np.float64) -> np.ndarray:
    """Words of a text as numbers [N]. Raises ValueError that names the line of the first word that is none."""
    try:
        return np.array(words, dtype="S").astype(kind)
    except (ValueError, OverflowError) as error:
        for word in words:
            try:
                np.array([word], dtype="S").astype(kind)
            except (ValueError, OverflowError):
                found = re.search(rb"(?<![\w.,+-])" + re.escape(word) + rb"(?![\w.,+-])", text)
                line = text.count(b"\n", 0, found.start() if found else 0) + 1
                comma = re.fullmatch(rb"[-+]?\d*,\d+([eE][-+]?\d+)?", word)
                fault = "has a decimal comma: export it with decimal points" if comma else "is not a number"
                raise ValueError(f"line {line}: {word.decode('latin-1')[:40]!r} {fault}") from error
        raise


Element = dict[str, Any]  # columns [N] by their names, or `Ragged`


def read_ply(content: bytes) -> tuple[dict[str, Element], dict[str, dict[str, str]], list[str]]:
    """Elements of a PLY file by name, the NumPy types of their columns, and the texture files that its comments
    name."""
    first = re.match(rb"(?i:ply)[ \t]*(\r\n|\n|\r)", content)
    # Lines may end in several ways; but after CR alone, a line feed may be the first of the binary numbers.
    line = rb"\r" if first and first[1] == b"\r" else rb"(?:\r\n|\n|\r)"
    end = re.search(rb"[\r\n](?i:end_header)[ \t]*(?:" + line + rb"|\Z)", content)
    if first is None or end is None:
        raise ValueError("it has no complete PLY header")
    order, textures = "", []
    counts: dict[str, int] = {}
    columns: dict[str, list[tuple[str, str, str]]] = {}  # name, type of the list's length or nothing, type
    for row in content[first.end() : end.start()].decode("latin-1").splitlines():
        words = row.split()
        match [word.lower() for word in words] if words and words[0].isupper() else words:
            case ["format", way, *_] if way in ORDERS:
                order = way
            case ["element", name, count] if count.isdecimal() and name not in counts:
                counts[name], columns[name] = int(count), []
            case ["property", "list", length, kind, name] if counts and {length, kind} <= KINDS.keys():
                columns[next(reversed(columns))].append((name, KINDS[length], KINDS[kind]))
            case ["property", kind, name] if counts and kind in KINDS:
                columns[next(reversed(columns))].append((name, "", KINDS[kind]))
            case ["comment", word, *rest] if word.lower() == "texturefile":
                textures.append(" ".join(rest))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"its header has a line that is not PLY:  {row.strip()[:60]}")
    if not order:
        raise ValueError("its header has no PLY format")
    body, text = content[end.end() :], order == "ascii"
    if text:  # convert every number to eight bytes, and continue as with a binary file
        body = numbers(body.split(), plain_text(content)).astype("<f8").tobytes()
    found: dict[str, Element] = {}
    start = 0
    for name, rows in counts.items():
        layout = [(key, length and "f8", "f8") if text else (key, length, kind) for key, length, kind in columns[name]]
        found[name], start = _element(body, start, name, rows, layout, ORDERS[order])
    kinds = {name: {key: kind for key, _, kind in of} for name, of in columns.items()}
    return found, kinds, textures


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
    elements, kinds, textures = read_ply(content)
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
        colors = by_face[owner[cuts]]
    places = None
    if textures and len(faces) == len(cuts):
        own, names = face.get("texcoord"), next((two for two in PLACES if vertex.keys() >= set(two)), None)
        if isinstance(own, Ragged) and np.array_equal(own.length, 2 * polygons.length):
            places = own.values.reshape(-1, 2).astype(np.float64)[cuts]
        elif names is not None:
            places = np.stack([vertex[name] for name in names], axis=1).astype(np.float64)[faces]
        if places is not None:  # PLY counts from the lower edge
            places = places * [1.0, -1.0] + [0.0, 1.0]
    notes = (f"it names {len(textures)} textures: only {textures[0]} is used",) if len(textures) > 1 else ()
    return FileMesh(vertices, faces, colors, places, "".join(textures[:1]), notes=notes)


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
    """The content of a file that a mesh file names, from its folder. Windows' separators, and names in another case,
    are understood. Raises ValueError if that is outside the folder or missing."""
    from trimesh.resolvers import FilePathResolver

    files, name = FilePathResolver(str(path)), name.strip().strip('"').replace("\\", "/")
    cased, folder = [], path.parent
    for part in name.split("/"):
        inside = [file.name for file in folder.iterdir()] if folder.is_dir() and part not in ("", "..") else []
        cased.append(next((other for other in inside if other.casefold() == part.casefold()), part))
        folder = folder / cased[-1]
    last = name.split("/")[-1].casefold()
    beside = [file.name for file in path.parent.iterdir() if file.name.casefold() == last]
    for choice in (name, "/".join(cased), *beside):
        try:
            return files.get(choice)
        except OSError:
            continue
        except ValueError as error:
            if not beside:
                raise ValueError(f"{name} lies outside its folder") from error
    raise ValueError(f"{name} is missing beside it")


def image_beside(path: Path, name: str, notes: list[str]) -> np.ndarray | None:
    """[H, W, 3] uint8 of an image that a mesh file names; None, and a note, if it cannot be read."""
    try:
        image = read_image(side_file(path, name))
    except ValueError as error:
        notes.append(f"texture {error}: left out")
        return None
    if image is None:
        notes.append(f"texture {name} cannot be read: left out (formats: {', '.join(TEXTURES)})")
    return image


def whole(values: np.ndarray) -> np.ndarray:
    """Indices as int64. Raises ValueError for fractions and values that are not finite."""
    if values.dtype.kind == "f" and not (np.isfinite(values) & (np.round(values) == values)).all():
        raise ValueError("indices that are not whole numbers")
    return values.astype(np.int64)


def triangles(length: np.ndarray, corners: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Cut polygons into triangles [F, 3] of indices into `corners`. The polygons have `length` [P] corners, which
    follow one another in `corners` [sum]. Raises ValueError for corners that are not in `vertices` [V, 3].

    Each becomes a fan around its first corner, or if a triangle of that lies outside the polygon, its ears are cut off
    one by one.
    """
    if len(corners) and not (corners.min() >= 0 and corners.max() < len(vertices)):
        raise ValueError(f"face indices out of range (0 to {len(vertices) - 1} allowed)")
    start = np.cumsum(length) - length
    # Back to the order of the file, polygon by polygon.
    before = np.cumsum(np.maximum(length - 2, 0)) - np.maximum(length - 2, 0)
    cuts = np.empty((int(np.maximum(length - 2, 0).sum()), 3), dtype=np.int64)
    for count in np.unique(length[length > 2]).tolist():
        some = np.flatnonzero(length == count)
        fan = np.stack([np.zeros(count - 2, int), np.arange(1, count - 1), np.arange(2, count)], axis=1)
        cuts[before[some][:, None] + np.arange(count - 2)] = start[some][:, None, None] + fan
        if count > 3:
            points = vertices[corners[start[some][:, None] + np.arange(count)]]
            legs = points[:, 1:] - points[:, :1]
            normals = np.cross(legs[:, :-1], legs[:, 1:])
            along = np.einsum("pfi,pi->pf", normals, normals.sum(1))
            outside = along < -FLAT * np.square(normals.sum(1)).sum(1, keepdims=True)
            for k in np.flatnonzero(outside.any(1)):
                cuts[before[some[k]] + np.arange(count - 2)] = start[some[k]] + _ears(points[k])
    return cuts


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
    text = plain_text(content)
    rows = [words for line in re.sub(rb"#[^\n]*", b"", text).split(b"\n") if (words := line.decode("latin-1").split())]
    first = rows[0][0] if rows else ""
    kind = re.fullmatch(r"(ST)?(C)?(N)?(4)?(n)?OFF", first.upper() if first.islower() else first)
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
    table = numbers([word.encode() for row in taken for word in row], text).reshape(count, 6 if has_shades else 3)
    colors = None
    if has_shades:
        fractions = table[:, 3:].max() <= 1.0
        colors = np.clip(np.round(table[:, 3:] * (255.0 if fractions else 1.0)), 0, 255).astype(np.uint8)
    length = np.array([int(row[0]) for row in rest], dtype=np.int64)
    if any(not 0 <= n < len(row) for n, row in zip(length.tolist(), rest, strict=True)):
        raise ValueError("cut short: a face has fewer corners than it announces")
    corners = [word.encode() for n, row in zip(length.tolist(), rest, strict=True) for word in row[1 : n + 1]]
    corners = numbers(corners, text, np.int64)
    shaded = colors is None and any(len(row) > n + 1 for n, row in zip(length.tolist(), rest, strict=True))
    notes = ("colours of its faces are left out: OFF is read with those of vertices, PLY with both",) * shaded
    return FileMesh(table[:, :3], corners[triangles(length, corners, table[:, :3])], colors, notes=notes)


def obj_surface(path: Path, content: bytes) -> FileMesh:
    """The triangles of an OBJ file, with the colours of its vertices and of its materials, whose images and libraries
    are read from the folder of `path`."""
    text = plain_text(content).replace(b"\\\n", b" ")
    rows: dict[bytes, list[list[bytes]]] = {key: [] for key in OBJ_ROWS}
    at: dict[bytes, list[int]] = {key: [] for key in OBJ_ROWS}  # their lines
    libraries, used = [], {0: ""}  # the names of materials, by the first face
    for number, line in enumerate(text.split(b"\n"), start=1):
        key, *rest = line.split(None, 1) or [b""]
        key = key.lower()
        if key in rows:
            rows[key].append(rest[0].partition(b"#")[0].split() if rest else [])
            at[key].append(number)
        elif key == b"usemtl":
            used[len(rows[b"f"])] = _name(rest[0]) if rest else ""
        elif key == b"mtllib" and rest:
            libraries.append(_name(rest[0]))
    for number, row in zip(at[b"v"], rows[b"v"], strict=True):
        if len(row) < 3:
            raise ValueError(f"line {number}: a vertex has fewer than three coordinates")
    vertices = numbers([word for row in rows[b"v"] for word in row[:3]], text).reshape(-1, 3)
    shades = None
    if rows[b"v"] and all(len(row) >= 6 for row in rows[b"v"]):
        shades = np.nan_to_num(numbers([word for row in rows[b"v"] for word in row[-3:]], text)).reshape(-1, 3)
        shades = np.clip(np.round(shades * (255.0 if shades.max() <= 1.0 else 1.0)), 0, 255).astype(np.uint8)
    length, table = _obj_corners(rows, at, text)
    cuts = triangles(length, table[:, 0], vertices)
    faces, owner = table[cuts, 0], np.repeat(np.arange(len(length)), length)[cuts[:, 0]]
    spots = numbers([word for row in rows[b"vt"] for word in (*row[:2], *[b"0"] * (2 - len(row)))], text).reshape(-1, 2)

    notes: list[str] = []
    known = _libraries(path, libraries, notes)
    if not libraries and any(used.values()):
        notes.append("it names materials, but no file that describes them (mtllib): their looks are left out")
    starts, colors, plain = np.array(list(used)), np.full((len(faces), 3, 3), 255, np.uint8), np.ones(len(faces), bool)
    numbered = {name: k for k, name in enumerate(dict.fromkeys(used.values()))}
    material = np.array([numbered[name] for name in used.values()])[np.searchsorted(starts, owner, side="right") - 1]
    colored, parts = shades is not None, []
    if shades is not None:
        colors[:] = shades[faces]
    for name, k in numbered.items():
        some = np.flatnonzero(material == k)
        if not name or not len(some) or not known:
            continue
        if name not in known:
            notes.append(f"material {name} is not in {', '.join(libraries)}: its look is left out")
            continue
        color, image, laid = _look(path, known[name], notes)
        if image is not None and (table[cuts[some], 1] < 0).any():
            notes.append(f"the texture of material {name} has no places (vt) on some faces: left out")
            image = None
        if image is not None:
            uv = laid(spots[table[cuts[some], 1]]) * [1.0, -1.0] + [0.0, 1.0]  # OBJ counts from the lower edge
            colors[some], plain[some], colored = looked_up(image, uv), False, True
            # A vertex is doubled where the texture is cut.
            pairs = table[cuts[some], 0] * (len(spots) + 1) + table[cuts[some], 1]
            _, first, label = np.unique(pairs, return_index=True, return_inverse=True)
            places, uv = vertices[faces[some]].reshape(-1, 3)[first], uv.reshape(-1, 2)[first]
            parts.append(Painted(places, label.reshape(-1, 3), uv, image))
        elif color is not None and shades is None:
            colors[some], colored = color, True
    painted = (*parts, *plain_parts(vertices, faces[plain], colors[plain])) if parts else ()
    return FileMesh(vertices, faces, colors if colored else None, painted=painted, notes=tuple(notes))


def _name(word: bytes) -> str:
    try:
        return word.decode().strip()
    except UnicodeDecodeError:
        return word.decode("latin-1").strip()


def _obj_corners(
    rows: dict[bytes, list[list[bytes]]], at: dict[bytes, list[int]], text: bytes
) -> tuple[np.ndarray, np.ndarray]:
    """Number of corners [P] of every polygon of an OBJ file, and rows [sum, 3] of the vertex, the place in the texture
    and the normal of every corner, from 0; -1 for none."""
    length = np.array([len(row) for row in rows[b"f"]], dtype=np.int64)
    words = b" ".join(word + b"/0" * (2 - word.count(b"/")) for row in rows[b"f"] for word in row) + b" "
    words = words.replace(b"//", b"/0/").replace(b"/ ", b"/0 ").replace(b"/", b" ").split()
    given = numbers(words, text, np.int64)
    if len(given) != 3 * length.sum():
        raise ValueError("a corner of a face has more than three indices")
    given = given.reshape(-1, 3)
    line = np.repeat(np.array(at[b"f"], dtype=np.int64), length)
    table = given - 1
    for k, key in enumerate(OBJ_ROWS[:3]):
        back = given[:, k] < 0  # counts back from where it stands, not from the end
        before = np.searchsorted(at[key], line)
        table[back, k] = before[back] + given[back, k]
        wrong = (table[:, k] < 0) & (back | (k == 0))
        if wrong.any():
            j = int(wrong.argmax())
            raise ValueError(f"line {line[j]}: a face has the index {given[j, k]}, {before[j]} rows come before it")
        beyond = table[:, k] >= len(rows[key])
        if k == 0 and beyond.any():
            j = int(beyond.argmax())
            raise ValueError(f"line {line[j]}: a face has the index {given[j, k]}, there are {len(rows[key])} vertices")
        table[beyond, k] = -1
    return length, table


def _libraries(path: Path, names: list[str], notes: list[str]) -> dict[str, dict[str, str]]:
    """The rows of the materials in MTL files, by their names and keys in lower case."""
    known: dict[str, dict[str, str]] = {}
    for line in names:
        found, missing = [], ""
        for choice in ([line], line.split() if " " in line else []):  # one name with blanks, or several
            try:
                found = [side_file(path, name) for name in choice]
            except ValueError as error:
                missing = missing or str(error)
            if found:
                break
        else:
            notes.append(f"material library {missing}: its colours and textures are left out")
        for content in found:
            rows: dict[str, str] = {}
            for row in plain_text(content).split(b"\n"):
                key, _, rest = _name(row).replace("\t", " ").partition(" ")
                if key.lower() == "newmtl":
                    rows = known.setdefault(rest.strip(), {})
                else:
                    rows.setdefault(key.lower(), rest.strip())
    return known


def _look(path: Path, rows: dict[str, str], notes: list[str]) -> tuple[np.ndarray | None, np.ndarray | None, Any]:
    """A material's colour [3] uint8 and image, None if it has none, and the function that lays places [..., 2] from the
    lower left into the image."""
    color = None
    try:
        if value := [float(word) for word in rows.get("kd", "").split()][:3]:
            color = np.round(255.0 * np.clip(np.broadcast_to(value, 3), 0.0, 1.0)).astype(np.uint8)
    except ValueError:
        notes.append(f"colour Kd {rows['kd'][:40]} is not three numbers: left out")
    # Tr is 0 or 1 for what is not transparent: programs differ.
    clear = rows.get("d", "1").strip("0.") == "1" and rows.get("tr", "1").strip("0.") in ("", "1")
    lost = {"normal maps": not OBJ_BUMPS.isdisjoint(rows), "transparency": "map_d" in rows or not clear}
    notes += [f"not shown: {what}" for what, is_lost in lost.items() if is_lost]
    words, options = rows.get("map_kd", "").split(), {}
    while words and (key := words[0].lower()) in MAP_OPTIONS and len(words) > 1:
        count = MAP_OPTIONS[key]
        count = len(list(takewhile(NUMBER.fullmatch, words[1:4]))) if count == 3 else count
        options[key], words = words[1 : 1 + count], words[1 + count :]
    image = image_beside(path, " ".join(words), notes) if words else None

    def laid(places: np.ndarray) -> np.ndarray:
        for key, combine in (("-s", np.multiply), ("-o", np.add)):
            given = [float(word) for word in options.get(key, [])][:2]
            places = combine(places, [*given, *[1.0 if key == "-s" else 0.0] * (2 - len(given))])
        return np.clip(places, 0.0, 1.0) if options.get("-clamp") == ["on"] else places

    return color, image, laid


def stl_surface(content: bytes) -> FileMesh:
    """The triangles of an STL file, text or binary."""
    count = int.from_bytes(content[80:84], "little") if len(content) >= 84 else 0
    needed = 84 + FACET * count
    head = plain_text(content[:512]).lower()
    text = plain_text(content).lower() if head.lstrip()[:5] == b"solid" and b"\0" not in head else b""
    if len(content) != needed and b"facet" in text:
        if not re.search(rb"end[ \t]*solid", text):
            raise ValueError("cut short: it has no endsolid")
        words = re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", text)
        corners = numbers([word for row in words for word in row], text).reshape(-1, 3)
        if len(corners) != 3 * (facets := len(re.findall(rb"\bouter\s+loop\b", text))):
            raise ValueError(f"damaged: {len(corners)} vertices for {facets} triangles")
        return FileMesh(corners, np.arange(len(corners)).reshape(-1, 3))
    if len(content) < 84:
        raise ValueError("it is not an STL file, or cut short")
    # The last triangle's last two bytes are an attribute, which some programs leave out.
    if len(content) < needed - 2:
        raise ValueError(f"cut short: {(len(content) - 84) // FACET} of {count} faces")
    if not count and len(content) > needed:
        raise ValueError(f"its header announces no faces, and {len(content) - 84} bytes follow")
    facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    corners = np.frombuffer(content[84:needed].ljust(needed - 84, b"\0"), facet)["corners"].astype(np.float64)
    notes = ("its colours are left out: STL is read without them",) if b"COLOR=" in content[:80] else ()
    return FileMesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), notes=notes)


def collada_surface(path: Path, *, upright: bool) -> FileMesh:
    """The triangles of all instances in the file's scene, in metres, with z up. Unless `upright`, its axes are taken as
    they are, whatever `up_axis` says: robot files rely on that, as RViz, MoveIt and Gazebo do it. Raises ValueError if
    there are none, and the errors of the reader if it is damaged."""
    collada: Any = importlib.import_module("collada")  # few need it
    file = collada.Collada(str(path), ignore=[collada.common.DaeUnsupportedError, collada.common.DaeBrokenRefError])
    vertices, faces, colors, first, textured = [], [], [], 0, False
    for instance in file.scene.objects("geometry") if file.scene is not None else ():
        mirrored = np.linalg.det(instance.matrix[:3, :3]) < 0.0
        for part in instance.primitives():
            if not isinstance(part, collada.triangleset.BoundTriangleSet):
                if not hasattr(part, "triangleset"):  # lines
                    continue
                part = part.triangleset()
            if part.vertex is None or not len(part.vertex_index):
                continue
            vertices.append(part.vertex)
            corners = np.asarray(part.vertex_index, np.int64) + first
            faces.append(corners[:, ::-1] if mirrored else corners)
            color = _color(part.material)
            textured |= color is None
            colors.append(np.broadcast_to(np.array(color or WHITE, np.uint8), (len(corners), 3, 3)))
            first += len(part.vertex)
    if not faces:
        raise ValueError("it has no triangles in its scene")
    notes = ["its textures are left out"] if textured else []
    up = file.assetInfo.upaxis or "Y_UP"
    if up != "Z_UP":
        notes.append(f"its up axis, {up[0].lower()}, is {'turned to z' if upright else 'taken as z, as in RViz'}")
    unit = float(file.assetInfo.unitmeter or 1.0)
    order, signs = UPRIGHT[up if upright else "Z_UP"]
    whole = unit * np.concatenate(vertices).astype(np.float64)[:, order] * signs
    return FileMesh(whole, np.concatenate(faces), np.concatenate(colors), notes=tuple(notes))


def _color(material: Any) -> tuple[int, int, int] | None:
    """sRGB of a material; None if it has an image."""
    diffuse = getattr(getattr(material, "effect", None), "diffuse", None)
    if diffuse is None:
        return WHITE
    if not isinstance(diffuse, tuple):
        return None
    red, green, blue = (round(255 * float(channel)) for channel in np.clip(diffuse[:3], 0.0, 1.0))
    return red, green, blue
