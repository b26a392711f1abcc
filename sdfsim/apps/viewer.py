"""The rerun viewer: live streams, and recordings on disk."""

import atexit
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import webbrowser
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from types import FrameType

from sdfsim.apps.recording import Playback
from sdfsim.base.errors import SdfsimError

LOOPBACK = "127.0.0.1"  # the address on which viewers listen; by default they would listen on the whole network
_GRPC_PORT, _WEB_PORT = 9876, 9090
_START_SECONDS = 60.0
_WINDOWS_CTRL_C = 0xC000013A  # the exit code there


def stream_to_viewer(playback: Playback, kind: str) -> str:
    """Send everything that `playback` logs from now on to a viewer: a window (`native`), or a page (`web`) that exists
    as long as this process runs. Returns the address of the page. Raises SdfsimError if the viewer does not start."""
    port, page_port = free_port(_GRPC_PORT), free_port(_WEB_PORT)
    web = ["--serve-web", "--web-viewer-port", str(page_port)]
    viewer = _launch(port, web if kind == "web" else ["--expect-data-soon", "--hide-welcome-screen"])
    if not _started(viewer, port) or (kind == "web" and not _started(viewer, page_port)):
        _end(viewer)
        raise SdfsimError("the rerun viewer does not start", "use --viewer file")
    playback.stream.connect_grpc(f"rerun+http://{LOOPBACK}:{port}/proxy")
    if kind == "native":
        return ""
    atexit.register(_end, viewer)
    page = _page(page_port, port)
    if has_screen():
        webbrowser.open(page)
    return page


def _started(viewer: subprocess.Popen, port: int) -> bool:
    """Wait until a viewer answers at a port. Returns whether it does."""
    began = time.monotonic()
    while not _answers(port):
        if viewer.poll() is not None or time.monotonic() - began > _START_SECONDS:
            return False
        time.sleep(0.1)
    return True


def _page(page_port: int, port: int) -> str:
    return f"http://localhost:{page_port}?url=rerun%2Bhttp://localhost:{port}/proxy"


def _command(port: int, options: list[str]) -> list[str]:
    return [viewer_program(), *options, "--bind", LOOPBACK, "--port", str(port)]


def _launch(port: int, options: list[str]) -> subprocess.Popen:
    """Start a viewer in its own process group, so that Ctrl-C for this process does not end it."""
    _end_orderly()
    quiet, group = subprocess.DEVNULL, getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)  # Windows has no sessions
    command = _command(port, options)
    return subprocess.Popen(command, stdout=quiet, stderr=quiet, start_new_session=True, creationflags=group)


def _end_orderly() -> None:
    """From now on this process ends as with `exit` if it is asked to (by `kill`, a service manager, or a terminal that
    closes), so that it ends its viewer too. Elsewhere than in the main thread, and where the caller has handlers of its
    own, nothing changes."""

    def leave(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        mine = threading.current_thread() is threading.main_thread()
        if number is not None and mine and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, leave)


def check_screen(kind: str) -> None:
    """Raises SdfsimError if a window (`native`) is wanted but there is no screen."""
    if kind == "native" and not has_screen():
        raise SdfsimError("there is no screen here for a window", "watch it in the browser, --viewer web or view --web")


def has_screen() -> bool:
    return bool(sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def show(recording: Path, *, web: bool = False, say: Callable[[str], None] = lambda line: None) -> None:
    """Open a recording, or that of a run folder, and wait until the viewer is closed. `say` gets the address of a page
    in the browser (`web`). Raises SdfsimError if there is no such recording, if there is no screen for a window, or if
    the viewer fails."""
    recording = _recording(recording)
    port, page_port = free_port(_GRPC_PORT), free_port(_WEB_PORT)
    if not web:
        check_screen("native")
    options = ["--web-viewer", "--web-viewer-port", str(page_port)] if web else []
    _end_orderly()
    viewer, announced = subprocess.Popen(_command(port, [str(recording), *options])), False
    try:
        if web and _started(viewer, page_port):  # before that, the address does not work
            say(f"watch it at {_page(page_port, port)}")
            say("the page stays up until Ctrl-C")
            announced = True
        code = viewer.wait()
    except BaseException as error:
        _end(viewer)
        if announced and isinstance(error, KeyboardInterrupt):
            return
        raise
    if code not in (0, -signal.SIGINT, 130, _WINDOWS_CTRL_C):
        raise SdfsimError(f"the rerun viewer ended with code {code}", "without a screen: sdfsim view --web")


def _end(process: subprocess.Popen) -> None:
    process.terminate()
    try:
        process.wait(timeout=10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _recording(place: Path) -> Path:
    """The recording of a run folder or of a reconstruction, or the file itself. Raises SdfsimError if there is none."""
    inside = [place / name for name in ("rollout.rrd", "reconstruction.rrd") if (place / name).is_file()]
    file = inside[0] if inside else place
    wanted = "give a run folder, or a rollout.rrd or rollout.npz that simulate has written"
    if place.is_dir() and not inside:
        unfinished = (place / "checkpoint").is_dir()
        wanted = "go on with the run: sdfsim simulate SCENE -o FOLDER --resume" if unfinished else wanted
        raise SdfsimError(f"{place}: neither rollout.rrd nor rollout.npz is in this folder", wanted)
    if not file.is_file():
        raise SdfsimError(f"{place}: no such recording", wanted)
    if file.open("rb").read(3) != b"RRF":
        raise SdfsimError(f"{file}: not a recording of rerun", wanted)
    return file


def viewer_program() -> str:
    """The viewer program inside the rerun package: the script `rerun` only starts it, may not be on the PATH, and may
    not end it. As with that script, RERUN_CLI_PATH may name another one."""
    package = find_spec("rerun_cli")
    folders = package.submodule_search_locations if package else None
    home = Path(next(iter(folders or []), "."))
    places = [home / "Rerun.app" / "Contents" / "MacOS" / "Rerun", home / "rerun", home / "rerun.exe"]
    found = os.environ.get("RERUN_CLI_PATH") or next((str(place) for place in places if place.is_file()), None)
    if not found:
        raise SdfsimError("the rerun program is missing", "pip install rerun-sdk")
    return found


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((LOOPBACK, port)) == 0


def free_port(wanted: int = 0) -> int:
    """`wanted` if nothing listens there, else any free port."""
    if wanted and not _answers(wanted):
        return wanted
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]
