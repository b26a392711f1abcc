"""Row 10: bad input is told in one line a fault, with exit code 1 or 2, and nothing is written.

Meshes that are inverted or doubled are no faults: they become the solids they bound (see tests/shape/). Every
field's own range is tested in tests/scene/test_load.py, and what strangers write in test_fuzz_*.py.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

import cli

HEAD = "version: 1\nduration: 0.1\n"
BALL = "shapes: {ball: {sphere: {radius: 0.5}}}\n"
FLOOR = "{name: floor, plane: {}}"
CUBE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\n"
OPEN = CUBE + "f 1 3 2\nf 1 4 3\nf 5 6 7\nf 5 7 8\nf 1 2 6\nf 1 6 5\n"


def body(fields: str, name: str = "b", shape: str = "ball") -> str:
    return HEAD + BALL + f"bodies:\n  - {FLOOR}\n  - {{name: {name}, shape: {shape}, position: [0, 0, 1]{fields}}}\n"


def mesh(file: str) -> str:
    return HEAD + f"shapes: {{thing: {{mesh: {file}, sdf: mesh}}}}\nbodies:\n  - {{name: b, shape: thing}}\n"


BAD = {
    "an unknown shape": (body("", shape="bal"), "shape"),
    "nobody": (HEAD + BALL + "bodies: []\n", "bodies"),
    "a missing mesh": (mesh("none.obj"), "none.obj"),
    "a mesh without faces": (mesh("empty.obj"), "empty.obj"),
    "an open mesh": (mesh("open.obj"), "open"),
    "faster than any contact": (body(", velocity: [0, 0, 1.0e9]"), "body 'b': 1e+09 m/s"),
    "turning faster than can be followed": (body(", angular_velocity: [0, 0, 1.0e9]"), "body 'b': 1e+09 rad/s"),
}


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "empty.obj").write_text(CUBE)
    (tmp_path / "nothing.obj").write_text("")
    (tmp_path / "open.obj").write_text(OPEN)
    return tmp_path


@pytest.mark.parametrize("fault", BAD)
def test_bad_input_is_one_clear_line_and_leaves_nothing(folder, fault):
    text, told = BAD[fault]
    scene, out = folder / "scene.yaml", folder / "run"
    scene.write_text(text)
    done = CliRunner().invoke(cli.app, ["simulate", str(scene), "-o", str(out), "--json"])
    assert done.exit_code in (1, 2)
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert errors and told in errors[0] and "Traceback" not in done.stderr and "internal" not in done.stderr
    problems = json.loads(done.stdout)
    assert problems["exit_code"] == done.exit_code and len(errors) == len(problems.get("problems", errors[:1]))
    assert not out.exists()
    assert sorted(p.name for p in folder.iterdir()) == ["empty.obj", "nothing.obj", "open.obj", "scene.yaml"]
