"""Checks whether poses can be trusted, and diagnoses problems of the photos."""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from pipeline.cameras import FOV_RANGE, View, focus, view_of, view_span
from pipeline.inputs.photos import Photo
from pipeline.sfm.agreement import ENOUGH, contradicting, excess, excess_of_photos

MAX_MEAN_ERROR = 2.0  # px
MIN_TRIANGULATION = 2.0  # degrees, of the median point; mapping leaves out points below 1.5
FEW_FEATURES, FEW_MATCHES, FEW_POINTS, FEW_PHOTOS = 150, ENOUGH, 30, 6
FOCAL_OFF = 1.5  # times the focal length of EXIF: beyond this the lens is a different one
# Of the matches. Right poses have up to 0.1, with looser matches 0.2; those of repeating textures two thirds and more,
# in the drawn sets of the tests and a few real ones; the limit is between them.
MANY_CONTRADICTIONS = 0.35
# Largest excess (see `excess`): right poses have up to 1.4, those of a wrong focal length or of two zooms treated as
# one 2.8 and more. Single photos with right poses have up to 1.9, and a few may exceed that.
MOST_EXCESS, FEW_ASTRAY = 2.0, 0.1  # on the sets of `DOUBTFUL` in `worker.py`
# Fewer photos, or neighbours that stand farther apart (degrees, as seen from the scene), are doubtful.
GOOD_PHOTOS, WIDE_STEP = 20, 18.0
HALF = 0.5  # share of a photo that is white: from here on it may be what is wrong with it
STILL = 0.5  # of a pair's matches not moving: the background is static
# Px by which all photos are off alike at one place of the picture, and its share of all error: a lens of another kind.
OTHER_LENS = (0.3, 0.3)
ONE_SIDE = 150.0  # degrees of viewpoints around the scene: below this it is seen from one side only
COMPONENT_NAMED = 3


@dataclass(frozen=True)
class Findings:
    """Facts about a set of photos that do not depend on poses."""

    components: list[list[str]]  # names of photos linked by verified matches, largest group first
    textureless: float  # share of photos with too few features
    still: float  # share of linked pairs whose matches mostly did not move
    turn_only: float  # share of linked pairs that a rotation of the camera, without a step, explains


def find(result: dict, photos: list[Photo]) -> Findings:
    """Evaluates a worker's counts and pairs. Blurred photos match each other, because they have no fine detail; they do
    not form a separate group."""
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


def check(result: dict, photos: list[Photo], ordinary: dict | None = None, *, known: bool = False) -> dict:
    """Decides whether a reconstruction can be trusted, for the report: `failures` is empty if the poses may be used.

    A complete reconstruction may be wrong: with repeating textures or several zooms, matches contradict the poses, or
    lie farther from their lines than necessary. `ordinary` is the result at ordinary thresholds, if `result` is not:
    its matches show best how the camera moved. `known` cameras may be off by some pixels.
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
    left_out = [{"photo": p.source, **left_out_reason(p, result, found)} for p in photos if p.name not in posed]
    against = result.get("agreement", [])
    angle, around = (result["angle"], view_span(views, np.array(result["middle"]))) if views else (0.0, 0.0)
    # A step along something flat looks like a turn, but gives depth.
    if angle >= MIN_TRIANGULATION and len(posed) >= needed:
        found = replace(found, turn_only=0.0)
    failures, warnings = [], []
    if drawn := result.get("overlay"):
        left, top, right, bottom = drawn
        warnings.append("what is drawn over the photos (a logo, a date) does not move with the scene and is not "
                        f"matched: from {left:.0%} to {right:.0%} of their width, {top:.0%} to {bottom:.0%} of their "
                        "height")  # fmt: skip
    if len(posed) < needed:
        failures.append(f"only {len(posed)} of {len(photos)} photos could be posed ({needed} are needed)")
    else:
        if left_out:
            warnings.append(f"{len(left_out)} of {len(photos)} photos were left out")
        if result.get("held"):
            source = "that of EXIF" if any(p.focal for p in photos) else "a guess"
            warnings.append("the photos all look exactly the same way, from which no focal length follows: it is "
                            f"{source}, and depths are only as right as that: tilt the camera in some")  # fmt: skip
        astray = [] if known else photos_astray(result)
        check_focal(views, photos, bool(astray), failures, warnings)
        check_errors(result, astray, failures, warnings)
        if angle < MIN_TRIANGULATION:
            failures.append(f"the cameras stand too close together (half of the points are seen from directions that "
                            f"are at most {angle:.1f} degrees apart)")  # fmt: skip
        elif around < ONE_SIDE:
            warnings.append(f"the photos show the scene from one side ({around:.0f} degrees around it): what they do "
                            "not show is guessed, so the result is not closed: walk further around")  # fmt: skip
    return {
        "photos": len(photos), "posed": len(posed), "left_out": left_out,
        "mean_error": round(result.get("mean_error", 0.0), 4), "points": result.get("points", 0),
        "field_of_view": sorted({round(view.fov, 2) for view in views}), "span_degrees": round(around, 1),
        "triangulation_degrees": round(angle, 2),
        "cameras": [len(names) for names in result.get("cameras", [])],
        "contradictions": round(contradicting(against), 4), "excess": round(excess(against), 3),
        "components": [len(c) for c in found.components],
        "other_lens": other_lens(result),
        "still_pairs": round(found.still, 3), "turn_only_pairs": round(found.turn_only, 3),
        "causes": diagnose(result, photos, views, found, failures), "failures": failures, "warnings": warnings,
    }  # fmt: skip


def check_focal(
    views: list[View], photos: list[Photo], doubtful: bool, failures: list[str], warnings: list[str]
) -> None:
    """Checks the field of view, and the focal length against EXIF."""
    off = [view.fov for view in views if not FOV_RANGE[0] <= view.fov <= FOV_RANGE[1]]
    if off:
        failures.append(f"implausible field of view of {off[0]:.0f} degrees: the poses are probably wrong")
    exif = {p.name: p.focal for p in photos}
    ratios = [view.focal / known for view in views if (known := exif[view.name])]
    to_exif = float(np.median(ratios)) if ratios else 1.0
    if not 1 / FOCAL_OFF < to_exif < FOCAL_OFF:
        # Cropped photos still have the focal length of the whole photo.
        wrong = "poses" if doubtful else "EXIF"
        message = f"focal length is {to_exif:.2f} times what EXIF says (cropped photos, or wrong {wrong})"
        (failures if doubtful else warnings).append(message)


def other_lens(result: dict) -> bool:
    """Whether the residuals say that the lens is of another kind than the one that was fitted."""
    off, share = result.get("lens", (0.0, 0.0))
    return off > OTHER_LENS[0] and share > OTHER_LENS[1]


def photos_astray(result: dict) -> list[str]:
    """The posed photos whose matches lie farther from their lines than with right poses, if there are too many of
    them."""
    agreement = result.get("agreement", [])
    photos = excess_of_photos(agreement)
    astray = [name for name, times in photos.items() if times > MOST_EXCESS]
    if excess(agreement) > MOST_EXCESS:
        return astray or list(photos)
    return astray if len(astray) > FEW_ASTRAY * len(photos) else []


def why_astray(views: list[View], astray: list[str], middle: np.ndarray) -> str:
    """Possible causes of such matches, the likelier first: too few photos or too large steps, or several zooms. Neither
    is certain."""
    zooms = "photos of several zooms, or cropped ones: give those of one zoom, or as the camera stored them, with EXIF"
    rays = focus(views, middle)[1]
    angles = np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1)))
    np.fill_diagonal(angles, np.inf)
    step = float(np.median(angles.min(1)))
    near = angles.argmin(1)
    widest = max((k for k, view in enumerate(views) if view.name in astray), key=lambda k: angles[k].min())
    pair = sorted((views[widest].source, views[near[widest]].source))
    few = (f"too few photos or too wide steps ({len(views)} photos, {step:.0f} degrees from one to the next): "
           f"add some, first between {pair[0]} and {pair[1]}")  # fmt: skip
    first, second = (few, zooms) if len(views) < GOOD_PHOTOS or step > WIDE_STEP else (zooms, few)
    return f"{first}; or else {second}"


def check_errors(result: dict, astray: list[str], failures: list[str], warnings: list[str]) -> None:
    """Checks the reprojection error, the points, and the matches that contradict the poses."""
    error, points, agreement = result.get("mean_error", 0.0), result.get("points", 0), result.get("agreement", [])
    against, posed = contradicting(agreement), len(result["views"])
    if error > MAX_MEAN_ERROR:
        failures.append(f"mean reprojection error of {error:.1f} px (at most {MAX_MEAN_ERROR})")
    if other_lens(result):
        failures.append(f"at the same place of the picture all photos are off by the same {result['lens'][0]:.1f} px")
    if points < FEW_POINTS:
        failures.append(f"only {points} points in common")
    if against > MANY_CONTRADICTIONS:
        failures.append(f"{against:.0%} of the matches contradict the poses")
    elif against > MANY_CONTRADICTIONS / 2:
        warnings.append(f"{against:.0%} of the matches contradict the poses: a texture may repeat")
    if astray:
        times = sorted(excess_of_photos(agreement)[name] for name in astray)
        far = f"{times[0]:.1f}" if times[-1] - times[0] < 0.05 else f"{times[0]:.1f} to {times[-1]:.1f}"
        failures.append(f"in {len(astray)} of {posed} photos, points that two photos share lie {far} times as far from "
                        "where all poses together put them as from where the two photos alone would "
                        f"(up to {MOST_EXCESS:g} is usual)")  # fmt: skip


def left_out_reason(photo: Photo, result: dict, found: Findings) -> dict:
    """The reason why a photo has no pose: `kind`, the same in words (`why`), and whether a more careful attempt may
    find one (`hopeful`)."""

    def reason(kind: str, why: str) -> dict:
        return {"kind": kind, "why": why, "hopeful": kind in ("overlap", "disagrees")}

    entry = result["counts"].get(photo.name, {})
    count, best = entry.get("features", 0), entry.get("best_matches", 0)
    if count < FEW_FEATURES:
        white = f"{photo.white:.0%} of it is white, blown out or blank" if photo.white > HALF else ""
        why = photo.fault or white or "blurred, dark, blown out or without texture"
        return reason("features", f"too few features ({count}): {why}")
    if photo.fault:
        return reason("fault", f"{photo.fault} (best pair: {best} matches)")
    group = next((c for c in found.components if photo.name in c), [])
    if len(group) >= COMPONENT_NAMED and group is not found.components[0]:
        others = f"it matches {len(group) - 1} other photos, none of them in the larger set"
        return reason("unrelated", f"shows something else: {others}")
    if best < FEW_MATCHES:
        return reason("overlap", f"too few matches with other photos (best pair: {best}): not enough overlap")
    return reason("disagrees", f"its {best} matches do not agree with the rest of the reconstruction")


def diagnose(result: dict, photos: list[Photo], views: list[View], found: Findings, failures: list[str]) -> list[str]:
    """Problems of the photos as a set, likeliest first; empty if the poses are good."""
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
    if other_lens(result):
        causes.append("the lens is a fisheye or bends in another way that is not found from photos alone: give its "
                      "calibration, as a transforms.json with camera_model OPENCV_FISHEYE or OPENCV or as a COLMAP "
                      "model, or photos that are straightened")  # fmt: skip
    elif found.textureless > 0.5:
        faults = Counter(p.fault or ("mostly white, blown out or blank" if p.white > HALF else "") for p in photos)
        fault, times = faults.most_common(1)[0]
        why = "blurred, dark, blown out, or without texture, like a blank wall"
        causes.append(f"there is too little to see: {f'{times} photos are {fault}' if fault else why}")
    elif len(result["counts"]) < FEW_PHOTOS:
        causes.append(f"{len(result['counts'])} photos are too few to be certain of anything")
    elif found.turn_only > 0.5 and found.still <= 0.5:
        causes.append("the photos seem to be taken from one spot: step sideways between photos, do not just turn")
    elif contradicting(result.get("agreement", [])) > MANY_CONTRADICTIONS or unposed:
        causes.append("a texture that repeats makes different places look the same: cover it, or lay something unlike "
                      "on it")  # fmt: skip
    elif views and (astray := photos_astray(result)):
        causes.append(why_astray(views, astray, np.array(result["middle"])))
    elif len(linked) < len(result["counts"]) / 2:
        causes.append("most photos overlap too little with the others")
    return causes


def failure_message(checks: dict) -> str:
    """The failures, their causes and the photos left out, in one line."""
    message = "camera poses: " + "; ".join(checks["failures"])
    if checks["causes"]:
        message += ". Probably " + "; and ".join(checks["causes"])
    named = [f"{entry['photo']}: {entry['why']}" for entry in checks["left_out"]]
    if named:
        message += ". Left out: " + "; ".join(named[:4]) + (f"; and {len(named) - 4} more" if len(named) > 4 else "")
    return message


def failure_hint(checks: dict) -> str:
    """Advice, from the most common reason."""
    if checks.get("known_cameras"):
        return "check which photo belongs to which camera, and its axes; or give the folder of photos alone"
    if checks["other_lens"]:
        return "switch to the main camera of the phone (not the wide one), or calibrate the lens"
    kinds = [entry["kind"] for entry in checks["left_out"]]
    if kinds.count("features") > kinds.count("overlap"):
        blown = sum("blown out" in entry["why"] and entry["kind"] == "features" for entry in checks["left_out"])
        bare = sum("without texture" in entry["why"] for entry in checks["left_out"])
        if blown - bare > len(checks["left_out"]) / 2:
            return "take them again with less light or exposure: what is white shows nothing"
        return "take sharper photos in better light, or put something textured under the object"
    return "take 20 to 60 photos in small steps around the object, each overlapping the one before by two thirds"
