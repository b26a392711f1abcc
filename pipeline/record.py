"""What a stage leaves behind: its fingerprint, its report, and a folder that appears complete or not at all."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

from sdfsim.errors import SdfsimError
from sdfsim.files import write_json

RECORD = "stage.json"
UNFINISHED = "unfinished.json"


def fingerprint(stage: str, version: int, inputs: str, options: dict) -> str:
    """Hash of what a stage's result depends on.

    Args:
        stage: its name.
        version: of its code, see `STAGE_VERSIONS`.
        inputs: name of the result that it reads, see `finish`; of the first stage, hash of the photos.
        options: that its result depends on.
    """
    return hashlib.sha256(json.dumps([stage, version, inputs, options], sort_keys=True).encode()).hexdigest()


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
    """The record of a finished stage: fingerprint, inputs, made, report, seconds; None where it has not finished."""
    try:
        known = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        # Where a record names no result of its own, its fingerprint is the name that later stages know it by.
        return {"made": known["fingerprint"], **known} if {"inputs", "report", "seconds"} <= set(known) else None
    except (OSError, ValueError, TypeError, KeyError):
        return None


def check_replaceable(place: Path) -> None:
    """That nothing lies at a stage's place but an earlier result of it.

    Raises:
        SdfsimError: something else does, which is never replaced.
    """
    if os.path.lexists(place) and read(place) is None:
        raise SdfsimError(
            f"{place}: in the way, and not replaced: sdfsim did not write it (it holds no {RECORD})",
            "choose another folder to write to, or move it away",
        )


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
    for half_written in work.rglob(".*.part"):
        if half_written.is_file():
            half_written.unlink()
    return work


def clear(work: Path, place: Path) -> None:
    """Removes what killed runs left of a stage whose result is there: the work on another, the result before it."""
    for left in (work, _old(place)):
        shutil.rmtree(left, ignore_errors=True)


def _old(place: Path) -> Path:
    return place.with_name(f".{place.name}.old")


def finish(work: Path, place: Path, wanted: str, inputs: str, report: dict, seconds: float) -> None:
    """Writes the record and moves the finished folder to its place, in place of an earlier result of the stage.

    Each result gets a name of its own, `made`: two of the same fingerprint may differ (time budgets, GPUs).

    Args:
        work: the folder that `begin` gave.
        place: where the result belongs.
        wanted: fingerprint of the stage.
        inputs: name of the result that it read.
        report: of the stage.
        seconds: that it took.

    Raises:
        SdfsimError: what lies at the place was not written by `finish`.
    """
    check_replaceable(place)
    # The mark of unfinished work goes last: where the record cannot be written, the next run goes on from here.
    write_json(
        work / RECORD,
        {"version": 1, "fingerprint": wanted, "inputs": inputs, "made": uuid.uuid4().hex, "seconds": seconds,
         "report": report},
    )  # fmt: skip
    place.parent.mkdir(parents=True, exist_ok=True)
    old = _old(place)
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
