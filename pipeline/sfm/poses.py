"""Photos -> camera poses and sparse points, in at most four attempts; each result is checked."""

import os
import re
import shutil
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.cameras import View, load_views, save_views
from pipeline.inputs.captures import load_capture
from pipeline.inputs.photos import KNOWN_CAMERAS, Photo
from pipeline.sfm.agreement import unexplained
from pipeline.sfm.pose_checks import check, failure_hint, failure_message, views_of
from sdfsim.base.errors import EXIT_QUALITY, SdfsimError
from sdfsim.base.files import read_json, replacing, write_json
from sdfsim.base.parallel import Progress, silent

# Each photo is matched with the photos that look most like it: this minimum and maximum, and between them a share of
# all. On the bundled set 14 of 48 gave the same poses as all pairs, in a third of the time.
PARTNERS, SHARE = (14, 40), 0.25
ORDINARY: dict[str, Any] = {
    "pixels": 1000, "features": 7000, "contrast": 0.02, "max_ratio": 0.8,
    "moving_only": False, "min_inliers": 15, "min_inlier_ratio": 0.35, "init_inliers": 100, "init_angle": 16.0,
    "pose_inliers": 30, "exhaustive_up_to": 30,
    "all_up_to": 150,  # photos; beyond this, pairs that do not look alike are never matched
}  # fmt: skip
CAREFUL: dict[str, Any] = {
    "max_ratio": 0.88, "min_inliers": 12, "min_inlier_ratio": 0.25, "init_inliers": 40, "init_angle": 6.0,
    "pose_inliers": 15,
}  # fmt: skip
# The worker's settings for each attempt, by name. The attempts end with the first that gives trusted poses of all
# photos.
ATTEMPTS = {
    "ordinary": ORDINARY,
    "without static matches": {**ORDINARY, "moving_only": True},
    "more matches": {**ORDINARY, **CAREFUL, "all_up_to": 0},
    "more features": {
        **ORDINARY, **CAREFUL, "pixels": 1600, "features": 12000, "contrast": 0.009,
        "exhaustive_up_to": 40, "all_up_to": 40,  # A pair takes most of a second.
    },
}  # fmt: skip

WORTH = 0.05  # of the photos left out: from here on a careful attempt is worth its minutes
WORSE = 1.15  # times as many unexplained matches of the first attempt: beyond this the poses are really worse
WIDEST_PAIR = 60.0  # degrees between the optical axes of known cameras whose photos are matched


def hopeful(settings: dict, first: dict) -> bool:
    """Whether an attempt is worth its time after the first one's failed checks. More features do not help for photos
    from one spot, with a static background, or of another lens."""
    if first["other_lens"]:
        return False
    still = first["still_pairs"] > 0.5
    return still if settings["moving_only"] else first["turn_only_pairs"] <= 0.9 and not still


def worth_more(checks: dict) -> bool:
    """Whether a more careful attempt may pose photos that good poses leave out: at least one in twenty, in focus and of
    the same object."""
    return sum(entry["hopeful"] for entry in checks["left_out"]) > WORTH * checks["photos"]


def better(new: tuple[dict, Path, dict], old: tuple[dict, Path, dict]) -> bool:
    """Whether an attempt (checks, folder, result) is better than an earlier one: trusted poses first, then more photos,
    unless the photos in both are posed worse; if neither can be trusted, more photos and points."""
    checks, before = new[0], old[0]
    if bool(checks["failures"]) != bool(before["failures"]):
        return not checks["failures"]
    if checks["failures"]:
        return (checks["posed"], checks["points"]) > (before["posed"], before["points"])
    # With the same matches, because each attempt has different features.
    both = [(a, b) for a, b in zip(new[2]["judged"], old[2]["judged"], strict=True) if a["own"] and b["own"]]
    worse = unexplained([a for a, _ in both]) > WORSE * unexplained([b for _, b in both])
    return checks["posed"] > before["posed"] and not worse


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
          on_progress: Progress = silent) -> dict:  # fmt: skip
    """Finds the poses of `photos` and writes `cameras.json`, `sparse.npz`, `checks.json` to `out`; returns the checks.

    Makes `ATTEMPTS` until poses of all photos can be trusted, for at most `timeout` s each; each has a separate folder,
    in which a killed run continues. Cameras that came with the photos are kept and checked. Raises SdfsimError (exit
    code 3) if too few photos could be posed, or if the result is not plausible.
    """
    known = photos_folder / KNOWN_CAMERAS
    job = {
        "version": 9,  # of the child's files, which a resumed run reads
        "images": str(photos_folder / "images"), "count": len(photos), "groups": size_groups(photos), "seed": seed,
        "masks": str(photos_folder / "masks") if all(p.mask for p in photos) else "",
        "known_cameras": str(known) if known.exists() else "", "refine": load_capture(photos_folder) is not None,
        "pairs": seen_together(load_views(known)) if known.exists() else None, "features_of": "",
        "partners": int(np.clip(SHARE * len(photos), *PARTNERS)),
    }  # fmt: skip
    tries: list[tuple[dict, Path, dict]] = []
    attempts: list[dict] = []
    best: Any = None
    for name, settings in ATTEMPTS.items():
        if tries and (job["known_cameras"] or not hopeful(settings, tries[0][0])):
            continue
        if tries and not best[0]["failures"] and not worth_more(best[0]):
            break
        folder = out / f"try_{name.replace(' ', '_')}"
        try:
            judge, more = str(tries[0][1] / "database.db") if tries else "", {}
            if name == "more matches":
                more = {"features_of": judge, "pairs": with_new(tries[0], photos)}
            elif tries and len(photos) <= settings["exhaustive_up_to"]:  # else only pairs that look alike
                more = {"pairs": worth_matching(tries[0], photos)}
            result = run_worker({**job, **settings, **more, "judge": judge}, folder, timeout, on_progress)
        except SdfsimError as error:
            if not tries:
                raise
            # The findings of earlier attempts are more useful than this failure.
            attempts.append({"name": name, "posed": 0, "failures": [error.message]})
            continue
        checks = check(result, photos, tries[0][2] if tries else None, known=bool(job["known_cameras"]))
        tries.append((checks, folder, result))
        best = tries[-1] if best is None or better(tries[-1], best) else best
        attempts.append({"name": name, "posed": checks["posed"], "failures": checks["failures"]})
    checks, folder, result = best
    checks["attempts"], checks["known_cameras"] = attempts, bool(job["known_cameras"])
    views = views_of(result, photos) if job["refine"] or not job["known_cameras"] else load_views(known)
    if checks["known_cameras"] and checks["failures"]:
        checks["failures"] = [f"the known cameras do not fit the photos: {'; '.join(checks['failures'])}"]
        checks["causes"] = []
    write_json(out / "checks.json", checks)
    if checks["failures"]:
        raise SdfsimError(failure_message(checks), failure_hint(checks), exit_code=EXIT_QUALITY)
    save_views(views, out / "cameras.json")
    with replacing(out / "sparse.npz") as partial:  # A copy: the attempt's result stays complete for a resumed run.
        shutil.copyfile(folder / "sparse.npz", partial)
    for _, used, _ in tries:  # Tens of megabytes that are no longer needed; the logs stay.
        (used / "database.db").unlink(missing_ok=True)
        shutil.rmtree(used / "colmap", ignore_errors=True)
    return checks


def seen_together(views: list[View]) -> list[list[str]]:
    """Pairs of photos that may show the same, by their cameras: at larger angles, features look different."""
    ahead = np.array([view.rotation[2] for view in views])
    close = ahead @ ahead.T > np.cos(np.radians(WIDEST_PAIR))
    return [[views[a].name, views[b].name] for a, b in np.argwhere(np.triu(close, 1)).tolist()]


def with_new(first: tuple[dict, Path, dict], photos: list[Photo]) -> list[list[str]] | None:
    """The pairs of photos of which an attempt (checks, folder, result) has posed at most one. None for all pairs, if
    its poses cannot be trusted."""
    if first[0]["failures"]:
        return None
    posed, names = {view["name"] for view in first[2]["views"]}, [photo.name for photo in photos]
    return [[a, b] for k, a in enumerate(names) for b in names[k + 1 :] if not {a, b} <= posed]


def worth_matching(first: tuple[dict, Path, dict], photos: list[Photo]) -> list[list[str]] | None:
    """The pairs that an attempt with other features needs after one (checks, folder, result): those that may show the
    same, and all with a photo that has no pose. None for all pairs, if its poses cannot be trusted."""
    new = with_new(first, photos)
    return new if new is None else seen_together(views_of(first[2], photos)) + new


def run_worker(job: dict, folder: Path, timeout: float, on_progress: Progress) -> dict:
    """Runs the COLMAP child process for one job, unless the folder already holds its result; returns `result.json`.
    Raises SdfsimError, which names its log, if it crashed or ran out of time."""
    before: Any = None
    with suppress(SdfsimError):  # absent, or cut short
        before = read_json(folder / "job.json")
        if before == job:
            return read_json(folder / "result.json")
    if before != job:
        shutil.rmtree(folder, ignore_errors=True)  # From other photos or settings.
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "colmap.log"
    write_json(folder / "job.json", job)
    root = str(Path(__file__).resolve().parents[2])
    # An empty entry would mean the user's folder, which may also contain a `pipeline`.
    paths = [root, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    lines = folder / "progress.log"
    with open(log, "wb") as errors, open(lines, "wb") as output:
        child = subprocess.Popen(
            [sys.executable, "-P", "-m", "pipeline.sfm.worker", str(folder / "job.json")],
            stdout=output, stderr=errors, stdin=subprocess.DEVNULL, env=environment,
        )  # fmt: skip
        started = time.monotonic()
        try:
            while child.poll() is None:
                if time.monotonic() - started > timeout:
                    message = f"camera poses: stopped after {timeout:.0f} s (log: {log})"
                    raise SdfsimError(message, "use fewer or smaller photos")
                on_progress(*estimate(folder, lines, job))
                with suppress(subprocess.TimeoutExpired):
                    child.wait(0.5)
        finally:
            child.kill()
            child.wait()
    if child.returncode != 0:
        message = f"camera poses: COLMAP failed with status {child.returncode} (log: {log})"
        raise SdfsimError(message, "run again; if it fails again, try fewer photos")
    return read_json(folder / "result.json")


def estimate(folder: Path, lines: Path, job: dict) -> tuple[float, str]:
    """Fraction done and a message, from the child's lines and the row counts of its database."""
    count = job["count"]
    said = re.findall(r"^(phase|placed) (\w+)$", lines.read_text(encoding="utf-8", errors="replace"), re.MULTILINE)
    phase = dict(said).get("phase", "features")
    if phase == "mapping":
        placed = [int(number) for word, number in said if word == "placed"] or [0]
        # Each further focal length starts again with no camera, but the progress must not go back.
        return 0.75 + 0.25 * min(1.0, max(placed) / count), f"placing cameras, {min(placed[-1], count)} of {count}"
    table, total = "keypoints", count
    if phase == "matches":
        pairs = count * (count - 1) // 2
        if count > job["exhaustive_up_to"]:
            pairs = min(pairs, count * job["partners"] * 3 // 5)  # About four in ten name each other.
        if job["pairs"] is not None and not job["features_of"]:  # There pairs that are not matched again count too.
            pairs = len(job["pairs"])
        table, total = "two_view_geometries", pairs
    rows = 0
    address = f"file:{folder / 'database.db'}?mode=ro"  # It may not exist yet, or be busy.
    with suppress(sqlite3.Error), closing(sqlite3.connect(address, uri=True, timeout=0.2)) as found:
        rows = found.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]
    part = min(1.0, rows / max(total, 1))
    if phase == "matches":
        return 0.2 + 0.55 * part, f"matching, {rows} of {total} pairs"
    return 0.2 * part, f"finding features, {rows} of {total} photos"
