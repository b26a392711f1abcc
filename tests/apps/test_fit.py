"""Many meshes at once: in processes, on a cluster."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from joblib import parallel_config

from sdfsim.apps.fit import fit, named_meshes
from sdfsim.base.errors import SdfsimError
from sdfsim.base.parallel import cluster, parallel
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.sdf.baked_grid import baked
from sdfsim.shape.make import mesh_shape, remarks, shape_from_mesh
from sdfsim.shape.shape import load_shape
from tests.helpers.command import run


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    folder = tmp_path / "meshes"
    folder.mkdir()
    box = primitives.box()
    for name, mesh in (("ball", primitives.sphere()), ("box", box), ("holed", Mesh(box.vertices, box.faces[1:]))):
        (folder / f"{name}.ply").write_bytes(write_ply(mesh))
    (folder / "notes.txt").write_text("not a mesh")
    (folder / "torn.obj").write_text("v 0 0")
    return folder


def test_a_folder_of_meshes_becomes_a_folder_of_shapes(meshes: Path, tmp_path: Path) -> None:
    out = tmp_path / "shapes"
    arguments = ["fit", str(meshes), "-o", str(out), "--budget", "0.3s", "--device", "cpu"]
    done = run(*arguments)
    assert done.exit_code == 1
    assert "holed: failed: " in done.stdout and "torn: failed: " in done.stdout
    assert "box: errors" in done.stdout and "ball: errors" in done.stdout
    assert load_shape(out / "box").volume == pytest.approx(1.0)
    ball = load_shape(out / "ball")
    grid = baked(ball.sdf, ball.nodes)
    assert (
        ball.certificate["baked_error"] * float(np.ptp(ball.sdf.bounds, axis=0).max()) == pytest.approx(grid.error)
        and grid.error > 0
    )
    assert not (out / "holed").exists()

    # Again: what is there is kept, the others are tried once more; with what was missing they succeed.
    (meshes / "torn.obj").unlink()
    written = (out / "box" / "shape.json").stat().st_mtime_ns
    found = run(*arguments, "--json")
    report = json.loads(found.stdout)
    assert list(report["shapes"]) == ["ball", "box", "holed"]
    assert (out / "box" / "shape.json").stat().st_mtime_ns == written
    assert report["shapes"]["box"]["error_in_box"] == load_shape(out / "box").certificate["error_in_box"]


def test_units_are_those_of_a_scene_file_and_odd_sizes_are_reported(tmp_path: Path) -> None:
    size, file, out = np.array([20.0, 30.0, 40.0]), tmp_path / "box.ply", tmp_path / "box"
    file.write_bytes(write_ply(primitives.box((20.0, 30.0, 40.0))))
    arguments = [
        "fit",
        str(file),
        "-o",
        str(out),
        "--recipe",
        "quick",
        "--budget",
        "1s",
        "--device",
        "cpu",
        "--units",
        "cm",
    ]
    assert "--units" not in run(*arguments).stdout
    shape = load_shape(out)
    np.testing.assert_allclose(np.ptp(shape.mesh.vertices, axis=0), 0.01 * size)
    assert shape.volume == pytest.approx(0.024)
    # Other options, or units, are another fit; without units, 40 m are a question.
    for options, same in ((arguments, True), ([*arguments, "--cap"], False), (arguments[:-2], False)):
        before = (out / "shape.json").stat().st_mtime_ns
        told = run(*options).stdout
        assert ((out / "shape.json").stat().st_mtime_ns == before) == same
    assert "it is 40 m wide in metres; if its unit is millimetres, give --units mm" in told
    for size, metres, given, note in (
        (4.9, 1.0, False, ""), (5.1, 1.0, False, "it is 5.1 m wide"), (80.0, 1.0, True, ""), (5.1, 0.001, True, ""),
        (400.0, 1.0, True, "it is 400 m wide; if that is wrong, give the file's unit with --units"),
    ):  # fmt: skip
        told = "\n".join(remarks(file, primitives.box((size, 1.0, 1.0)), metres, given=given))
        assert ("--units" in told) == bool(note) and note in told


def test_python_is_warned_of_what_the_command_prints(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "lid.ply").write_bytes(write_ply(primitives.box((20.0, 30.0, 40.0))))
    how: dict = {"recipe": "quick", "budget": 1.0, "device": "cpu"}
    fit(tmp_path / "lid.ply", tmp_path / "seen", **how, on_progress=lambda fraction, message: None)
    assert "m wide" not in caplog.text
    for _ in range(2):
        fit(tmp_path / "lid.ply", tmp_path / "lid", **how)
    assert caplog.text.count("lid: it is 40 m wide in metres; if its unit is millimetres") == 1


def test_an_error_names_the_mesh_and_not_the_folder(tmp_path: Path) -> None:
    box = primitives.box()
    (tmp_path / "holed.ply").write_bytes(write_ply(Mesh(box.vertices, box.faces[2:])))
    done = run("fit", str(tmp_path / "holed.ply"), "-o", str(tmp_path / "out"), "--device", "cpu")
    assert done.exit_code == 1 and f"{tmp_path / 'holed.ply'}: not a solid" in done.stderr
    for kind in ("grid", "mesh"):
        with pytest.raises(SdfsimError, match=r"holed\.ply: not a solid"):
            shape_from_mesh(tmp_path / "holed.ply", tmp_path / "cache", sdf=kind)


def test_a_turned_gltf_is_reported(tmp_path: Path) -> None:
    mesh_shape(primitives.box((0.3, 0.2, 0.1)), name="box", kind="mesh").save(tmp_path / "box")
    done = run("export", str(tmp_path / "box"), "-o", str(tmp_path / "box.glb"))
    assert "z up is turned to glTF's y up" in done.stdout
    arguments = [
        "fit",
        str(tmp_path / "box.glb"),
        "-o",
        str(tmp_path / "again"),
        "--recipe",
        "quick",
        "--budget",
        "1s",
        "--device",
        "cpu",
    ]
    assert "glTF has y up: it is turned to z up" in run(*arguments).stdout
    np.testing.assert_allclose(np.ptp(load_shape(tmp_path / "again").mesh.vertices, axis=0), [0.3, 0.2, 0.1], atol=1e-6)


def test_names(meshes: Path, tmp_path: Path) -> None:
    (meshes / "._ball.ply").write_bytes(b"\0\5\x16\7")  # of macOS
    (meshes / "__MACOSX").mkdir()
    assert list(named_meshes([meshes])) == ["ball", "box", "holed", "torn"]
    twins = []
    for name in ("cow", "cat"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "visual.obj").write_text("")
        twins.append(tmp_path / name / "visual.obj")
    assert list(named_meshes([*twins, *twins, meshes / "box.ply"])) == ["cow", "cat", "box"]
    (tmp_path / "cow" / "visual.ply").write_text("")
    with pytest.raises(SdfsimError, match="both become cow"):
        named_meshes([tmp_path / "cow" / "visual.ply", *twins])
    (tmp_path / "empty").mkdir()
    with pytest.raises(SdfsimError, match="no mesh files"):
        named_meshes([tmp_path / "empty"])


def where(number: int) -> tuple[int, int, int]:
    if number == 13:
        raise ValueError("unlucky")
    return number * number, os.getpid(), torch.get_num_threads()


def test_work_is_spread_over_processes_of_one_thread() -> None:
    with parallel_config(backend="loky"):
        found = dict(parallel(where, [(n,) for n in range(6)]))
    assert [found[n][0] for n in range(6)] == [n * n for n in range(6)]
    assert all(pid != os.getpid() and threads == 1 for _, pid, threads in found.values())
    assert list(parallel(where, [])) == []
    with pytest.raises(ValueError, match="unlucky"):
        list(parallel(where, [(n,) for n in range(10, 20)]))


def test_the_same_call_works_on_a_cluster(monkeypatch) -> None:
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as engine:
        with cluster(engine.scheduler_address):
            found = dict(parallel(where, [(n,) for n in range(8)]))
        workers = {worker.pid for worker in engine.workers.values()}
    assert len(found) == 8 and {pid for _, pid, _ in found.values()} <= workers
    monkeypatch.setattr("sdfsim.base.parallel.SCHEDULER_ANSWERS", 0.5)
    with pytest.raises(SdfsimError, match="no scheduler"), cluster("tcp://127.0.0.1:1"):
        pass
