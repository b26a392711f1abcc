"""Text meshes that say how long they are: one that was cut short is told, where its reader would pass over it."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from sdfsim.errors import SdfsimError


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
