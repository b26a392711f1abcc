"""Photos of noise, and stages that only note that they ran."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pipeline import stages
from tests.helpers.photos import RESULTS, noise


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


@pytest.fixture
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
