"""What a glTF file announces, checked before anything is read: a small file may claim any amount of geometry."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

from sdfsim.errors import SdfsimError

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
