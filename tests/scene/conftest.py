"""Scenes from text."""

from pathlib import Path

import pytest

from sdfsim import load_scene
from sdfsim.scene.scene import Scene


@pytest.fixture
def load(tmp_path: Path):
    def from_text(text: str) -> Scene:
        file = tmp_path / "scene.yaml"
        file.write_text(text, encoding="utf-8")
        return load_scene(file)

    return from_text
