"""A model on a device: the caller's own stays where it is."""

import pytest
import torch

from sdfsim.learned.model import load_model
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import random_model

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


def test_nothing_is_copied_where_nothing_has_to_move(tmp_path):
    model = random_model("impulse")
    assert model.to("cpu") is model
    model.save(tmp_path / "mine.safetensors")
    unread = load_model(tmp_path / "mine.safetensors", weights=False)
    assert unread.network is None and unread.to(META) is unread
