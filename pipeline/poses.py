"""Photos -> camera poses and sparse points, with a verdict on whether they can be trusted."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pipeline.cameras import View, save_views
from pipeline.photos import Photo
from sdfsim.errors import EXIT_QUALITY, SdfsimError
from sdfsim.files import read_json, write_json

Progress = Callable[[float, str], None]

# Field of view of the longer side, degrees: from a short telephoto to a wide angle lens.
FOV_RANGE = (18.0, 110.0)
MAX_MEAN_ERROR = 2.0
MIN_TRIANGULATION = 1.5
FEW_FEATURES = 150
FEW_MATCHES = 30

FIRST_TRY = {
    "max_features": 3000, "peak_threshold": 0.0066667, "max_ratio": 0.8, "guided": False, "min_inliers": 15,
    "init_inliers": 100, "init_angle": 16.0, "pose_inliers": 30, "min_inlier_ratio": 0.35,
}  # fmt: skip
SECOND_TRY = {
    "max_features": 12000, "peak_threshold": 0.003, "max_ratio": 0.88, "guided": True, "min_inliers": 12,
    "init_inliers": 40, "init_angle": 6.0, "pose_inliers": 15, "min_inlier_ratio": 0.25,
}  # fmt: skip


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
          exhaustive_up_to: int = 150, one_thread: bool = False,
          on_progress: Progress | None = None) -> dict:  # fmt: skip
    """Finds the poses of `photos` and writes `cameras.json`, `sparse.npz`, `verdict.json` to `out`.

    Tries once with ordinary settings and once more with more features and looser thresholds where the first try
    leaves too many photos out or is not plausible.

    Args:
        photos: what the photos stage prepared, in `photos_folder`.
        photos_folder: holds `images/` (and `masks/`).
        out: existing folder.
        seed: of every random choice in matching and mapping.
        timeout: s for each try.
        exhaustive_up_to: with more photos than this only neighbours in name order are matched.
        one_thread: bundle adjustment on one thread: the same result on every machine, but slower.
        on_progress: called with (fraction, message).

    Returns:
        The verdict (also in verdict.json): posed, left_out with reasons, mean_error px, focal checks, warnings.

    Raises:
        SdfsimError: (exit code 3) too few photos could be posed, or the result is not plausible.
    """
    out, photos_folder = Path(out), Path(photos_folder)
    job = {
        "images": str(photos_folder / "images"), "count": len(photos), "groups": size_groups(photos), "seed": seed,
        "masks": str(photos_folder / "masks") if all(p.mask for p in photos) else "",
        "exhaustive_up_to": exhaustive_up_to, "one_thread": one_thread,
    }  # fmt: skip
    tries = []
    for number, settings in enumerate((FIRST_TRY, SECOND_TRY)):
        folder = out / f"try{number + 1}"
        folder.mkdir(parents=True, exist_ok=True)

        def report(fraction: float, message: str, number: int = number) -> None:
            if on_progress:
                on_progress(fraction if number == 0 else 0.5 + fraction / 2, ("retry: " if number else "") + message)

        try:
            result = run_worker({**job, **settings}, folder, timeout, report)
        except SdfsimError as error:
            if not tries:
                raise
            # What the first try found out says more than that the second one broke.
            tries[0][0]["warnings"].append(f"the second try failed: {error.message}")
            break
        verdict = judge(result, photos)
        verdict["settings"] = "ordinary" if number == 0 else "more features, looser thresholds"
        tries.append((verdict, folder, result))
        if not verdict["failures"]:
            break
    # Best: plausible first, then the most photos.
    verdict, folder, result = max(tries, key=lambda t: (not t[0]["failures"], t[0]["posed"]))
    verdict["tries"] = len(tries)
    write_json(out / "verdict.json", verdict)
    if verdict["failures"]:
        raise SdfsimError(failure_message(verdict), failure_hint(verdict), exit_code=EXIT_QUALITY)
    save_views(views_of(result, photos), out / "cameras.json")
    os.replace(folder / "sparse.npz", out / "sparse.npz")
    for _, used, _ in tries:  # Tens of megabytes that nothing reads any more; the logs stay.
        (used / "database.db").unlink(missing_ok=True)
        shutil.rmtree(used / "colmap", ignore_errors=True)
    return verdict


def run_worker(job: dict, folder: Path, timeout: float, on_progress: Progress) -> dict:
    """Runs the COLMAP child process on one job.

    Returns:
        What it wrote to `result.json`.

    Raises:
        SdfsimError: it crashed or ran out of time; the message names its log.
    """
    log = folder / "colmap.log"
    (folder / "result.json").unlink(missing_ok=True)
    write_json(folder / "job.json", job)
    environment = dict(os.environ)
    root = str(Path(__file__).resolve().parent.parent)
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [root, environment.get("PYTHONPATH", "")]))
    lines = folder / "progress.log"
    with open(log, "wb") as errors, open(lines, "wb") as output:
        child = subprocess.Popen(
            [sys.executable, "-m", "pipeline.poses_worker", str(folder / "job.json")],
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


def views_of(result: dict, photos: list[Photo]) -> list[View]:
    """The posed views of a worker's result, in photo order."""
    source = {p.name: p.source for p in photos}
    return [
        View(**{**{k: x for k, x in v.items() if k != "camera"}, "source": source[v["name"]],
                "rotation": np.array(v["rotation"]), "translation": np.array(v["translation"])})
        for v in result["views"]
    ]  # fmt: skip


def judge(result: dict, photos: list[Photo]) -> dict:
    """Decides whether a reconstruction can be trusted.

    "All registered" is not "right": repeating textures give complete but wrong reconstructions, which show in the
    focal length, the reprojection error or the spread of points.

    Args:
        result: of the worker.
        photos: all photos.

    Returns:
        A dict for the report; `failures` is empty when the poses may be used, `warnings` are for the reader.
    """
    posed = {view["name"] for view in result["views"]}
    needed = max(3, int(np.ceil(len(photos) / 2)))
    left_out = [
        {"photo": p.source, "why": left_out_reason(result["counts"].get(p.name, {}))}
        for p in photos
        if p.name not in posed
    ]
    failures, warnings = [], []
    if len(posed) < needed:
        failures.append(f"only {len(posed)} of {len(photos)} photos could be posed ({needed} are needed)")
    elif left_out:
        warnings.append(f"{len(left_out)} of {len(photos)} photos were left out")
    focal = []
    views = views_of(result, photos)
    prior = {p.name: p.focal for p in photos}
    for view in views:
        fov = 2 * np.degrees(np.arctan(0.5 * max(view.width, view.height) / view.focal))
        focal.append({"focal": round(view.focal, 2), "fov": round(float(fov), 2), "exif": prior[view.name]})
    fovs = sorted({entry["fov"] for entry in focal})
    off = [f for f in fovs if not FOV_RANGE[0] <= f <= FOV_RANGE[1]]
    if off and len(posed) >= needed:
        failures.append(f"implausible field of view of {off[0]:.0f} degrees: the poses are probably wrong")
    ratios = [entry["focal"] / entry["exif"] for entry in focal if entry["exif"]]
    if ratios and not 0.67 < float(np.median(ratios)) < 1.5:
        warnings.append(f"focal length is {np.median(ratios):.2f} times what EXIF says (cropped photos?)")
    error = result.get("mean_error", 0.0)
    if error > MAX_MEAN_ERROR:
        failures.append(f"mean reprojection error of {error:.1f} px (at most {MAX_MEAN_ERROR})")
    angle = 0.0
    if len(posed) >= needed and result.get("points", 0) < 30:
        failures.append(f"only {result.get('points', 0)} points in common")
    elif views:
        angle = spread_angle(views, result)
        if angle < MIN_TRIANGULATION:
            failures.append(f"the cameras stand too close together ({angle:.1f} degrees apart as seen from the scene)")
    return {
        "photos": len(photos), "posed": len(posed), "needed": needed, "left_out": left_out,
        "mean_error": round(error, 4), "points": result.get("points", 0),
        "track_length": round(result.get("track_length", 0.0), 2), "models": result["models"],
        "field_of_view": fovs, "focal": sorted({entry["focal"] for entry in focal}),
        "spread_angle": round(angle, 2), "failures": failures, "warnings": warnings,
    }  # fmt: skip


def spread_angle(views: list[View], result: dict) -> float:
    """Largest angle (degrees) between viewing rays to the centre of what the cameras look at."""
    centers = np.array([v.center for v in views])
    axes = np.array([v.rotation[2] for v in views])
    from pipeline.normalise import nearest_to_axes

    focus = nearest_to_axes(centers, axes)
    rays = focus - centers
    rays /= np.linalg.norm(rays, axis=1, keepdims=True) + 1e-12
    return float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))


def left_out_reason(entry: dict) -> str:
    """Why a photo has no pose, from its feature and match counts."""
    found, best = entry.get("features", 0), entry.get("best_matches", 0)
    if found < FEW_FEATURES:
        return f"too few features ({found}): blurred, dark or without texture"
    if best < FEW_MATCHES:
        return f"too few matches with other photos (best pair: {best}): not enough overlap"
    return f"its {best} matches do not agree with the rest of the reconstruction"


def failure_message(verdict: dict) -> str:
    """The verdict's failures and the photos left out, in one line."""
    message = "camera poses: " + "; ".join(verdict["failures"])
    left = verdict["left_out"]
    if left:
        named = [f"{entry['photo']}: {entry['why']}" for entry in left[:4]]
        message += ". Left out: " + "; ".join(named) + (f"; and {len(left) - 4} more" if len(left) > 4 else "")
    return message


def failure_hint(verdict: dict) -> str:
    """What to try, from the commonest reason."""
    reasons = " ".join(entry["why"] for entry in verdict["left_out"])
    if reasons.count("features") > reasons.count("overlap"):
        return "take sharper photos in better light, or put something textured under the object"
    return "take 20 to 60 photos in small steps around the object, each overlapping the one before by two thirds"
