"""Files that are complete or absent (written under a temporary name, then renamed), arrays without pickle, digests."""

import hashlib
import json
import logging
import os
import secrets
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.base.errors import SdfsimError

_log = logging.getLogger(__name__)
LOCK = ".lock"
# The options of a run, the command first.
CONFIG = "config.yaml"
# What an archive may unpack to: this many bytes, or this many times its own size.
FREELY, MOST_GROWTH = 2**30, 100


def user_cache(name: str) -> Path:
    """The folder `sdfsim/NAME` in the user's cache folder."""
    own = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")  # the latter on Windows
    return Path(own or Path.home() / ".cache") / "sdfsim" / name


def path_from(folder: Path, path: Path | str) -> str:
    """A path relative to `folder`, as files there write it: with slashes, which every system reads; absolute if it lies
    on another drive."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:
        return Path(os.path.abspath(path)).as_posix()


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` to write to; it is renamed to `path` when the block ends without an error. Raises
    SdfsimError if the disk is full or the folder not writable."""
    # Unique across threads of a worker and hosts that share a folder, too.
    partial = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.part")
    try:
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise SdfsimError(
            f"{path}: cannot be written: {error.strerror or error}",
            "free some space, close the program that has it open, or choose another folder",
        ) from error
    finally:
        partial.unlink(missing_ok=True)


def visible(folder: Path) -> list[Path]:
    """Files and folders in a folder, sorted by name, without hidden ones and those that macOS adds (`._NAME`,
    `__MACOSX`)."""
    return sorted(path for path in folder.iterdir() if not hidden(path.name))


def hidden(name: str) -> bool:
    """Whether a file or folder of this name is hidden or made by the system."""
    return name.startswith(".") or name == "__MACOSX"


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file of these bytes."""
    with replacing(path) as partial:
        partial.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, content: Any) -> None:
    """Write an indented JSON file. Raises ValueError for NaN and infinity, which are not JSON."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_json(path: Path, hint: str = "") -> Any:
    """The content of a JSON file. Raises SdfsimError if it is absent or not JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise SdfsimError(f"{path}: {not_read(error)}", hint) from error


def not_read(error: Exception, what: str = "") -> str:
    """Why a file cannot be read (as `what`), without its name, which the system's message would repeat."""
    if isinstance(error, FileNotFoundError):
        return "no such file"
    reason = error.strerror if isinstance(error, OSError) and error.strerror else error
    return f"cannot be read{what and ' as '}{what}: {reason}"


def write_arrays(path: Path, arrays: dict[str, Any], *, compressed: bool = True) -> None:
    """Write an `.npz` file."""
    with replacing(path) as partial, open(partial, "wb") as handle:
        (np.savez_compressed if compressed else np.savez)(handle, **arrays)


def read_arrays(path: Path, what: str, hint: str = "") -> dict[str, np.ndarray]:
    """All arrays of an `.npz` file, which messages call `what`. Raises SdfsimError if it is absent, cut short, not an
    archive, or would unpack to an absurd size."""
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(member.file_size for member in archive.infolist())
        if unpacked > max(FREELY, MOST_GROWTH * path.stat().st_size):
            raise ValueError(f"it would unpack to {unpacked / 2**30:.1f} GiB")
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except Exception as error:  # readers of damaged files raise errors of many types
        raise SdfsimError(f"{path}: {not_read(error, what)}", hint) from error


def cached_arrays(path: Path, what: str, make: Callable[[], dict[str, Any]]) -> dict[str, np.ndarray]:
    """The arrays of a cache file, which is made on first use, and again if it is damaged. If it cannot be written, as
    on a full disk, this logs a warning, and the arrays are made again the next time."""
    if path.is_file():
        try:
            return read_arrays(path, what, "delete it")
        except SdfsimError:
            path.unlink(missing_ok=True)
    arrays = {name: np.asarray(value) for name, value in make().items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, arrays, compressed=False)
    except (SdfsimError, OSError) as error:
        _log.warning("%s cannot be cached: %s", what, error)
    return arrays


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Make a folder, keep other runs out of it inside the block, and remove half-written files of a killed run.

    The system lifts the lock when this process ends, however it ends. A folder made here is removed again if it stays
    empty. Raises SdfsimError if another run holds the folder, or if it cannot be written.
    """
    from filelock import FileLock, Timeout  # comes with torch, which is all that training needs

    made, lock = not folder.exists(), FileLock(folder / LOCK, timeout=0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout as error:
        hint = "wait until it ends, or choose another folder"
        raise SdfsimError(f"{folder}: another run is writing to this folder", hint) from error
    except OSError as error:
        raise SdfsimError(f"{folder}: cannot be written: {error.strerror}", "choose another folder") from error
    try:
        for left in folder.glob(".*.part"):
            if left.is_file():
                left.unlink(missing_ok=True)
        yield
    finally:
        with suppress(OSError):  # Windows does not remove an open file, but does so when it is released
            (folder / LOCK).unlink()
        lock.release()
        if made:
            with suppress(OSError):  # not empty: the run has written something
                folder.rmdir()


def check_writable(folder: Path) -> None:
    """Check that a folder can be made and written to, without making it. Raises SdfsimError if not."""
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise SdfsimError(f"{folder}: cannot be written: {error.strerror}", "choose another -o") from error


def check_own(folder: Path, command: str, *names: str) -> None:
    """Check that the files that a run replaces in a folder (config.yaml and `names`) come from an earlier run of the
    same command. Raises SdfsimError if not."""
    import yaml  # imported here because training needs torch and numpy only

    there = [name for name in (CONFIG, *names) if os.path.lexists(folder / name)]
    if not there:
        return
    try:
        config = yaml.safe_load((folder / CONFIG).read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError):
        config = None
    if not isinstance(config, dict) or config.get("command") != command:
        raise SdfsimError(
            f"{folder / there[0]}: exists and is not from an earlier `sdfsim {command}`, so it is not replaced",
            "choose another folder to write to, or move it away",
        )


def digest(*parts: Any) -> str:
    """A hash of the content of `parts`: arrays, tensors, networks, dataclasses and Python's own types."""
    hashed = hashlib.sha256()
    _feed(hashed, parts)
    return hashed.hexdigest()[:32]


def _feed(hashed: Any, value: Any) -> None:
    if hasattr(value, "state_dict"):  # a network
        value = [type(value).__name__, dict(value.state_dict())]
    elif hasattr(value, "detach"):  # a tensor
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        hashed.update(f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    elif isinstance(value, dict):
        _feed(hashed, [[str(key), value[key]] for key in sorted(value, key=str)])
    elif isinstance(value, list | tuple):
        hashed.update(f"{len(value)}[".encode())
        for item in value:
            _feed(hashed, item)
    elif is_dataclass(value) and not isinstance(value, type):
        _feed(hashed, [type(value).__name__, *([field.name, getattr(value, field.name)] for field in fields(value))])
    elif value is None or isinstance(value, str | int | float | bool | np.generic | Path):
        hashed.update(repr(value).encode() + b";")
    else:
        raise TypeError(f"no digest of a {type(value).__name__}")
