"""Which recording is shown, and when the address of a page is told."""

from __future__ import annotations

import signal
import subprocess
import sys
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sdfsim import Rollout, SdfsimError
from sdfsim.apps import viewer
from tests.helpers.command import run


@pytest.mark.parametrize("name", ["rollout.rrd", "reconstruction.rrd"])
def test_a_folder_is_shown_by_the_recording_in_it(tmp_path, monkeypatch, name):
    opened: list[list[str]] = []
    ended = SimpleNamespace(poll=lambda: 0, wait=lambda: 0)
    monkeypatch.setattr(viewer.subprocess, "Popen", lambda command: opened.append(command) or ended)
    (tmp_path / name).write_bytes(b"RRF2")
    for place in (tmp_path, tmp_path / name):
        viewer.show(place, web=True)
        assert str(tmp_path / name) in opened.pop()


BALL = """
version: 1
duration: 0.2
shapes: {ball: {sphere: {radius: 0.5}}}
bodies: [{name: ball, shape: ball, position: [0, 0, 5]}]
"""


def heights(recording: Path) -> list[float]:
    """m, of the ball in a recording, frame by frame."""
    from rerun.chunk import RrdReader

    chunks = [chunk for chunk in RrdReader(str(recording)).stream() if str(chunk.entity_path) == "/world/ball"]
    (moving,) = [chunk.to_record_batch() for chunk in chunks if not chunk.is_static]
    return [place[0][2] for place in moving.column("Transform3D:translation").to_pylist()]


def test_a_run_without_a_recording_is_drawn_from_its_rollout(tmp_path, monkeypatch):
    (tmp_path / "scene.yaml").write_text(BALL)
    assert run("simulate", tmp_path / "scene.yaml", "-o", tmp_path / "run", "--viewer", "none").exit_code == 0
    fallen = Rollout.load(tmp_path / "run" / "rollout.npz")
    opened: list[list[str]] = []
    ended = SimpleNamespace(poll=lambda: 0, wait=lambda: 0)
    monkeypatch.setattr(viewer.subprocess, "Popen", lambda command: opened.append(command) or ended)
    for place in (tmp_path / "run", tmp_path / "run" / "rollout.npz"):
        (tmp_path / "run" / "rollout.rrd").unlink(missing_ok=True)
        done = run("view", place, "--web")
        assert done.exit_code == 0, done.output
        assert "drawn from rollout.npz" in done.output and str(tmp_path / "run" / "rollout.rrd") in opened.pop()
        np.testing.assert_allclose(heights(tmp_path / "run" / "rollout.rrd"), fallen.position[:, 0, 2], atol=1e-6)
    assert "drawn" not in run("view", tmp_path / "run", "--web").output  # it has one now
    (tmp_path / "run" / "rollout.rrd").unlink()
    (tmp_path / "scene.yaml").unlink()
    assert "no such" in run("view", tmp_path / "run", "--web").output  # the scene is missing


def test_a_folder_without_a_run_says_what_is_missing(tmp_path):
    with pytest.raises(SdfsimError, match=r"neither rollout\.rrd nor rollout\.npz is in this folder"):
        viewer.show(tmp_path, web=True)
    (tmp_path / "checkpoint").mkdir()
    with pytest.raises(SdfsimError) as error:
        viewer.show(tmp_path, web=True)
    assert "--resume" in error.value.hint


def children(pid: int) -> list[int]:
    found = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True, check=False)
    return [int(word) for word in found.stdout.split()]


def alive(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(
    ("command", "number"),
    [("view", signal.SIGTERM), pytest.param("simulate", signal.SIGHUP, marks=pytest.mark.slow)],
)
def test_a_page_lives_as_long_as_its_command_without_a_terminal(tmp_path, command, number):
    (tmp_path / "scene.yaml").write_text(BALL)
    simulate = ["simulate", str(tmp_path / "scene.yaml"), "-o", str(tmp_path / "run")]
    if command == "view":
        assert run(*simulate).exit_code == 0
    asked = ["view", str(tmp_path / "run"), "--web"] if command == "view" else [*simulate, "--viewer", "web"]
    root = Path(__file__).resolve().parents[2]
    with subprocess.Popen([sys.executable, "cli.py", *asked], cwd=root, stdin=subprocess.DEVNULL,
                          stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:  # fmt: skip
        address = ""
        for line in process.stderr:
            address = line.split()[-1].partition("?")[0] if line.startswith("watch it at") else address
            if line.startswith("the page stays up"):
                break
        (page,) = children(process.pid)
        with urllib.request.urlopen(address, timeout=10) as answer:
            assert answer.status == 200
        assert process.poll() is None
        process.send_signal(number)
        assert process.wait(timeout=30) == 128 + number
    assert not alive(page)
