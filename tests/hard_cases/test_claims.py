"""Files that claim more than they hold, are cut short or changed, and two runs in one folder: one clear line each."""

import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file, save_file

from sdfsim import SdfsimError, load_shape
from sdfsim.base import files
from sdfsim.base.files import LOCK, locked, read_arrays
from sdfsim.geometry.mesh_io import load_mesh, write_ply
from sdfsim.geometry.primitives import box
from sdfsim.learned.model import load_model
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import MESH_FILE, RECORD_FILE, WEIGHTS_FILE, with_sdf
from tests.hard_cases.strangers import time_limit
from tests.helpers.command import run
from tests.helpers.scenes import tiny_model


def header_of(tensors: dict, metadata: dict | None = None) -> bytes:
    text = json.dumps(tensors | ({"__metadata__": metadata} if metadata else {})).encode()
    return struct.pack("<Q", len(text)) + text


def test_weights_cannot_claim_what_is_not_there(tmp_path):
    analytic_shape("box", size=(1, 1, 1)).save(tmp_path)
    huge = {"dtype": "F32", "shape": [10**6, 10**6], "data_offsets": [0, 4 * 10**12]}
    for content in (header_of({"nodes": huge}) + b"\0" * 64, struct.pack("<Q", 2**62) + b"{}", b"", b"\x80\x04pickle"):
        (tmp_path / "shape.safetensors").write_bytes(content)
        with pytest.raises(SdfsimError, match=r"shape\.safetensors: damaged or cut short"):
            load_shape(tmp_path)
        (tmp_path / "model.safetensors").write_bytes(content)
        with pytest.raises(SdfsimError, match="not a model"):
            load_model(tmp_path / "model.safetensors")


CLAIMS = [
    {"config": {"width": 60_000, "rounds": 6}},
    {"config": {"width": 8, "rounds": 10**9}},
    {"config": {"width": 16, "rounds": 1}},
    {"config": {"width": "8"}},
    {"config": None},
    {"kind": "unknown"},
    {"dt": 0.0},
    {"dt": "fast"},
    {"length": float("nan")},
    {"unknown": 1},
]


@pytest.mark.parametrize("claim", CLAIMS, ids=str)
def test_a_model_is_what_its_weights_are(tmp_path, claim):
    file = tiny_model(tmp_path / "model.safetensors")
    weights = load_file(file)
    from safetensors import safe_open

    with safe_open(file, framework="pt") as handle:
        info = json.loads(handle.metadata()["sdfsim_model"])
    assert load_model(file).dt == 0.02
    save_file(weights, file, {"sdfsim_model": json.dumps(info | claim)})
    with time_limit(20.0), pytest.raises(SdfsimError, match="not a model of this version"):
        load_model(file)


def npy_header(shape: str, version: int = 1) -> bytes:
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H" if version == 1 else "<I", len(text)) + text


def test_arrays_cannot_claim_what_is_not_there(tmp_path):
    file = tmp_path / "a.npz"
    for shape in ("(101,)", "(1000000000,)", "(1000000000000,)", "(1000000, 1000000, 1000000)", "(-1,)", "('a',)"):
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("a.npy", npy_header(shape) + b"\0" * 800)
        with pytest.raises(SdfsimError, match="cannot be read as arrays"):
            read_arrays(file, "arrays")


def test_an_archive_cannot_be_a_bomb(tmp_path, monkeypatch):
    file = tmp_path / "a.npz"
    np.savez_compressed(file, a=np.zeros(10**6))  # packed a thousandfold, and harmless
    assert read_arrays(file, "arrays")["a"].shape == (10**6,)
    monkeypatch.setattr(files, "FREELY", 10**6)  # bytes; the real limit would take a second to fill
    with pytest.raises(SdfsimError, match="would unpack to"):
        read_arrays(file, "arrays")
    np.savez_compressed(file, a=np.random.default_rng(0).normal(size=10**6))  # large, and really there
    assert read_arrays(file, "arrays")["a"].shape == (10**6,)


def test_arrays_are_never_objects(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.array([{"a": 1}], dtype=object))
    with pytest.raises(SdfsimError, match="cannot be read as arrays"):
        read_arrays(tmp_path / "a.npz", "arrays")


def test_a_gltf_cannot_claim_what_is_not_there(tmp_path):
    from tests.helpers.mesh_files import ORIGINALS, glb, taken_apart

    header, body = taken_apart(ORIGINALS["glb"])
    file = tmp_path / "a.glb"

    def refused(change, why: str) -> None:
        changed = json.loads(json.dumps(header))
        change(changed)
        file.write_bytes(glb(changed, body))
        with time_limit(20.0), pytest.raises(SdfsimError, match=why):
            load_mesh(file)

    def without_data(changed):
        del changed["accessors"][0]["bufferView"]
        changed["accessors"][0]["count"] = 10**12

    refused(without_data, "compressed")

    def sparse(changed):
        without_data(changed)
        few = {"bufferView": 0, "componentType": 5121}
        changed["accessors"][0]["sparse"] = {"count": 1, "indices": few, "values": few}

    refused(sparse, "has no data")
    refused(lambda changed: changed["bufferViews"][0].update(byteStride=0), "accessor")

    def copied(changed):
        changed["nodes"] = [{"mesh": 0}] * 1000
        for accessor in changed["accessors"]:
            accessor["count"] = 10**6

    refused(copied, "accessor")
    file.write_bytes(glb(header, body))
    assert len(load_mesh(file).vertices) == 64


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
