"""Faces of OBJ files that count backwards, which the reader of the format takes for something else."""

from __future__ import annotations

import re
from pathlib import Path

from sdfsim.errors import SdfsimError

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
