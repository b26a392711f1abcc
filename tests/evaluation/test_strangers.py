"""Strangers: what lies in a folder is taken for what it is, and what is wrong with one input stops no other."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from benchmarks import records, strangers
from benchmarks.records import read_record
from benchmarks.strangers import Failed, Found, Row, command, found_in, main, recorded
from sdfsim.base.errors import SdfsimError

SCENE = """version: 1
shapes: {block: {box: {size: [0.3, 0.2, 0.1]}}}
bodies:
  - {name: floor, motion: static, plane: {}, friction: 1.0}
  - {name: block, shape: block, position: [0, 0, 0.05]}
"""
FRICTION, G, SPEED = 0.3, 9.81, 2.0


def slide(file: Path) -> None:
    """A block that slides to a stop, in closed form."""
    end = SPEED / (FRICTION * G)
    lines = ["time,body,x,y,z,qx,qy,qz,qw"]
    for k in range(80):
        t = min(0.02 * k, end)
        lines.append(f"{0.02 * k:.2f},block,{SPEED * t - 0.5 * FRICTION * G * t**2:.9f},0,0.05,0,0,0,1")
    file.write_text("\n".join(lines) + "\n")


def photo(file: Path) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 8)).save(file)


def test_inputs_are_taken_for_what_they_are(tmp_path):
    for k in range(3):
        photo(tmp_path / "room" / f"{k}.jpg")
        photo(tmp_path / "set" / "images" / f"{k}.png")  # the folder above is given: masks may lie in it
        photo(tmp_path / "model" / f"texture{k}.png")
    photo(tmp_path / "two" / "0.jpg")
    of_all = "model/a.glb b.STL film.mp4 scan.r3d one/x.csv one/x.yaml all/x.csv all/y.npz all/scene.yaml lone/z.csv"
    for name in (*of_all.split(), "run/rollout.npz", "run/other.csv", "notes.txt", ".hidden/c.obj"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    found = {
        (one.kind, tuple(file.relative_to(tmp_path).as_posix() for file in one.files), one.scene and one.scene.name)
        for one in found_in(tmp_path)
    }
    assert found == {
        ("photos", ("room",), None), ("photos", ("set",), None), ("photos", ("film.mp4",), None),
        ("photos", ("scan.r3d",), None), ("mesh", ("model/a.glb",), None), ("mesh", ("b.STL",), None),
        ("recordings", ("one/x.csv",), "x.yaml"), ("recordings", ("all/x.csv", "all/y.npz"), "scene.yaml"),
        ("recordings", ("lone/z.csv",), None), ("recordings", ("run",), None),
    }  # fmt: skip


def test_what_failed_comes_first_and_then_what_is_faulty(tmp_path, monkeypatch):
    rows = [
        Row("fine.obj", "mesh", "fitted"),
        Row("bad.obj", "mesh", wrong=["not a | mesh"]),
        Row("odd.obj", "mesh", "fitted", wrong=["left the scene"]),
    ]
    monkeypatch.setattr(records, "RECORDS", tmp_path)
    recorded("mesh", rows)
    record = read_record("strangers_mesh")
    assert [row[0] for row in record.rows] == ["`bad.obj`", "`odd.obj`", "`fine.obj`"]
    assert record.rows[0][-1] == "not a / mesh" and record.notes == ["1 of 3 without a fault."]


def test_a_command_that_dies_or_hangs_says_how(monkeypatch):
    dies = "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)"
    for program, told in ((dies, "killed by signal 11"), ("import time; time.sleep(60)", "stopped after 1 s")):
        monkeypatch.setattr(strangers, "PROGRAM", program)
        with pytest.raises(Failed, match=told):
            command("fit", longest=1.0)


def test_an_error_of_a_command_is_its_line(tmp_path):
    with pytest.raises(Failed, match=r"simulate: .*nothing\.yaml.*no such"):
        command("simulate", tmp_path / "nothing.yaml", "-o", tmp_path / "run", longest=120.0)


def test_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(SdfsimError, match="no photos, meshes or recordings"):
        main(tmp_path, out=tmp_path / "out")


@pytest.mark.slow
def test_a_folder_of_all_kinds(tmp_path, monkeypatch):
    """A tilted box and a ring come to rest, a recording gives its friction; a mesh that is none has a line that says
    why, and an open one is capped."""
    import trimesh

    folder = tmp_path / "in"
    (folder / "slide").mkdir(parents=True)
    turned = trimesh.transformations.rotation_matrix(0.3, [1, 2, 3])
    trimesh.creation.box((0.1, 0.2, 0.05), transform=turned).export(folder / "box.stl")
    ring = trimesh.creation.annulus(30.0, 50.0, 20.0, sections=48)  # in no unit that is said
    ring.export(folder / "ring.ply")
    box = trimesh.creation.box((1, 1, 1))
    trimesh.Trimesh(box.vertices, box.faces[box.face_normals[:, 2] < 0.9]).export(folder / "open.obj")
    (folder / "bad.obj").write_text("v 0 0 0\nv 1 0 0\nf 1 2 3\n")
    slide(folder / "slide" / "way.csv")
    (folder / "slide" / "scene.yaml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(records, "RECORDS", tmp_path)
    main(Path("in"), out=Path("out"), longest=600.0)
    rows = {row["name"]: row for row in json.loads((tmp_path / "out" / "table.json").read_text())}
    assert rows.keys() == {"box.stl", "ring.ply", "open.obj", "bad.obj", "slide/way.csv"}
    for name in ("box.stl", "ring.ply", "open.obj"):
        assert rows[name]["rests"].startswith("1 of 1") and not rows[name]["wrong"], rows[name]
    assert rows["open.obj"]["became"] == "capped and fitted"
    assert rows["bad.obj"]["became"] == "nothing" and "bad.obj" in rows["bad.obj"]["wrong"][0]
    assert "windows repeated" in rows["slide/way.csv"]["became"]
    (off, *_), _ = (part.split() for part in rows["slide/way.csv"]["exact"].split(";"))
    assert float(off) < 2.0  # % of the size, of a motion that is known in closed form
    assert read_record("strangers_mesh").notes == ["3 of 4 without a fault."]


def test_a_mesh_that_no_cap_closes_became_nothing(tmp_path, monkeypatch):
    """Refused as open, and with --cap for another reason."""
    asked = []

    def fails(*line, longest):
        asked.append(line)
        raise Failed("fit: it encloses nothing" if "--cap" in line else "fit: an opening (--cap closes it)")

    monkeypatch.setattr(strangers, "command", fails)
    row = strangers.judged(Found("mesh", (tmp_path / "a.obj",)), tmp_path, tmp_path / "out", "quick", 9.0)
    assert len(asked) == 2 and row.became == "nothing" and row.wrong == ["fit: it encloses nothing"]


def test_recordings_of_one_scene_are_one_row(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(strangers, "command", lambda *line, longest: seen.append(line) or {
        "windows": 3, "error_m": 1e-4, "notes": ["noise"], "held_out": {"after": [2.0, 1.0], "before": [1.0, 5.0]},
    })  # fmt: skip
    files = (tmp_path / "a.csv", tmp_path / "b.csv")
    row = strangers.judged(
        Found("recordings", files, tmp_path / "scene.yaml"), tmp_path, tmp_path / "out", "quick", 9.0
    )
    assert row.name == "a.csv and 1 more" and seen[0][:3] == ("identify", *files) and "--scene" in seen[0]
    assert row.exact == "2 % and 1 degrees off; 1 % and 5 degrees as the scene was"
    assert row.wrong == ["the identified numbers are farther off than those of the scene"] and row.notes == ["noise"]
