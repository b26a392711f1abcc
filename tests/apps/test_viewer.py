"""Which moment of a recording a picture shows, and when the address of a page is told."""

from __future__ import annotations

import signal
import sys
import threading
import urllib.request
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sdfsim import SdfsimError
from sdfsim.apps import viewer

STEP = 4.0 / 240.5  # s: 4 s are 240 steps and a half, so the last of 240 is before them


class Client:
    """Stands for a viewer that holds a recording of 240 steps."""

    shown: float

    @classmethod
    def connect(cls, address: str) -> Client:
        return cls()

    def get_state(self) -> SimpleNamespace:
        end = round(240 * STEP * 1e9)
        lines = [SimpleNamespace(name="step", start=0, end=240), SimpleNamespace(name="time", start=0, end=end)]
        return SimpleNamespace(active_recording="run", loading=False, recordings=[SimpleNamespace(timelines=lines)])

    def set_time(self, timeline: str, *, duration: float, **rest: Any) -> None:
        Client.shown = duration

    def save_screenshot(self, path: str) -> None:
        Path(path).touch()


@pytest.mark.parametrize(
    ("at", "shown"), [(None, 240 * STEP), (0.0, 0.0), (1.5, 1.5), (4.0, 240 * STEP), (4.02, None), (-0.01, None)]
)
def test_the_time_that_a_run_was_asked_for_is_its_end(tmp_path, monkeypatch, at, shown):
    monkeypatch.setattr("rerun.experimental.ViewerClient", Client)
    monkeypatch.setattr(viewer, "_TOAST_SECONDS", 0.0)
    process: Any = SimpleNamespace(poll=lambda: None)
    if shown is None:
        with pytest.raises(SdfsimError, match=rf"--at {at:g}: .*\b0 to 3\.99168 s"):
            viewer._picture(process, "", tmp_path / "x.png", at)
    else:
        viewer._picture(process, "", tmp_path / "x.png", at)
        assert Client.shown == pytest.approx(shown, abs=1e-9)


@pytest.mark.parametrize("name", ["rollout.rrd", "reconstruction.rrd"])
def test_a_folder_is_shown_by_the_recording_in_it(tmp_path, monkeypatch, name):
    opened: list[list[str]] = []
    ended = SimpleNamespace(poll=lambda: 0, wait=lambda: 0)
    monkeypatch.setattr(viewer.subprocess, "Popen", lambda command: opened.append(command) or ended)
    with pytest.raises(SdfsimError, match="no such recording"):
        viewer.show(tmp_path, web=True)
    (tmp_path / name).write_bytes(b"RRF2")
    for place in (tmp_path, tmp_path / name):
        viewer.show(place, web=True)
        assert str(tmp_path / name) in opened.pop()


SLOW = """\
import sys, time
from http.server import BaseHTTPRequestHandler, HTTPServer

class Page(BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.end_headers()

time.sleep(1.0)
HTTPServer(("127.0.0.1", int(sys.argv[sys.argv.index("--web-viewer-port") + 1])), Page).serve_forever()
"""


def test_the_address_of_a_page_is_told_once_it_answers(tmp_path, monkeypatch):
    """A viewer takes a while to start; who opens the address at once sees the page. Ctrl-C ends both, as it should."""
    (tmp_path / "slow.py").write_text(SLOW)
    (tmp_path / "a.rrd").write_bytes(b"RRF2")
    real = viewer.subprocess.Popen
    started: list[Any] = []
    told: list[str] = []

    def popen(command: list[str]) -> Any:
        started.append(real([sys.executable, str(tmp_path / "slow.py"), *command[1:]]))
        return started[0]

    def say(line: str) -> None:
        if line.startswith("watch it at "):
            with urllib.request.urlopen(line.removeprefix("watch it at ").partition("?")[0], timeout=10) as answer:
                assert answer.status == 200
                told.append(line)
            main = threading.main_thread().ident
            threading.Timer(1.0, signal.pthread_kill, [main, signal.SIGINT]).start()

    monkeypatch.setattr(viewer.subprocess, "Popen", popen)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background shells have it ignored
    try:
        viewer.show(tmp_path / "a.rrd", web=True, say=say)
    finally:
        signal.signal(signal.SIGINT, before)
    assert told and started[0].poll() is not None
