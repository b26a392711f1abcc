"""Photos of noise, and stages that only note that they ran."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline import report_page, stages


@pytest.fixture
def photos(tmp_path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for k in range(3):
        pixels = np.random.default_rng(k).integers(0, 255, (80, 80, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"{k}.png")
    return folder


@pytest.fixture
def calls(monkeypatch) -> list[str]:
    """Replaces what stages do by a note of their names and one file each."""
    done: list[str] = []

    def action(name: str):
        def act(run: stages.Run, work: Path) -> dict:
            done.append(name)
            (work / "result").write_text(name)
            if name == "scene":
                (run.folder / "scene.yaml").write_text("version: 1\n")
            return {"name": name}

        return act

    monkeypatch.setattr(stages, "ACTIONS", {name: action(name) for name in stages.STAGES})
    monkeypatch.setattr(report_page, "write_page", lambda folder, report: None)  # There is nothing to show.
    return done
