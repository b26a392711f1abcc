"""What lies where results belong: what is not ours is never replaced, and what killed runs left goes."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from PIL import Image

from pipeline import record, stages
from pipeline.report import STAGES, place_of
from sdfsim.errors import SdfsimError
from sdfsim.run import simulate


def tree(folder: Path) -> dict[str, bytes]:
    """Every file of a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def simulate_tower(out: Path) -> None:
    """One step."""
    scene = Path(__file__).parents[2] / "samples" / "tower.yaml"
    simulate(
        scene, out, model=None, seconds=0.02, seed=None, viewer="none", device="cpu", on_progress=lambda *_: None,
        say=lambda _: None,
    )  # fmt: skip


@pytest.mark.parametrize("finished", [False, True])
@pytest.mark.parametrize("stage", STAGES)
def test_photos_where_a_result_belongs_stay(photos, tmp_path, calls, stage, finished):
    """Also where a stage's record lies beside them, and by whatever path they are given."""
    scan = tmp_path / "scan"
    place = place_of(scan, stage)
    place.parent.mkdir()
    shutil.copytree(photos, place / "images")
    if finished:
        shutil.copytree(photos, tmp_path / "other" / "images")
        stages.reconstruct(tmp_path / "other", tmp_path / "done", until_stage="photos")
        shutil.copy(tmp_path / "done" / "photos" / record.RECORD, place)
        calls.clear()
    (tmp_path / "link").symlink_to(place / "images")
    before = tree(scan)
    for given in (place, place / "images", tmp_path / "link"):
        with pytest.raises(SdfsimError, match=f"where the result of the {stage} stage belongs"):
            stages.reconstruct(given, scan)
    assert calls == [] and tree(scan) == before


def test_photos_named_from_beside_the_results_stay(photos, tmp_path, calls, monkeypatch):
    """`-o .` in the folder that holds `photos`."""
    monkeypatch.chdir(tmp_path)
    before = tree(photos)
    with pytest.raises(SdfsimError, match="photos"):
        stages.reconstruct("photos", ".")
    assert calls == [] and tree(photos) == before and sorted(p.name for p in tmp_path.iterdir()) == ["photos"]
    stages.reconstruct("photos", "out")  # Beside them is fine, and so is among them.
    stages.reconstruct("photos", "photos", until_stage="photos")
    assert before.items() <= tree(photos).items()


def test_masks_where_a_result_belongs_stay(photos, tmp_path, calls):
    photos = photos.rename(tmp_path / "raw")
    (tmp_path / "mesh").mkdir()
    for photo in photos.iterdir():
        Image.new("L", (80, 80)).save(tmp_path / "mesh" / photo.name)
    (photos / "masks").symlink_to(tmp_path / "mesh")
    with pytest.raises(SdfsimError, match="where the result of the mesh stage belongs"):
        stages.reconstruct(photos, tmp_path)
    assert len(list((tmp_path / "mesh").iterdir())) == 3


@pytest.mark.parametrize("stage", STAGES)
def test_anything_else_where_a_result_belongs_is_refused_before_the_first_stage(photos, tmp_path, calls, stage):
    out = tmp_path / "out"
    place_of(out, stage).mkdir(parents=True)
    (place_of(out, stage) / "mine.blend").write_text("years of work")
    before = tree(out)
    with pytest.raises(SdfsimError, match="not replaced") as caught:
        stages.reconstruct(photos, out)
    assert "choose another folder" in caught.value.hint
    assert calls == [] and tree(out) == before


@pytest.mark.parametrize("name", ["config.yaml", "report.json", "report.html"])
def test_files_of_the_users_among_the_results_stay(photos, tmp_path, calls, name):
    out = tmp_path / "out"
    out.mkdir()
    (out / name).write_text("mine: true")
    with pytest.raises(SdfsimError, match=f"{name}: in the way, and not replaced"):
        stages.reconstruct(photos, out)
    assert calls == [] and tree(out) == {name: b"mine: true"}


def test_the_folder_of_another_command_is_left_alone(photos, tmp_path, calls):
    """Each writes a config.yaml and a report.json: neither takes the other's folder."""
    simulate_tower(tmp_path / "run")
    stages.reconstruct(photos, tmp_path / "scan", until_stage="photos")
    before = tree(tmp_path / "run"), tree(tmp_path / "scan")
    with pytest.raises(SdfsimError, match="not from an earlier `sdfsim reconstruct`"):
        stages.reconstruct(photos, tmp_path / "run")
    with pytest.raises(SdfsimError, match="not from an earlier `sdfsim simulate`"):
        simulate_tower(tmp_path / "scan")
    assert (tree(tmp_path / "run"), tree(tmp_path / "scan")) == before


def test_one_stage_alone_replaces_nothing_of_the_users_either(photos, tmp_path, calls):
    out = tmp_path / "out"
    stages.reconstruct(photos, out, until_stage="distill")
    (out / "mesh").write_text("mine")
    with pytest.raises(SdfsimError, match="not replaced"):
        stages.run_stage("mesh", out)
    assert (out / "mesh").read_text() == "mine" and "mesh" not in calls


def test_what_appears_while_a_stage_runs_is_not_replaced(tmp_path):
    work = record.begin(tmp_path / "w", "a", fresh=False)
    (work / "result").write_text("")
    (tmp_path / "place").mkdir()
    (tmp_path / "place" / "mine").write_text("")
    with pytest.raises(SdfsimError, match="not replaced"):
        record.finish(work, tmp_path / "place", "a", "before", {}, 1.0)
    assert (tmp_path / "place" / "mine").exists() and (work / "result").exists()


def test_half_written_files_of_a_killed_run_do_not_get_into_the_result(tmp_path):
    work = record.begin(tmp_path / "w", "a", fresh=False)
    (work / "deep" / ".shape.part").mkdir(parents=True)
    for name in (".checkpoint.safetensors.7.part", "deep/.x.json.8.part", "deep/.shape.part/y", "deep/z.part"):
        (work / name).write_text("half")
    assert sorted(tree(record.begin(work, "a", fresh=False))) == [
        "deep/.shape.part/y", "deep/z.part", record.UNFINISHED,
    ]  # fmt: skip


def test_a_skipped_stage_leaves_nothing_of_runs_that_were_killed(photos, tmp_path, calls, monkeypatch):
    """One that was to do it again, and one that had just put the new result in place of the old."""
    out = tmp_path / "out"
    stages.reconstruct(photos, out)

    def killed(run: stages.Run, work: Path) -> dict:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setitem(stages.ACTIONS, "distill", killed)
        with pytest.raises(KeyboardInterrupt):
            stages.reconstruct(photos, out, from_stage="distill")
    shutil.copytree(out / "mesh", out / ".mesh.old")
    assert (out / ".distill.part").exists()
    calls.clear()
    stages.reconstruct(photos, out)
    assert calls == [] and not (out / ".distill.part").exists() and not (out / ".mesh.old").exists()


def test_another_result_of_the_same_options_makes_later_stages_old(photos, tmp_path, calls):
    """With a budget, or on a GPU, a stage done again makes something else of the same."""
    out = tmp_path / "out"
    stages.reconstruct(photos, out)
    report = stages.reconstruct(photos, out, from_stage="distill", until_stage="distill")
    assert list(report["stages"]) == ["photos", "poses", "distill"]
    with pytest.raises(SdfsimError, match="the mesh stage is older than what it reads"):
        stages.run_stage("fit", out)
    calls.clear()
    stages.reconstruct(photos, out)
    assert calls == ["mesh", "fit", "scene"]


def test_records_without_a_name_of_their_result_still_count(photos, tmp_path, calls):
    import json

    out = tmp_path / "out"
    stages.reconstruct(photos, out)
    before = None
    for stage in STAGES:
        path = place_of(out, stage) / record.RECORD
        known = json.loads(path.read_text())
        del known["made"]
        known["inputs"] = before["fingerprint"] if before else known["inputs"]
        path.write_text(json.dumps(known))
        before = known
    assert set(stages.run_stage("scene", out)["stages"]) == set(STAGES)
