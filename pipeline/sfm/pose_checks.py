"""Can a set of poses be trusted, and if not, what is wrong with the photos?"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.cameras import View, spread_angle, view_span
from pipeline.inputs.photos import Photo

# Field of view of the longer side, degrees: from a short telephoto to a wide angle lens.
FOV_RANGE = (18.0, 110.0)
MAX_MEAN_ERROR = 2.0
MIN_TRIANGULATION = 1.5
FEW_FEATURES = 150
FEW_MATCHES = 30
FEW_POINTS = 30
FEW_PHOTOS = 6
# A focal length off by more than this is another lens. What the pairs say on their own is less exact: from a dozen
# photos it was off by 1.36.
FOCAL_OFF, PAIRS_OFF = 1.5, 1.7
# A pair contradicts the poses where its matches lie farther from their lines; right poses have 0 to 3 % of such pairs.
CONTRADICTION = 4.0
MANY_CONTRADICTIONS = 0.25
STILL = 0.5  # of a pair's matches not moving: the background stands still
ONE_SIDE = 150.0  # degrees of view points around the scene below which it is seen from one side only
COMPONENT_NAMED = 3


@dataclass(frozen=True)
class Findings:
    """What the photos of a set have in common, whatever poses were found.

    Attributes:
        components: names of photos linked by verified matches, largest group first.
        textureless: share of photos with too few features.
        still: share of linked pairs whose matches mostly did not move.
        rotation_only: share of linked pairs that a turn of the camera, without a step, explains.
    """

    components: list[list[str]] = field(default_factory=list)
    textureless: float = 0.0
    still: float = 0.0
    rotation_only: float = 0.0


def find(result: dict, photos: list[Photo]) -> Findings:
    """Looks at a worker's counts and pairs.

    Blurred photos match each other, for want of anything finer; a group of nothing else is no group.
    """
    sound = {photo.name for photo in photos if not photo.fault}
    counts, pairs = result["counts"], result.get("pairs", [])
    group = {name: name for name in counts}

    def root(name: str) -> str:
        while group[name] != name:
            group[name] = group[group[name]]
            name = group[name]
        return name

    for pair in pairs:
        if pair["matches"] >= FEW_MATCHES:
            group[root(pair["a"])] = root(pair["b"])
    members: dict[str, list[str]] = {}
    for name in sorted(counts):
        members.setdefault(root(name), []).append(name)
    groups = [names for names in members.values() if sound.intersection(names)]
    groups += [[name] for names in members.values() for name in names if not sound.intersection(names)]
    linked = [pair for pair in pairs if pair["matches"] >= FEW_MATCHES]
    share = 1 / max(1, len(linked))
    return Findings(
        sorted(groups, key=lambda names: (-len(names), names[0])),
        sum(entry["features"] < FEW_FEATURES for entry in counts.values()) / max(1, len(counts)),
        share * sum(pair["still"] > STILL for pair in linked),
        result.get("turn_only", 0.0),
    )


def views_of(result: dict, photos: list[Photo]) -> list[View]:
    """The posed views of a worker's result, in photo order."""
    source = {p.name: p.source for p in photos}
    return [
        View(**{**{k: x for k, x in v.items() if k != "camera"}, "source": source[v["name"]],
                "rotation": np.array(v["rotation"]), "translation": np.array(v["translation"])})
        for v in result["views"]
    ]  # fmt: skip


def check(result: dict, photos: list[Photo], ordinary: dict | None = None) -> dict:
    """Decides whether a reconstruction can be trusted.

    "All registered" is not "right": repeating textures give complete but wrong reconstructions, which show in the
    focal length, the reprojection error, the spread of points, or in pairs that contradict the poses.

    Args:
        result: of the worker.
        photos: all photos.
        ordinary: of the worker at ordinary thresholds, if `result` is not. Its matches tell best how the camera moved:
            looser thresholds take unlike places for alike, and others leave out what stands still.

    Returns:
        A dict for the report; `failures` is empty when the poses may be used, `warnings` are for the reader.
    """
    views = views_of(result, photos)
    posed = {view.name for view in views}
    found = find(result, photos)
    if ordinary is not None:
        first = find(ordinary, photos)
        found = replace(
            found, still=max(found.still, first.still), rotation_only=max(found.rotation_only, first.rotation_only)
        )
    needed = needed_photos(len(photos), found)
    left_out = [{"photo": p.source, "why": left_out_reason(p, result, found)} for p in photos if p.name not in posed]
    failures, warnings = [], []
    if len(posed) < needed:
        failures.append(f"only {len(posed)} of {len(photos)} photos could be posed ({needed} are needed)")
    elif left_out:
        warnings.append(f"{len(left_out)} of {len(photos)} photos were left out")
    if len(views) >= needed:
        for check in (check_focal, check_errors, check_spread):
            failed, warned = check(result, views, photos)
            failures += failed
            warnings += warned
    causes = diagnose(result, found, failures)
    angle, around = (spread_angle(views), view_span(views)) if views else (0.0, 0.0)
    focal = sorted({round(view.focal, 2) for view in views})
    return {
        "photos": len(photos), "posed": len(posed), "needed": needed, "left_out": left_out,
        "mean_error": round(result.get("mean_error", 0.0), 4), "points": result.get("points", 0),
        "track_length": round(result.get("track_length", 0.0), 2), "models": [len(m) for m in result["models"]],
        "field_of_view": sorted({round(view.fov, 2) for view in views}), "focal": focal,
        "spread_angle": round(angle, 2), "span_degrees": round(around, 1),
        "contradictions": round(contradicting(result), 4), "components": [len(c) for c in found.components],
        "still_pairs": round(found.still, 3), "turn_only_pairs": round(found.rotation_only, 3),
        "causes": causes, "failures": failures, "warnings": warnings,
    }  # fmt: skip


def needed_photos(count: int, found: Findings) -> int:
    """Photos that have to be posed: half of those that belong together, and a third of all."""
    together = len(found.components[0]) if found.components else count
    return max(3, -(-together // 2), -(-count // 3))


def check_focal(result: dict, views: list[View], photos: list[Photo]) -> tuple[list[str], list[str]]:
    """Field of view, and the focal length against EXIF and against what the pairs say on their own."""
    failures, warnings = [], []
    off = sorted(view.fov for view in views if not FOV_RANGE[0] <= view.fov <= FOV_RANGE[1])
    if off:
        failures.append(f"implausible field of view of {off[0]:.0f} degrees: the poses are probably wrong")
    prior = {p.name: p.focal for p in photos}
    pairs = result.get("focal_of_pairs", {})
    to_exif = median_ratio([(v.focal, prior[v.name]) for v in views])
    to_pairs = median_ratio([(v.focal, pairs.get(v.name)) for v in views])
    agree = to_pairs is not None and 1 / PAIRS_OFF < to_pairs < PAIRS_OFF
    if to_exif is not None and not 1 / FOCAL_OFF < to_exif < FOCAL_OFF:
        # Photos that were cropped carry the focal length of the whole photo.
        text = f"focal length is {to_exif:.2f} times what EXIF says"
        if agree:
            warnings.append(f"{text}, but the pairs of photos agree with it (cropped photos, or wrong EXIF?)")
        else:
            failures.append(f"{text} (cropped photos, or wrong poses)")
    elif to_exif is None and to_pairs is not None and not agree:
        failures.append(
            f"focal length is {to_pairs:.2f} times what the pairs of photos say: the poses are probably wrong"
        )
    return failures, warnings


def median_ratio(pairs: list[tuple[float, float | None]]) -> float | None:
    """Median of first / second where there is a second."""
    ratios = [first / second for first, second in pairs if second]
    return float(np.median(ratios)) if ratios else None


def check_errors(result: dict, views: list[View], photos: list[Photo]) -> tuple[list[str], list[str]]:
    """Reprojection error, points, and pairs that contradict the poses."""
    failures, warnings = [], []
    error = result.get("mean_error", 0.0)
    if error > MAX_MEAN_ERROR:
        failures.append(f"mean reprojection error of {error:.1f} px (at most {MAX_MEAN_ERROR})")
    if result.get("points", 0) < FEW_POINTS:
        failures.append(f"only {result.get('points', 0)} points in common")
    against = contradicting(result)
    if against > MANY_CONTRADICTIONS:
        failures.append(f"{against:.0%} of the pairs of photos contradict the poses")
    elif against > MANY_CONTRADICTIONS / 3:
        warnings.append(f"{against:.0%} of the pairs of photos contradict the poses: a texture may repeat")
    return failures, warnings


def contradicting(result: dict) -> float:
    """Share of pairs of posed photos that contradict the poses."""
    pairs = result.get("contradictions", [])
    return sum(pair["error"] > CONTRADICTION for pair in pairs) / len(pairs) if pairs else 0.0


def check_spread(result: dict, views: list[View], photos: list[Photo]) -> tuple[list[str], list[str]]:
    """Whether the cameras stand far enough apart, and on how many sides of the scene."""
    angle, around = spread_angle(views), view_span(views)
    if angle < MIN_TRIANGULATION:
        return [f"the cameras stand too close together ({angle:.1f} degrees apart as seen from the scene)"], []
    if around < ONE_SIDE:
        return [], [f"the photos show the scene from one side ({around:.0f} degrees around it): what they do not show "
                    "is guessed, so a closed object cannot come of it"]  # fmt: skip
    return [], []


def left_out_reason(photo: Photo, result: dict, found: Findings) -> str:
    """Why a photo has no pose."""
    entry = result["counts"].get(photo.name, {})
    count, best = entry.get("features", 0), entry.get("best_matches", 0)
    if count < FEW_FEATURES:
        return f"too few features ({count}): " + (photo.fault or "blurred, dark or without texture")
    group = next((c for c in found.components if photo.name in c), [])
    if len(group) >= COMPONENT_NAMED and group is not found.components[0]:
        return f"shows something else: it matches {len(group) - 1} other photos, none of them in the larger set"
    if photo.fault:
        return f"{photo.fault} (best pair: {best} matches)"
    if best < FEW_MATCHES:
        return f"too few matches with other photos (best pair: {best}): not enough overlap"
    return f"its {best} matches do not agree with the rest of the reconstruction"


def diagnose(result: dict, found: Findings, failures: list[str]) -> list[str]:
    """What is the matter with the photos as a set, likeliest first; nothing where the poses are good."""
    causes = []
    if found.still > 0.5:
        causes.append("the background stands still while the object turns (a turntable?): give masks of the object, or "
                      "walk around it instead")  # fmt: skip
    larger = [c for c in found.components if len(c) >= COMPONENT_NAMED]
    if len(larger) > 1:
        causes.append(f"the photos show {len(larger)} things that have nothing in common (sets of "
                      f"{', '.join(str(len(c)) for c in larger)} photos); the largest is used")  # fmt: skip
    if not failures:
        return causes
    if found.textureless <= 0.5 and len(result["counts"]) < FEW_PHOTOS:
        causes.append(f"{len(result['counts'])} photos are too few to be certain of anything")
    elif found.textureless > 0.5:
        causes.append("there is too little to see: blurred, dark, or without texture, like a blank wall")
    elif found.rotation_only > 0.5 and found.still <= 0.5:
        causes.append("the photos seem to be taken from one spot: step sideways between photos, do not just turn")
    elif contradicting(result) > MANY_CONTRADICTIONS / 3 or disagreeing(result, found):
        causes.append("a texture that repeats makes different places look the same: cover it, or lay something unlike "
                      "on it")  # fmt: skip
    elif found.components and len(found.components[0]) < len(result["counts"]) / 2:
        causes.append("most photos overlap too little with the others")
    return causes


def disagreeing(result: dict, found: Findings) -> bool:
    """Whether most photos that match others well could not be posed with them."""
    linked = found.components[0] if found.components else []
    posed = {view["name"] for view in result["views"]}
    return len(linked) >= 6 and len(posed & set(linked)) < len(linked) / 2


def failure_message(checks: dict) -> str:
    """The failures, causes and photos left out, in one line."""
    message = "camera poses: " + "; ".join(checks["failures"])
    if checks["causes"]:
        message += ". Probably " + "; and ".join(checks["causes"])
    left = checks["left_out"]
    if left:
        named = [f"{entry['photo']}: {entry['why']}" for entry in left[:4]]
        message += ". Left out: " + "; ".join(named) + (f"; and {len(left) - 4} more" if len(left) > 4 else "")
    return message


def failure_hint(checks: dict) -> str:
    """What to try, from the commonest reason."""
    reasons = " ".join(entry["why"] for entry in checks["left_out"])
    if reasons.count("features") > reasons.count("overlap"):
        return "take sharper photos in better light, or put something textured under the object"
    return "take 20 to 60 photos in small steps around the object, each overlapping the one before by two thirds"
