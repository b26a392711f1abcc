"""Can a set of poses be trusted, and if not, what is wrong with the photos?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from pipeline.cameras import View, spread_angle, view_of, view_span
from pipeline.inputs.photos import Photo

# Field of view of the longer side, degrees: from a short telephoto to a wide angle lens.
FOV_RANGE = (18.0, 110.0)
MAX_MEAN_ERROR = 2.0  # px
MIN_TRIANGULATION = 1.5  # degrees
FEW_FEATURES, FEW_MATCHES, FEW_POINTS, FEW_PHOTOS = 150, 30, 30, 6
# A focal length off by more than this is another lens. What the pairs say on their own is less exact: from a dozen
# photos it was off by 1.36.
FOCAL_OFF, PAIRS_OFF = 1.5, 1.7
# A pair contradicts the poses where its matches lie farther (px) from their lines; right poses have 0 to 3 % of these.
CONTRADICTION, MANY_CONTRADICTIONS = 4.0, 0.25
STILL = 0.5  # of a pair's matches not moving: the background stands still
ONE_SIDE = 150.0  # degrees of view points around the scene below which it is seen from one side only
COMPONENT_NAMED = 3


@dataclass(frozen=True)
class Findings:
    """What the photos of a set have in common, whatever poses were found."""

    components: list[list[str]]  # names of photos linked by verified matches, largest group first
    textureless: float  # share of photos with too few features
    still: float  # share of linked pairs whose matches mostly did not move
    turn_only: float  # share of linked pairs that a turn of the camera, without a step, explains


def find(result: dict, photos: list[Photo]) -> Findings:
    """Looks at a worker's counts and pairs. Blurred photos match each other, for want of anything finer; a group of
    nothing else is no group."""
    sound = {photo.name for photo in photos if not photo.fault}
    counts, names = result["counts"], sorted(result["counts"])
    linked = [pair for pair in result["pairs"] if pair["matches"] >= FEW_MATCHES]
    ends = np.array([(names.index(pair["a"]), names.index(pair["b"])) for pair in linked], int).reshape(-1, 2)
    graph = coo_matrix((np.ones(len(ends)), ends.T), shape=(len(names), len(names)))
    label = connected_components(graph, directed=False)[1]
    members = [[name for name, number in zip(names, label, strict=True) if number == k] for k in np.unique(label)]
    groups = [group for group in members if sound.intersection(group)]
    groups += [[name] for group in members for name in group if not sound.intersection(group)]
    return Findings(
        sorted(groups, key=lambda names: (-len(names), names[0])),
        sum(entry["features"] < FEW_FEATURES for entry in counts.values()) / max(1, len(counts)),
        sum(pair["still"] > STILL for pair in linked) / max(1, len(linked)),
        result["turn_only"],
    )


def views_of(result: dict, photos: list[Photo]) -> list[View]:
    """The posed views of a worker's result, in photo order."""
    source = {photo.name: photo.source for photo in photos}
    return [view_of({**view, "source": source[view["name"]]}) for view in result["views"]]


def check(result: dict, photos: list[Photo], ordinary: dict | None = None) -> dict:
    """Decides whether a reconstruction can be trusted, for the report: `failures` is empty when the poses may be used.

    "All registered" is not "right": repeating textures give complete but wrong reconstructions, which show in the focal
    length, the reprojection error, or in pairs that contradict the poses. `ordinary` is the result at ordinary
    thresholds, if `result` is not: its matches tell best how the camera moved.
    """
    views = views_of(result, photos)
    posed = {view.name for view in views}
    found = find(result, photos)
    if ordinary is not None:
        first = find(ordinary, photos)
        still, turn_only = max(found.still, first.still), max(found.turn_only, first.turn_only)
        found = replace(found, still=still, turn_only=turn_only)
    together = len(found.components[0]) if found.components else len(photos)
    needed = max(3, -(-together // 2), -(-len(photos) // 3))
    left_out = [{"photo": p.source, "why": left_out_reason(p, result, found)} for p in photos if p.name not in posed]
    angle, around = (spread_angle(views), view_span(views)) if views else (0.0, 0.0)
    failures, warnings = [], []
    if len(posed) < needed:
        failures.append(f"only {len(posed)} of {len(photos)} photos could be posed ({needed} are needed)")
    else:
        if left_out:
            warnings.append(f"{len(left_out)} of {len(photos)} photos were left out")
        check_focal(result, views, photos, failures, warnings)
        check_errors(result, failures, warnings)
        if angle < MIN_TRIANGULATION:
            failures.append(f"the cameras stand too close together ({angle:.1f} degrees apart as seen from the scene)")
        elif around < ONE_SIDE:
            warnings.append(f"the photos show the scene from one side ({around:.0f} degrees around it): what they do "
                            "not show is guessed, so no closed object can come of it: walk further around")  # fmt: skip
    return {
        "photos": len(photos), "posed": len(posed), "left_out": left_out,
        "mean_error": round(result.get("mean_error", 0.0), 4), "points": result.get("points", 0),
        "field_of_view": sorted({round(view.fov, 2) for view in views}), "span_degrees": round(around, 1),
        "contradictions": round(contradicting(result), 4), "components": [len(c) for c in found.components],
        "still_pairs": round(found.still, 3), "turn_only_pairs": round(found.turn_only, 3),
        "causes": diagnose(result, found, failures), "failures": failures, "warnings": warnings,
    }  # fmt: skip


def check_focal(result: dict, views: list[View], photos: list[Photo], failures: list[str], warnings: list[str]) -> None:
    """Checks the field of view, and the focal length against EXIF and against what the pairs say on their own."""
    off = [view.fov for view in views if not FOV_RANGE[0] <= view.fov <= FOV_RANGE[1]]
    if off:
        failures.append(f"implausible field of view of {off[0]:.0f} degrees: the poses are probably wrong")

    def ratio(known: dict) -> float | None:
        ratios = [view.focal / known[view.name] for view in views if known.get(view.name)]
        return float(np.median(ratios)) if ratios else None

    to_exif, to_pairs = ratio({p.name: p.focal for p in photos}), ratio(result["focal_of_pairs"])
    agree = to_pairs is not None and 1 / PAIRS_OFF < to_pairs < PAIRS_OFF
    if to_exif is not None and not 1 / FOCAL_OFF < to_exif < FOCAL_OFF:
        # Photos that were cropped carry the focal length of the whole photo.
        wrong = "EXIF" if agree else "poses"
        told = f"focal length is {to_exif:.2f} times what EXIF says (cropped photos, or wrong {wrong})"
        (warnings if agree else failures).append(told)
    elif to_exif is None and to_pairs is not None and not agree:
        failures.append(
            f"focal length is {to_pairs:.2f} times what the pairs of photos say: the poses are probably wrong"
        )


def check_errors(result: dict, failures: list[str], warnings: list[str]) -> None:
    """Checks the reprojection error, the points, and the pairs that contradict the poses."""
    error, points, against = result.get("mean_error", 0.0), result.get("points", 0), contradicting(result)
    if error > MAX_MEAN_ERROR:
        failures.append(f"mean reprojection error of {error:.1f} px (at most {MAX_MEAN_ERROR})")
    if points < FEW_POINTS:
        failures.append(f"only {points} points in common")
    if against > MANY_CONTRADICTIONS:
        failures.append(f"{against:.0%} of the pairs of photos contradict the poses")
    elif against > MANY_CONTRADICTIONS / 3:
        warnings.append(f"{against:.0%} of the pairs of photos contradict the poses: a texture may repeat")


def contradicting(result: dict) -> float:
    """Share of pairs of posed photos that contradict the poses."""
    pairs = result.get("contradictions", [])
    return sum(pair["error"] > CONTRADICTION for pair in pairs) / len(pairs) if pairs else 0.0


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
    linked = found.components[0] if found.components else []
    posed = {view["name"] for view in result["views"]}
    unposed = len(linked) >= 6 and len(posed & set(linked)) < len(linked) / 2  # of photos that match others well
    if found.textureless > 0.5:
        causes.append("there is too little to see: blurred, dark, or without texture, like a blank wall")
    elif len(result["counts"]) < FEW_PHOTOS:
        causes.append(f"{len(result['counts'])} photos are too few to be certain of anything")
    elif found.turn_only > 0.5 and found.still <= 0.5:
        causes.append("the photos seem to be taken from one spot: step sideways between photos, do not just turn")
    elif contradicting(result) > MANY_CONTRADICTIONS / 3 or unposed:
        causes.append("a texture that repeats makes different places look the same: cover it, or lay something unlike "
                      "on it")  # fmt: skip
    elif len(linked) < len(result["counts"]) / 2:
        causes.append("most photos overlap too little with the others")
    return causes


def failure_message(checks: dict) -> str:
    """The failures, causes and photos left out, in one line."""
    message = "camera poses: " + "; ".join(checks["failures"])
    if checks["causes"]:
        message += ". Probably " + "; and ".join(checks["causes"])
    named = [f"{entry['photo']}: {entry['why']}" for entry in checks["left_out"]]
    if named:
        message += ". Left out: " + "; ".join(named[:4]) + (f"; and {len(named) - 4} more" if len(named) > 4 else "")
    return message


def failure_hint(checks: dict) -> str:
    """What to try, from the commonest reason."""
    if checks.get("known_cameras"):
        return "check which photo belongs to which camera, and its axes; or give the folder of photos alone"
    reasons = " ".join(entry["why"] for entry in checks["left_out"])
    if reasons.count("features") > reasons.count("overlap"):
        return "take sharper photos in better light, or put something textured under the object"
    return "take 20 to 60 photos in small steps around the object, each overlapping the one before by two thirds"
