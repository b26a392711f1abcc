"""Photo sets with one thing wrong each, through structure-from-motion: every one gets the right diagnosis."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from pipeline.cameras import load_poses, load_views
from pipeline.inputs.photos import load_photos, prepare_photos
from pipeline.sfm.poses import solve
from sdfsim.base.errors import EXIT_QUALITY, SdfsimError
from tests.pipeline import photo_sets

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


def test_a_blank_wall(tmp_path):
    photo_sets.blank_wall(tmp_path / "in")
    message = failure(tmp_path / "in", tmp_path)
    assert "only 0 of 30 photos" in message and "there is too little to see" in message and "blank wall" in message


def test_two_sets_in_one_folder(tmp_path):
    photo_sets.two_sets(tmp_path / "in")
    verdict = posed(tmp_path / "in", tmp_path)
    assert verdict["posed"] >= 16
    left = {entry["photo"]: entry["why"] for entry in verdict["left_out"]}
    assert sum(name.startswith("other_") for name in left) == 10
    assert sum("shows something else" in why for name, why in left.items() if name.startswith("other_")) >= 8
    assert any("nothing in common" in cause for cause in verdict["causes"])


def test_all_photos_from_one_spot(tmp_path):
    photo_sets.one_spot(tmp_path / "in")
    message = failure(tmp_path / "in", tmp_path)
    assert "taken from one spot" in message and "step sideways" in message


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
    from pipeline.cameras import save_views
    from pipeline.inputs.photos import KNOWN_CAMERAS

    (wrong / "images").symlink_to(work / "images")
    moved = [type(v)(**{**v.__dict__, "name": o.name}) for v, o in zip(views, views[3:] + views[:3], strict=True)]
    save_views(moved, wrong / KNOWN_CAMERAS)
    with pytest.raises(SdfsimError, match="known cameras"):
        solve(load_photos(work), wrong, wrong)


def test_a_killed_run_goes_on_and_ends_as_an_undisturbed_one(tmp_path):
    """Killed once features are there, and again while it matches."""
    import json
    import os
    import signal
    import subprocess
    import sys
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
