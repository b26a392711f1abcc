"""What a study found is stored, and `simulate --quality` and `plan` take it from there."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

import cli
from sdfsim import load_scene
from sdfsim.dynamics.model import Model, new_network
from sdfsim.errors import SdfsimError
from sdfsim.files import read_json, write_json
from sdfsim.studies.tradeoff_cost import COSTS_FILE
from sdfsim.studies.tradeoff_knobs import Setting, for_any_scene, setting_from
from sdfsim.studies.tradeoff_quality import QUALITY_FILE, at_quality, quality_note, quality_setting, store

SCENE = """
version: 1
duration: 0.2
shapes:
  ring: {primitive: {name: torus, size: 0.2}, sdf: grid, resolution: 24}
bodies:
  - {name: floor, plane: {}}
  - {name: ring, shape: ring, position: [0, 0, 0.2]}
"""


def measured(**changes) -> dict:
    """A tradeoff.json of three points."""
    chosen = {"draft": Setting(nodes="thin 16", rounds=2), "standard": Setting(nodes="grid 7"), "fine": Setting()}
    points = [
        {"key": name, "label": s.label, "fingerprint": {"setting": s.to_json()}, "ms": {"median": 1.0 + k},
         "errors": {"50": {"translation_rmse": 0.2}}, "penetration_p95": 0.1, "energy_gain": None, "peak_mib": None}
        for k, (name, s) in enumerate(chosen.items())
    ]  # fmt: skip
    report = {"source": "x/data", "quick": False, "sdfsim": "0", "trajectories": 3, "bodies": 9, "horizon_steps": 50}
    return report | {"dt_s": 0.02, "points": points, "qualities": {name: name for name in chosen}} | changes


def test_a_quality_is_for_networks_of_the_kind_it_was_measured_with(scene, tmp_path):
    network = new_network("paper", {"width": 8, "steps": 1})
    Model("mine", "paper", network, 0.02, 10.0, 1.4, 0.1).save(tmp_path / "mine.safetensors")
    with pytest.raises(SdfsimError, match="measured with small, an impulse network; mine is a paper one"):
        at_quality("draft", load_scene(scene), tmp_path / "mine.safetensors")
    assert "; other was not)" in quality_note("draft", "other")
    assert quality_note("draft", None) == quality_note("draft", "small")


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "scene.yaml").write_text(SCENE)
    return tmp_path / "scene.yaml"


def test_qualities_are_stored_with_their_figures_and_change_scene_and_model(tmp_path, scene):
    write_json(tmp_path / "tradeoff.json", measured())
    file = tmp_path / "quality.json"
    assert store(tmp_path, file, tmp_path / "costs.json") == [f"wrote {file}"]
    stored = read_json(file)
    assert stored["qualities"]["draft"]["ms"] == {"median": 1.0} and stored["measured_on"] == "data"
    made = load_scene(scene)
    draft, model = at_quality("draft", made, None, file)
    assert len(draft.shapes[1].nodes) == 16 < len(made.shapes[1].nodes) and len(model.network.rounds) == 2
    fine, model = at_quality("fine", made, None, file)
    assert fine.shapes[1] == made.shapes[1] and len(model.network.rounds) > 2
    with pytest.raises(SdfsimError, match="no quality 'best'"):
        quality_setting("best", file)


def test_costs_of_one_model_leave_those_of_others(tmp_path):
    with pytest.raises(SdfsimError, match=r"no tradeoff\.json"):
        store(tmp_path, tmp_path / "q.json", tmp_path / "c.json")
    grown = {"kind": "impulse", "quick": True, "cost": {"base": 1.0}, "held_out_median": 0.1, "held_out_within": 1.0}
    for name in ("small", "base"):
        write_json(tmp_path / "growth.json", grown | {"model": name})
        store(tmp_path, tmp_path / "q.json", tmp_path / "c.json")
    stored = read_json(tmp_path / "c.json")["models"]
    assert set(stored) == {"small", "base"} and stored["base"] == grown
    assert not (tmp_path / "q.json").exists()


def test_the_bundled_qualities_are_measured_points_in_order():
    stored = read_json(QUALITY_FILE)
    assert list(stored["qualities"]) == ["draft", "standard", "fine"]
    entries = list(stored["qualities"].values())
    steps = str(stored["horizon_steps"])
    assert [e["ms"]["median"] for e in entries] == sorted(e["ms"]["median"] for e in entries)
    errors = [e["errors"][steps]["translation_rmse"] for e in entries]
    assert errors[2] == min(errors)
    assert all(for_any_scene(setting_from(e["setting"])) for e in entries)


def test_simulate_takes_a_quality_and_says_what_it_is(tmp_path, scene):
    out = tmp_path / "run"
    done = CliRunner().invoke(
        cli.app, ["simulate", str(scene), "-o", str(out), "--viewer", "none", "--quality", "draft"]
    )
    assert done.exit_code == 0, done.stderr
    report = json.loads((out / "report.json").read_text())
    assert report["quality"].startswith("quality draft: small") and report["quality"] in done.stdout
    assert "quality: draft" in (out / "config.yaml").read_text()


def test_plan_tells_how_long_the_run_will_take(scene):
    assert COSTS_FILE.exists()
    done = CliRunner().invoke(cli.app, ["plan", str(scene), "--json"])
    assert done.exit_code == 0, done.stderr
    report = json.loads(done.stdout)
    assert 0 < report["run"]["seconds"] < 60 and 0 < report["run"]["in_contact"] <= 1
    assert report["run"]["seconds"] == pytest.approx(1e-3 * report["run"]["step_ms"] * report["steps"])
