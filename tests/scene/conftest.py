"""Scenes from text."""

from __future__ import annotations

from pathlib import Path

import pytest

from sdfsim import SceneError, load_scene
from sdfsim.scene.scene import Scene

HEAD = "version: 1\nshapes:\n  ball: {sphere: {radius: 0.5}}\nbodies:\n"  # bodies[0] is on line 5


@pytest.fixture
def load(tmp_path: Path):
    def from_text(text: str) -> Scene:
        file = tmp_path / "scene.yaml"
        file.write_text(text, encoding="utf-8")
        return load_scene(file)

    return from_text


def problems_of(load, text: str) -> list[str]:
    """The faults of a scene, without the folder in front of the file's name."""
    with pytest.raises(SceneError) as caught:
        load(text)
    return ["scene.yaml:" + line.split("scene.yaml:", 1)[1] for line in caught.value.problems]
