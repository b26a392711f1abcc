"""Stages: skipped when unchanged, done again when not, resumed when killed; nothing of the user's is lost. What a run
reports, also where it stopped."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pipeline import stages
from pipeline.cameras import save_views
from pipeline.options import Options, read_config
from pipeline.report import improvements, write_recording
from pipeline.sfm.pose_checks import check, views_of
from pipeline.stages import STAGES, Record, begin, finish, reconstruct, run_stage
from sdfsim.base.errors import EXIT_QUALITY, SdfsimError
from sdfsim.base.files import locked, write_arrays
from tests.helpers.command import run as command
from tests.helpers.photos import RESULTS, noise, photo, result

NAMES = list(STAGES)
DEVICES = ("distill", "mesh", "fit")
REAL = dict(STAGES)


def tree(folder: Path) -> dict[str, bytes]:
    """Every file of a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_unchanged_stages_are_skipped(photos, tmp_path, calls):
    reconstruct(photos, tmp_path / "out", preset="quick")
    assert calls == NAMES
    calls.clear()
    report = reconstruct(photos, tmp_path / "out", preset="quick")
    assert calls == []
    assert list(report["stages"]) == NAMES
    assert json.loads((tmp_path / "out" / "report.json").read_text()) == report


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"size": 2.0}, ["mesh", "fit", "scene"]),
        ({"from_stage": "fit"}, ["fit", "scene"]),
        ({"preset": "standard"}, ["distill", "mesh", "fit", "scene"]),
        ({"until_stage": "poses", "seed": 3}, ["poses"]),
        ({"drop": "none"}, ["scene"]),
        ({"material": {"object1": "wood"}}, ["scene"]),
    ],
)
def test_what_changed_is_done_again(photos, tmp_path, calls, changes, expected):
    reconstruct(photos, tmp_path / "out", preset="quick")
    calls.clear()
    reconstruct(photos, tmp_path / "out", **{"preset": "quick", **changes})
    assert calls == expected


def test_a_stage_of_another_version_is_done_again_with_those_after_it(photos, tmp_path, calls, monkeypatch):
    reconstruct(photos, tmp_path / "out")
    calls.clear()
    monkeypatch.setitem(STAGES, "mesh", replace(STAGES["mesh"], version=99))
    reconstruct(photos, tmp_path / "out")
    assert calls == ["mesh", "fit", "scene"]


def test_a_mask_of_another_name_or_content_changes_everything(photos, tmp_path, calls):
    """The name of its folder is that of its body."""
    noise(photos / "masks" / "cup", ["0.png", "1.png", "2.png"], (80, 80))
    reconstruct(photos, tmp_path / "out")
    for change in (
        lambda: (photos / "masks" / "cup").rename(photos / "masks" / "mug"),
        lambda: (photos / "masks" / "mug" / "0.png").write_bytes((photos / "masks" / "mug" / "1.png").read_bytes()),
        lambda: (photos / "masks" / "mug" / "2.png").unlink(),
    ):
        change()
        calls.clear()
        reconstruct(photos, tmp_path / "out")
        assert calls == NAMES
    calls.clear()
    photos.rename(tmp_path / "moved")
    reconstruct(tmp_path / "moved", tmp_path / "out")
    assert calls == []


def test_a_killed_stage_goes_on_in_its_own_folder(photos, tmp_path, calls, act):
    def killed(project: stages.Project, work: Path) -> dict:
        (work / "checkpoint").write_text("half")
        raise KeyboardInterrupt

    ordinary, found = STAGES["distill"].run, []
    act("distill", killed)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(photos, tmp_path / "out")
    assert not (tmp_path / "out" / "distill").exists()
    act("distill", lambda run, work: found.append((work / "checkpoint").exists()) or ordinary(run, work))
    calls.clear()
    reconstruct(photos, tmp_path / "out")
    assert found == [True] and calls == ["distill", "mesh", "fit", "scene"]


def test_run_stage_needs_the_stages_before(photos, tmp_path, calls):
    out = tmp_path / "out"
    with pytest.raises(SdfsimError, match=str(out)):
        run_stage("distill", out)
    reconstruct(photos, out, preset="quick", until_stage="photos")
    with pytest.raises(SdfsimError, match="poses stage"):
        run_stage("distill", out)
    run_stage("poses", out)
    calls.clear()
    report = run_stage("distill", out, seed=5, preset=None)
    assert calls == ["distill"] and report["options"]["preset"] == "quick" and report["options"]["seed"] == 5
    (out / "photos" / stages.RECORD).unlink()
    with pytest.raises(SdfsimError) as caught:
        run_stage("mesh", out)
    assert caught.value.hint == "run `sdfsim poses` first"


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"preset": "slow"}, "preset"),
        ({"size": -1.0}, "size"),
        ({"budget": 0.0}, "budget"),
        ({"until_stage": "x"}, "stage"),
        ({"distance": ["a:1,1", "b:1,1", 0.0]}, "distance"),
        ({"distance": ["a:1,1", "a:1,1", 1.0]}, "both ends"),
        ({"from_stage": "mesh", "until_stage": "poses"}, "poses comes before mesh"),
        ({"photos": "none"}, "no such folder"),
    ],
)
def test_bad_options_are_one_line_and_write_nothing(photos, tmp_path, keywords, words):
    with pytest.raises(SdfsimError, match=words) as caught:
        reconstruct(**{"photos": photos, "out": tmp_path / "out", **keywords})
    assert "\n" not in caught.value.message
    assert not (tmp_path / "out").exists()


def test_a_full_disk_and_an_unwritable_folder_are_one_clear_line(photos, tmp_path, calls, act):
    def full(project: stages.Project, work: Path) -> dict:
        raise OSError(28, "No space left on device", str(work))

    act("mesh", full)
    with pytest.raises(SdfsimError, match="No space left on device"):
        reconstruct(photos, tmp_path / "out")
    (tmp_path / "file").write_text("")
    with pytest.raises(SdfsimError, match="cannot be written"):
        reconstruct(photos, tmp_path / "file" / "out")


def test_stages_made_from_an_older_result_are_not_reported(photos, tmp_path, calls, act):
    ordinary, out = STAGES["fit"].run, tmp_path / "out"
    act("fit", lambda run, work: {**ordinary(run, work), "passed": False, "reason": "too coarse"})
    report = reconstruct(photos, out)
    assert report["failed_checks"] == ["fit: too coarse"] and "scene" in report["paths"]
    report = run_stage("mesh", out, size=5.0)
    assert list(report["stages"]) == ["photos", "poses", "distill", "mesh"]
    assert report["failed_checks"] == [] and "scene" not in report["paths"]
    with pytest.raises(SdfsimError, match="fit stage is older") as caught:
        run_stage("scene", out)
    assert "sdfsim fit" in caught.value.hint
    run_stage("fit", out)
    assert list(run_stage("scene", out)["stages"]) == NAMES


def test_a_second_run_into_the_same_folder_is_refused(photos, tmp_path, calls):
    out = tmp_path / "out"
    reconstruct(photos, out, until_stage="photos")
    with locked(out):
        for again in (lambda: reconstruct(photos, out), lambda: run_stage("poses", out)):
            with pytest.raises(SdfsimError, match=str(out)) as caught:
                again()
            assert caught.value.exit_code == 1
    run_stage("poses", out)


@pytest.mark.parametrize("stage", ["photos", "fit"])
def test_photos_where_a_result_belongs_stay(photos, tmp_path, calls, stage):
    """By whatever path they are given."""
    place = tmp_path / "scan" / STAGES[stage].folder
    place.parent.mkdir()
    shutil.copytree(photos, place / "images")
    (tmp_path / "link").symlink_to(place / "images")
    before = tree(tmp_path / "scan")
    for given in (place, place / "images", tmp_path / "link"):
        with pytest.raises(SdfsimError, match=rf"{place}.*\b{stage}\b"):
            reconstruct(given, tmp_path / "scan")
    assert calls == [] and tree(tmp_path / "scan") == before


@pytest.mark.parametrize("name", ["photos/mine.blend", "assets/mine.blend", "config.yaml", "report.json", "report.md"])
def test_anything_else_where_a_result_belongs_is_refused_before_the_first_stage(photos, tmp_path, calls, name):
    out = tmp_path / "out"
    (out / name).parent.mkdir(parents=True)
    (out / name).write_text("mine: true")
    with pytest.raises(SdfsimError, match="not replaced"):
        reconstruct(photos, out)
    assert calls == [] and tree(out) == {name: b"mine: true"}


def test_what_appears_while_a_stage_runs_is_not_replaced(tmp_path):
    work = begin(tmp_path / "w", "a", fresh=False)
    (work / "result").write_text("")
    (tmp_path / "place").mkdir()
    (tmp_path / "place" / "mine").write_text("")
    with pytest.raises(SdfsimError, match="not replaced"):
        finish(work, tmp_path / "place", Record("a", "before", "made", 1.0, {}))
    assert (tmp_path / "place" / "mine").exists() and (work / "result").exists()


@pytest.fixture
def asked(calls, monkeypatch) -> dict[str, dict]:
    """What was asked of distill, mesh and fit, which do nothing else; the other stages note their names."""
    found: dict[str, dict] = {}

    def note(where: str, stage: str, result) -> None:
        monkeypatch.setattr(where, lambda *places, **options: found.setdefault(stage, options) and result)
        monkeypatch.setitem(STAGES, stage, REAL[stage])

    note("pipeline.field.training.train", "distill", SimpleNamespace(report={}))
    note("pipeline.mesh.meshing.make_meshes", "mesh", RESULTS["mesh"])
    note("pipeline.scene_writer.fit_parts", "fit", {})
    monkeypatch.setattr("sdfsim.base.parallel.choose_threads", lambda work, repeat: 0.0)
    monkeypatch.setattr("pipeline.cameras.load_poses", lambda folder: None)
    return found


def test_a_budget_for_everything_is_shared_and_one_for_a_stage_is_all_its_own(photos, tmp_path, asked):
    out = tmp_path / "out"
    reconstruct(photos, out, budget=1000.0)
    assert asked["fit"]["budget"] == pytest.approx(150.0)
    assert 700.0 < asked["distill"]["budget"] < 850.0 - stages.AFTER_TRAINING
    asked.clear()
    for stage in ("distill", "mesh", "fit"):
        report = run_stage(stage, out, budget=None if stage == "mesh" else 30.0)
        assert report["options"]["budget"] == 1000.0
    assert asked["distill"]["budget"] == asked["fit"]["budget"] == 30.0
    assert read_config(out).budget == 1000.0


def test_the_device_reaches_every_stage_that_computes_there(photos, tmp_path, asked, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    reconstruct(photos, tmp_path / "out", device="cuda")
    assert {stage: options["device"] for stage, options in asked.items()} == dict.fromkeys(DEVICES, "cuda")


def test_a_device_that_is_not_there_is_refused_before_any_stage(photos, tmp_path, calls, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SdfsimError, match="CUDA"):
        reconstruct(photos, tmp_path / "out", device="cuda")
    assert not (tmp_path / "out").exists()
    reconstruct(photos, tmp_path / "out")
    with pytest.raises(SdfsimError, match="CUDA"):
        run_stage("mesh", tmp_path / "out", device="cuda")


def test_poses_of_a_folder_in_work_keep_its_other_options(photos, tmp_path, calls, monkeypatch):
    monkeypatch.setattr("pipeline.report.write_recording", lambda folder, done: None)
    out = tmp_path / "out"
    assert command("poses", photos, "-o", out).exit_code == 0
    assert read_config(out) == Options(photos=str(photos))
    reconstruct(photos, out, preset="quick", seed=7, size=2.5, drop="ball", budget=900.0)
    before = read_config(out)
    calls.clear()
    assert command("poses", photos, "-o", out).exit_code == 0
    assert read_config(out) == before and calls == []
    assert command("poses", photos, "-o", out, "--preset", "standard").exit_code == 0
    assert read_config(out) == before.changed({"preset": "standard"})


def test_a_place_that_is_not_in_the_photos_is_refused_before_the_poses(photos, tmp_path, calls, monkeypatch):
    for stage in ("photos", "poses"):
        monkeypatch.setitem(STAGES, stage, REAL[stage])
    monkeypatch.setattr("pipeline.sfm.poses.solve", lambda *places, **options: pytest.fail("solved"))
    with pytest.raises(SdfsimError, match=r"distance: .*'cup\.png'"):
        reconstruct(photos, tmp_path / "out", distance=["0.png:3,4", "cup.png:1,1", 0.1])


def test_the_page_names_every_photo_and_the_recording_shows_the_cameras(photos, tmp_path, act):
    found = result(3, 2)

    def posed(run, work):
        save_views(views_of(found, [photo(k) for k in range(3)]), work / "cameras.json")
        arrays = {"xyz": np.ones((5, 3)), "rgb": np.zeros((5, 3), np.uint8), "error": np.zeros(5)}
        write_arrays(work / "sparse.npz", {**arrays, "point_of": np.zeros(0, int), "view_of": np.zeros(0, int)})
        checks = check(found, [photo(k) for k in range(3)])
        return {
            **checks,
            "left_out": [{"photo": "2.png", "kind": "overlap", "why": "too few matches", "hopeful": True}],
        }

    act("poses", posed)
    out = tmp_path / "out"
    report = reconstruct(photos, out, until_stage="poses")
    text = (out / "report.md").read_text()
    assert "| 0.png | posed |" in text and "| 2.png | left out | too few matches |" in text
    assert report["paths"]["report"] == str(out / "report.md")
    assert [row["state"] for row in report["photos"]] == ["posed", "posed", "left out"]
    made = write_recording(out, report["stages"])
    assert made is not None and made.read_bytes()[:3] == b"RRF"


def test_a_run_that_stopped_says_where_and_why(photos, tmp_path, act):
    def failing(run, work):
        (work / "checks.json").write_text(json.dumps(check(result(6, 1, features=20), [photo(k) for k in range(6)])))
        raise SdfsimError("camera poses: only 1 of 6", "take sharper photos", exit_code=EXIT_QUALITY)

    act("poses", failing)
    with pytest.raises(SdfsimError) as caught:
        reconstruct(photos, tmp_path / "out")
    assert caught.value.exit_code == EXIT_QUALITY
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["error"] == {
        "stage": "poses", "message": "camera poses: only 1 of 6", "hint": "take sharper photos",
    }  # fmt: skip
    assert report["poses"]["posed"] == 1 and any("too little to see" in line for line in report["improve"])
    assert "It stopped in the poses stage" in (tmp_path / "out" / "report.md").read_text()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (Options(preset="quick"), "--preset standard"),
        (Options(preset="standard"), "more and sharper photos"),
        (Options(preset="standard", budget=60.0), "a larger --budget"),
    ],
)
def test_nobody_is_reported_to_do_what_they_did(options, said, photos, tmp_path, act):
    (line,) = improvements({"poses": {}, "stages": {}, "photos": [], "psnr": 12.0, "failed_checks": []}, options)
    assert said in line and f"--preset {options.preset}" not in line

    def failing(**places):
        raise SdfsimError("mesh: the field holds no surface", exit_code=EXIT_QUALITY)

    for stage in ("photos", "poses", "distill"):
        act(stage, lambda run, work: {})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.mesh.meshing.make_meshes", lambda *places, **named: failing())
        with pytest.raises(SdfsimError, match="mesh: ") as caught:
            reconstruct(photos, tmp_path / "out", preset=options.preset, budget=options.budget)
    assert said in caught.value.hint and f"--preset {options.preset}" not in caught.value.hint
