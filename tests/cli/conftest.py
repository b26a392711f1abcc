"""What the commands are given, and how they are run."""

import pytest

from tests.helpers.command import SCENE
from tests.helpers.scenes import tiny_model


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> str:
    """Untrained weights: what the commands do around the network does not depend on them."""
    return str(tiny_model(tmp_path_factory.mktemp("model") / "untrained.safetensors"))


@pytest.fixture
def scene(tmp_path) -> str:
    (tmp_path / "scene.yaml").write_text(SCENE)
    return str(tmp_path / "scene.yaml")
