"""A model on a device: the caller's own stays where it is."""

import re

import numpy as np
import pytest
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.learned.model import BUNDLED, bundled_models, load_model
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import random_model

FOUR = 4 * 2**20  # bytes
META = "meta"  # stands in for a GPU


@pytest.mark.parametrize("kind", ["impulse", "sdf-sim"])
def test_a_model_that_goes_to_a_device_leaves_itself_behind(kind, dropped):
    model = random_model(kind)
    simulator = Simulator(dropped, model)
    there = model.to(META)
    assert {weight.device for weight in there.network.state_dict().values()} == {torch.device(META)}
    assert there.network.training is False and there.reach == model.reach
    simulator.run(steps=1)
    assert {weight.device.type for weight in model.network.state_dict().values()} == {"cpu"}


def test_a_model_of_an_earlier_version_ends_in_one_line():
    with pytest.raises(SdfsimError, match="'small' not found") as caught:
        load_model("small")
    assert caught.value.hint == "models are solver, gnn, sdf-sim; or give the path of a .safetensors"


@pytest.mark.parametrize("name", bundled_models())
def test_a_bundled_model_is_small_and_its_card_has_its_own_figures(name):
    """To the digits that the card has, of the errors that the file itself keeps."""
    file, card = BUNDLED / f"{name}.safetensors", (BUNDLED / f"{name}.md").read_text(encoding="utf-8")
    assert file.stat().st_size < FOUR
    model = load_model(name)
    parameters = sum(p.numel() for p in model.network.parameters())
    assert card.startswith(f"# {name}\n") and f"{parameters:,} parameters" in card
    row = next(line for line in card.splitlines() if line.startswith("| this model"))
    for errors in (model.card["errors"]["model"][steps] for steps in ("50", "100")):
        assert f" {errors['translation_rmse']:.3f} " in row
        assert "rotation_error" not in errors or f" {errors['rotation_error']:.1f} " in row
    if "curve" in model.card:
        last = model.card["curve"][-1]
        assert last[0] == model.card["optimiser_steps"]
        assert re.search(rf"^\| {last[0]:,} \| {last[1]:.4f} \|$", card, re.MULTILINE)


@pytest.mark.parametrize(("name", "deepest"), [("gnn", 0.1), ("sdf-sim", 0.8)])
def test_a_learned_simulator_runs_by_its_name(name, deepest, tmp_path):
    """A ball of MOVi-B's size and materials falls freely until it meets the floor, which holds it: at its surface, or,
    as the card of `sdf-sim` tells, only at its middle. Without the floor it would be 3.8 m below in the end."""
    (tmp_path / "scene.yaml").write_text(
        "version: 1\ngravity: [0, 0, -10]\nduration: 1\nshapes: {ball: {sphere: {radius: 0.7}}}\nbodies:\n"
        "  - {name: floor, plane: {}, friction: 0.3, restitution: 0.5}\n"
        "  - {name: ball, shape: ball, position: [0, 0, 1.2], mass: 1, friction: 0.8, restitution: 0.7}\n"
    )
    from sdfsim.scene.load import load_scene

    scene = load_scene(tmp_path / "scene.yaml")
    rollout = Simulator(scene, name).run(1.0)
    assert rollout.meta["model"] == name
    height = rollout.position[:, 1, 2]
    met = np.sqrt(2 * 0.5 / 10)
    flying = rollout.time < met - 0.05
    np.testing.assert_allclose(height[flying], 1.2 - 5 * rollout.time[flying] ** 2, atol=0.02)
    assert height.min() > 0.7 - deepest and height[rollout.time > met].max() < 1.2
