"""Replacing a bundled model: weights, errors and card come out of one call."""

import pytest

pytest.importorskip("pybullet")

from sdfsim.dynamics.model import load_model
from sdfsim.errors import SdfsimError
from sdfsim.learning.bundle import bundle
from sdfsim.learning.generate import make_dataset
from sdfsim.learning.train import train


@pytest.fixture(scope="module")
def trained(cube_data, cube_meshes, presets, tmp_path_factory):
    """The same tiny model trained from three seeds."""
    out = tmp_path_factory.mktemp("runs")
    for split in ("train", "validation"):
        make_dataset("movi-b", cube_data, shapes=cube_meshes, trajectories=2, seed=1, split=split)
    for seed in range(3):
        train(cube_data, out / str(seed), preset="tiny", steps=20, seed=seed)
    return [out / str(seed) / "model.safetensors" for seed in range(3)]


def test_a_trained_model_is_bundled_with_its_errors(cube_data, trained, tmp_path):
    report = bundle(trained[0], cube_data, "mine", tmp_path / "models", seeds=trained[1:])
    model = load_model(tmp_path / "models" / "mine.safetensors")
    card = (tmp_path / "models" / "mine.md").read_text()
    assert model.name == "mine" and model.card["errors"]["model"] == report["model"]
    assert model.card["errors"]["chaos_floor"] == report["chaos_floor"]
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in card.splitlines() if line.startswith("|")}
    first = rows["flying on without contact"]  # the last table's: it has no errors
    assert len(first) == 6 and first[-1].strip().endswith(" s")
    assert f"| this model | {report['model']['50']['translation_rmse']:.3f} (" in card
    assert f"| teacher, 1e-3 m/s off | {_error(report, '1e-3'):.3f} (" in card
    others = [seed["100"]["rotation_error"] for seed in report["other_seeds"]]
    assert len(others) == 2
    assert rows["other training seeds (2): low - high"][3].strip() == f"{min(others):.1f} - {max(others):.1f}"
    assert "m, 50 steps = 1 s" in card and "penetration 95 %" in card and "| 20 | 16 |" in card
    assert "--preset tiny" in card and "--trajectories 3 --seed 1 --split test" in card


def test_other_seeds_must_be_of_the_same_preset_and_not_the_same_model(cube_data, presets, trained, tmp_path):
    with pytest.raises(SdfsimError, match="the same weights"):
        bundle(trained[0], cube_data, "mine", tmp_path, seeds=[trained[0]])
    train(cube_data, tmp_path / "other", preset="tiny", steps=10, seed=1)
    with pytest.raises(SdfsimError, match="another optimiser steps"):
        bundle(trained[0], cube_data, "mine", tmp_path, seeds=[tmp_path / "other" / "model.safetensors"])
    assert not (tmp_path / "mine.safetensors").exists()


def _error(report: dict, size: str) -> float:
    return report["chaos_floor"]["perturbations"][size]["50"]["translation_rmse"]
