"""Photos -> camera poses and sparse points, by a ladder of attempts, with a verdict on whether they can be trusted."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.cameras import load_view_file, save_views
from pipeline.inputs.photos import GIVEN, Photo
from pipeline.sfm.pose_checks import failure_hint, failure_message, judge, views_of
from sdfsim.errors import EXIT_QUALITY, SdfsimError
from sdfsim.files import read_json, replacing, write_json

Progress = Callable[[float, str], None]

ORDINARY: dict[str, Any] = {
    "pixels": 1000, "max_features": 3000, "peak_threshold": 0.0066667, "affine": False, "max_ratio": 0.8,
    "guided": False, "moving_only": False, "min_inliers": 15, "min_inlier_ratio": 0.35, "mapper": "incremental",
    "init_inliers": 100, "init_angle": 16.0, "pose_inliers": 30, "hold_focal": False,
}  # fmt: skip
MORE = {
    **ORDINARY, "pixels": 1600, "max_features": 12000, "peak_threshold": 0.003, "max_ratio": 0.88, "guided": True,
    "min_inliers": 12, "min_inlier_ratio": 0.25, "init_inliers": 40, "init_angle": 6.0, "pose_inliers": 15,
}  # fmt: skip


@dataclass(frozen=True)
class Rung:
    """One way to find poses.

    Attributes:
        name: what it does, for the report.
        settings: of the worker.
        when: whether it is worth trying after these verdicts, none of them good.
        matches_of: name of an earlier rung whose matches it takes, or nothing.
    """

    name: str
    settings: dict[str, Any]
    when: Callable[[list[dict]], bool]
    matches_of: str = ""


def _about_focal(verdicts: list[dict]) -> bool:
    return any("EXIF" in failure for failure in verdicts[0]["failures"])


def _moved(verdicts: list[dict]) -> bool:
    """Photos that a turn on the spot explains, or of a background that stands still, tell no more with more matches."""
    return verdicts[0]["turn_only_pairs"] <= 0.9 and verdicts[0]["still_pairs"] <= 0.5


def _hopeful(verdicts: list[dict]) -> bool:
    """More of the same cannot mend photos from one spot, or of nothing."""
    last = verdicts[-1]
    return _moved(verdicts) and last["turn_only_pairs"] <= 0.5 and last["components"][0] >= last["needed"]


LADDER = (
    Rung("ordinary", ORDINARY, lambda verdicts: True),
    Rung("without what stands still in the picture", {**ORDINARY, "moving_only": True},
         lambda verdicts: verdicts[0]["still_pairs"] > 0.5),
    Rung("focal length of EXIF held", {**ORDINARY, "hold_focal": True}, _about_focal, "ordinary"),
    Rung("more pixels and features, looser thresholds", MORE, _moved),
    Rung("global mapping", {**MORE, "mapper": "global"}, _hopeful, "more pixels and features, looser thresholds"),
    Rung("affine features", {**MORE, "max_features": 6000, "affine": True},
         lambda verdicts: _hopeful(verdicts) and "repeats" not in " ".join(verdicts[-1]["failures"])),
)  # fmt: skip
KNOWN = (Rung("known cameras", ORDINARY, lambda verdicts: True),)


def size_groups(photos: list[Photo]) -> list[dict]:
    """Photos that share one camera: same size, same body, same zoom (EXIF focal within 2 %)."""
    groups: dict[tuple, dict] = {}
    for photo in photos:
        zoom = round(np.log(photo.focal) / 0.02) if photo.focal else None
        key = (photo.width, photo.height, photo.camera, zoom)
        entry = {"width": photo.width, "height": photo.height, "focal": photo.focal, "names": []}
        groups.setdefault(key, entry)["names"].append(photo.name)
    return list(groups.values())


def solve(photos: list[Photo], photos_folder: Path, out: Path, *, seed: int = 0, timeout: float = 1800.0,
          exhaustive_up_to: int = 150, on_progress: Progress | None = None) -> dict:  # fmt: skip
    """Finds the poses of `photos` and writes `cameras.json`, `sparse.npz`, `verdict.json` to `out`.

    Climbs `LADDER` until poses can be trusted; each rung has a folder of its own, in which a killed run goes on. Where
    the photos came with cameras these are kept, checked against the photos, and given sparse points.

    Args:
        photos: what the photos stage prepared, in `photos_folder`.
        photos_folder: holds `images/` (and `masks/`, `given.json`).
        out: existing folder.
        seed: of every random choice in matching and mapping.
        timeout: s for each rung.
        exhaustive_up_to: with more photos than this only neighbours in name order are matched.
        on_progress: called with (fraction, message).

    Returns:
        The verdict (also in verdict.json): posed, left_out with reasons, mean_error px, focal checks, warnings, and
        the rungs that were tried.

    Raises:
        SdfsimError: (exit code 3) too few photos could be posed, or the result is not plausible.
    """
    out, photos_folder = Path(out), Path(photos_folder)
    given = photos_folder / GIVEN
    job = {
        "images": str(photos_folder / "images"), "count": len(photos), "groups": size_groups(photos), "seed": seed,
        "masks": str(photos_folder / "masks") if all(p.mask for p in photos) else "",
        "given": str(given) if given.exists() else "", "exhaustive_up_to": exhaustive_up_to,
    }  # fmt: skip
    tries: list[tuple[dict, Path, dict]] = []
    told: list[dict] = []
    rungs = KNOWN if job["given"] else LADDER
    for number, rung in enumerate(rungs):
        made = rung.matches_of in {"", *(one["name"] for one in told if "seconds" in one)}
        if not made or not rung.when([verdict for verdict, _, _ in tries]):
            continue

        def report(fraction: float, message: str, number: int = number, rung: Rung = rung) -> None:
            if on_progress:
                on_progress(fraction, (f"again, {rung.name}: " if number else "") + message)

        folder, started = out / folder_of(rung), time.monotonic()
        matches = str(out / folder_of(_named(rung.matches_of)) / "database.db") if rung.matches_of else ""
        try:
            result = run_worker({**job, **rung.settings, "matches_of": matches}, folder, timeout, report)
        except SdfsimError as error:
            if not tries:
                raise
            # What the rungs before found out says more than that this one broke.
            told.append({"name": rung.name, "posed": 0, "failures": [error.message]})
            continue
        verdict = judge(result, photos, tries[0][2] if tries else None)
        tries.append((verdict, folder, result))
        told.append({"name": rung.name, "posed": verdict["posed"], "failures": verdict["failures"],
                     "seconds": round(time.monotonic() - started, 1)})  # fmt: skip
        if not verdict["failures"]:
            break
    # Best: plausible first, then the most photos and points.
    verdict, folder, result = max(tries, key=lambda t: (not t[0]["failures"], t[0]["posed"], t[0]["points"]))
    verdict["attempts"], verdict["known_cameras"] = told, bool(job["given"])
    hint = failure_hint(verdict)
    if verdict["known_cameras"] and verdict["failures"]:
        verdict["failures"] = [f"the known cameras do not fit the photos: {'; '.join(verdict['failures'])}"]
        verdict["causes"] = []
        hint = (
            "check which photo belongs to which camera, and its axes; or give the folder of photos to find poses anew"
        )
    write_json(out / "verdict.json", verdict)
    if verdict["failures"]:
        raise SdfsimError(failure_message(verdict), hint, exit_code=EXIT_QUALITY)
    views = load_view_file(given) if job["given"] else views_of(result, photos)
    save_views(views, out / "cameras.json")
    with replacing(out / "sparse.npz") as partial:  # A copy: the rung's result stays whole for a run that goes on.
        shutil.copyfile(folder / "sparse.npz", partial)
    for _, used, _ in tries:  # Tens of megabytes that nothing reads any more; the logs stay.
        (used / "database.db").unlink(missing_ok=True)
        shutil.rmtree(used / "colmap", ignore_errors=True)
    return verdict


def _named(name: str) -> Rung:
    return next(rung for rung in LADDER if rung.name == name)


def folder_of(rung: Rung) -> str:
    """A rung's folder in that of the stage."""
    return "try_" + rung.name.split(",")[0].replace(" ", "_")


def read_if_there(path: Path) -> Any:
    """The content of a JSON file, or None where it is absent or was cut short."""
    try:
        return read_json(path)
    except SdfsimError:
        return None


def run_worker(job: dict, folder: Path, timeout: float, on_progress: Progress) -> dict:
    """Runs the COLMAP child process on one job, unless the folder holds the result of the same job already.

    Returns:
        What it wrote to `result.json`.

    Raises:
        SdfsimError: it crashed or ran out of time; the message names its log.
    """
    if read_if_there(folder / "job.json") != job:
        shutil.rmtree(folder, ignore_errors=True)  # Of other photos or settings.
    elif (done := read_if_there(folder / "result.json")) is not None:
        return done
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "colmap.log"
    write_json(folder / "job.json", job)
    environment = dict(os.environ)
    root = str(Path(__file__).resolve().parent.parent)
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [root, environment.get("PYTHONPATH", "")]))
    lines = folder / "progress.log"
    with open(log, "wb") as errors, open(lines, "wb") as output:
        child = subprocess.Popen(
            [sys.executable, "-m", "pipeline.sfm.worker", str(folder / "job.json")],
            stdout=output, stderr=errors, stdin=subprocess.DEVNULL, env=environment,
        )  # fmt: skip
        started = time.monotonic()
        try:
            while child.poll() is None:
                if time.monotonic() - started > timeout:
                    raise SdfsimError(
                        f"camera poses: stopped after {timeout:.0f} s (log: {log})", "use fewer or smaller photos"
                    )
                on_progress(*estimate(folder, lines, job["count"], job["exhaustive_up_to"]))
                try:
                    child.wait(0.5)
                except subprocess.TimeoutExpired:
                    continue
        finally:
            if child.poll() is None:
                child.kill()
                child.wait()
    if child.returncode != 0 or not (folder / "result.json").exists():
        reason = crash_reason(child.returncode, log)
        raise SdfsimError(f"camera poses: COLMAP {reason} (log: {log})", "run again; if it stays, try fewer photos")
    return read_json(folder / "result.json")


def crash_reason(code: int, log: Path) -> str:
    """How the child ended, in words: a signal's name or the last line of its log."""
    if code < 0:
        return f"was ended by {signal.Signals(-code).name}"
    tail = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return f"failed: {tail[-1].strip()[:200]}" if tail else f"failed with status {code}"


def estimate(folder: Path, lines: Path, count: int, exhaustive_up_to: int) -> tuple[float, str]:
    """Fraction done and a message, from the child's lines and the row counts of its database."""
    said = lines.read_text(errors="replace").splitlines()
    phase = next((line.split()[1] for line in reversed(said) if line.startswith("phase")), "features")
    placed = next((int(line.split()[1]) for line in reversed(said) if line.startswith("placed")), 0)
    if phase == "mapping":
        return 0.75 + 0.25 * min(1.0, placed / count), f"placing cameras, {placed} of {count}"
    if phase == "done":
        return 1.0, "done"
    table, total = ("keypoints", count) if phase == "features" else ("two_view_geometries", count * (count - 1) / 2)
    if phase == "matches" and count > exhaustive_up_to:
        total = count * 20
    rows = 0
    try:
        with sqlite3.connect(f"file:{folder / 'database.db'}?mode=ro", uri=True, timeout=0.2) as database:
            rows = database.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]
        database.close()
    except sqlite3.Error:
        pass  # Not there yet, or busy: only a progress bar.
    part = min(1.0, rows / max(total, 1))
    if phase == "features":
        return 0.2 * part, f"finding features, {rows} of {count} photos"
    return 0.2 + 0.55 * part, f"matching, {rows} of {int(total)} pairs"
