"""Replacing a bundled model: weights, errors and card come out of one call."""

import json

import pytest

pytest.importorskip("pybullet")

from sdfsim.data.generate import make_dataset
from sdfsim.evaluation.model_card import bundle
from sdfsim.learned.model import load_model
from sdfsim.training.train import train


@pytest.fixture(scope="module")
def trained(cube_data, cube_meshes, presets, tmp_path_factory):
    """A tiny model, trained from a seed that is not the usual one."""
    out = tmp_path_factory.mktemp("runs")
    for split in ("train", "validation"):
        make_dataset("movi-b", cube_data, shapes=cube_meshes, trajectories=2, seed=1, split=split)
    train(cube_data, out, preset="tiny", steps=20, seed=2)
    return out / "model.safetensors"


def test_a_trained_model_is_bundled_with_its_errors(cube_data, trained, tmp_path):
    report = bundle(trained, cube_data, "mine", tmp_path / "models")
    model = load_model(tmp_path / "models" / "mine.safetensors")
    card = (tmp_path / "models" / "mine.md").read_text()
    assert model.name == "mine" and model.card["errors"]["model"] == report["model"]
    assert model.card["errors"]["chaos_floor"] == report["chaos_floor"]
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in card.splitlines() if line.startswith("|")}
    first = rows["ballistic"]  # the last table's: it has no errors
    assert len(first) == 6 and first[-1].strip().endswith(" s")
    assert f"| this model | {report['model']['50']['translation_rmse']:.3f} (" in card
    assert f"| teacher, 1e-3 m/s off | {_error(report, '1e-3'):.3f} (" in card
    assert (
        "m, 50 steps = 1 s" in card
        and "penetration 95 %" in card
        and "Preset tiny, seed 2: 20 steps of\n16 frames" in card
    )
    assert "recipe movi-b" in card and "seed 1" in card
    logged = [json.loads(line) for line in (trained.parent / "log.jsonl").read_text().splitlines()]
    assert model.card["curve"] == [[line["step"], line["held_out_loss"]] for line in logged] and len(logged) > 5
    assert float(rows["20"][0]) == pytest.approx(logged[-1]["held_out_loss"], abs=1e-4)
    halfway = next(line["held_out_loss"] for line in logged if line["step"] >= 10)
    assert f"it fell from\n{halfway:.3g} to {logged[-1]['held_out_loss']:.3g}." in card


def _error(report: dict, size: str) -> float:
    return report["chaos_floor"]["perturbations"][size]["50"]["translation_rmse"]
