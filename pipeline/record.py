"""What a stage leaves behind: its fingerprint, its report, and a folder that appears complete or not at all."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from sdfsim.errors import SdfsimError
from sdfsim.files import write_json

RECORD = "stage.json"
UNFINISHED = "unfinished.json"


def fingerprint(stage: str, inputs: str, options: dict, modules: tuple[str, ...]) -> str:
    """Hash of a stage's inputs (their fingerprint), options and code.

    Args:
        stage: its name.
        inputs: fingerprint of what it reads.
        options: that its result depends on.
        modules: of this package whose source its result depends on.
    """
    digest = hashlib.sha256(json.dumps([stage, inputs, options], sort_keys=True).encode())
    for name in modules:
        digest.update((Path(__file__).parent / f"{name}.py").read_bytes())
    return digest.hexdigest()


def content_of_photos(given: Path) -> str:
    """Hash of the names and contents of the photos (or the video), their masks and cameras."""
    from pipeline.sources import find_source

    digest = hashlib.sha256()
    for path in find_source(given).files():
        digest.update(path.name.encode("utf-8", "surrogateescape") + b"\0")
        try:
            with open(path, "rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
        except OSError as error:
            raise SdfsimError(f"{path}: cannot be read ({error.strerror})") from error
    return digest.hexdigest()


def read(folder: Path) -> dict | None:
    """The record of a finished stage: fingerprint, inputs, report, seconds; None where it has not finished."""
    try:
        known = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        return known if {"fingerprint", "inputs", "report", "seconds"} <= set(known) else None
    except (OSError, ValueError, TypeError):
        return None


def begin(work: Path, wanted: str, *, fresh: bool) -> Path:
    """A folder to work in: the one a killed run left for the same fingerprint, else an empty one.

    Args:
        work: its place.
        wanted: fingerprint of the stage.
        fresh: never go on from a killed run.
    """
    try:
        left = json.loads((work / UNFINISHED).read_text(encoding="utf-8"))["fingerprint"]
    except (OSError, ValueError, KeyError, TypeError):
        left = None
    if fresh or left != wanted:
        if work.exists():
            shutil.rmtree(work)
        work.mkdir(parents=True)
        write_json(work / UNFINISHED, {"fingerprint": wanted})
    return work


def finish(work: Path, place: Path, wanted: str, inputs: str, report: dict, seconds: float) -> None:
    """Writes the record and moves the finished folder to its place.

    Args:
        work: the folder that `begin` gave.
        place: where the result belongs.
        wanted: fingerprint of the stage.
        inputs: fingerprint of what it read.
        report: of the stage.
        seconds: that it took.
    """
    # The mark of unfinished work goes last: where the record cannot be written, the next run goes on from here.
    write_json(
        work / RECORD,
        {"version": 1, "fingerprint": wanted, "inputs": inputs, "seconds": seconds, "report": report},
    )
    place.parent.mkdir(parents=True, exist_ok=True)
    old = place.with_name(f".{place.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    # A folder cannot be replaced in one step; between the two renames the stage counts as not done.
    if place.exists():
        os.rename(place, old)
    os.rename(work, place)
    (place / UNFINISHED).unlink(missing_ok=True)
    shutil.rmtree(old, ignore_errors=True)


@contextlib.contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Turns a full disk or a folder that cannot be written into one clear line.

    Raises:
        SdfsimError: in place of such an OSError.
    """
    try:
        yield
    except OSError as error:
        reasons = {errno.ENOSPC: "the disk is full", errno.EDQUOT: "the disk quota is used up"}
        hint = "free some space and run again: finished stages are kept" if error.errno in reasons else ""
        reason = reasons.get(error.errno or 0, error.strerror or str(error))
        raise SdfsimError(f"{error.filename or folder}: cannot be written ({reason})", hint) from error
