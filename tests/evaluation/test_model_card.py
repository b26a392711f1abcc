"""Replacing a bundled model: weights, errors and card come out of one call."""

from dataclasses import replace

import pytest

pytest.importorskip("pybullet")

from sdfsim.data.generate import make_dataset
from sdfsim.dynamics.model import Model, load_model, new_network
from sdfsim.errors import SdfsimError
from sdfsim.evaluation.model_card import _cast, _commands, _folders, bundle
from sdfsim.training.train import train


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


def test_a_paper_network_is_told_as_published_too(cube_data, trained, tmp_path):
    plan = {"config": {"width": 8, "steps": 1}}
    card = load_model(trained[0]).card
    paper = Model("p", "paper", new_network("paper", plan["config"]), 0.02, 10.0, 1.0, 0.1, nodes=8)
    replace(paper, card=card | {"preset": card["preset"] | plan}).save(tmp_path / "paper.safetensors")
    report = bundle(tmp_path / "paper.safetensors", cube_data, "mine", tmp_path / "models")
    error = report["as_published"]["50"]["translation_rmse"]
    card = (tmp_path / "models" / "mine.md").read_text()
    assert f"| this model, free flight learned too (as published) | {error:.3f} (" in card


def test_other_seeds_must_be_of_the_same_preset_and_not_the_same_model(cube_data, presets, trained, tmp_path):
    with pytest.raises(SdfsimError, match="the same weights"):
        bundle(trained[0], cube_data, "mine", tmp_path, seeds=[trained[0]])
    train(cube_data, tmp_path / "other", preset="tiny", steps=10, seed=1)
    with pytest.raises(SdfsimError, match="another optimiser steps"):
        bundle(trained[0], cube_data, "mine", tmp_path, seeds=[tmp_path / "other" / "model.safetensors"])
    assert not (tmp_path / "mine.safetensors").exists()


def test_the_card_says_how_to_repeat_exactly_this_training(cube_data, trained):
    model = load_model(trained[2])
    assert model.card["seed"] == 2 and model.card["optimiser_steps"] == 20
    made = {"engine": "pybullet", "shapes": 2, "random_solids": 0}
    piles = [
        made | {"recipe": "pile", "seed": seed, "trajectories": {"train": 5}, "bodies": count}
        for seed, count in ((0, 8), (7, None))
    ]
    data = [*model.card["data"], *piles]
    lines = _commands(model.card | {"data": data}, _folders(data))
    assert _folders(data) == ["MOVI-B", "PILE-1", "PILE-2"]
    assert [_cast(made) for made in data[:2]] == ["1 shapes", "2 shapes, each in one split alone"]
    varied = made | {"recipe": "varied", "shapes": 9}
    assert _cast(varied) == "5 shapes, each in one split alone, and 4 of the recipe's own in all"
    assert lines[3:5] == [
        "sdfsim dataset pile -o PILE-1 --shapes SHAPES --bodies 8 --trajectories 5 --seed 0 --split train",
        "sdfsim dataset pile -o PILE-2 --shapes SHAPES --trajectories 5 --seed 7 --split train",
    ]
    module = "python -m sdfsim.training.train MOVI-B PILE-1 PILE-2 RUN --preset tiny"
    assert lines[5] == f"{module} --seed 2 --steps 20"
    usual = {"seed": 0, "optimiser_steps": 150, "data": data}
    assert _commands(model.card | usual, _folders(data))[5] == (
        "sdfsim train --data MOVI-B --data PILE-1 --data PILE-2 -o RUN --preset tiny"
    )


def test_models_from_before_the_card_told_seed_and_counts_are_still_bundled(cube_data, trained, tmp_path):
    """And one trained where there were no test trajectories is another seed of one trained where they are."""
    model = load_model(trained[0])
    known = [d | {"trajectories": {}} for d in model.card["data"]]
    card = {k: v for k, v in model.card.items() if k != "seed"} | {"data": known}
    replace(model, card=card).save(tmp_path / "old.safetensors")
    bundle(tmp_path / "old.safetensors", cube_data, "mine", tmp_path / "models")
    text = (tmp_path / "models" / "mine.md").read_text()
    assert "made with pybullet.\n" in text and "training.train MOVI-B RUN --preset tiny --steps 20" in text
    assert "on average" not in text
    other = load_model(trained[1])
    trained_only = [d | {"trajectories": {"train": 2, "validation": 2}} for d in other.card["data"]]
    plan = {k: v for k, v in other.card["preset"].items() if k not in ("in_row", "late", "bf16")}
    replace(other, card=other.card | {"data": trained_only, "preset": plan}).save(tmp_path / "other.safetensors")
    assert len(bundle(trained[0], cube_data, "mine", tmp_path, [tmp_path / "other.safetensors"])["other_seeds"]) == 1


def _error(report: dict, size: str) -> float:
    return report["chaos_floor"]["perturbations"][size]["50"]["translation_rmse"]
