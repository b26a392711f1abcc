"""What the pairs of photos in COLMAP's database say for or against a reconstruction. Used in the child process only."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np


def counts(pycolmap, job: dict, database: Path) -> tuple[dict[str, dict], list[dict], float]:
    """Features of each photo with its verified matches, every verified pair, and the share of `turn_only` pairs.

    A pair holds the names, the number of matches, and the share of them that did not move between the photos.
    """
    pairs, moving = [], []
    sizes = {name: group for group in job["groups"] for name in group["names"]}
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image.name for image in opened.read_all_images()}
        points = {key: opened.read_keypoints(key)[:, :2] for key in images}
        result = {name: {"features": len(points[key]), "best_matches": 0, "partners": 0}
                  for key, name in images.items()}  # fmt: skip
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            matched = np.asarray(geometry.inlier_matches, int).reshape(-1, 2)
            if not len(matched):
                continue
            first, second = pycolmap.pair_id_to_image_pair(pair)
            moved = np.linalg.norm(points[first][matched[:, 0]] - points[second][matched[:, 1]], axis=1)
            still = float((moved < 2.0).mean())
            pairs.append({"a": images[first], "b": images[second], "matches": len(matched), "still": round(still, 3)})
            if len(matched) >= 30 and still < 0.5 and sizes[images[first]] is sizes[images[second]]:
                moving.append((sizes[images[first]], points[first][matched[:, 0]], points[second][matched[:, 1]]))
            for key in (first, second):
                entry = result[images[key]]
                entry["best_matches"] = max(entry["best_matches"], len(matched))
                entry["partners"] += 1
    some = moving[:: max(1, len(moving) // 200)]
    return result, pairs, round(turn_only(some), 3)


def turn_only(pairs: list[tuple[dict, np.ndarray, np.ndarray]], least: float = 2.0) -> float:
    """Share of pairs of photos whose matches a turn of the camera on the spot explains.

    A turn moves rays, not points: with the right focal length one rotation maps the rays of all matches. The focal
    length is the one that explains most pairs so.

    Args:
        pairs: width and height of the photos, and matched pixels [M, 2] of both.
        least: px, median error below which a turn explains a pair.
    """
    best = 0.0
    for ratio in np.geomspace(0.4, 4.0, 24):
        explained = 0
        for size, first, second in pairs:
            focal = ratio * max(size["width"], size["height"])
            middle = np.array([size["width"], size["height"]]) / 2
            p, q = (np.hstack([(pixels - middle) / focal, np.ones((len(pixels), 1))]) for pixels in (first, second))
            p, q = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (p, q))
            u, _, vt = np.linalg.svd(q.T @ p)
            turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
            explained += np.median(np.linalg.norm(q - p @ turn.T, axis=1)) * focal < least
        best = max(best, explained / max(1, len(pairs)))
    return best


def contradictions(pycolmap, database: Path, views: list[dict]) -> list[dict]:
    """Pairs of posed photos, with how far their matches are from the lines that the poses put them on.

    Each pair was matched and verified on its own. Where poses are right nearly all pairs agree with them; photos of
    repeating things match well in many places, and no poses agree with all of it.
    """
    posed = {view["name"]: view for view in views}
    found = []
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image.name for image in opened.read_all_images()}
        points = {key: opened.read_keypoints(key)[:, :2] for key in images}
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            matched = np.asarray(geometry.inlier_matches, int).reshape(-1, 2)
            if len(matched) < 30 or images[first] not in posed or images[second] not in posed:
                continue
            a, b = posed[images[first]], posed[images[second]]
            error = epipolar_errors(a, b, points[first][matched[:, 0]], points[second][matched[:, 1]])
            found.append({"a": images[first], "b": images[second], "matches": len(matched),
                          "error": round(float(np.median(error)), 3)})  # fmt: skip
    return found


def epipolar_errors(a: dict, b: dict, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Sampson distances [M], px of photo `a`, of matched pixels [M, 2] of two posed photos."""

    def rays(view: dict, pixels: np.ndarray) -> np.ndarray:
        bent = (pixels - [view["cx"], view["cy"]]) / view["focal"]
        flat = bent
        for _ in range(8):
            flat = bent / (1 + view["k"] * np.clip((flat**2).sum(1, keepdims=True), 0, 4))
        return np.hstack([flat, np.ones((len(flat), 1))])

    turn_a, turn_b = np.array(a["rotation"]), np.array(b["rotation"])
    turn = turn_b @ turn_a.T
    x, y, z = np.array(b["translation"]) - turn @ np.array(a["translation"])
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ turn
    p, q = rays(a, first), rays(b, second)
    forth, back = p @ essential.T, q @ essential
    slope = (forth[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1)
    return np.abs((q * forth).sum(1)) / np.sqrt(np.maximum(slope, 1e-30)) * a["focal"]


def focal_of_pairs(pycolmap, job: dict, database: Path, out: Path) -> dict[str, float]:
    """Focal length (px) of each photo's camera from the pairs' fundamental matrices alone, where they tell it.

    An estimate that owes nothing to the mapping: a second opinion on its focal length (view graph calibration, Sweeney
    et al., 2015).
    """
    copy = out / "focal.db"
    shutil.copyfile(database, copy)
    try:
        with pycolmap.Database.open(copy) as opened:
            before = {camera.camera_id: float(camera.params[0]) for camera in opened.read_all_cameras()}
        options = pycolmap.ViewGraphCalibrationOptions(random_seed=job["seed"], reestimate_relative_pose=False)
        if not pycolmap.calibrate_view_graph(copy, options):
            return {}
        with pycolmap.Database.open(copy) as opened:
            after = {camera.camera_id: float(camera.params[0]) for camera in opened.read_all_cameras()}
            return {
                image.name: after[image.camera_id] for image in opened.read_all_images()
                if after[image.camera_id] != before[image.camera_id]
            }  # fmt: skip
    finally:
        copy.unlink(missing_ok=True)
