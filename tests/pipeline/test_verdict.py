"""The verdict on poses: what passes, what does not, and what it says is wrong with the photos."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from pipeline.cameras import view_span
from pipeline.inputs.photos import Photo
from pipeline.sfm.pose_checks import failure_hint, failure_message, find, judge, views_of


def photo(index: int, width: int = 640, height: int = 480, focal: float | None = None, fault: str = "") -> Photo:
    size = (width, height)
    return Photo(f"{index:04d}.jpg", f"IMG_{index}.JPG", *size, size, None, focal, "", False, 0.4, fault)


def result(count: int, posed: int, *, focal: float = 600.0, error: float = 0.5, features: int = 2000,
           span: float = 360.0, still: float = 0.0, matches: int = 200) -> dict:  # fmt: skip
    """What the worker would say of `posed` of `count` photos on an arc around the origin, all in a chain of pairs."""
    views = []
    for k in range(posed):
        a = np.radians(span) * k / max(posed, 1)
        turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        views.append({"name": f"{k:04d}.jpg", "width": 640, "height": 480, "focal": focal, "cx": 320, "cy": 240,
                      "k": 0, "camera": 1, "rotation": turn.tolist(), "translation": [0, 0, 3]})  # fmt: skip
    names = [f"{k:04d}.jpg" for k in range(count)]
    counts = {name: {"features": features, "best_matches": 10, "partners": 1} for name in names}
    pairs = [{"a": a, "b": b, "matches": matches, "still": still} for a, b in pairwise(names)]
    against = [{"a": pair["a"], "b": pair["b"], "matches": matches, "error": 0.3} for pair in pairs]
    return {"views": views, "counts": counts, "pairs": pairs, "contradictions": against, "mean_error": error,
            "points": 900, "track_length": 4.0, "models": [names[:posed]], "turn_only": 0.0,
            "focal_of_pairs": {}}  # fmt: skip


PHOTOS = [photo(k) for k in range(10)]


def test_good_poses_pass():
    verdict = judge(result(10, 9), PHOTOS)
    assert verdict["failures"] == [] and verdict["posed"] == 9 and verdict["causes"] == []
    assert verdict["left_out"][0]["photo"] == "IMG_9.JPG"
    assert "too few matches" in verdict["left_out"][0]["why"]


def test_too_few_posed_names_photos_reasons_and_what_to_try():
    verdict = judge(result(10, 4, features=20), PHOTOS)
    message = failure_message(verdict)
    assert "only 4 of 10 photos" in message and "IMG_4.JPG: too few features (20)" in message and "\n" not in message
    assert "textured" in failure_hint(verdict)


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"focal": 5000.0}, "field of view"), ({"focal": 100.0}, "field of view"), ({"error": 3.0}, "reprojection error")],
)
def test_all_registered_is_not_right(changes, words):
    verdict = judge(result(10, 10, **changes), PHOTOS)
    assert any(words in failure for failure in verdict["failures"])


@pytest.mark.parametrize("times", [0.5, 2.0])
def test_a_focal_length_off_by_two_does_not_pass(times):
    """Against EXIF, or without EXIF against what the pairs of photos say on their own."""
    by_exif = judge(result(10, 10, focal=600 * times), [photo(k, focal=600.0) for k in range(10)])
    assert any("what EXIF says" in failure for failure in by_exif["failures"])
    alone = {**result(10, 10, focal=600 * times), "focal_of_pairs": {p.name: 600.0 for p in PHOTOS}}
    assert any("the pairs of photos say" in failure for failure in judge(alone, PHOTOS)["failures"])


def test_wrong_exif_is_a_warning_where_the_pairs_agree_with_the_poses():
    agreed = {**result(10, 10), "focal_of_pairs": {p.name: 610.0 for p in PHOTOS}}
    verdict = judge(agreed, [photo(k, focal=1500.0) for k in range(10)])
    assert verdict["failures"] == [] and "EXIF" in verdict["warnings"][0]


def test_pairs_that_contradict_the_poses_are_counted():
    found = result(10, 10)
    for pair in found["contradictions"][:4]:
        pair["error"] = 40.0
    verdict = judge(found, PHOTOS)
    assert verdict["contradictions"] == pytest.approx(4 / 9, abs=1e-3)
    assert any("contradict" in failure for failure in verdict["failures"])
    assert any("repeats" in cause for cause in verdict["causes"])


def two_things() -> dict:
    found = result(18, 11)
    del found["pairs"][10]  # the chain falls into 11 and 7 photos
    return found


def test_two_sets_the_larger_is_taken_and_the_rest_is_named():
    verdict = judge(two_things(), [photo(k) for k in range(18)])
    assert verdict["failures"] == [] and verdict["components"][:2] == [11, 7]
    assert "sets of 11, 7 photos" in verdict["causes"][0]
    assert [entry["photo"] for entry in verdict["left_out"]] == [f"IMG_{k}.JPG" for k in range(11, 18)]
    assert all("shows something else" in entry["why"] for entry in verdict["left_out"])


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (result(10, 0, features=30, matches=0), "too little to see"),
        ({**result(10, 0), "turn_only": 0.8}, "from one spot"),
        (result(10, 0, still=0.9), "turntable"),
        (result(10, 2), "a texture that repeats"),
        (result(10, 0, matches=5), "overlap too little"),
        (result(3, 2), "3 photos are too few"),
    ],
)
def test_what_is_wrong_with_the_photos(found, words):
    verdict = judge(found, PHOTOS[: len(found["counts"])])
    assert words in verdict["causes"][0] and words in failure_message(verdict)


@pytest.mark.parametrize(
    ("first", "words"),
    [({**result(10, 0), "turn_only": 0.8}, "from one spot"), (result(10, 0, still=0.9), "turntable")],
)
def test_how_the_camera_moved_is_told_by_the_ordinary_matches(first, words):
    verdict = judge(result(10, 3), PHOTOS, first)
    assert words in verdict["causes"][0]
    assert words not in judge(result(10, 3), PHOTOS)["causes"][0]


def test_blurred_photos_are_left_out_as_such():
    verdict = judge(result(10, 6), [photo(k, fault="blurred" if k > 5 else "") for k in range(10)])
    assert all(entry["why"].startswith("blurred") for entry in verdict["left_out"])


def test_blurred_photos_that_match_each_other_are_no_set_of_their_own():
    verdict = judge(two_things(), [photo(k, fault="blurred" if k > 10 else "") for k in range(18)])
    assert all(entry["why"].startswith("blurred") for entry in verdict["left_out"]) and len(verdict["left_out"]) == 7
    assert verdict["causes"] == [] and verdict["components"] == [11] + 7 * [1]


def test_cameras_on_one_side_are_no_closed_object():
    verdict = judge(result(10, 10, span=90.0), PHOTOS)
    assert verdict["failures"] == [] and "from one side (81 degrees" in verdict["warnings"][0]


@pytest.mark.parametrize(("span", "expected"), [(90.0, 81.0), (200.0, 180.0), (360.0, 324.0)])
def test_span_is_the_arc_less_the_largest_gap(span, expected):
    assert view_span(views_of(result(10, 10, span=span), PHOTOS)) == pytest.approx(expected, abs=0.01)


def test_cameras_too_close_together_fail():
    verdict = judge(result(10, 10, span=1.0), PHOTOS)
    assert "too close together" in verdict["failures"][0]


def test_components_need_more_than_a_few_matches():
    found = result(6, 0, matches=200)
    found["pairs"][2]["matches"] = 20
    assert [len(group) for group in find(found, PHOTOS[:6]).components] == [3, 3]
