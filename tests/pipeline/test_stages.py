"""Stages: skipped when nothing changed, done again when something did, resumed when killed, never half-written."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from PIL import Image

from pipeline import record, stages
from pipeline.report import notes
from sdfsim.errors import SdfsimError
from sdfsim.files import locked

ROOT = Path(__file__).resolve().parent.parent.parent


def test_unchanged_stages_are_skipped(photos, tmp_path, calls):
    stages.reconstruct(photos, tmp_path / "out", preset="quick")
    assert calls == list(stages.STAGES)
    calls.clear()
    report = stages.reconstruct(photos, tmp_path / "out", preset="quick")
    assert calls == []
    assert set(report["stages"]) == set(stages.STAGES)
    assert json.loads((tmp_path / "out" / "report.json").read_text()) == report


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"size": 2.0}, ["mesh", "fit", "scene"]),
        ({"from_stage": "fit"}, ["fit", "scene"]),
        ({"preset": "standard"}, ["distill", "mesh", "fit", "scene"]),
        ({"until_stage": "poses", "seed": 3}, ["poses"]),
    ],
)
def test_what_changed_is_done_again(photos, tmp_path, calls, changes, expected):
    stages.reconstruct(photos, tmp_path / "out", preset="quick")
    calls.clear()
    stages.reconstruct(photos, tmp_path / "out", **{"preset": "quick", **changes})
    assert calls == expected


@pytest.mark.parametrize("stage", stages.STAGES)
def test_a_stage_of_another_version_is_done_again_with_those_after_it(photos, tmp_path, calls, monkeypatch, stage):
    stages.reconstruct(photos, tmp_path / "out", preset="quick")
    calls.clear()
    monkeypatch.setitem(stages.STAGE_VERSIONS, stage, stages.STAGE_VERSIONS[stage] + 1)
    stages.reconstruct(photos, tmp_path / "out", preset="quick")
    assert calls == list(stages.STAGES[stages.STAGES.index(stage) :])


def test_a_changed_comment_changes_no_stage(photos, tmp_path, calls, monkeypatch):
    stages.reconstruct(photos, tmp_path / "out", preset="quick")
    calls.clear()
    ordinary = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: ordinary(path) + b"#" * (path.suffix == ".py"))
    stages.reconstruct(photos, tmp_path / "out", preset="quick")
    assert calls == []


def test_another_photo_changes_everything(photos, tmp_path, calls):
    stages.reconstruct(photos, tmp_path / "out", preset="quick")
    calls.clear()
    Image.new("RGB", (80, 80)).save(photos / "9.png")
    stages.reconstruct(photos, tmp_path / "out", preset="quick")
    assert calls == list(stages.STAGES)


def test_a_killed_stage_goes_on_in_its_own_folder(photos, tmp_path, calls, monkeypatch):
    def killed(run: stages.Run, work: Path) -> dict:
        (work / "checkpoint").write_text("half")
        raise KeyboardInterrupt

    ordinary = stages.ACTIONS["distill"]
    monkeypatch.setitem(stages.ACTIONS, "distill", killed)
    with pytest.raises(KeyboardInterrupt):
        stages.reconstruct(photos, tmp_path / "out", preset="quick")
    assert not (tmp_path / "out" / "distill").exists()
    found = []
    monkeypatch.setitem(
        stages.ACTIONS, "distill", lambda run, work: found.append((work / "checkpoint").exists()) or ordinary(run, work)
    )
    calls.clear()
    stages.reconstruct(photos, tmp_path / "out", preset="quick")
    assert found == [True] and calls == ["distill", "mesh", "fit", "scene"]


def test_leftovers_of_other_options_are_not_used(tmp_path):
    work = record.begin(tmp_path / "w", "a", fresh=False)
    (work / "x").write_text("")
    assert (record.begin(work, "a", fresh=False) / "x").exists()
    assert not (record.begin(work, "b", fresh=False) / "x").exists()
    (work / "x").write_text("")
    assert not (record.begin(work, "b", fresh=True) / "x").exists()


def test_run_stage_needs_the_stages_before(photos, tmp_path, calls):
    with pytest.raises(SdfsimError, match="not the folder of a reconstruction"):
        stages.run_stage("distill", tmp_path / "out")
    stages.reconstruct(photos, tmp_path / "out", preset="quick", until_stage="photos")
    with pytest.raises(SdfsimError, match="the poses stage has not run"):
        stages.run_stage("distill", tmp_path / "out")
    stages.run_stage("poses", tmp_path / "out")
    calls.clear()
    report = stages.run_stage("distill", tmp_path / "out", seed=5, preset=None)
    assert calls == ["distill"] and report["options"]["preset"] == "quick" and report["options"]["seed"] == 5


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"preset": "slow"}, "preset"),
        ({"size": -1.0}, "size"),
        ({"budget": 0.0}, "budget"),
        ({"until_stage": "x"}, "stage"),
    ],
)
def test_bad_options_are_one_line_and_write_nothing(photos, tmp_path, keywords, words):
    with pytest.raises(SdfsimError, match=words) as caught:
        stages.reconstruct(photos, tmp_path / "out", **keywords)
    assert "\n" not in caught.value.message
    assert not (tmp_path / "out").exists()


def test_bad_photos_write_nothing(tmp_path):
    with pytest.raises(SdfsimError, match="no such folder"):
        stages.reconstruct(tmp_path / "none", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_unwritable_output_is_one_clear_line(photos, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SdfsimError, match="cannot be written"):
        stages.reconstruct(photos, tmp_path / "file" / "out")


def test_full_disk_is_one_clear_line(photos, tmp_path, calls, monkeypatch):
    def full(run: stages.Run, work: Path) -> dict:
        raise OSError(28, "No space left on device", str(work))

    monkeypatch.setitem(stages.ACTIONS, "mesh", full)
    with pytest.raises(SdfsimError, match="the disk is full"):
        stages.reconstruct(photos, tmp_path / "out", preset="quick")


def test_stages_made_from_an_older_result_are_not_reported(photos, tmp_path, calls, monkeypatch):
    ordinary = stages.ACTIONS["fit"]
    failing = {"passed": False, "reason": "too coarse"}
    monkeypatch.setitem(stages.ACTIONS, "fit", lambda run, work: {**ordinary(run, work), **failing})
    out = tmp_path / "out"
    report = stages.reconstruct(photos, out, preset="quick")
    assert report["failed_checks"] == ["fit: too coarse"] and "scene" in report["paths"]
    report = stages.run_stage("mesh", out, size=5.0)
    assert list(report["stages"]) == ["photos", "poses", "distill", "mesh"]
    assert report["failed_checks"] == [] and "scene" not in report["paths"]
    with pytest.raises(SdfsimError, match="the fit stage is older than what it reads") as caught:
        stages.run_stage("scene", out)
    assert "sdfsim fit" in caught.value.hint
    stages.run_stage("fit", out)
    assert set(stages.run_stage("scene", out)["stages"]) == set(stages.STAGES)


def test_the_hint_names_a_command_that_exists(photos, tmp_path, calls):
    out = tmp_path / "out"
    stages.reconstruct(photos, out, until_stage="photos")
    (out / "photos" / record.RECORD).unlink()
    with pytest.raises(SdfsimError) as caught:
        stages.run_stage("distill", out)
    assert caught.value.hint == "run `sdfsim poses` first"


def test_a_second_run_into_the_same_folder_is_refused(photos, tmp_path, calls):
    out = tmp_path / "out"
    stages.reconstruct(photos, out, until_stage="photos")
    with locked(out):
        for again in (lambda: stages.reconstruct(photos, out), lambda: stages.run_stage("poses", out)):
            with pytest.raises(SdfsimError, match="another run is writing") as caught:
                again()
            assert caught.value.exit_code == 1
    stages.run_stage("poses", out)


def test_a_record_that_cannot_be_written_keeps_the_work(tmp_path, monkeypatch):
    work = record.begin(tmp_path / "w", "a", fresh=False)
    (work / "result").write_text("")

    def full(path: Path, content: dict) -> None:
        raise SdfsimError(f"{path}: cannot be written: No space left on device")

    monkeypatch.setattr(record, "write_json", full)
    with pytest.raises(SdfsimError, match="No space left"):
        record.finish(work, tmp_path / "place", "a", "before", {}, 1.0)
    assert (record.begin(work, "a", fresh=False) / "result").exists()


def test_notes_name_what_was_passed_over_assumed_or_is_vague():
    found = notes({
        "photos": {"notes": ["photos of several sizes"]},
        "poses": {"warnings": ["12 left out"], "left_out": [{"photo": f"{k}.jpg", "why": "dark"} for k in range(12)]},
        "mesh": {"up_from": "cameras", "size": "assumed: widest side = 1 m"},
    })  # fmt: skip
    assert found[:3] == ["photos of several sizes", "12 left out", "left out: 0.jpg: dark"]
    assert found[-3:-1] == [
        "left out: 2 more",
        "no level plane found: up is taken from the cameras and may be off by some degrees",
    ]
    assert found[-1] == "size assumed: widest side = 1 m (give --size or --distance)"


@pytest.mark.slow
def test_the_whole_chain_on_the_rendered_set(tmp_path):
    sys.path.insert(0, str(ROOT))
    from benchmarks.reconstruct import evaluate

    source = ROOT / "samples" / "photos" / "table_vase"
    report = stages.reconstruct(source, tmp_path, preset="quick")
    truth = evaluate(tmp_path, source)
    assert truth["poses"]["center_error_worst_percent"] < 0.5
    surface = truth["surface_percent_of_table_width"]["surface"]
    assert surface["median"] <= 1.0
    assert surface["p90"] <= 4.0
    assert report["psnr"] > 20
    assert (tmp_path / "scene.yaml").exists()
