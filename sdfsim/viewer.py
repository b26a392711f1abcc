"""The rerun viewer: live streams, recordings on disk, and pictures taken without a screen."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import sysconfig
import tempfile
import time
from pathlib import Path
from shutil import which
from typing import Literal
from urllib.parse import quote

from sdfsim.errors import SdfsimError
from sdfsim.playback import Playback

WINDOW = "1600x900"
_GRPC_PORT, _WEB_PORT = 9876, 9090
_START_SECONDS = 60.0
_TOAST_SECONDS = 10.0  # the notices of the start cover the plots until they fade
_NO_GRAPHICS = "pictures need a Vulkan driver: apt-get install mesa-vulkan-drivers"


def stream_to_viewer(playback: Playback, kind: Literal["native", "web"]) -> str:
    """Send everything that `playback` logs from now on to a viewer.

    Args:
        playback: nothing logged yet.
        kind: a window, or a page served by this process for as long as it runs.

    Returns:
        The address of the page, or an empty string for a window.

    Raises:
        SdfsimError: no screen, or the viewer does not start.
    """
    import rerun as rr

    check_screen(kind)
    try:
        if kind == "native":
            playback.stream.spawn(port=_free_port(_GRPC_PORT), hide_welcome_screen=True)
            return ""
        source = playback.stream.serve_grpc(grpc_port=_free_port(_GRPC_PORT))
        port = _free_port(_WEB_PORT)
        rr.serve_web_viewer(web_port=port, open_browser=_has_screen(), connect_to=source)
    except RuntimeError as error:
        raise SdfsimError(f"the rerun viewer does not start: {error}", "use --viewer file") from error
    return f"http://localhost:{port}?url={quote(source, safe=':/')}"


def check_screen(kind: Literal["native", "web"]) -> None:
    """Raises SdfsimError when a window is wanted where there is no screen."""
    if kind == "native" and not _has_screen():
        raise SdfsimError("--viewer native: there is no screen here", "use --viewer web, or --viewer file")


def _has_screen() -> bool:
    return bool(sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def show(recording: Path, *, web: bool = False) -> None:
    """Open a recording, and wait until the viewer is closed.

    Raises:
        SdfsimError: no such recording, or the viewer fails.
    """
    command = [_executable(), str(_existing(recording))]
    if web:
        command += [
            "--web-viewer",
            "--web-viewer-port",
            str(_free_port(_WEB_PORT)),
            "--port",
            str(_free_port(_GRPC_PORT)),
        ]
    code = subprocess.run(command, check=False).returncode
    if code not in (0, -signal.SIGINT, 130):
        raise SdfsimError(f"the rerun viewer ended with code {code}", "without a screen: sdfsim view --web")


def screenshot(recording: Path, picture: Path, *, at: float | None = None) -> None:
    """Write what the viewer shows of a recording as a PNG, without a screen.

    Args:
        recording: .rrd.
        picture: .png to write.
        at: time in s (default: the end of the recording).

    Raises:
        SdfsimError: no such recording, no such time in it, no graphics driver, or the file cannot be written.
    """
    _existing(recording)
    if not picture.parent.is_dir() or not os.access(picture.parent, os.W_OK):
        raise SdfsimError(f"{picture}: the folder is missing or not writable")
    port = _free_port(0)
    command = [_executable(), "--headless", "--window-size", WINDOW, "--port", str(port), str(recording.resolve())]
    with tempfile.TemporaryFile() as log:
        # A group of its own: `rerun` is a script that starts the real viewer, and both have to go.
        viewer = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        try:
            _picture(viewer, f"rerun+http://127.0.0.1:{port}/proxy", picture, at)
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
    times = [t for recording in state.recordings for t in recording.timelines if t.name == "time"]
    if times:
        first, last = (times[0].start or 0) * 1e-9, (times[0].end or 0) * 1e-9
        if at is not None and not first <= at <= last + 1e-6:
            raise SdfsimError(f"--at {at:g}: the recording holds {first:g} to {last:g} s")
        client.set_time("time", duration=last if at is None else at, play_state="paused")
    time.sleep(_TOAST_SECONDS)
    client.save_screenshot(str(picture.resolve()))
    if not picture.exists():
        raise SdfsimError(f"{picture}: cannot be written")


def _end(process: subprocess.Popen) -> None:
    try:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(timeout=10)
    except ProcessLookupError:
        pass
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)


def _existing(recording: Path) -> Path:
    if not recording.is_file():
        raise SdfsimError(f"{recording}: no such recording", "give a rollout.rrd that simulate has written")
    with open(recording, "rb") as handle:
        if handle.read(3) != b"RRF":
            raise SdfsimError(f"{recording}: not a rerun recording", "give a rollout.rrd that simulate has written")
    return recording


def _executable() -> str:
    """The `rerun` of this environment, which may not be on the PATH."""
    beside = which("rerun", path=sysconfig.get_path("scripts"))
    found = beside or which("rerun")
    if not found:
        raise SdfsimError("the rerun program is missing", "pip install rerun-sdk")
    return found


def _free_port(wanted: int) -> int:
    """`wanted` if nothing listens there, else any free port."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
                return probe.getsockname()[1]
            except OSError:
                continue
    raise SdfsimError("no free network port for the viewer")
