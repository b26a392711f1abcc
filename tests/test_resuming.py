"""A run that was interrupted goes on as if nothing had happened, and ends early when asked to."""

from pathlib import Path

import numpy as np
import pytest

from sdfsim import SdfsimError, progress, resuming, run
from sdfsim.dynamics.rollout import Rollout

TOWER = Path(__file__).resolve().parents[1] / "samples" / "tower.yaml"


def simulate(scene: Path, out: Path, *, stop: float | None = None, kind=KeyboardInterrupt, seconds=0.15, **options):
    def on_progress(stage: str, fraction: float, message: str) -> None:
        if stop is not None and stage == "simulate" and stop < fraction < 1:
            raise kind

    settings = {"model": None, "seed": None, "viewer": "none", "device": "cpu"}
    settings |= {"on_progress": on_progress, "on_address": print, "seconds": seconds}
    return run.simulate(scene, out, **(settings | options))


@pytest.fixture
def sleepy(tmp_path) -> Path:
    """A ball on its way to the floor, with sleep on, so that all of a state is kept."""
    path = tmp_path / "scene.yaml"
    path.write_text(
        "version: 1\neffects: {sleep: on}\nshapes: {ball: {sphere: {radius: 0.5}}}\nbodies:\n"
        "  - {name: floor, plane: {}}\n  - {name: ball, shape: ball, position: [0, 0, 0.51]}\n"
        "  - {name: far, shape: ball, position: [9, 0, 3]}\n"
    )
    return path


class Killed(Exception):
    """Ends a run without a chance to keep anything more."""


@pytest.mark.parametrize("kind", [KeyboardInterrupt, Killed])
def test_a_resumed_run_is_the_run(sleepy, tmp_path, monkeypatch, kind):
    monkeypatch.setattr(resuming, "EVERY", 0.0)
    for _ in range(2):  # interrupted twice, the second time farther on
        with pytest.raises(kind):
            simulate(sleepy, tmp_path / "run", stop=0.3 + 0.3 * _, kind=kind, resume=True)
    part = sorted(p.name for p in (tmp_path / "run" / "checkpoint").glob("part_*.npz"))
    assert len(part) >= 3
    simulate(sleepy, tmp_path / "run", resume=True)
    simulate(sleepy, tmp_path / "whole")
    resumed, whole = (Rollout.load(tmp_path / name / "rollout.npz") for name in ("run", "whole"))
    for name in ("time", "position", "orientation", "velocity", "contact_point", "contact_count"):
        np.testing.assert_array_equal(getattr(resumed, name), getattr(whole, name), err_msg=name)
    assert not (tmp_path / "run" / "checkpoint").exists()


def test_another_run_is_not_gone_on_with(sleepy, tmp_path, monkeypatch):
    monkeypatch.setattr(resuming, "EVERY", 0.0)
    with pytest.raises(KeyboardInterrupt):
        simulate(sleepy, tmp_path / "run", stop=0.5)
    sleepy.write_text(sleepy.read_text().replace("0.51]", "0.52]"))
    with pytest.raises(SdfsimError, match="another scene"):
        simulate(sleepy, tmp_path / "run", resume=True)
    assert (tmp_path / "run" / "rollout.npz").exists()
    assert simulate(sleepy, tmp_path / "run", seconds=0.05)["status"] == "done"  # anew
    assert not (tmp_path / "run" / "checkpoint").exists()


def test_a_run_ends_when_everything_rests(tmp_path):
    report = simulate(TOWER, tmp_path / "run", seconds=3.0, until_settled=True)
    assert report["settled"] and report["simulated_s"] < 1.0
    falling = simulate(TOWER, tmp_path / "short", seconds=0.05, until_settled=True)
    assert falling["settled"] is False and falling["status"] == "done"


def test_the_time_left_counts_from_where_the_work_was_taken_up(monkeypatch, capsys):
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    session = progress.Session()
    session.stage_progress("simulate", 0.5, "half of it was there")
    now[0] += 20.0
    session.stage_progress("simulate", 0.75, "a quarter more")
    assert "about 20 s left" in capsys.readouterr().err
