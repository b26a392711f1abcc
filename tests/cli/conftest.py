"""What the commands are given, and how they are run."""

import pytest
import torch

from sdfsim.learned.model import Model, new_network
from tests.helpers.command import SCENE


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> str:
    """Untrained weights: what the commands do around the network does not depend on them."""
    path = tmp_path_factory.mktemp("model") / "untrained.safetensors"
    torch.manual_seed(0)
    Model("untrained", "impulse", new_network("impulse", {"width": 8, "rounds": 1}), 0.02, 10.0, 1.0, 0.1).save(path)
    return str(path)


@pytest.fixture
def scene(tmp_path) -> str:
    (tmp_path / "scene.yaml").write_text(SCENE)
    return str(tmp_path / "scene.yaml")
