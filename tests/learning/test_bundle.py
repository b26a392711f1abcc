"""Replacing a bundled model: weights, errors and card come out of one call."""

import pytest

pytest.importorskip("pybullet")

from sdfsim.dynamics.model import load_model
from sdfsim.learning.bundle import bundle
from sdfsim.learning.movi import make_dataset
from sdfsim.learning.train import train


def test_a_trained_model_is_bundled_with_its_errors(cube_data, cube_meshes, presets, tmp_path):
    for split in ("train", "validation"):
        make_dataset("movi-b", cube_data, shapes=cube_meshes, trajectories=2, seed=1, split=split)
    train(cube_data, tmp_path / "run", preset="tiny", steps=20)
    report = bundle(tmp_path / "run" / "model.safetensors", cube_data, "mine", tmp_path / "models")
    model = load_model(tmp_path / "models" / "mine.safetensors")
    card = (tmp_path / "models" / "mine.md").read_text()
    assert model.name == "mine" and model.card["errors"]["model"] == report["model"]
    assert f"| this model | 100 | {report['model']['100']['translation_rmse']:.3f}" in card
    assert "--preset tiny" in card and "--trajectories 3 --seed 1 --split test" in card
