"""Poses: the ladder of attempts, the child process, what a killed run leaves, and photos with one thing wrong each,
which is named."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.cameras import load_poses, load_views, save_views
from pipeline.inputs.photos import KNOWN_CAMERAS, load_photos, prepare_photos
from pipeline.sfm import poses, worker
from pipeline.sfm.agreement import agreement, excess, excess_of_photos, unexplained
from pipeline.sfm.pose_checks import check, failure_hint, failure_message, find
from pipeline.sfm.poses import ORDINARY, run_worker, size_groups, solve
from pipeline.sfm.worker import zooms_of
from sdfsim.base.errors import EXIT_QUALITY, SdfsimError
from sdfsim.base.files import write_arrays, write_json
from tests.helpers.photos import photo, result, turned
from tests.pipeline import photo_sets

ROOT = Path(__file__).resolve().parent.parent.parent
TABLE_VASE = ROOT / "samples" / "photos" / "table_vase"


PHOTOS = [photo(k) for k in range(10)]


def test_good_poses_pass():
    verdict = check(result(10, 9), PHOTOS)
    assert verdict["failures"] == [] and verdict["posed"] == 9 and verdict["causes"] == []
    assert verdict["left_out"][0]["photo"] == "IMG_9.JPG"
    assert verdict["left_out"][0]["kind"] == "overlap" and verdict["left_out"][0]["hopeful"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"focal": 5000.0}, "field of view"),
        ({"focal": 100.0}, "field of view"),
        ({"error": 3.0}, "reprojection error"),
        ({"span": 1.0}, "too close together"),
    ],
)
def test_all_registered_is_not_right(changes, words):
    verdict = check(result(10, 10, **changes), PHOTOS)
    assert any(words in failure for failure in verdict["failures"])


def astray(found: dict, times: float, which: slice = slice(None)) -> dict:
    """The result, with the matches of some pairs so many times as far from their lines as they have to be."""
    for pair in found["agreement"][which]:
        pair["error"] = times * pair["own"]
    return found


@pytest.mark.parametrize("times", [0.5, 2.0])
def test_a_focal_length_that_neither_exif_nor_the_matches_bear_out_does_not_pass(times):
    by_exif = check(astray(result(10, 10, focal=600 * times), 3.0), [photo(k, focal=600.0) for k in range(10)])
    assert any("what EXIF says" in failure for failure in by_exif["failures"])


def test_wrong_exif_is_a_warning_where_the_matches_agree_with_the_poses():
    verdict = check(result(10, 10), [photo(k, focal=1500.0) for k in range(10)])
    assert verdict["failures"] == [] and "EXIF" in verdict["warnings"][0]


def test_matches_farther_from_their_lines_than_they_have_to_be_are_wrong_focal_lengths():
    """Within half a pixel or so, where each pair alone would be within a quarter: no pair contradicts the poses."""
    verdict = check(astray(result(10, 10), 3.0), PHOTOS)
    assert verdict["contradictions"] == 0 and verdict["excess"] == pytest.approx(3.0)
    assert "in 10 of 10 photos, points that two photos share lie 3.0 times as far" in verdict["failures"][0]
    assert check(astray(result(10, 10), 1.7), PHOTOS)["failures"] == []  # what right poses of real photos have
    # Cameras that a phone tracked are off by some pixels.
    assert check(astray(result(10, 10), 3.0), PHOTOS, known=True)["failures"] == []


@pytest.mark.parametrize(("count", "span", "few_first"), [(16, 360.0, True), (40, 360.0, False), (25, 80.0, False)])
def test_matches_astray_have_two_possible_causes_the_likelier_first(count, span, few_first):
    verdict = check(
        astray(result(count, count, span=span), 3.0, slice(0, count // 3)), [photo(k) for k in range(count)]
    )
    (cause,) = verdict["causes"]
    first, _, second = cause.partition("; or else ")
    few, zooms = (first, second) if few_first else (second, first)
    assert few.startswith(f"too few photos or too wide steps ({count} photos") and "between IMG_" in few
    assert "of several zooms" in zooms
    assert ("Probably too few" in failure_message(verdict)) == few_first
    # What is measured of the photos astray, not of all.
    assert "lie 3.0 times as far" in verdict["failures"][0] and verdict["excess"] < 2


def test_a_third_of_the_photos_wrong_does_not_pass_however_right_the_rest_is():
    photos = [photo(k) for k in range(20)]
    verdict = check(astray(result(20, 20), 4.0, slice(0, 5)), photos)
    assert verdict["excess"] < 1.5 and "in 5 of 20 photos" in verdict["failures"][0]


def contradicted(found: dict, count: int, matches: int) -> dict:
    for pair in found["agreement"][:count]:
        pair |= {"error": 40.0, "matches": matches}
    return found


def test_matches_that_contradict_the_poses_are_counted():
    verdict = check(contradicted(result(10, 10), 4, 200), PHOTOS)
    assert verdict["contradictions"] == pytest.approx(4 / 9, abs=1e-3)
    assert any("contradict" in failure for failure in verdict["failures"])
    assert any("repeats" in cause for cause in verdict["causes"])


def test_pairs_of_few_matches_contradict_little():
    """Every third pair of right poses of a fox's photos did, by matches that came about by chance."""
    found = result(10, 10)
    strangers = [{"a": f"{a:04d}.jpg", "b": f"{a + 5:04d}.jpg", "matches": 30, "error": 300.0, "own": 1.0, "cost": 1.0}
                 for a in range(4)]  # fmt: skip
    found["agreement"] += strangers
    verdict = check(found, PHOTOS)
    assert verdict["contradictions"] == pytest.approx(4 * 30 / (9 * 200 + 4 * 30), abs=1e-3)
    assert verdict["failures"] == [] and verdict["warnings"] == []


def two_things() -> dict:
    found = result(18, 11)
    del found["pairs"][10]  # the chain falls into 11 and 7 photos
    return found


def test_two_sets_the_larger_is_taken_and_the_rest_is_named():
    verdict = check(two_things(), [photo(k) for k in range(18)])
    assert verdict["failures"] == [] and verdict["components"][:2] == [11, 7]
    assert "sets of 11, 7 photos" in verdict["causes"][0]
    assert [entry["photo"] for entry in verdict["left_out"]] == [f"IMG_{k}.JPG" for k in range(11, 18)]
    assert all(entry["kind"] == "unrelated" for entry in verdict["left_out"])


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
    verdict = check(found, PHOTOS[: len(found["counts"])])
    assert words in verdict["causes"][0] and words in failure_message(verdict)


@pytest.mark.parametrize(
    ("first", "words"),
    [({**result(10, 0), "turn_only": 0.8}, "from one spot"), (result(10, 0, still=0.9), "turntable")],
)
def test_how_the_camera_moved_is_reported_by_the_ordinary_matches(first, words):
    verdict = check(result(10, 3), PHOTOS, first)
    assert words in verdict["causes"][0]
    assert words not in check(result(10, 3), PHOTOS)["causes"][0]


@pytest.mark.parametrize(("features", "words"), [(30, "sharper photos"), (2000, "small steps")])
def test_the_hint_goes_by_the_commonest_reason(features, words):
    assert words in failure_hint(check(result(10, 0, features=features, matches=5), PHOTOS))


def test_blurred_photos_that_match_each_other_are_no_set_of_their_own():
    verdict = check(two_things(), [photo(k, fault="blurred" if k > 10 else "") for k in range(18)])
    assert (
        all(entry["kind"] == "fault" and "blurred" in entry["why"] for entry in verdict["left_out"])
        and len(verdict["left_out"]) == 7
    )
    assert verdict["causes"] == [] and verdict["components"] == [11] + 7 * [1]


def test_cameras_on_one_side_are_no_closed_object():
    verdict = check(result(10, 10, span=90.0), PHOTOS)
    assert verdict["failures"] == [] and "from one side (81 degrees" in verdict["warnings"][0]


def test_components_need_more_than_a_few_matches():
    found = result(6, 0, matches=200)
    found["pairs"][2]["matches"] = 20
    assert [len(group) for group in find(found, PHOTOS[:6]).components] == [3, 3]


def test_one_camera_for_each_size_and_zoom():
    photos = [photo(0), photo(1), photo(2, 480, 640), photo(3, focal=600), photo(4, focal=605), photo(5, focal=900)]
    assert [len(g["names"]) for g in size_groups(photos)] == [2, 1, 2, 1]


@pytest.mark.parametrize("path", [None, "", ":"])
def test_the_child_imports_nothing_of_the_users_folder(path, tmp_path, monkeypatch):
    """Whatever it is called there."""
    for name in ("pipeline", "json", "numpy"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(f"open({str(tmp_path / 'marker')!r}, 'w')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    if path is not None:
        monkeypatch.setenv("PYTHONPATH", path)
    job = {**ORDINARY, "count": 3, "exhaustive_up_to": 100, "pairs": None}
    with pytest.raises(SdfsimError, match=r"status \d+.*colmap\.log"):
        run_worker(job, tmp_path / "work", 60, lambda fraction, message: None)
    assert not (tmp_path / "marker").exists()
    assert "KeyError" in (tmp_path / "work" / "colmap.log").read_text()  # ours ran, and the job lacks what it needs


def test_a_child_that_hangs_is_ended(tmp_path, monkeypatch):
    script = tmp_path / "sleep.sh"
    script.write_text("#!/bin/sh\nexec sleep 60\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    with pytest.raises(SdfsimError, match=r"\b1 s\b.*colmap\.log"):
        run_worker(
            {"count": 3, "exhaustive_up_to": 100, "pairs": None}, tmp_path / "work", 1.0, lambda fraction, message: None
        )


def test_photos_without_anything_in_common_fail_with_reasons(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    for k in range(3):
        Image.new("RGB", (160, 120), (60 * k, 90, 90)).save(folder / f"flat{k}.jpg")
    photos, _ = prepare_photos(folder, tmp_path, long_side=160)
    with pytest.raises(SdfsimError) as caught:
        solve(photos, tmp_path, tmp_path, timeout=120)
    assert caught.value.exit_code == EXIT_QUALITY
    assert "only 0 of 3" in caught.value.message and "flat0.jpg: too few features" in caught.value.message
    assert "there is too little to see" in caught.value.message


def climb(monkeypatch, tmp_path, results: dict, photos: int = 10) -> tuple[list[str], dict]:
    """Makes the attempts on made-up results; returns the names of those made, and the checks."""
    tried = []

    def run(job, folder, timeout, report):
        name = folder.name.removeprefix("try_").replace("_", " ")
        tried.append(name)
        folder.mkdir(parents=True)
        write_arrays(folder / "sparse.npz", {"xyz": np.zeros((0, 3))})
        found = results.get(name, result(photos, 0))
        if isinstance(found, SdfsimError):
            raise found
        return found

    monkeypatch.setattr(poses, "run_worker", run)
    try:
        checks = solve([photo(k) for k in range(photos)], tmp_path, tmp_path)
    except SdfsimError as error:
        assert error.exit_code == EXIT_QUALITY
        checks = {"error": error.message}
    return tried, checks


STILL, MATCHES, MORE = "without static matches", "more matches", "more features"
STOPPED = SdfsimError("camera poses: stopped after 5 s")


@pytest.mark.parametrize(
    ("results", "after", "posed"),
    [
        ({MORE: result(10, 10)}, MORE, 10),  # the first good attempt is the last
        ({"ordinary": result(10, 0, still=0.9), STILL: result(10, 10)}, STILL, 10),
        # Photos that good poses leave out. More features are found less exactly, which says nothing of the poses.
        ({"ordinary": result(25, 19), MATCHES: result(25, 25)}, MATCHES, 25),
        ({"ordinary": result(25, 19), MATCHES: result(25, 20), MORE: result(25, 25, error=0.75)}, MORE, 25),
        # The best attempt counts, not the last, and one that breaks leaves the findings of the others.
        ({"ordinary": result(10, 4), MORE: result(10, 3)}, MORE, "only 4 of 10 photos"),
        ({"ordinary": result(10, 4), MORE: STOPPED}, MORE, "IMG_4.JPG"),
        ({"ordinary": {**result(10, 0), "turn_only": 0.95}}, "", "taken from one spot"),
    ],
)
def test_attempts_go_on_until_poses_are_good(monkeypatch, tmp_path, results, after, posed):
    count = len(results.get("ordinary", result(10, 0))["counts"])
    tried, checks = climb(monkeypatch, tmp_path, results, count)
    assert tried == {"": ["ordinary"], MORE: ["ordinary", MATCHES, MORE]}.get(after, ["ordinary", after])
    if isinstance(posed, str):
        assert posed in checks["error"]
        return
    assert checks["posed"] == posed and (tmp_path / "cameras.json").exists()
    assert [one["name"] for one in checks["attempts"]] == tried and checks["attempts"][-1]["posed"] == posed


def worse(found: dict) -> dict:
    for pair in found["judged"]:
        pair["cost"] *= 1.5
    return found


@pytest.mark.parametrize(
    "careful", [result(25, 18), worse(result(25, 25)), astray(result(25, 25), 3.0), SdfsimError("stopped")]
)
def test_good_poses_stay_where_the_careful_attempt_is_no_better(monkeypatch, tmp_path, careful):
    """Fewer photos, or more of them but those of before farther off, or wrong ones, or none in time."""
    tried, checks = climb(monkeypatch, tmp_path, {"ordinary": result(25, 19), MATCHES: careful, MORE: careful}, 25)
    assert tried == ["ordinary", MATCHES, MORE] and checks["posed"] == 19 and checks["failures"] == []


def test_photos_that_no_care_would_pose_get_no_careful_attempt(monkeypatch, tmp_path):
    """They show something else, or next to nothing; or they are one or two among many."""
    blank = result(25, 19)
    for name in list(blank["counts"])[19:]:
        blank["counts"][name]["features"] = 20
    for number, found in enumerate((two_things(), blank, result(48, 47))):
        (tmp_path / str(number)).mkdir()
        tried, checks = climb(monkeypatch, tmp_path / str(number), {"ordinary": found}, len(found["counts"]))
        assert tried == ["ordinary"] and checks["posed"] < checks["photos"]


def test_a_finished_attempt_is_not_run_again(tmp_path, monkeypatch):
    job = {"count": 3, "exhaustive_up_to": 100, "pairs": None, "features_of": ""}
    (tmp_path / "try").mkdir()
    write_json(tmp_path / "try" / "job.json", job)
    write_json(tmp_path / "try" / "result.json", {"views": []})
    monkeypatch.setattr(poses.subprocess, "Popen", lambda *a, **k: pytest.fail("started"))
    assert run_worker(job, tmp_path / "try", 1.0, lambda fraction, message: None) == {"views": []}


def test_the_leavings_of_another_job_go(tmp_path, monkeypatch):
    write_json(tmp_path / "job.json", {"count": 4})
    (tmp_path / "database.db").write_text("old")
    monkeypatch.setattr(sys, "executable", "/bin/false")
    job = {"count": 3, "exhaustive_up_to": 100, "pairs": None, "features_of": ""}
    with pytest.raises(SdfsimError):
        run_worker(job, tmp_path, 5.0, lambda fraction, message: None)
    assert not (tmp_path / "database.db").exists()


def pictured(views: list[dict], noise: float = 0.3) -> list:
    """Matches between all pairs of these views: the same 200 points, seen with some noise."""
    rng = np.random.default_rng(3)
    points = rng.normal(size=(200, 3)) * [0.6, 0.4, 0.6]
    cameras = poses.views_of({"views": views}, [photo(k) for k in range(len(views))])
    seen = [camera.project(points)[0] + rng.normal(0, noise, (200, 2)) for camera in cameras]
    return [
        (a.name, b.name, seen[i], seen[j])
        for i, a in enumerate(cameras) for j, b in enumerate(cameras[i + 1 :], i + 1)
    ]  # fmt: skip


@pytest.mark.parametrize(("times", "right"), [(1.0, True), (1.5, False), (0.67, False)])
def test_a_wrong_focal_length_shows_in_how_far_the_matches_lie(times, right):
    """Right poses leave the matches about as far from their lines as noise does: the least any lines could."""
    views = result(8, 8, span=160.0)["views"]
    entries = agreement(pictured(views), [{**view, "focal": times * view["focal"]} for view in views])
    assert len(entries) == 28
    assert excess(entries) < 1.3 if right else excess(entries) > 3
    assert (unexplained(entries) < 0.1) == right
    assert all((times < 1.5) == right for times in excess_of_photos(entries).values())


def test_zooms_are_reported_apart_by_the_focal_lengths_of_each_photo_alone():
    focals = {"a": 700.0, "b": 1030.0, "c": 680.0, "d": 1060.0, "e": 735.0}
    assert zooms_of([*"abcdef"], focals) == [["c", "a", "e"], ["b", "d"], ["f"]]
    assert zooms_of([*"ace"], focals) == [["c", "a", "e"]] and zooms_of(["f"], focals) == [["f"]]


def zoomed(folder: Path, count: int, zooms: dict[int, float]) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Writes `count` photos of the bundled set, without EXIF, of which every so manyth is cropped to its middle and
    enlarged again; returns the true focal lengths and camera centres by file name."""
    about = json.loads((TABLE_VASE / "transforms.json").read_text())
    folder.mkdir()
    focals, centers = {}, {}
    for number, index in enumerate(np.arange(count) * len(about["frames"]) // count):
        frame = about["frames"][index]
        zoom = next((z for every, z in zooms.items() if number % every == every - 1), 1.0)
        with Image.open(TABLE_VASE / frame["file_path"]) as image:
            w, h = image.size
            middle = ((1 - 1 / zoom) * w / 2, (1 - 1 / zoom) * h / 2, (1 + 1 / zoom) * w / 2, (1 + 1 / zoom) * h / 2)
            name = Path(frame["file_path"]).name
            image.resize((w, h), Image.Resampling.LANCZOS, box=middle).save(folder / name, quality=95)
        focals[name], centers[name] = about["fl_x"] * zoom, np.array(frame["transform_matrix"])[:3, 3]
    return focals, centers


@pytest.mark.slow
@pytest.mark.parametrize("zooms", [{}, {2: 1.5}, {2: 2.0}, {5: 1.4}])
def test_twenty_photos_of_one_or_two_zooms_are_posed_right(tmp_path, zooms):
    from pycolmap import estimate_sim3d

    focals, centers = zoomed(tmp_path / "in", 20, zooms)
    photos, _ = prepare_photos(tmp_path / "in", tmp_path, long_side=640)
    checks = solve(photos, tmp_path, tmp_path)
    views = load_views(tmp_path)
    assert checks["posed"] == 20 and checks["excess"] < 1.8
    assert [view.focal / focals[view.source] for view in views] == pytest.approx([1.0] * 20, abs=0.02)
    found, true = np.array([v.center for v in views]), np.array([centers[v.source] for v in views])
    move = estimate_sim3d(found, true)
    assert move
    off = np.linalg.norm(move.scale * found @ move.rotation.matrix().T + move.translation - true, axis=1)
    assert off.max() < 0.01 * np.linalg.norm(true - true.mean(0), axis=1).mean()


@pytest.mark.parametrize(("still", "found"), [(12, [0.0625, 0.0833, 0.2083, 0.1667]), (0, []), (400, [])])
def test_what_is_drawn_over_the_photos_is_found_by_what_stands_still(tmp_path, still, found):
    """A logo of 12 features in 9 of the 48 x 36 cells of the picture; no logo; and a background that stands still."""
    import pycolmap

    rng, size = np.random.default_rng(0), np.array([480, 360])
    inside = (np.array([31.0, 31]), np.array([99.0, 59])) if still < 100 else (np.zeros(2), size)
    logo = rng.uniform(*inside, (still, 2))
    logo[:2] = np.array([[31.0, 31], [99, 59]])[:still]
    with pycolmap.Database.open(tmp_path / "database.db") as opened:
        camera = opened.write_camera(
            pycolmap.Camera(model="SIMPLE_RADIAL", width=480, height=360, params=[500, 240, 180, 0])
        )
        images = [opened.write_image(pycolmap.Image(name=f"{k}.jpg", camera_id=camera)) for k in range(12)]
        for image in images:
            places = np.concatenate([logo + rng.normal(0, 0.2, logo.shape), rng.uniform(0, 1, (60, 2)) * size])
            shape = np.tile([2.0, 0, 0, 2], (len(places), 1))
            opened.write_keypoints(image, np.column_stack([places, shape]).astype(np.float32))
        every = np.arange(still + 60, dtype=np.uint32)
        for k, a in enumerate(images):
            for b in images[k + 1 :]:
                opened.write_matches(a, b, np.stack([every, every], 1))
    job = {"groups": [{"width": 480, "height": 360, "names": [f"{k}.jpg" for k in range(12)]}]}
    assert worker.overlay(pycolmap, job, tmp_path / "database.db") == pytest.approx(found, abs=1e-3)


def test_what_is_drawn_over_the_photos_is_reported():
    verdict = check({**result(10, 10), "overlay": [0.05, 0.1, 0.2, 0.15]}, PHOTOS)
    assert "a logo, a date" in verdict["warnings"][0] and "from 5% to 20% of their width" in verdict["warnings"][0]


@pytest.mark.parametrize(
    ("tilt", "focal", "held"), [(0.9, 600.0, True), (4.0, 600.0, False), (4.0, 3000.0, True), (20.0, 3000.0, False)]
)
def test_cameras_that_look_exactly_one_way_have_no_focal_length_of_their_own(tilt, focal, held):
    views = result(10, 10, focal=focal, span=0.0)["views"]
    for number, view in enumerate(views):
        view["rotation"] = turned(np.radians(tilt) * (number % 2 - 0.5)).tolist()
    assert worker.undetermined(views) == held
    verdict = check({**result(10, 10), "held": held}, PHOTOS)
    assert any("no focal length follows: it is a guess" in line for line in verdict["warnings"]) == held


def test_progress_never_counts_more_photos_than_there_are(tmp_path):
    (tmp_path / "progress.log").write_text("phase mapping\nplaced 29\nplaced 30\n")
    assert poses.estimate(tmp_path, tmp_path / "progress.log", {"count": 29}) == (1.0, "placing cameras, 29 of 29")


def test_blown_out_photos_are_neither_blurred_nor_of_something_else():
    """Seven of 18 match each other alone, as white photos do; one of them counts as sound."""
    photos = [photo(k, fault="blown out" if k > 11 else "") for k in range(18)]
    verdict = check(two_things(), photos)
    assert [entry["why"].split(" (")[0] for entry in verdict["left_out"][1:]] == ["blown out"] * 6
    white = [replace(photo(k), white=0.8) for k in range(10)]
    verdict = check(result(10, 0, features=30, matches=0), white)
    assert "10 photos are mostly white" in verdict["causes"][0] and "less light" in failure_hint(verdict)
    assert "80% of it is white" in verdict["left_out"][0]["why"]


@pytest.mark.parametrize("bend", [0.0, 0.8])
def test_what_the_lens_leaves_is_what_all_photos_have_alike(bend):
    """Points are off by 0.8 sin(2 pi x / width) px at each place, 0.8 / sqrt(2) RMS; noise is 0.5 px in x and y."""
    import pycolmap

    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 12, 900
    pycolmap.set_random_seed(0)
    model, rng = pycolmap.synthesize_dataset(options), np.random.default_rng(0)
    for image in model.images.values():
        width = model.cameras[image.camera_id].width
        for point in image.points2D:
            point.xy = point.xy + rng.normal(0, 0.5, 2) + [bend * np.sin(2 * np.pi * point.xy[0] / width), 0]
    off, share = worker.lens_left(model)
    assert off == pytest.approx(bend / 2**0.5, abs=0.08)
    assert share == pytest.approx(off / np.hypot(off, 0.5 * 2**0.5), abs=0.05)


def test_a_lens_of_another_kind_is_refused_and_named(monkeypatch, tmp_path):
    """All photos have a pose, the error is below 2 px, and no pair contradicts: yet all are off alike."""
    fisheye = {**result(10, 10, error=1.3), "lens": [0.55, 0.42]}
    tried, checks = climb(monkeypatch, tmp_path, {"ordinary": fisheye})
    assert tried == ["ordinary"]
    assert "all photos are off by the same 0.6 px" in checks["error"] and "the lens is a fisheye" in checks["error"]
    for usual in ([0.55, 0.2], [0.2, 0.5]):
        assert check({**result(10, 10), "lens": usual}, PHOTOS)["failures"] == []


@pytest.mark.slow
def test_photos_in_no_order_are_matched_by_what_they_show(tmp_path, monkeypatch):
    """Their names tell nothing: a quarter of the pairs is matched, and all are posed, the loop around the table
    closed."""
    shuffled = np.random.default_rng(4).permutation(48)
    (tmp_path / "in").mkdir()
    for number, path in zip(shuffled, sorted((TABLE_VASE / "images").iterdir()), strict=True):
        shutil.copyfile(path, tmp_path / "in" / f"{number:03d}.jpg")
    photos, _ = prepare_photos(tmp_path / "in", tmp_path, long_side=640)
    monkeypatch.setattr(poses, "PARTNERS", (10, 10))
    checks = solve(photos, tmp_path, tmp_path)
    listed = (tmp_path / "try_ordinary" / "pairs.txt").read_text().splitlines()
    assert 200 < len(listed) < 48 * 10 * 0.7
    assert checks["posed"] == 48 and checks["span_degrees"] > 300
    assert [view.focal for view in load_views(tmp_path)] == pytest.approx([620.0] * 48, rel=0.005)


pytestmark = pytest.mark.slow


def posed(folder: Path, work: Path) -> dict:
    photos, _ = prepare_photos(folder, work)
    return solve(photos, work, work)


def failure(folder: Path, work: Path) -> str:
    with pytest.raises(SdfsimError) as caught:
        posed(folder, work)
    assert caught.value.exit_code == EXIT_QUALITY and "\n" not in caught.value.message
    return caught.value.message


def test_three_photos_of_different_sides(tmp_path):
    (tmp_path / "in").mkdir()
    for number in (15, 19, 23):
        shutil.copy(photo_sets.TABLE_VASE / "images" / f"{number:03d}.jpg", tmp_path / "in")
    assert "3 photos are too few" in failure(tmp_path / "in", tmp_path)


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (photo_sets.blank_wall, ("only 0 of 30 photos", "there is too little to see", "blank wall")),
        (photo_sets.one_spot, ("taken from one spot", "step sideways")),
    ],
)
def test_a_blank_wall_and_all_photos_from_one_spot(tmp_path, make, told):
    make(tmp_path / "in")
    message = failure(tmp_path / "in", tmp_path)
    assert all(words in message for words in told)


def test_two_sets_in_one_folder(tmp_path):
    photo_sets.two_sets(tmp_path / "in")
    verdict = posed(tmp_path / "in", tmp_path)
    assert verdict["posed"] >= 16
    left = {entry["photo"]: entry["why"] for entry in verdict["left_out"]}
    assert sum(name.startswith("other_") for name in left) == 10
    assert sum("shows something else" in why for name, why in left.items() if name.startswith("other_")) >= 8
    assert any("nothing in common" in cause for cause in verdict["causes"])


def test_every_second_photo_blurred(tmp_path):
    photo_sets.half_blurred(tmp_path / "in")
    photos, notes = prepare_photos(tmp_path / "in", tmp_path)
    assert [p.fault for p in photos] == ["", "blurred"] * 24
    assert any(note.startswith("24 of 48 photos are blurred, take them again: 001.jpg, 003.jpg") for note in notes)
    verdict = solve(photos, tmp_path, tmp_path)
    assert verdict["posed"] >= 24
    assert all(entry["kind"] in ("fault", "features") for entry in verdict["left_out"])


def test_a_repeating_texture(tmp_path):
    """Either nothing that can be trusted comes out, and why; or the poses are right, the focal length with them."""
    photo_sets.repeating(tmp_path / "in")
    try:
        posed(tmp_path / "in", tmp_path)
    except SdfsimError as error:
        assert "repeats" in error.message
        return
    focal = np.median([view.focal for view in load_views(tmp_path)])
    assert focal == pytest.approx(465.0, rel=0.1)


def test_a_turntable_before_a_background_that_stands_still(tmp_path):
    photo_sets.turntable(tmp_path / "in")
    try:
        verdict = posed(tmp_path / "in", tmp_path)
        assert "turntable" in verdict["causes"][0]
    except SdfsimError as error:
        assert "turntable" in error.message and "masks" in error.message


def test_the_same_photos_give_the_same_poses(tmp_path):
    photo_sets.good(tmp_path / "in", 12)
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        posed(tmp_path / "in", tmp_path / name)
    for one, two in zip(load_views(tmp_path / "one"), load_views(tmp_path / "two"), strict=True):
        assert one.focal == two.focal and one.name == two.name
        assert np.array_equal(one.rotation, two.rotation) and np.array_equal(one.translation, two.translation)
    assert np.array_equal(load_poses(tmp_path / "one").sparse.xyz, load_poses(tmp_path / "two").sparse.xyz)


def test_known_cameras_are_kept_and_checked(tmp_path):
    """The true cameras get sparse points on the true surface; cameras of other photos are found out."""
    photo_sets.good(tmp_path / "in", 12)
    work = tmp_path / "work"
    work.mkdir()
    photos, _ = prepare_photos(tmp_path / "in" / "transforms.json", work)
    verdict = solve(photos, work, work)
    assert verdict["known_cameras"] and verdict["posed"] == 12 and verdict["mean_error"] < 1.0
    points = load_poses(work).sparse.xyz
    inside = np.abs(points).max(1) < 2.4
    top = np.abs(points[:, 2] - 0.35) < 0.01
    floor = np.abs(points[:, 2]) < 0.01
    sides = (np.abs(np.abs(points[:, 0]) - 0.3) < 0.01) | (np.abs(np.abs(points[:, 1]) - 0.2) < 0.01)
    assert (top | floor | sides)[inside].mean() > 0.9

    wrong = tmp_path / "wrong"
    wrong.mkdir()
    views = load_views(work)
    (wrong / "images").symlink_to(work / "images")
    moved = [type(v)(**{**v.__dict__, "name": o.name}) for v, o in zip(views, views[3:] + views[:3], strict=True)]
    save_views(moved, wrong / KNOWN_CAMERAS)
    with pytest.raises(SdfsimError, match="known cameras"):
        solve(load_photos(work), wrong, wrong)


def test_a_killed_run_goes_on_and_ends_as_an_undisturbed_one(tmp_path):
    """Killed once features are there, and again while it matches."""
    import os
    import signal
    import subprocess
    import time

    photo_sets.good(tmp_path / "in", 10)
    code = (
        "import sys; from pathlib import Path\nfrom pipeline.inputs.photos import load_photos\n"
        "from pipeline.sfm.poses import solve\nwork = Path(sys.argv[1]); solve(load_photos(work), work, work)"
    )
    work = tmp_path / "work"
    work.mkdir()
    prepare_photos(tmp_path / "in", work)
    whole = tmp_path / "whole"
    shutil.copytree(work, whole)
    solve(load_photos(whole), whole, whole)
    log = work / "try_ordinary" / "progress.log"
    for word in ("phase matches", "phase mapping"):
        child = subprocess.Popen([sys.executable, "-c", code, str(work)])
        while child.poll() is None and not (log.exists() and word in log.read_text()):
            time.sleep(0.02)
        if child.poll() is None:
            os.kill(child.pid, signal.SIGKILL)
        child.wait()
        time.sleep(2.5)  # COLMAP's process notices within a second that its parent is gone.
    solve(load_photos(work), work, work)
    one, two = (json.loads((folder / "cameras.json").read_text())["views"] for folder in (work, whole))
    assert [view["name"] for view in one] == [view["name"] for view in two]
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(a["rotation"], b["rotation"], atol=1e-6)
        assert a["focal"] == pytest.approx(b["focal"], rel=1e-5)
