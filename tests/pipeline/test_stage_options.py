"""Options on their way from a call to a stage: what is kept for later, what counts for one call, what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from pipeline import actions, asset, distill, meshing, stages
from pipeline.options import Options, read_config
from sdfsim.errors import SdfsimError
from tests.cli.conftest import run as command


@pytest.fixture
def asked(monkeypatch) -> dict[str, dict]:
    """Replaces the work of three stages by a note of what was asked of it."""
    found: dict[str, dict] = {}

    def note(module, function: str, stage: str, result) -> None:
        monkeypatch.setattr(module, function, lambda *places, **options: found.setdefault(stage, options) and result)

    note(distill, "train", "distill", distill.Trained(None, 0.0, None, {}))  # type: ignore[arg-type]
    note(meshing, "make_meshes", "mesh", {})
    note(asset, "fit_parts", "fit", {})
    monkeypatch.setattr("sdfsim.parallel.choose_threads", lambda work, repeat: 0.0)
    monkeypatch.setattr("pipeline.cameras.load_views", lambda folder: [])
    monkeypatch.setattr("pipeline.cameras.load_sparse", lambda folder: None)
    return found


ACTIONS = dict(stages.ACTIONS)


@pytest.fixture
def real(calls, asked, monkeypatch) -> dict[str, dict]:
    """What was asked of distill, mesh and fit in stages that note only their names otherwise."""
    for stage in ("distill", "mesh", "fit"):
        monkeypatch.setitem(stages.ACTIONS, stage, ACTIONS[stage])
    return asked


def test_a_budget_for_everything_is_shared_and_one_for_a_stage_is_all_its_own(photos, tmp_path, real):
    out = tmp_path / "out"
    stages.reconstruct(photos, out, budget=1000.0)
    assert real["fit"]["budget"] == pytest.approx(150.0)
    assert 700.0 < real["distill"]["budget"] < 850.0 - actions.AFTER_TRAINING
    real.clear()
    for stage in ("distill", "mesh", "fit"):
        report = stages.run_stage(stage, out, budget=None if stage == "mesh" else 30.0)
        assert report["options"]["budget"] == 1000.0
    assert real["distill"]["budget"] == real["fit"]["budget"] == 30.0
    assert read_config(out).budget == 1000.0


def test_a_stage_with_a_budget_of_its_own_is_another_than_with_a_share(photos, tmp_path, real):
    out = tmp_path / "out"
    stages.reconstruct(photos, out, budget=1000.0)
    real.clear()
    stages.run_stage("distill", out, budget=1000.0)
    assert real["distill"]["budget"] == 1000.0
    real.clear()
    stages.run_stage("distill", out, budget=1000.0)
    assert real == {}


def test_the_budget_of_a_stage_is_checked(photos, tmp_path, calls):
    stages.reconstruct(photos, tmp_path / "out", until_stage="poses")
    with pytest.raises(SdfsimError, match="budget: must be > 0"):
        stages.run_stage("distill", tmp_path / "out", budget=0.0)


def test_the_device_reaches_every_stage_that_computes_there(photos, tmp_path, real, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    stages.reconstruct(photos, tmp_path / "out", device="cuda")
    assert {stage: options["device"] for stage, options in real.items()} == dict.fromkeys(real, "cuda")
    assert set(real) == {"distill", "mesh", "fit"}
    real.clear()
    stages.run_stage("mesh", tmp_path / "out", device="cpu", again=True)
    assert real["mesh"]["device"] == "cpu"


@pytest.mark.parametrize("stage", stages.STAGES)
def test_a_device_that_is_not_there_is_refused_before_any_stage(photos, tmp_path, calls, monkeypatch, stage):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    out = tmp_path / "out"
    with pytest.raises(SdfsimError, match="no CUDA device here"):
        stages.reconstruct(photos, out, device="cuda", until_stage=stage)
    assert not out.exists()
    stages.reconstruct(photos, out)
    with pytest.raises(SdfsimError, match="no CUDA device here"):
        stages.run_stage(stage, out, device="cuda", again=True)
    with pytest.raises(SdfsimError, match="device: 'gpu' is not one of"):
        stages.run_stage(stage, out, device="gpu", again=True)


def test_relative_photos_are_found_from_elsewhere(photos, tmp_path, real, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stages.reconstruct("photos", "out")
    assert read_config(Path("out")).photos == str(photos)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    stages.run_stage("mesh", tmp_path / "out", again=True)


def test_from_a_stage_after_the_last_one_is_refused(photos, tmp_path, calls):
    with pytest.raises(SdfsimError, match="from mesh until poses: poses comes before mesh"):
        stages.reconstruct(photos, tmp_path / "out", from_stage="mesh", until_stage="poses")
    assert calls == [] and not (tmp_path / "out").exists()
    stages.reconstruct(photos, tmp_path / "out", from_stage="poses", until_stage="poses")
    assert calls == ["photos", "poses"]


def test_poses_of_a_folder_in_work_keep_its_other_options(photos, tmp_path, calls, monkeypatch):
    monkeypatch.setattr("pipeline.recording.record", lambda folder: None)
    out = tmp_path / "out"
    assert command("poses", photos, "-o", out).exit_code == 0
    assert read_config(out) == Options(str(photos))
    stages.reconstruct(photos, out, preset="quick", seed=7, size=2.5, keep=["piece1"], drop="ball", budget=900.0)
    before = read_config(out)
    calls.clear()
    assert command("poses", photos, "-o", out).exit_code == 0
    assert read_config(out) == before and calls == []
    assert command("poses", photos, "-o", out, "--preset", "fine").exit_code == 0
    assert read_config(out) == before.changed({"preset": "fine"})


def test_a_place_that_is_not_in_the_photos_is_refused_before_the_poses(photos, tmp_path, calls, monkeypatch):
    for stage in ("photos", "poses"):
        monkeypatch.setitem(stages.ACTIONS, stage, ACTIONS[stage])
    monkeypatch.setattr("pipeline.poses.solve", lambda *places, **options: calls.append("solved") or {})
    with pytest.raises(SdfsimError, match=r"distance: no photo is called 'cup\.png'"):
        stages.reconstruct(photos, tmp_path / "out", distance=["0.png:3,4", "cup.png:1,1", 0.1])
    assert calls == []
    stages.reconstruct(photos, tmp_path / "out", distance=["0.png:3,4", "2.png:1,1", 0.1], until_stage="poses")
    assert calls == ["solved"]
