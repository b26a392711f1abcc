"""Warns before a compilation that takes long."""

import logging
from typing import Any

_log = logging.getLogger(__name__)
_said: set[str] = set()


def warn_compiling(function: Any, what: str, takes: str) -> None:
    """Warn, once in a process, that `what` is about to be compiled: where the compiled `function` is neither in memory
    nor in numba's cache for this source."""
    if what in _said or is_compiled(function):
        return
    _said.add(what)
    _log.warning("compiling %s, once for this version: about %s", what, takes)


def is_compiled(function: Any) -> bool:
    """Whether a function of numba is ready within a second; one that runs as Python needs no compiling."""
    if not hasattr(function, "signatures"):
        return True
    if function.signatures:
        return True
    try:
        # The entries for the source file as it is now; empty if it has changed since.
        return bool(function._cache._cache_file._load_index())
    except (AttributeError, OSError):  # there is no cache, or it cannot be read
        return False
