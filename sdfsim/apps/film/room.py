"""Places of a room that was reconstructed from photos, in a film of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sdfsim.apps.film.camera import Points
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_arrays, read_json

NEAR = 1.5  # px between a feature of a photo and the point of the room that it is
RATIO = 0.8  # of distances to the best and the second best place, of which a feature is taken to be the best
INLIER = 3.0, 0.006  # px, or relative to the longer side: how far a place may be from where it is seen
ENOUGH = 16  # places
MOST = 80  # places that are kept, all over the picture
FEATURES = 4000  # of a picture


def photos_of(scene: Path | None) -> Path | None:
    """The folder of `sdfsim reconstruct` that a scene file lies in, if it has the photos still."""
    folder = scene.parent if scene is not None else None
    needed = ("poses/cameras.json", "poses/sparse.npz", "distill/field.json", "mesh/placement.json", "photos/images")
    return folder if folder is not None and all((folder / name).exists() for name in needed) else None


def of_room(pixels: np.ndarray, folder: Path, name: str, without: int = -1) -> Points:
    """Where a picture [H, W, 3] uint8 shows places of a reconstructed room: features
    that look like those of its photos (`without` one), as far as one camera sees them all. Raises SdfsimError if there
    are too few."""
    import cv2

    where, words = _features(cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_RGB2GRAY))
    places, point, known = _known(folder, without)
    index = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 4}, {"checks": 64})
    index.add([known])
    seen, found = [], []
    for options in index.knnMatch(words, k=8):
        best = options[0]
        # Photos show a place many times: the second best is the best that is another place.
        other = next((o.distance for o in options[1:] if point[o.trainIdx] != point[best.trainIdx]), np.inf)
        if best.distance < RATIO * other:
            seen.append(where[best.queryIdx])
            found.append(places[point[best.trainIdx]])
    chosen = _agreeing(np.array(seen).reshape(-1, 2), np.array(found).reshape(-1, 3), pixels.shape[1::-1])
    if len(chosen) < ENOUGH:
        raise SdfsimError(
            f"{name}: only {len(chosen)} features of the room are found in it (at least {ENOUGH})",
            "film more of what the photos show, or give points of known places: --points",
        )
    return Points(np.array(seen)[chosen], np.array(found)[chosen])


def _features(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places [F, 2] px of a picture's features, and what they look like [F, 128]: RootSIFT."""
    import cv2

    found, words = cv2.SIFT.create(FEATURES, contrastThreshold=0.01).detectAndCompute(grey, None)  # type: ignore[attr-defined]
    if words is None:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    root = np.sqrt(words / np.maximum(words.sum(1, keepdims=True), 1e-9))
    return np.array([key.pt for key in found]) + 0.5, root.astype(np.float32)


def _known(folder: Path, without: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places [P, 3] m of a room, and what they look like in its photos: the place of each [K], and its features
    [K, 128]."""
    import cv2
    from scipy.spatial import KDTree

    sparse = read_arrays(folder / "poses/sparse.npz", "points of a room")
    views = read_json(folder / "poses/cameras.json", "reconstruct the room again")["views"]
    places = xyz = np.asarray(sparse["xyz"])
    for file, key in (("distill/field.json", "to_unit"), ("mesh/placement.json", "to_metres")):
        way = read_json(folder / file, "reconstruct the room again")[key]
        places = way["scale"] * places @ np.array(way["rotation"]).T + way["translation"]
    points, words = [np.zeros(0, np.int64)], [np.zeros((0, 128), np.float32)]
    for k, view in enumerate(views):
        grey = cv2.imread(str(folder / "photos/images" / view["name"]), cv2.IMREAD_GRAYSCALE)
        own = np.unique(sparse["point_of"][sparse["view_of"] == k])
        if grey is None or not len(own) or k == without:
            continue
        local = xyz[own] @ np.array(view["rotation"]).T + view["translation"]
        flat = local[:, :2] / local[:, 2:]
        bent = flat * (1 + view["k"] * np.square(flat).sum(1, keepdims=True))
        where, looks = _features(grey)
        if len(where):
            away, nearest = map(np.asarray, KDTree(where).query(view["focal"] * bent + (view["cx"], view["cy"])))
            points.append(own[away < NEAR])
            words.append(looks[nearest[away < NEAR]])
    return places, np.concatenate(points), np.concatenate(words)


def _agreeing(seen: np.ndarray, places: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Those of the pixels [N, 2] and places [N, 3] that one camera sees, at most `MOST` and far apart."""
    import cv2

    wide, high = size
    most, best = max(INLIER[0], INLIER[1] * max(size)), np.zeros(0, np.int64)
    if len(seen) < ENOUGH:
        return best
    cv2.setRNGSeed(0)
    for focal in np.geomspace(0.5, 2.5, 12) * max(size):
        lens = np.array([[focal, 0, wide / 2], [0, focal, high / 2], [0, 0, 1.0]])
        done, _, _, rows = cv2.solvePnPRansac(
            places, seen, lens, None, iterationsCount=1000, reprojectionError=most, flags=cv2.SOLVEPNP_SQPNP
        )
        if done and rows is not None and len(rows) > len(best):
            best = np.asarray(rows).ravel()
    order, away = best[:1], np.full(len(best), np.inf)
    while len(order) and len(order) < min(MOST, len(best)):  # always the one that is farthest from those before
        away = np.minimum(away, np.linalg.norm(seen[best] - seen[order[-1]], axis=1))
        order = np.append(order, best[away.argmax()])
    return order
