"""Compiled code: cached under a hash of its source. Long compilations are announced, and done in another process so
that results do not depend on them."""

import gc
import hashlib
import json
import logging
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from threading import Lock
from typing import Any

from sdfsim.base.files import user_cache

_log = logging.getLogger(__name__)
_lock = Lock()
_ready: set[tuple] = set()  # functions with types of arguments that this process has compiled, or found compiled
_spent = 0.0  # s, see `seconds_spent`
_open: list[float] = []  # when the compilations began that are going on in this process
_watched = _said = False


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


def compile_before(
    function: Any, arguments: Sequence[Any], what: str, takes: str, missing: Mapping[int, bool] | None = None
) -> None:
    """Compile a numba `function` for arguments of these types, unless it is in memory or in numba's cache for this
    source. Warn once in a process that `what` is compiled. `missing`: see `is_compiled`.

    A process of its own compiles it and fills the cache, and this one loads it from there, as all later ones do: code
    that has just been compiled rounds differently, so a run could not be repeated bit by bit. If the cache cannot be
    written, the first call compiles.
    """
    from numba import typeof
    from numba.core.serialize import dumps

    global _said, _spent
    types = tuple(typeof(each) for each in arguments)
    with _lock:  # if several threads need it, one of them compiles
        if (what, types) in _ready:
            return
        _ready.add((what, types))
        # These types exactly: arrays of another type or layout need a form of their own.
        if not hasattr(function, "signatures") or types in _forms(function):
            return
        again = ", for other types of arrays" if is_compiled(function, missing) else ""
        _log.warning("compiling %s%s, once for this version: about %s", what, again, takes)
        _said = True
        try:
            function._cache._impl.locator.ensure_cache_path()
        except (AttributeError, OSError):
            return
        started = time.perf_counter()
        wanted = dumps((function.py_func.__module__, function.py_func.__qualname__, types))
        path = json.dumps([*sys.path]).encode() + b"\n"
        subprocess.run([sys.executable, "-c", _CHILD], input=path + wanted, capture_output=True, check=False)
        _spent += time.perf_counter() - started


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


def is_compiled(function: Any, missing: Mapping[int, bool] | None = None) -> bool:
    """Whether a numba function is ready within a second. One that runs as plain Python needs no compiling.

    Args:
        missing: argument index -> whether it is None, for arguments where None selects another specialisation.
    """
    if not hasattr(function, "signatures"):
        return True
    return any(_fits(arguments, missing) for arguments in _forms(function))


def _forms(function: Any) -> list[tuple]:
    """The types of arguments for which a numba function is in memory, or in the cache for its source as it is now."""
    try:
        kept = [key[0] for key in function._cache._cache_file._load_index()]
    except (AttributeError, OSError):  # there is no cache, or it cannot be read
        kept = []
    return [*function.signatures, *kept]


def _fits(arguments: tuple, missing: Mapping[int, bool] | None) -> bool:
    return all((str(arguments[place]) == "none") == none for place, none in (missing or {}).items())
