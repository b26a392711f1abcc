"""Compiled code: cached under a hash of its source. Long compilations are announced, and done in another process so
that results do not depend on them."""

import gc
import hashlib
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from sdfsim.base.files import user_cache

_log = logging.getLogger(__name__)
_lock = threading.Lock()
_ready: set[tuple] = set()  # functions with types of arguments that this process has compiled, or found compiled
_spent = 0.0  # s, see `seconds_spent`
_open: list[float] = []  # when the compilations began that are going on in this process
_watched = _said = False


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C waits for the end of the block: a handler that raises an exception while numba converts arguments or
    results ends the process."""
    handler = signal.getsignal(signal.SIGINT)
    if not callable(handler) or threading.current_thread() is not threading.main_thread():
        yield
        return
    pressed: list[tuple[Any, ...]] = []
    signal.signal(signal.SIGINT, lambda *given: pressed.append(given))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if pressed:
            handler(*pressed[0])


# The module path comes first: reading the types imports modules from it.
_CHILD = (
    "import sys, json; sys.path[:] = json.loads(sys.stdin.buffer.readline());"
    "from sdfsim.base.compiling import _compile_here; _compile_here(sys.stdin.buffer.read())"
)


def cache_of(sources: Iterable[Path]) -> Path:
    """The folder in the user's cache for the compiled code of these files, named after a hash of them: numba checks
    only the file that a function is in, and would use outdated code if another file changed."""
    hashed = hashlib.sha256()
    for file in sources:
        hashed.update(file.read_bytes())
    return user_cache("kernels") / hashed.hexdigest()[:16]


@contextmanager
def kept(cache: Path) -> Iterator[None]:
    """Keep the compiled code of functions that are defined in the block in the folder `cache`, unless the user has set
    numba's own: modules with such functions are imported inside the block."""
    from numba.core import config

    settings: Any = config
    before = settings.CACHE_DIR
    settings.CACHE_DIR = before or str(cache)
    try:
        yield
    finally:
        settings.CACHE_DIR = before


def compile_before(jobs: Sequence[tuple[Any, tuple]], what: str) -> None:
    """Compile numba functions for types of arguments, [(function, types)], unless they are in memory or in numba's
    cache for their source. Warn that `what` is compiled.

    Processes of their own compile them, as many as there are cores, and fill the cache, and this one loads them from
    there, as all later ones do: code that has just been compiled rounds differently, so a run could not be repeated bit
    by bit. If the cache cannot be written, the first call compiles.
    """
    from numba.core.serialize import dumps

    global _said, _spent
    with _lock:  # if several threads need one, one of them compiles
        if not hasattr(jobs[0][0], "signatures"):  # plain Python
            return
        missing = [job for job in jobs if (_name(job[0]), job[1]) not in _ready]
        _ready.update((_name(function), types) for function, types in missing)
        # These types exactly: arrays of another type or layout need a form of their own.
        missing = [job for job in missing if job[1] not in _forms(job[0])]
        if not missing:
            return
        cores = os.cpu_count() or 1
        missing.sort(key=lambda job: -_seconds(job[0]))
        takes = max(_seconds(missing[0][0]), sum(_seconds(function) for function, _ in missing) / cores)
        parts = f" in {len(missing)} parts" if len(missing) > 1 else ""
        _log.warning("compiling %s%s, once for this version: about %.0f s", what, parts, takes)
        _said = True
        try:
            _cache_of(missing[0][0])._impl.locator.ensure_cache_path()
        except (AttributeError, OSError):
            return
        started = time.perf_counter()
        path = json.dumps([*sys.path]).encode() + b"\n"

        def compiled(job: tuple[Any, tuple]) -> None:
            wanted = dumps((*_name(job[0]), job[1]))
            subprocess.run([sys.executable, "-c", _CHILD], input=path + wanted, capture_output=True, check=False)

        with ThreadPoolExecutor(cores) as pool:
            list(pool.map(compiled, missing))
        _spent += time.perf_counter() - started


def _name(function: Any) -> tuple[str, str]:
    return function.py_func.__module__, function.py_func.__qualname__


def _seconds(function: Any) -> float:
    """About how long a function is compiled, s."""
    return float(getattr(function, "seconds", 20.0))


def say_compiling() -> None:
    """From now on warn, once, when this process begins to compile anything of numba; some functions take seconds."""
    global _watched
    if not _watched:
        _watched = True
        from numba.core import event

        class Watch(event.Listener):
            def on_start(self, event: Any) -> None:
                global _said
                if not _said:
                    _said = True
                    _log.warning("compiling code for this machine, once for this version: some seconds")
                _open.append(time.perf_counter())

            def on_end(self, event: Any) -> None:
                global _spent
                began = _open.pop()
                _spent += time.perf_counter() - began if not _open else 0.0

        event.register("numba:compile", Watch())


def seconds_spent() -> float:
    """s that this process has spent on compiling so far."""
    return _spent


def running() -> float:
    """s, a clock that stands still while this process compiles: for the time of steps and runs."""
    return time.perf_counter() - _spent


def _compile_here(wanted: bytes) -> None:
    """Compile what the parent process asks for."""
    from numba.core.serialize import loads

    # Types, graphs and code stay until the end. Looking for garbage among them took a sixth of the time.
    gc.disable()
    module, name, types = loads(wanted)
    getattr(import_module(module), name).compile(types)


def is_compiled(function: Any) -> bool:
    """Whether a numba function is ready within a second. One that runs as plain Python needs no compiling."""
    return not hasattr(function, "signatures") or bool(_forms(function))


def _cache_of(function: Any) -> Any:
    """Numba's cache of a dispatcher, or of a piece of the contact step."""
    return function.cache() if hasattr(function, "cache") else function._cache


def _forms(function: Any) -> list[tuple]:
    """The types of arguments for which a function is in memory, or in the cache for its source as it is now."""
    try:
        index = _cache_of(function)._cache_file._load_index()
    except (AttributeError, OSError, RuntimeError):  # there is no cache, or it cannot be read
        index = {}
    known = (key[0] for key in index)
    return [*function.signatures, *(getattr(each, "args", each) for each in known)]
