"""Files that are whole or absent: written under a temporary name, then renamed. Arrays without pickle."""

from __future__ import annotations

import json
import os
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.errors import SdfsimError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` to write to; it takes the final name when the block ends without an error.

    Raises:
        SdfsimError: the disk is full or the folder not writable.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise SdfsimError(
            f"{path}: cannot be written: {error.strerror or error}", "free some space or choose another folder"
        ) from error
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """A UTF-8 text file."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: Path, content: Any) -> None:
    """A JSON file, indented. NaN and infinity are refused: they are not JSON."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_json(path: Path, hint: str = "") -> Any:
    """The content of a JSON file. Raises SdfsimError when it is absent or not JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SdfsimError(f"{path}: cannot be read: {error}", hint) from error


def write_arrays(path: Path, arrays: dict[str, Any], *, compressed: bool = True) -> None:
    """An `.npz` file."""
    with replacing(path) as partial, open(partial, "wb") as handle:
        (np.savez_compressed if compressed else np.savez)(handle, **arrays)


def read_arrays(path: Path, what: str, hint: str = "") -> dict[str, np.ndarray]:
    """All arrays of an `.npz` file; `what` says in the message what it should have been.

    Raises:
        SdfsimError: absent, cut short, or not such a file.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except (OSError, ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise SdfsimError(f"{path}: cannot be read as {what}: {error}", hint) from error


def check_writable(folder: Path) -> None:
    """That a folder can be made and written to, without making it. Raises SdfsimError otherwise."""
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise SdfsimError(f"{folder}: cannot be written: {error.strerror}", "choose another -o") from error
