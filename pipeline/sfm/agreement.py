"""Agreement of poses with the matches between photos; each pair was verified independently."""

import numpy as np

from pipeline.cameras import View, view_of

ENOUGH = 30  # matches of a pair: fewer are not significant
CONTRADICTION = 4.0  # px from its line: beyond this a match contradicts the poses; the limit of verification
FINEST = 0.2  # px; poses with smaller distances than this need not be better


def agreement(pairs: list, views: list[dict]) -> list[dict]:
    """Compares the poses with the matches (names, and pixels [M, 2] in both) of every pair that has enough of them.

    An entry has the median distances (px) of matches from the epipolar lines of the poses (`error`, None if one of the
    photos has no pose) and from the best lines for this pair alone (`own`); and the share that the poses leave
    unexplained, with each match weighted by its distance (`cost`).
    """
    posed = {view["name"]: view_of({**view, "source": ""}) for view in views}
    found = []
    for a, b, first, second in pairs:
        if len(first) < ENOUGH:
            continue
        entry = {"a": a, "b": b, "matches": len(first), "error": None, "own": None, "cost": 1.0}
        if a in posed and b in posed:
            errors = epipolar_errors(posed[a], posed[b], first, second)
            own = float(np.median(own_errors(first, second)))
            cost = float(np.minimum(errors / CONTRADICTION, 1).mean())
            entry |= {"error": round(float(np.median(errors)), 3), "own": round(own, 3), "cost": round(cost, 4)}
        found.append(entry)
    return found


def unexplained(entries: list[dict]) -> float:
    """Share of all matches that the poses leave unexplained; lower is better, for any set of posed photos."""
    total = sum(entry["matches"] for entry in entries)
    return sum(entry["matches"] * entry["cost"] for entry in entries) / total if total else 1.0


def contradicting(entries: list[dict]) -> float:
    """Share of the matches of posed photos in pairs that contradict the poses. Pairs are weighted by their matches,
    because a few dozen matches arise by chance, even between photos of different things."""
    posed = [entry for entry in entries if entry["error"] is not None]
    total = sum(entry["matches"] for entry in posed)
    return sum(e["matches"] for e in posed if e["error"] > CONTRADICTION) / total if total else 0.0


def excess(entries: list[dict]) -> float:
    """Distance of matches from their lines, divided by the best possible distance: the median of the pairs' medians,
    weighted by matches. A wrong focal length shows here; repeating textures also show in `contradicting`."""
    posed = sorted((entry["error"] / max(entry["own"], FINEST), entry["matches"])
                   for entry in entries if entry["error"] is not None)  # fmt: skip
    half = sum(matches for _, matches in posed) / 2
    for ratio, matches in posed:
        half -= matches
        if half <= 0:
            return ratio
    return 0.0


def excess_of_photos(entries: list[dict]) -> dict[str, float]:
    """The `excess` of each posed photo's pairs."""
    own: dict[str, list[dict]] = {}
    for entry in entries:
        if entry["error"] is not None:
            for end in "ab":
                own.setdefault(entry[end], []).append(entry)
    return {name: excess(some) for name, some in sorted(own.items())}


def epipolar_errors(a: View, b: View, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Sampson distances [M], px, of matched pixels [M, 2] of two posed photos, their lenses' distortion taken away."""
    turn = b.rotation @ a.rotation.T
    x, y, z = b.translation - turn @ a.translation
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ turn
    form = np.diag([1, 1, b.focal]) @ essential @ np.diag([1, 1, a.focal])  # of pixels from the middle of each photo
    p, q = (view.focal * view.straight(*at.T.astype(float))[:, :2] for view, at in ((a, first), (b, second)))
    return sampson(form, p, q)


def sampson(form: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Sampson distances [M] of matches [M, 2] under the bilinear form [3, 3]."""
    from skimage.transform import FundamentalMatrixTransform

    return FundamentalMatrixTransform(form).residuals(first, second)


def own_errors(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Sampson distances [M], px, of matched pixels [M, 2] from the lines of the bilinear form that fits best (MAGSAC++,
    Barath et al., 2020): no poses can be much better, whatever the focal length. Zeros if no form is found."""
    import cv2

    p, q = (np.ascontiguousarray(pixels, float) for pixels in (first, second))
    try:
        form = cv2.findFundamentalMat(p, q, cv2.USAC_MAGSAC, 1.0, 0.999, 5000)[0]
    except cv2.error:  # OpenCV 5.0 raises an assertion where it finds none
        form = None
    return np.zeros(len(first)) if form is None else sampson(form, first, second)
