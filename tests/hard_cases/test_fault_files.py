"""Weights, shapes and checkpoints that are cut short or changed, and two runs in one folder: one clear line each."""

from pathlib import Path

import numpy as np
import pytest

from sdfsim import SdfsimError, load_shape
from sdfsim.base.files import LOCK, locked
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.geometry.primitives import box
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import MESH_FILE, RECORD_FILE, WEIGHTS_FILE, with_sdf
from tests.helpers.command import run

SCENE = "version: 1\nduration: 0.04\nbodies: [{name: floor, plane: {}}]\n"


@pytest.mark.parametrize("share", [0.0, 0.7])
@pytest.mark.parametrize("name", [WEIGHTS_FILE, MESH_FILE, RECORD_FILE])
def test_shapes_that_are_cut_short_are_one_line(tmp_path, name, share):
    folder = with_sdf(analytic_shape("box", size=(1, 1, 1)), "grid", resolution=8).save(tmp_path / "crate")
    assert load_shape(folder).volume == 1.0
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[: int(share * len(content))])
    with pytest.raises(SdfsimError, match=r"crate") as caught:
        load_shape(folder)
    assert caught.value.message.isprintable() and len(caught.value.message) < 400


def test_a_training_checkpoint_that_is_cut_short_is_one_line(tmp_path, monkeypatch):
    from sdfsim.training import train
    from tests.hard_cases import crashing

    monkeypatch.setattr(train, "PRESETS", dict(train.PRESETS))
    monkeypatch.setattr(train, "CHECKPOINT_SECONDS", train.CHECKPOINT_SECONDS)
    crashing.tiny_train()
    crashing.write_cubes(tmp_path / "data")
    command = ("train", "--data", tmp_path / "data", "-o", tmp_path / "out")
    assert run(*command).exit_code == 0
    checkpoint = tmp_path / "out" / "checkpoint.npz"
    again = run(*command)
    assert again.exit_code == 1 and "continue with --resume" in again.stderr
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    cut = run(*command, "--resume")
    assert cut.exit_code == 1 and "cannot be read as a checkpoint" in cut.stderr and "delete it" in cut.stderr
    np.savez(checkpoint, run=np.array("{}"))
    foreign = run(*command, "--resume")
    assert foreign.exit_code == 1 and "internal error" not in foreign.stderr


def commands(home: Path, out: Path) -> list[tuple]:
    """Every command that writes a folder, with what it reads."""
    (home / "scene.yaml").write_text(SCENE)
    (home / "box.ply").write_bytes(write_ply(box()))
    (home / "data").mkdir()
    (home / "data" / "dataset.json").write_text("{}")
    return [
        ("simulate", home / "scene.yaml", "-o", out, "--viewer", "none"),
        ("fit", home / "box.ply", "-o", out),
        ("train", "--data", home / "data", "-o", out),
    ]


def test_two_runs_never_write_one_folder(tmp_path):
    out = tmp_path / "out"
    with locked(out):
        (out / "report.json").write_text("{}")
        (out / "config.yaml").write_text("command: simulate\n")
        for command in commands(tmp_path, out):
            done = run(*command)
            assert done.exit_code == 1, command
            assert f"{out}: another run is writing to this folder" in done.stderr and "wait until" in done.stderr
        assert sorted(p.name for p in out.iterdir()) == [LOCK, "config.yaml", "report.json"]
    assert sorted(p.name for p in out.iterdir()) == ["config.yaml", "report.json"]


def test_what_a_killed_run_left_is_no_lock_and_is_cleared_away(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / LOCK).touch()
    (out / ".rollout.npz.4711.part").write_bytes(b"half of i")
    assert run(*commands(tmp_path, out)[0]).exit_code == 0
    assert sorted(p.name for p in out.iterdir()) == ["config.yaml", "report.json", "rollout.npz"]
