"""The ladder of attempts, the child process, and what a killed run leaves."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline import poses
from pipeline.cameras import load_sparse
from pipeline.inputs.photos import prepare_photos
from pipeline.sfm.poses import LADDER, ORDINARY, run_worker, size_groups, solve
from sdfsim.errors import EXIT_QUALITY, SdfsimError
from sdfsim.files import write_arrays, write_json
from tests.pipeline.test_verdict import photo, result

ROOT = Path(__file__).resolve().parent.parent.parent


def test_one_camera_for_each_size_and_zoom():
    photos = [photo(0), photo(1), photo(2, 480, 640), photo(3, focal=600), photo(4, focal=605), photo(5, focal=900)]
    assert [len(g["names"]) for g in size_groups(photos)] == [2, 1, 2, 1]


def test_a_crash_of_the_child_is_one_clear_line(tmp_path):
    job = {**ORDINARY, "count": 3, "exhaustive_up_to": 100}  # Lacks what the child needs.
    with pytest.raises(SdfsimError) as caught:
        run_worker(job, tmp_path, 60, lambda fraction, message: None)
    assert "COLMAP failed" in caught.value.message and "colmap.log" in caught.value.message


def test_a_child_that_hangs_is_ended(tmp_path, monkeypatch):
    script = tmp_path / "sleep.sh"
    script.write_text("#!/bin/sh\nexec sleep 60\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    with pytest.raises(SdfsimError, match="stopped after 1 s"):
        run_worker({"count": 3, "exhaustive_up_to": 100}, tmp_path / "work", 1.0, lambda fraction, message: None)


def test_photos_without_anything_in_common_fail_with_reasons(tmp_path):
    from PIL import Image

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
    """Runs the ladder on made-up results by rung; returns the rungs that were tried, and the verdict."""
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
        verdict = solve([photo(k) for k in range(photos)], tmp_path, tmp_path)
    except SdfsimError as error:
        assert error.exit_code == EXIT_QUALITY
        verdict = {"error": error.message}
    return tried, verdict


def test_the_first_good_rung_is_the_last(monkeypatch, tmp_path):
    tried, verdict = climb(monkeypatch, tmp_path, {"more pixels and features": result(10, 10)})
    assert tried == ["ordinary", "more pixels and features"]
    assert [(one["name"], one["posed"]) for one in verdict["attempts"]] == [
        ("ordinary", 0), ("more pixels and features, looser thresholds", 10),
    ]  # fmt: skip
    assert (tmp_path / "cameras.json").exists()


def test_the_ladder_ends_with_the_best_rung_not_the_last(monkeypatch, tmp_path):
    tried, verdict = climb(monkeypatch, tmp_path, {"ordinary": result(10, 4), "global mapping": result(10, 3)})
    assert tried == ["ordinary", "more pixels and features", "global mapping", "affine features"]
    assert "only 4 of 10 photos" in verdict["error"]


def test_what_stands_still_gets_a_rung_of_its_own(monkeypatch, tmp_path):
    still = result(10, 0, still=0.9)
    tried, verdict = climb(
        monkeypatch, tmp_path, {"ordinary": still, "without what stands still in the picture": result(10, 10)}
    )
    assert tried == ["ordinary", "without what stands still in the picture"] and verdict["posed"] == 10


def test_photos_from_one_spot_are_not_tried_for_long(monkeypatch, tmp_path):
    turning = {**result(10, 0), "turn_only": 0.9}
    tried, verdict = climb(monkeypatch, tmp_path, {"ordinary": turning, "more pixels and features": turning})
    assert tried == ["ordinary", "more pixels and features"]
    assert "taken from one spot" in verdict["error"]


def test_a_rung_that_breaks_leaves_the_verdict_of_the_others(monkeypatch, tmp_path):
    broken = {"more pixels and features": SdfsimError("camera poses: stopped after 5 s"), "ordinary": result(10, 4)}
    tried, verdict = climb(monkeypatch, tmp_path, broken)
    assert "only 4 of 10 photos" in verdict["error"] and "IMG_4.JPG" in verdict["error"]
    assert "global mapping" not in tried  # it would take matches that the broken rung has not made


def test_rungs_that_share_matches_come_after_their_source():
    names = [rung.name for rung in LADDER]
    assert all(names.index(rung.matches_of) < k for k, rung in enumerate(LADDER) if rung.matches_of)
    assert len({poses.folder_of(rung) for rung in LADDER}) == len(LADDER)


def test_a_finished_rung_is_not_run_again(tmp_path, monkeypatch):
    job = {"count": 3, "exhaustive_up_to": 100}
    (tmp_path / "try").mkdir()
    write_json(tmp_path / "try" / "job.json", job)
    write_json(tmp_path / "try" / "result.json", {"views": []})
    monkeypatch.setattr(poses.subprocess, "Popen", lambda *a, **k: pytest.fail("started"))
    assert run_worker(job, tmp_path / "try", 1.0, lambda fraction, message: None) == {"views": []}


def test_poses_that_could_not_be_moved_to_their_place_are_found_again(tmp_path, monkeypatch):
    """A full disk or a kill after the last line of `solve`: the next run takes the results of the rungs again."""

    def run(job, folder, timeout, report):
        if not folder.exists():
            folder.mkdir()
            write_arrays(folder / "sparse.npz", {"xyz": np.ones((1, 3))})
        return result(10, 10)

    monkeypatch.setattr(poses, "run_worker", run)
    first = solve([photo(k) for k in range(10)], tmp_path, tmp_path)
    again = solve([photo(k) for k in range(10)], tmp_path, tmp_path)
    assert again["posed"] == first["posed"] == 10
    with np.load(tmp_path / "sparse.npz") as arrays:
        assert (arrays["xyz"] == 1).all()


def test_the_leavings_of_another_job_go(tmp_path, monkeypatch):
    write_json(tmp_path / "job.json", {"count": 4})
    (tmp_path / "database.db").write_text("old")
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(SdfsimError):
        run_worker({"count": 3, "exhaustive_up_to": 100}, tmp_path, 5.0, lambda fraction, message: None)
    assert not (tmp_path / "database.db").exists()


def test_epipolar_errors_are_those_of_projected_points():
    """Matches of points that two cameras see have no error; moved off their lines by 3 px they have 3 / sqrt(2)."""
    from pipeline.sfm.worker import epipolar_errors

    views = result(10, 10)["views"]
    for view in views[:2]:
        view["k"] = 0.05
    a, b = poses.views_of({"views": views[:2]}, [photo(0), photo(1)])
    points = np.random.default_rng(0).normal(size=(200, 3)) * 0.5
    first, second = a.project(points)[0], b.project(points)[0]
    assert epipolar_errors(views[0], views[1], first, second).max() < 1e-3
    moved = second + np.array([0, 3.0])  # The cameras turn about y, so all lines are nearly level.
    assert np.median(epipolar_errors(views[0], views[1], first, moved)) == pytest.approx(3 / 2**0.5, rel=0.2)


def test_turning_on_the_spot_is_told_from_walking():
    from pipeline.sfm.worker import turn_only

    rng = np.random.default_rng(0)
    size = {"width": 640, "height": 480}
    directions = rng.uniform([-0.4, -0.3, 1], [0.4, 0.3, 1], (300, 3))
    turn = np.array([[np.cos(0.2), 0, np.sin(0.2)], [0, 1, 0], [-np.sin(0.2), 0, np.cos(0.2)]])

    def seen(points: np.ndarray) -> np.ndarray:
        return 600 * points[:, :2] / points[:, 2:] + [320, 240]

    turned = (size, seen(directions), seen(directions @ turn.T) + rng.normal(0, 0.5, (300, 2)))
    deep = directions * rng.uniform(1, 4, (300, 1))
    walked = (size, seen(deep), seen(deep + np.array([0.4, 0, 0])))
    assert turn_only([turned, turned, walked]) == pytest.approx(2 / 3)
    assert turn_only([walked]) == 0.0


def test_a_cut_file_of_points_is_one_clear_line(tmp_path):
    write_arrays(tmp_path / "sparse.npz", {"xyz": np.zeros((500, 3))})
    (tmp_path / "sparse.npz").write_bytes((tmp_path / "sparse.npz").read_bytes()[:60])
    with pytest.raises(SdfsimError, match=r"sparse\.npz: cannot be read"):
        load_sparse(tmp_path)


@pytest.mark.slow
def test_poses_of_the_rendered_set(tmp_path):
    sys.path.insert(0, str(ROOT))
    from benchmarks.reconstruct import pose_errors
    from pipeline.cameras import load_views

    source = ROOT / "samples" / "photos" / "table_vase"
    photos, _ = prepare_photos(source, tmp_path, long_side=640)
    solve(photos, tmp_path, tmp_path)
    report, _ = pose_errors(load_views(tmp_path), source)
    assert report["posed"] == 48
    assert report["center_error_worst_percent"] < 0.5
    assert report["focal_error_percent"] < 0.5
