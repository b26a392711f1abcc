"""The commands `fit` and `evaluate`: interruption, stages, tables."""

from __future__ import annotations

from tests.cli.conftest import run


def test_fitting_a_folder_ends_with_its_scene(tmp_path, monkeypatch):
    calls = []

    def run_stage(name, folder, *, progress, **options):
        calls.append((name, {key: value for key, value in options.items() if value is not None}))
        return {"seconds": {name: 1.0}, "paths": {}, "failed_checks": [], "notes": ["a metre is a guess"]}

    monkeypatch.setattr("pipeline.stages.run_stage", run_stage)
    done = run("fit", tmp_path, "--recipe", "paper")
    assert done.exit_code == 0 and done.stderr == "a metre is a guess\n"
    assert calls == [("fit", {"recipe": "paper", "device": "auto"}), ("scene", {})]
