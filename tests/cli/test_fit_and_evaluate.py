"""The commands `fit` and `evaluate`: interruption, stages, tables."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from sdfsim.shape.shape import load_shape

from sdfsim.shape import fit, primitives
from sdfsim.shape.checkpoint import Checkpoint
from sdfsim.shape.mesh import write_ply
from tests.cli.conftest import run


def test_fitting_a_mesh_goes_on_where_it_was_interrupted(tmp_path, monkeypatch):
    plan = replace(plans.PLANS["default"], width=16, layers=4, steps=400, batch=256, pool=4000, goal=None)
    monkeypatch.setitem(plans.PLANS, "default", plan)
    (tmp_path / "box.ply").write_bytes(write_ply(primitives.box()))
    save, calls = Checkpoint.save, []

    def interrupted(self, *state):
        save(self, *state)
        calls.append(state[-1][0])
        if len(calls) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(Checkpoint, "save", interrupted)
    assert run("fit", tmp_path / "box.ply", "-o", tmp_path / "box").exit_code == 130
    done = run("fit", tmp_path / "box.ply", "-o", tmp_path / "box", "--json")
    report = json.loads(done.stdout)
    assert calls == [200, 400] and done.exit_code == (0 if report["passed"] else 3)
    assert load_shape(tmp_path / "box").volume == pytest.approx(1.0)
    assert sorted(p.name for p in (tmp_path / "box").iterdir()) == ["mesh.ply", "shape.json", "shape.safetensors"]


def test_fitting_a_folder_ends_with_its_scene(tmp_path, monkeypatch):
    calls = []

    def run_stage(name, folder, *, progress, **options):
        calls.append((name, {key: value for key, value in options.items() if value is not None}))
        return {"seconds": {name: 1.0}, "paths": {}, "failed_checks": [], "notes": ["a metre is a guess"]}

    monkeypatch.setattr("pipeline.stages.run_stage", run_stage)
    done = run("fit", tmp_path, "--recipe", "paper")
    assert done.exit_code == 0 and done.stderr == "a metre is a guess\n"
    assert calls == [("fit", {"recipe": "paper", "device": "auto"}), ("scene", {})]
