"""Scene files that are wrong are told about line by line."""

from dataclasses import replace

import numpy as np
import pytest

from sdfsim import Scene, SceneError, load_scene
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.shape.make import analytic_shape
from tests.helpers.scene_files import HEAD, problems_of

BODY = [
    ("mass: -0.3", "bodies[0].mass: must be > 0 (got -0.3 kg)"),
    ("mass: .nan", "bodies[0].mass: must be a number in kg (got '.nan')"),
    ("mass: 1e308", "bodies[0].mass: must be <= 1e+12 (got 1e308 kg)"),
    ("mass: '1'", "bodies[0].mass: must be a number in kg (got '1')"),
    ("mass:", "bodies[0].mass: must be a number in kg (got nothing)"),
    ("mass: 1, density: 2", "bodies[0].density: give only one of mass, density (got mass and density)"),
    ("restitution: 1.5", "bodies[0].restitution: must be <= 1 (got 1.5)"),
    ("positon: [0, 0, 0]", "bodies[0].positon: unknown key (did you mean 'position'?)"),
    ("position: [0, 0]", "bodies[0].position: must be 3 numbers (got 2)"),
    ("position: 0.5", "bodies[0].position: must be 3 numbers (got 0.5)"),
    ("quat_xyzw: none", "bodies[0].quat_xyzw: must be 4 numbers (got 'none')"),
    ("position: [0, inf, 0]", "bodies[0].position[1]: must be a number in m (got 'inf')"),
    ("motion: static, velocity: [0, 0, 1]", "bodies[0].velocity: must be zero: a static body does not move"),
    ("motion: driven", "bodies[0].motion: must be one of static, dynamic, kinematic (got 'driven')"),
    ("quat_xyzw: [0, 0, 0, 0]", "bodies[0].quat_xyzw: must not be zero"),
    ("collides_with: [flor]", "bodies[0].collides_with[0]: no body is called 'flor' (did you mean 'floor'?)"),
    ("avoids: [flor]", "bodies[0].avoids[0]: no body is called 'flor' (did you mean 'floor'?)"),
    ("collides_with: none", "bodies[0].collides_with: must be all, or a list of names (got 'none')"),
    ("count: 2.5", "bodies[0].count: must be a whole number (got 2.5)"),
    ("count: 3", "bodies[0].count: needs arrange: {grid: [nx, ny, nz], spacing: metres} (got 3 at one place)"),
    ("arrange: {grid: [2, 2, 2]}", "bodies[0].arrange.spacing: is required"),
    ("mass: !!python/object/apply:os.getcwd []", None),
]


@pytest.mark.parametrize(("fields", "fault"), BODY)
def test_a_wrong_body_is_reported_with_its_line(load, fields, fault):
    text = f"{HEAD}  - {{name: a, shape: ball, {fields}}}\n  - {{name: floor, motion: static, plane: {{}}}}\n"
    found = problems_of(load, text)
    if fault is not None:
        assert found == [f"scene.yaml:5: {fault}"]


FILES = [
    ("", ["scene.yaml:1: the file is empty"]),
    ("- 1\n", ["scene.yaml:1: must be a mapping (got a list)"]),
    ("version: 1\nbodies: []\n", ["scene.yaml:2: bodies: must have at least 1 entry (got 0)"]),
    ("bodies: [{name: a, plane: {}}]\n", ["scene.yaml:1: version: is required"]),
    ("version: 1\n", ["scene.yaml:1: bodies: is required"]),
    ("version: 1\nversion: 1\nbodies: []\n", ["scene.yaml:2: version: the key appears twice (first on line 1)"]),
    ("version: 1\nbodies: [\n", ["scene.yaml:3: not valid YAML: "]),
    ("version: 1\nbodies:\n\t- {}\n", ["scene.yaml:3: not valid YAML: "]),
    ("a: &a [*a]\n", ["scene.yaml:1: a: unknown key"]),
]


@pytest.mark.parametrize(("text", "faults"), FILES)
def test_a_wrong_file_is_reported_with_its_line(load, text, faults):
    found = problems_of(load, text)
    for fault in faults:
        assert any(line.startswith(fault) for line in found), found


TOP = [
    ("version: 2", "version: must be 1 (got 2)"),
    ("effects: {frictoin: off}", "effects.frictoin: unknown key (did you mean 'friction'?)"),
    ("effects: {sleep: maybe}", "effects.sleep: must be one of auto, on, off (got 'maybe')"),
    ("limits: {memory_gib: 1}", "limits: unknown key"),
    ("shapes: {cup: {asset: nowhere}}", "shapes.cup.asset: no such folder: FOLDER/nowhere"),
    ("shapes: {cup: {sphere: {}}}", "shapes.cup.sphere.radius: is required"),
    (
        "shapes: {cup: {}}",
        "shapes.cup: one of asset, mesh, primitive, sphere, capsule, cylinder, box, cone, torus, plane, parts is",
    ),
    ("shapes: {cup: {sphere: {radius: 1}, units: cm}}", "shapes.cup.units: is for mesh only"),
    ("shapes: {cup: {plane: {}, wall: 0.01}}", "shapes.cup.wall: is not for a plane"),
    ("shapes: {cup: {sphere: {radius: 1}, sdf: grid}}", "shapes.cup.sdf: is for asset, mesh, primitive only"),
    ("shapes: {cup: {sphere: {radius: 1}, centre: on}}", "shapes.cup.centre: is for asset, mesh, primitive only"),
    ("shapes: {cup: {primitive: {name: box}, resolution: 64}}", "shapes.cup.resolution: is for sdf: grid only"),
    ("shapes: {cup: {primitive: {name: tours}}}", "shapes.cup.primitive.name: no such primitive: 'tours'"),
]


@pytest.mark.parametrize(("line", "fault"), TOP)
def test_a_wrong_top_level_is_reported_with_its_line(load, tmp_path, line, fault):
    version = "" if line.startswith("version") else "version: 1\n"
    found = problems_of(load, f"# comment\n{version}{line}\nbodies:\n  - {{name: floor, plane: {{}}}}\n")
    where = "scene.yaml:2: " if not version else "scene.yaml:3: "
    assert any(f.startswith(where + fault.replace("FOLDER", str(tmp_path))) for f in found), found


def test_every_fault_is_reported_at_once_in_file_order(load):
    found = problems_of(
        load,
        "version: 3\nduration: -1\nshapes:\n  ball: {sphere: {radius: 0.1}}\nbodies:\n"
        "  - {name: a, shape: bal, mass: 0}\n  - name: a\n    shape: ball\n    velocity: [1, 2]\n",
    )
    assert found == [
        "scene.yaml:1: version: must be 1 (got 3)",
        "scene.yaml:2: duration: must be > 0 (got -1 s)",
        "scene.yaml:6: bodies[0].shape: no shape is called 'bal' (did you mean 'ball'?)",
        "scene.yaml:6: bodies[0].mass: must be > 0 (got 0 kg)",
        "scene.yaml:7: bodies[1].name: two bodies are called 'a' (the first is bodies[0])",
        "scene.yaml:9: bodies[1].velocity: must be 3 numbers (got 2)",
    ]


def test_what_is_missing_or_no_scene_file_is_refused(tmp_path):
    (tmp_path / "bytes.yaml").write_bytes(b"version: 1\n\xff\xfe")
    (tmp_path / "deep.yaml").write_text("[" * 5_000)
    for name, told in (
        ("scene.yaml", "no such file"), (".", "cannot be read"), ("bytes.yaml", r"bytes\.yaml:2: not UTF-8 text"),
        ("deep.yaml", "not valid YAML"),
    ):  # fmt: skip
        with pytest.raises(SceneError, match=told):
            load_scene(tmp_path / name)


def test_a_broken_asset_is_reported_at_its_line(load, tmp_path):
    (tmp_path / "cup").mkdir()
    found = problems_of(load, "version: 1\nshapes:\n  c: {asset: cup}\nbodies:\n  - {name: a, shape: c, mass: 1}\n")
    assert len(found) == 1 and found[0].startswith("scene.yaml:3: shapes.c.asset: ")


@pytest.mark.parametrize("change", [{"volume": 0.0}, {"volume": -1.0}, {"nodes": np.zeros((0, 3))}])
def test_a_shape_that_cannot_move_is_reported_where_it_should(load, tmp_path, change):
    replace(analytic_shape("box", size=(1, 1, 1)), **change).save(tmp_path / "cup")
    text = "version: 1\nshapes:\n  c: {asset: cup}\nbodies:\n  - {name: a, shape: c, mass: 1MOTION}\n"
    found = problems_of(load, text.replace("MOTION", ""))
    assert len(found) == 1 and found[0].startswith("scene.yaml:5: bodies[0].name: cannot move: its shape has ")
    assert load(text.replace("MOTION", ", motion: static")).bodies[0].motion == "static"


def test_a_model_file_is_taken_from_the_scenes_folder(tmp_path):
    file = tmp_path / "scene.yaml"
    body = "bodies:\n  - {name: floor, plane: {}}\n"
    for said, meant in (
        ("model: models/mine.safetensors", str(tmp_path / "models/mine.safetensors")),
        ("model: /models/mine.safetensors", "/models/mine.safetensors"),
        ("model: gnn", "gnn"),
        ("effects: {sleep: off}", None),
    ):
        file.write_text(f"version: 1\n{said}\n{body}")
        assert load_scene(file, allow_outside=True).model == meant


def test_a_shape_that_is_not_exact_is_named(load, monkeypatch):
    text = "version: 1\nshapes:\n  b: {primitive: {name: box}}\nbodies:\n  - {name: a, shape: b}\n"
    for certificate, told in (
        ({}, ((), ())),
        ({"passed": True, "reason": "", "caveat": ""}, ((), ())),
        ({"passed": True, "reason": "", "caveat": "rough"}, ((), ("b: rough",))),
        ({"passed": False, "reason": "thin walls", "caveat": ""}, (("b: thin walls",), ())),
    ):
        shape = replace(analytic_shape("box", size=(1, 1, 1), name="b"), certificate=certificate)
        monkeypatch.setattr("sdfsim.scene.load.shape_from_primitive", lambda *a, shape=shape, **k: shape)
        scene = load(text)
        assert (scene.missed, scene.caveats) == told


def test_a_wrong_kind_of_sdf_is_one_fault_not_two(load):
    shape = "{primitive: {name: box}, sdf: voxel, resolution: 16}"
    assert len(problems_of(load, f"version: 1\nshapes:\n  b: {shape}\nbodies:\n  - {{name: a, shape: b}}\n")) == 1


def test_a_mesh_without_units_is_asked_for_them_where_it_is_large(tmp_path, caplog):
    (tmp_path / "part.ply").write_bytes(write_ply(primitives.box((80.0, 40.0, 5.0))))
    for units, size, note in (("", 80.0, True), (", units: mm", 0.08, False), (", units: m", 80.0, False)):
        (tmp_path / "scene.yaml").write_text(
            f"version: 1\nshapes:\n  p: {{mesh: part.ply, sdf: mesh{units}}}\nbodies:\n  - {{name: a, shape: p}}\n"
        )
        scene = load_scene(tmp_path / "scene.yaml")
        assert np.ptp(scene.shapes[0].mesh.vertices, axis=0).max() == pytest.approx(size)
        told = ("p: it is 80 m wide in metres; if its unit is millimetres, give --units mm (units: mm)",)
        assert scene.notes == (told if note else ())
    load_scene(tmp_path / "scene.yaml")
    # Who calls from Python sees no notes: it is warned of, once.
    assert [record.getMessage() for record in caplog.records if "units" in record.getMessage()] == list(told)


@pytest.mark.parametrize("shown", [False, True])
def test_python_warns_of_a_mesh_in_millimetres_that_a_scene_of_its_own_has(tmp_path, caplog, shown):
    name = f"plate{shown}"
    (tmp_path / "plate.ply").write_bytes(write_ply(primitives.box((120.0, 40.0, 5.0))))
    built = Scene().add(name, mesh=tmp_path / "plate.ply", sdf="mesh", motion="static")
    for _ in range(2):
        built.load(*([lambda fraction, message: None] if shown else []))
    assert caplog.text.count(f"{name}: it is 120 m wide in metres") == (not shown)
