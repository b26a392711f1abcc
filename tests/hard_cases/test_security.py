"""Files from strangers reach nothing outside, run nothing and take no absurd memory; those that claim more than they
hold, are cut short or changed, and two runs in one folder, end in one clear line; viewers stay on this machine."""

import ast
import json
import struct
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file, save_file

from sdfsim import SceneError, SdfsimError, load_scene, load_shape
from sdfsim.apps import viewer
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

ROOT = Path(__file__).resolve().parents[2]
OUTSIDE = "leads out of the scene's folder"


def sources() -> list[Path]:
    places = [ROOT / "cli.py", *(p for room in ("sdfsim", "pipeline", "benchmarks", "samples", "scripts") for p in
              (ROOT / room).rglob("*.py"))]  # fmt: skip
    return [path for path in places if path.is_file()]


BANNED_MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "shelve", "marshal"}
BANNED_CALLS = {"eval", "exec", "os.system", "os.popen", "joblib.load", "yaml.load", "yaml.load_all",
                "yaml.full_load", "yaml.unsafe_load", "pandas.read_pickle", "np.fromregex"}  # fmt: skip
SAFE_ARGUMENTS = {"np.load": ("allow_pickle", "False"), "numpy.load": ("allow_pickle", "False"),
                  "yaml.compose": ("Loader", "yaml.SafeLoader"), "torch.load": ("weights_only", "True")}  # fmt: skip


def unsafe(source: str) -> list[str]:
    """Calls in a source that run what a file says, or could."""
    found = []
    for node in ast.walk(ast.parse(source)):
        modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        modules += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        found += [f"import {name}" for name in modules if name.split(".")[0] in BANNED_MODULES]
        if not isinstance(node, ast.Call):
            continue
        name, given = ast.unparse(node.func), {k.arg: ast.unparse(k.value) for k in node.keywords}
        key, safe = SAFE_ARGUMENTS.get(name, ("", ""))
        if name in BANNED_CALLS or (key and given.get(key) != safe):
            found.append(ast.unparse(node))
        if given.get("shell") == "True" or name.endswith("extractall"):
            found.append(ast.unparse(node))
    return found


def test_nothing_in_the_sources_runs_what_a_file_says():
    found = {str(path.relative_to(ROOT)): calls for path in sources() if (calls := unsafe(path.read_text()))}
    assert len(sources()) > 100 and found == {}


@pytest.fixture
def home(tmp_path) -> Path:
    """A scene's folder with a mesh, an asset and a model inside, and others beside it."""
    for place in (tmp_path / "home", tmp_path / "other"):
        place.mkdir()
        (place / "cube.ply").write_bytes(write_ply(box()))
        analytic_shape("box", size=(1, 1, 1)).save(place / "crate")
        tiny_model(place / "tiny.safetensors")
    return tmp_path / "home"


def scene_in(home: Path, line: str, shape: str = "box: {size: [1, 1, 1]}") -> Path:
    file = home / "scene.yaml"
    body = "bodies: [{name: floor, plane: {}}, {name: a, shape: thing, position: [0, 0, 2]}]"
    file.write_text(f"version: 1\nduration: 0.04\n{line}\nshapes: {{thing: {{{shape}}}}}\n{body}\n")
    return file


WAYS_OUT = ["../other/{name}", "{other}/{name}", "linked/{name}"]


@pytest.mark.parametrize("way", WAYS_OUT)
@pytest.mark.parametrize(("kind", "name"), [("mesh", "cube.ply"), ("asset", "crate"), ("model", "tiny.safetensors")])
def test_paths_in_a_scene_stay_in_its_folder(home, way, kind, name):
    other = home.parent / "other"
    (home / "linked").symlink_to(other)
    path = way.format(other=other, name=name)
    line, shape = (f"model: {path}", "box: {size: [1, 1, 1]}") if kind == "model" else ("", f"{kind}: {path}")
    file = scene_in(home, line, shape + (", sdf: mesh" if kind == "mesh" else ""))
    with pytest.raises(SceneError, match=OUTSIDE) as caught:
        load_scene(file)
    assert len(caught.value.problems) == 1 and "--allow-outside" in caught.value.problems[0]
    assert len(load_scene(file, allow_outside=True).bodies) == 2


def test_a_file_of_a_shape_folder_may_not_lead_outside(home):
    (home / "crate" / "mesh.ply").unlink()
    (home / "crate" / "mesh.ply").symlink_to(home.parent / "other" / "crate" / "mesh.ply")
    with pytest.raises(SceneError, match=OUTSIDE):
        load_scene(scene_in(home, "", "asset: crate"))


def test_paths_that_stay_inside_are_taken_however_they_are_written(home, tmp_path):
    (tmp_path / "elsewhere").symlink_to(home)
    for path in ("crate", "./crate", "../home/crate", str(home / "crate"), "crate/../crate"):
        assert load_scene(scene_in(home, "", f"asset: {path}")).shapes
        assert load_scene(tmp_path / "elsewhere" / "scene.yaml").shapes


def test_the_commands_take_paths_outside_only_when_told(home, tmp_path):
    file = str(scene_in(home, "model: tiny.safetensors", "asset: ../other/crate"))
    for command in (["plan", file], ["simulate", file, "-o", str(tmp_path / "run"), "--viewer", "none"]):
        refused = run(*command)
        assert refused.exit_code == 1 and OUTSIDE in refused.stderr and not (tmp_path / "run").exists()
        assert run(*command, "--allow-outside").exit_code == 0
    assert "allow_outside: true" in (tmp_path / "run" / "config.yaml").read_text()


def test_the_side_files_of_a_mesh_stay_in_its_folder(home):
    secret = home.parent / "other" / "secret.bin"
    secret.write_bytes(np.eye(3, dtype="<f4").tobytes())
    view = {"buffer": 0, "byteOffset": 0, "byteLength": 36}
    accessor = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
    gltf = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "accessors": [accessor],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}], "bufferViews": [view],
    }  # fmt: skip
    for uri, fine in (("near.bin", True), ("../other/secret.bin", False), (str(secret), False)):
        (home / "near.bin").write_bytes(secret.read_bytes())
        (home / "a.gltf").write_text(json.dumps(gltf | {"buffers": [{"byteLength": 36, "uri": uri}]}))
        if fine:
            assert len(load_mesh(home / "a.gltf").vertices) == 3
        else:
            with pytest.raises(SdfsimError, match="not a readable mesh"):
                load_mesh(home / "a.gltf")


def test_what_a_scene_says_cannot_command_the_terminal(home):
    file = scene_in(home, '"\\e[2J\\e]0;owned\\a": 1')
    said = run("plan", str(file)).stderr
    assert "unknown key" in said and all(c.isprintable() or c == "\n" for c in said)


BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{n}: &{n} [{', '.join([f'*{m}'] * 10)}]\n" for m, n in zip("abcdef", "bcdefg", strict=True)
)
BODIES = "version: 1\nbodies: &b\n" + "- &a {name: x, motion: kinematic, path: *b}\n" + "- *a\n" * 3000


@pytest.mark.parametrize("text", [BOMB, BODIES], ids=["aliases of aliases", "a list in its own entries"])
def test_aliases_cannot_multiply_a_scene(tmp_path, text):
    (tmp_path / "scene.yaml").write_text(text)
    with time_limit(20.0), pytest.raises(SceneError, match="repeated aliases included"):
        load_scene(tmp_path / "scene.yaml")


def test_a_scene_has_its_limits(tmp_path):
    file = tmp_path / "scene.yaml"
    with open(file, "wb") as handle:
        handle.truncate(2**30)  # takes no room on the disk
    with pytest.raises(SceneError, match="too large for a scene"):
        load_scene(file)
    head = "version: 1\nshapes: {b: {sphere: {radius: 1}}}\nbodies:\n"
    entry = "- {{name: b{0}, shape: b, arrange: {{grid: [99999, 1, 1], spacing: 3}}}}\n"
    file.write_text(head + "".join(entry.format(n) for n in range(3)))
    with pytest.raises(SceneError, match="at most 100000 bodies") as caught:
        load_scene(file)
    assert len(caught.value.problems) == 1
    with pytest.raises(SceneError, match="cannot be read: not a file"):
        load_scene(Path("/dev/zero"))


def listening(port: int) -> list[str]:
    """Addresses at which something listens on a port."""
    found = []
    for table, length in (("tcp", 8), ("tcp6", 32)):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            _, local, _, state, *_ = line.split()
            address, number = local.split(":")
            if state == "0A" and int(number, 16) == port:
                raw = bytes.fromhex(address[:length])
                found.append(".".join(str(b) for b in raw[::-1]) if table == "tcp" else address)
    return found


@pytest.mark.skipif(sys.platform != "linux", reason="/proc/net, which tells who listens where, exists on Linux only")
def test_the_live_viewer_listens_on_this_machine_only(home, monkeypatch):
    from sdfsim.apps.recording import Playback

    monkeypatch.setattr(viewer, "has_screen", lambda: False)
    playback = Playback(load_scene(scene_in(home, "")))
    page = viewer.stream_to_viewer(playback, "web")
    ports = [int(part.split("?")[0].split("/")[0]) for part in page.split(":") if part[:1].isdigit()]
    assert len(ports) == 2
    assert [listening(port) for port in ports] == [["127.0.0.1"], ["127.0.0.1"]]


# Writes what it was told, and answers where a page was wanted, once.
VIEWER = """\
import socket, sys
open("TOLD", "w").write(" ".join(sys.argv[1:]))
if "--web-viewer-port" in sys.argv:
    page = socket.create_server(("127.0.0.1", int(sys.argv[sys.argv.index("--web-viewer-port") + 1])))
    page.accept()
"""


@pytest.mark.parametrize("web", [False, True])
def test_every_viewer_is_told_where_to_listen(tmp_path, monkeypatch, web):
    (tmp_path / "a.rrd").write_bytes(b"RRF2")
    told = tmp_path / "told"
    fake = tmp_path / "rerun"
    fake.write_text(f"#!{sys.executable}\n{VIEWER.replace('TOLD', str(told))}")
    fake.chmod(0o755)
    monkeypatch.setattr(viewer, "viewer_program", lambda: str(fake))
    monkeypatch.setattr(viewer, "has_screen", lambda: True)
    done = run("view", str(tmp_path / "a.rrd"), *(["--web"] if web else []))
    assert done.exit_code == 0 and "--bind 127.0.0.1 " in told.read_text()
    assert ("watch it at http://localhost:" in done.stderr) == web


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
