"""The rerun viewer: live streams, recordings on disk, and pictures taken without a screen."""

from __future__ import annotations

import atexit
import os
import signal
import socket
import subprocess
import sys
import sysconfig
import tempfile
import time
import webbrowser
from ipaddress import ip_address
from pathlib import Path
from shutil import which
from typing import Any, Literal
from urllib.parse import quote

from sdfsim.errors import SdfsimError
from sdfsim.recording import Playback

WINDOW = "1600x900"
LOOPBACK = "127.0.0.1"
_GRPC_PORT, _WEB_PORT = 9876, 9090
_START_SECONDS = 60.0
_TOAST_SECONDS = 10.0  # the notices of the start cover the plots until they fade
_NO_GRAPHICS = "pictures need a Vulkan driver: apt-get install mesa-vulkan-drivers"


def stream_to_viewer(playback: Playback, kind: Literal["native", "web"], *, bind: str = LOOPBACK) -> str:
    """Send everything that `playback` logs from now on to a viewer: a window, or a page that is there for as long as
    this process runs, whose address is returned. Raises SdfsimError for no screen, or where the viewer does not start.
    """
    check_screen(kind)
    serving = _Serving(bind)
    web = [*serving.page_options, "--serve-web"]
    viewer = _start(serving, web if kind == "web" else ["--expect-data-soon", "--hide-welcome-screen"])
    playback.stream.connect_grpc(f"rerun+http://{serving.near}:{serving.port}/proxy")
    if kind == "native":
        return ""
    atexit.register(_end, viewer)
    if _has_screen():
        webbrowser.open(serving.page)
    return serving.page


class _Serving:
    """Ports for a viewer that listens on `bind` (0.0.0.0 is every address of this machine), and how they are told to
    it; its own default would let the whole network in. Raises SdfsimError where that is not an address."""

    def __init__(self, bind: str) -> None:
        try:
            address = ip_address(bind)
        except ValueError as error:
            raise SdfsimError(f"--bind {bind}: not an address", f"such as {LOOPBACK}, or 0.0.0.0 for all") from error
        self.port, self.page_port = _free_port(_GRPC_PORT), _free_port(_WEB_PORT)
        self.near = LOOPBACK if address.is_unspecified or address.is_loopback else bind
        host = "localhost" if address.is_loopback else socket.gethostname() if address.is_unspecified else bind
        self.page = f"http://{host}:{self.page_port}?url={quote(f'rerun+http://{host}:{self.port}/proxy', safe=':/')}"
        self.options = ["--bind", bind, "--port", str(self.port)]
        self.page_options = ["--web-viewer-port", str(self.page_port)]
        if not address.is_loopback:
            self.page_options += ["--cors-allow-origin", f"http://{host}:{self.page_port}"]


def _launch(options: list[str], output: Any) -> subprocess.Popen:
    """A viewer in a group of its own: `rerun` is a script that starts the real one, and both have to go together."""
    return subprocess.Popen([_executable(), *options], stdout=output, stderr=output, start_new_session=True)


def _start(serving: _Serving, options: list[str]) -> subprocess.Popen:
    viewer = _launch([*serving.options, *options], subprocess.DEVNULL)
    started = time.monotonic()
    while time.monotonic() - started < _START_SECONDS and viewer.poll() is None:
        try:
            socket.create_connection((serving.near, serving.port), timeout=1.0).close()
            return viewer
        except OSError:
            time.sleep(0.1)
    _end(viewer)
    raise SdfsimError("the rerun viewer does not start", "use --viewer file")


def check_screen(kind: Literal["native", "web"]) -> None:
    """Raises SdfsimError when a window is wanted where there is no screen."""
    if kind == "native" and not _has_screen():
        raise SdfsimError("--viewer native: there is no screen here", "use --viewer web, or --viewer file")


def _has_screen() -> bool:
    return bool(sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def show(recording: Path, *, web: bool = False, bind: str = LOOPBACK) -> None:
    """Open a recording, and wait until the viewer is closed. Raises SdfsimError for no such recording, or where it
    fails."""
    serving = _Serving(bind)
    command = [_executable(), str(_existing(recording)), *serving.options]
    if web:
        command += ["--web-viewer", *serving.page_options]
    code = subprocess.run(command, check=False).returncode
    if code not in (0, -signal.SIGINT, 130):
        raise SdfsimError(f"the rerun viewer ended with code {code}", "without a screen: sdfsim view --web")


def screenshot(recording: Path, picture: Path, *, at: float | None = None) -> None:
    """Write what the viewer shows of a recording `at` a time in s (default: the end) as a PNG, without a screen. Raises
    SdfsimError for no such recording or time, no graphics driver, or a file that cannot be written."""
    _existing(recording)
    if not picture.parent.is_dir() or not os.access(picture.parent, os.W_OK):
        raise SdfsimError(f"{picture}: the folder is missing or not writable")
    port = _free_port(0)
    options = ["--headless", "--window-size", WINDOW, "--bind", LOOPBACK, "--port", str(port)]
    with tempfile.TemporaryFile() as log:
        viewer = _launch([*options, str(recording.resolve())], log)
        try:
            _picture(viewer, f"rerun+http://{LOOPBACK}:{port}/proxy", picture, at)
        except ConnectionError as error:
            log.seek(0)
            told = log.read().decode(errors="replace")
            hint = _NO_GRAPHICS if "adapter" in told.lower() and viewer.poll() is not None else ""
            raise SdfsimError(f"{recording}: no picture: {str(error).splitlines()[0]}", hint) from error
        finally:
            _end(viewer)


def _picture(viewer: subprocess.Popen, address: str, picture: Path, at: float | None) -> None:
    from rerun.experimental import ViewerClient

    started = time.monotonic()
    while True:
        try:
            client = ViewerClient.connect(address)
            state = client.get_state()
            if state.active_recording and not state.loading:
                break
        except ConnectionError:
            pass
        if viewer.poll() is not None or time.monotonic() - started > _START_SECONDS:
            raise ConnectionError("the viewer did not start")
        time.sleep(0.2)
    timelines = {t.name: t for recording in state.recordings for t in recording.timelines}
    if time_line := timelines.get("time"):
        first, last = (time_line.start or 0) * 1e-9, (time_line.end or 0) * 1e-9
        count = timelines.get("step")
        steps = (count.end or 0) - (count.start or 0) if count else 0
        client.set_time("time", duration=_moment(at, first, last, steps), play_state="paused")
    time.sleep(_TOAST_SECONDS)
    client.save_screenshot(str(picture.resolve()))
    if not picture.exists():
        raise SdfsimError(f"{picture}: cannot be written")


def _moment(at: float | None, first: float, last: float, steps: int) -> float:
    """The time in s to show, between the `first` and the `last` of a recording of so many steps. A run is a whole
    number of steps, so it ends up to one before the time that was asked for: that is its end too."""
    step = (last - first) / steps if steps else 0.0
    if at is not None and not first <= at <= last + max(step, 1e-6):
        raise SdfsimError(f"--at {at:g}: the recording holds {first:g} to {last:g} s")
    return last if at is None else min(at, last)


def _end(process: subprocess.Popen) -> None:
    try:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(timeout=10)
    except ProcessLookupError:
        pass
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)


def _existing(recording: Path) -> Path:
    hint = "give a rollout.rrd that simulate has written"
    if not recording.is_file():
        raise SdfsimError(f"{recording}: no such recording", hint)
    with open(recording, "rb") as handle:
        if handle.read(3) != b"RRF":
            raise SdfsimError(f"{recording}: not a rerun recording", hint)
    return recording


def _executable() -> str:
    """The `rerun` of this environment, which may not be on the PATH."""
    found = which("rerun", path=sysconfig.get_path("scripts")) or which("rerun")
    if not found:
        raise SdfsimError("the rerun program is missing", "pip install rerun-sdk")
    return found


def _free_port(wanted: int) -> int:
    """`wanted` if nothing listens there, else any free port."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            try:
                probe.bind((LOOPBACK, port))
                return probe.getsockname()[1]
            except OSError:
                continue
    raise SdfsimError("no free network port for the viewer")
