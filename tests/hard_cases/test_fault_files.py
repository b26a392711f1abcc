"""Weights, shapes and checkpoints that are cut short or changed, and two runs in one folder: one clear line each."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from typer.testing import CliRunner

import cli
from sdfsim import SdfsimError, load_shape
from sdfsim.dynamics.model import Model, new_network
from sdfsim.files import LOCK, locked
from sdfsim.shape import shape as shape_module
from sdfsim.shape.mesh import write_ply
from sdfsim.shape.primitives import box
from sdfsim.shape.shape import MESH_FILE, RECORD_FILE, WEIGHTS_FILE, analytic_shape, with_sdf

SCENE = "version: 1\nduration: 0.04\nbodies: [{name: floor, plane: {}}]\n"


def run(*arguments: object):
    return CliRunner().invoke(cli.app, [str(a) for a in arguments])


@pytest.fixture
def model(tmp_path) -> Path:
    path = tmp_path / "tiny.safetensors"
    torch.manual_seed(0)
    Model("tiny", "impulse", new_network("impulse", {"width": 8, "rounds": 1}), 0.02, 10.0, 1.0, 0.1).save(path)
    return path


@pytest.mark.parametrize("share", [0.0, 0.5, 0.999])
def test_weights_that_are_cut_short_are_one_line(tmp_path, model, share):
    (tmp_path / "scene.yaml").write_text(SCENE)
    content = model.read_bytes()
    model.write_bytes(content[: int(share * len(content))])
    done = run("simulate", tmp_path / "scene.yaml", "-o", tmp_path / "out", "--model", model)
    assert done.exit_code == 1 and done.stderr.startswith(f"error: {model}: not a model of this version of sdfsim")
    assert "Traceback" not in done.stderr and not (tmp_path / "out").exists()


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


RECORDS = [
    ("volume", float("nan")), ("volume", "much"), ("com", [0, 0]), ("com", [0, 0, float("inf")]), ("inertia", [[1]]),
    ("certificate", 3), ("sdf", None), ("sdf", {"kind": "spline"}), ("version", 99),
    ("sdf.scale", 0.0), ("sdf.scale", -1.0), ("sdf.centre", [0]), ("sdf.centre", [float("nan")] * 3),
    ("sdf.kind", "mlp"),
]  # fmt: skip


@pytest.mark.parametrize(("key", "value"), RECORDS, ids=str)
def test_a_record_that_says_nonsense_is_one_line(tmp_path, key, value):
    folder = with_sdf(analytic_shape("box", size=(1, 1, 1)), "grid", resolution=8).save(tmp_path)
    record = json.loads((folder / RECORD_FILE).read_text())
    *way, last = key.split(".")
    place = record[way[0]] if way else record
    place[last] = value
    (folder / RECORD_FILE).write_text(json.dumps(record))
    with pytest.raises(SdfsimError):
        load_shape(folder)


@pytest.mark.parametrize("change", ["flat", "uneven", "whole numbers", "not finite", "no bounds", "far bounds"])
def test_weights_of_the_wrong_form_are_one_line(tmp_path, change):
    folder = with_sdf(analytic_shape("box", size=(1, 1, 1)), "grid", resolution=8).save(tmp_path)
    tensors = load_file(folder / WEIGHTS_FILE)
    grid = tensors["grid"]
    if change == "no bounds":
        del tensors["bounds"]
    elif change == "far bounds":
        tensors["bounds"] = tensors["bounds"] * float("nan")
    else:
        forms = {"flat": grid.reshape(-1), "uneven": grid[:4], "whole numbers": grid.int(), "not finite": grid / 0}
        tensors["grid"] = forms[change].contiguous()
    save_file(tensors, folder / WEIGHTS_FILE)
    with pytest.raises(SdfsimError):
        load_shape(folder)


@pytest.mark.parametrize("name", [WEIGHTS_FILE, MESH_FILE, RECORD_FILE])
def test_a_damaged_cache_entry_is_made_again(tmp_path, name):
    file, kept = tmp_path / "a.ply", tmp_path / "cache"
    file.write_bytes(write_ply(box()))
    shape_module.shape_from_mesh(file, kept, sdf="grid", resolution=8)
    (entry,) = kept.iterdir()
    whole = (entry / name).read_bytes()
    (entry / name).write_bytes(whole[: len(whole) // 2])
    assert shape_module.shape_from_mesh(file, kept, sdf="grid", resolution=8).volume == pytest.approx(1.0)
    assert list(kept.iterdir()) == [entry] and (entry / name).read_bytes() == whole


def test_a_training_checkpoint_that_is_cut_short_is_one_line(tmp_path, monkeypatch):
    from sdfsim.training import train
    from tests.hard_cases import crashing
    from tests.hard_cases.test_crash_commands import write_cubes

    monkeypatch.setattr(train, "PRESETS", dict(train.PRESETS))
    monkeypatch.setattr(train, "CHECKPOINT_SECONDS", train.CHECKPOINT_SECONDS)
    crashing.tiny_train()
    write_cubes(tmp_path / "data")
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


def test_a_lock_leaves_no_folder_behind_that_nothing_came_into(tmp_path):
    with pytest.raises(SdfsimError), locked(tmp_path / "new"):
        raise SdfsimError("nothing came of it")
    assert not (tmp_path / "new").exists()
    (tmp_path / "old").mkdir()
    with locked(tmp_path / "old"):
        pass
    assert (tmp_path / "old").is_dir()
