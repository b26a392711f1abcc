"""Long compilations: announced, and done in another process so that results do not depend on them."""

import gc
import json
import logging
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from threading import Lock
from typing import Any

_log = logging.getLogger(__name__)
_lock = Lock()
_ready: set[str] = set()  # functions that this process has compiled, or found compiled


# The module path comes first: reading the types imports modules from it.
_CHILD = (
    "import sys, json; sys.path[:] = json.loads(sys.stdin.buffer.readline());"
    "from sdfsim.base.compiling import _compile_here; _compile_here(sys.stdin.buffer.read())"
)


def compile_before(
    function: Any, arguments: Sequence[Any], what: str, takes: str, missing: Mapping[int, bool] | None = None
) -> None:
    """Compile a numba `function` for arguments of these types, unless it is in memory or in numba's cache for this
    source. Warn once in a process that `what` is compiled. `missing`: see `is_compiled`.

    A process of its own compiles it and fills the cache, and this one loads it from there, as all later ones do: code
    that has just been compiled rounds differently, so a run could not be repeated bit by bit. If the cache cannot be
    written, the first call compiles.
    """
    with _lock:  # if several threads need it, one of them compiles
        if what in _ready:
            return
        _ready.add(what)
        if is_compiled(function, missing):
            return
        _log.warning("compiling %s, once for this version: about %s", what, takes)
        try:
            function._cache._impl.locator.ensure_cache_path()
        except (AttributeError, OSError):
            return
        from numba import typeof
        from numba.core.serialize import dumps

        name = (function.py_func.__module__, function.py_func.__qualname__)
        wanted = dumps((*name, tuple(typeof(each) for each in arguments)))
        path = json.dumps([*sys.path]).encode() + b"\n"
        subprocess.run([sys.executable, "-c", _CHILD], input=path + wanted, capture_output=True, check=False)


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
    if any(_fits(arguments, missing) for arguments in function.signatures):
        return True
    try:
        # The entries for the source file as it is now; empty if it has changed since.
        return any(_fits(key[0], missing) for key in function._cache._cache_file._load_index())
    except (AttributeError, OSError):  # there is no cache, or it cannot be read
        return False


def _fits(arguments: tuple, missing: Mapping[int, bool] | None) -> bool:
    return all((str(arguments[place]) == "none") == none for place, none in (missing or {}).items())
