"""What is imported or made on first use: torch, which simulations with the contact solve alone never need, rerun, the
packages of extras, and what belongs to an object."""

import importlib
import weakref
from collections.abc import Callable
from typing import Any, TypeVar

from sdfsim.base.errors import SdfsimError

Of = TypeVar("Of")
Made = TypeVar("Made")
_MADE: dict[tuple[int, Callable], Any] = {}


class _Package:
    def __init__(self, module: str) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        found = getattr(importlib.import_module(self._module), name)
        setattr(self, name, found)
        return found


torch, rr, rrb = _Package("torch"), _Package("rerun"), _Package("rerun.blueprint")


class NotInstalled(SdfsimError):
    """A package of an extra is not installed, or does not load."""


def optional(module: str, title: str, extra: str) -> Any:
    """A module of a package that belongs to an extra. Raises NotInstalled if it is missing, or with its own error if it
    does not load."""
    try:
        return importlib.import_module(module)
    except Exception as error:  # a package that is broken may raise anything
        missing = error.name or "" if isinstance(error, ModuleNotFoundError) else None
        if missing is not None and f"{module}.".startswith(f"{missing}."):
            raise NotInstalled(f"{title} is not installed", f"pip install 'sdfsim[{extra}]'") from error
        why = " ".join(f"{type(error).__name__}: {error}".split())
        hint = f"mend what it names, or pip install --force-reinstall {module.partition('.')[0]}"
        raise NotInstalled(f"{title} is installed, but does not load ({why})", hint) from error


def pyplot() -> Any:
    """matplotlib's pyplot, set to draw into files. Raises NotInstalled if matplotlib is missing."""
    optional("matplotlib", "matplotlib", "bench").use("Agg")
    return importlib.import_module("matplotlib.pyplot")


def made_once(of: Of, make: Callable[[Of], Made]) -> Made:
    """What the function `make` makes of an object, at its first call; it is kept as long as the object is."""
    key = id(of), make
    if key not in _MADE:
        _MADE[key] = make(of)
        weakref.finalize(of, _MADE.pop, key, None)
    return _MADE[key]
