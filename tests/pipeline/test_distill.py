"""Training against a clock that the test moves on, and training that goes wrong."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from pipeline import distill
from pipeline.field.training import PRESETS, Trainer, train
from sdfsim.errors import SdfsimError
from tests.pipeline.test_field import SMALL, posed_noise

RECIPE = replace(PRESETS["quick"], size=SMALL, rays=16, iterations=1000, surface_points=8)


@pytest.fixture
def clock(monkeypatch) -> SimpleNamespace:
    """Every step of training takes one second, and learns nothing."""
    clock = SimpleNamespace(now=0.0)

    def timed(trainer: Trainer) -> dict[str, float]:
        clock.now += 1.0
        trainer.iteration += 1
        return {"color": 0.1}

    monkeypatch.setattr(distill, "time", SimpleNamespace(monotonic=lambda: clock.now))
    monkeypatch.setattr(Trainer, "step", timed)
    monkeypatch.setattr(distill, "calibrate", lambda probe, threads: 1.0)
    monkeypatch.setattr("pipeline.field.training.CACHE", 9)
    return clock


def test_a_run_that_goes_on_has_what_is_left_of_its_budget(tmp_path, clock):
    views, sparse = posed_noise(tmp_path)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    whole.mkdir()
    killed.mkdir()
    report = train(views, sparse, tmp_path, whole, recipe=RECIPE, budget=150.0).report
    assert report["train_seconds"] == 150.0 and report["iterations"] == 150
    ended = clock.now

    def kill(fraction: float, message: str) -> None:
        if clock.now - ended >= 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(views, sparse, tmp_path, killed, recipe=RECIPE, budget=150.0, checkpoint_every=0.0, on_progress=kill)
    report = train(views, sparse, tmp_path, killed, recipe=RECIPE, budget=150.0).report
    assert report["resumed"] and report["seconds_before"] == 100.0
    assert report["train_seconds"] == pytest.approx(150.0, abs=distill.PACE)
    assert report["train_seconds"] <= 150.0 and report["iterations"] == report["train_seconds"]


def test_a_loss_that_is_not_finite_points_to_what_is_there_by_then(tmp_path, monkeypatch):
    views, sparse = posed_noise(tmp_path)
    monkeypatch.setattr(Trainer, "step", lambda trainer: {"color": float("nan")})
    monkeypatch.setattr(distill, "calibrate", lambda probe, threads: 1.0)
    with pytest.raises(SdfsimError, match="no longer finite") as caught:
        train(views, sparse, tmp_path, tmp_path, recipe=RECIPE)
    assert "cameras in the report" in caught.value.hint and "recording" not in caught.value.hint
