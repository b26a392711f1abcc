"""Compilations that take long: announced, and made where they change nothing of what is then run."""

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
_ready: set[str] = set()  # what has been compiled, or found to be, in this process


# The path of modules first: types are read by what is in them.
_CHILD = (
    "import sys, json; sys.path[:] = json.loads(sys.stdin.buffer.readline());"
    "from sdfsim.base.compiling import _compile_here; _compile_here(sys.stdin.buffer.read())"
)


def compile_before(
    function: Any, arguments: Sequence[Any], what: str, takes: str, missing: Mapping[int, bool] | None = None
) -> None:
    """Have a `function` of numba, that is neither in memory nor in numba's cache for this source, compiled for such
    arguments, and warn once in a process that `what` is. `missing`: see `is_compiled`.

    It is compiled in a process of its own, and this one loads what that has kept, as all later ones do: code that has
    just been compiled rounds differently, and a run could not be repeated bit by bit. Where nothing can be kept the
    first call compiles.
    """
    with _lock:  # of several threads that need it one has it compiled
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
    """What the process that started this one wants compiled."""
    from numba.core.serialize import loads

    module, name, types = loads(wanted)
    getattr(import_module(module), name).compile(types)


def is_compiled(function: Any, missing: Mapping[int, bool] | None = None) -> bool:
    """Whether a function of numba is ready within a second; one that runs as Python needs no compiling.

    Args:
        missing: by their place, whether arguments are None, where that makes it another function.
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
