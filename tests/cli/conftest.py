"""What the commands are given, and how they are run."""

from __future__ import annotations

import pytest
import torch
from typer.testing import CliRunner

import cli
from sdfsim.learned.model import Model, new_network

SCENE = """
version: 1
duration: 0.2
shapes:
  ball: {sphere: {radius: 0.5}}
bodies:
  - {name: floor, plane: {}}
  - {name: ball, shape: ball, position: [0, 0, 5]}
"""


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


def run(*arguments: object):
    return CliRunner().invoke(cli.app, [str(a) for a in arguments])
