"""The verdict on poses, and the child process."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline import poses
from pipeline.cameras import load_sparse
from pipeline.photos import Photo, prepare_photos
from pipeline.poses import FIRST_TRY, failure_hint, failure_message, judge, run_worker, size_groups, solve
from sdfsim.errors import EXIT_QUALITY, SdfsimError
from sdfsim.files import write_arrays

ROOT = Path(__file__).resolve().parent.parent.parent


def photo(index: int, width: int = 640, height: int = 480, focal: float | None = None) -> Photo:
    return Photo(f"{index:04d}.jpg", f"IMG_{index}.JPG", width, height, focal, "", False, 0.01)


def result(count: int, posed: int, *, focal: float = 600.0, error: float = 0.5, features: int = 2000) -> dict:
    views = []
    for k in range(posed):
        a = 2 * np.pi * k / max(posed, 1)
        turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        views.append({"name": f"{k:04d}.jpg", "width": 640, "height": 480, "focal": focal, "cx": 320, "cy": 240,
                      "k": 0, "camera": 1, "rotation": turn.tolist(), "translation": [0, 0, 3]})  # fmt: skip
    counts = {f"{k:04d}.jpg": {"features": features, "best_matches": 10, "partners": 1} for k in range(count)}
    return {"views": views, "counts": counts, "mean_error": error, "points": 900, "track_length": 4.0, "models": 1}


def test_good_poses_pass():
    verdict = judge(result(10, 9), [photo(k) for k in range(10)])
    assert verdict["failures"] == [] and verdict["posed"] == 9
    assert verdict["left_out"][0]["photo"] == "IMG_9.JPG"
    assert "too few matches" in verdict["left_out"][0]["why"]


def test_too_few_posed_names_photos_reasons_and_what_to_try():
    verdict = judge(result(10, 4, features=20), [photo(k) for k in range(10)])
    message = failure_message(verdict)
    assert "only 4 of 10 photos" in message and "IMG_4.JPG: too few features (20)" in message and "\n" not in message
    assert "textured" in failure_hint(verdict)


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"focal": 5000.0}, "field of view"), ({"focal": 100.0}, "field of view"), ({"error": 3.0}, "reprojection error")],
)
def test_all_registered_is_not_right(changes, words):
    verdict = judge(result(10, 10, **changes), [photo(k) for k in range(10)])
    assert any(words in failure for failure in verdict["failures"])


def test_focal_far_from_exif_is_a_warning():
    verdict = judge(result(6, 6), [photo(k, focal=1500.0) for k in range(6)])
    assert verdict["failures"] == [] and "EXIF" in verdict["warnings"][0]


def test_one_camera_for_each_size_and_zoom():
    photos = [photo(0), photo(1), photo(2, 480, 640), photo(3, focal=600), photo(4, focal=605), photo(5, focal=900)]
    assert [len(g["names"]) for g in size_groups(photos)] == [2, 1, 2, 1]


def test_a_crash_of_the_child_is_one_clear_line(tmp_path):
    job = {**FIRST_TRY, "count": 3, "exhaustive_up_to": 100}  # Lacks what the child needs.
    with pytest.raises(SdfsimError) as caught:
        run_worker(job, tmp_path, 60, lambda fraction, message: None)
    assert "COLMAP failed" in caught.value.message and "colmap.log" in caught.value.message


def test_a_child_that_hangs_is_ended(tmp_path, monkeypatch):
    script = tmp_path / "sleep.sh"
    script.write_text("#!/bin/sh\nexec sleep 60\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    with pytest.raises(SdfsimError, match="stopped after 1 s"):
        run_worker({"count": 3, "exhaustive_up_to": 100}, tmp_path, 1.0, lambda fraction, message: None)


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


def test_a_second_try_that_breaks_leaves_the_verdict_of_the_first(tmp_path, monkeypatch):
    def run(job, folder, timeout, report):
        if folder.name == "try2":
            raise SdfsimError("camera poses: stopped after 5 s")
        return result(10, 4)

    monkeypatch.setattr(poses, "run_worker", run)
    with pytest.raises(SdfsimError, match=r"only 4 of 10 photos.*IMG_4\.JPG") as caught:
        solve([photo(k) for k in range(10)], tmp_path, tmp_path)
    assert caught.value.exit_code == EXIT_QUALITY


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
