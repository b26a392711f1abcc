"""Photos of noise, and stages that only note that they ran."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline import stages


def noise(folder: Path, names: Sequence[str], size: tuple[int, int] = (120, 90)) -> Path:
    """Writes photos of noise, width x height, into a folder that is made where missing."""
    for k, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        pixels = np.random.default_rng(k).integers(0, 255, (*size[::-1], 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / name)
    return folder


@pytest.fixture
def photos(tmp_path) -> Path:
    return noise(tmp_path / "photos", ["0.png", "1.png", "2.png"], (80, 80))


@pytest.fixture
def act(monkeypatch) -> Callable[[str, Callable], None]:
    """Replaces what a stage does."""

    def put(stage: str, action: Callable) -> None:
        monkeypatch.setitem(stages.STAGES, stage, replace(stages.STAGES[stage], run=action))

    return put


@pytest.fixture
def calls(act) -> list[str]:
    """Replaces what all stages do by a note of their names and one file each."""
    done: list[str] = []

    def action(name: str) -> Callable:
        def note(project: stages.Project, work: Path) -> dict:
            done.append(name)
            (work / "result").write_text(name)
            if name == "scene":
                (project.folder / "scene.yaml").write_text("version: 1\n")
            return RESULTS.get(name, {})

        return note

    for name in stages.STAGES:
        act(name, action(name))
    return done


RESULTS = {
    "poses": {"posed": 3, "photos": 3, "mean_error": 0.5, "points": 9, "field_of_view": [60.0], "left_out": []},
    "mesh": {"extent_m": [1.0, 1.0, 1.0], "size": "a ruler", "up_from": "plane", "up_within_degrees": 1.0},
}
