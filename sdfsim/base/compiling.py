"""Warns before a compilation that takes long."""

import logging
from collections.abc import Mapping
from typing import Any

_log = logging.getLogger(__name__)
_said: set[str] = set()


def warn_compiling(function: Any, what: str, takes: str, missing: Mapping[int, bool] | None = None) -> None:
    """Warn, once in a process, that `what` is about to be compiled: where the compiled `function` is neither in memory
    nor in numba's cache for this source. `missing`: see `is_compiled`."""
    if what in _said or is_compiled(function, missing):
        return
    _said.add(what)
    _log.warning("compiling %s, once for this version: about %s", what, takes)


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
