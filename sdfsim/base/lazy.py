"""Packages that are imported on first use: torch, which simulations with the contact solve alone never need, and the
packages of extras."""

import importlib
from typing import Any

from sdfsim.base.errors import SdfsimError


class _Torch:
    def __getattr__(self, name: str) -> Any:
        found = getattr(importlib.import_module("torch"), name)
        setattr(self, name, found)
        return found


torch = _Torch()


class NotInstalled(SdfsimError):
    """A package of an extra is not installed."""


def optional(module: str, title: str, extra: str) -> Any:
    """A module of a package that belongs to an extra. Raises NotInstalled if it is missing."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise NotInstalled(f"{title} is not installed", f"pip install 'sdfsim[{extra}]'") from error


def pyplot() -> Any:
    """matplotlib's pyplot, set to draw into files. Raises NotInstalled if matplotlib is missing."""
    optional("matplotlib", "matplotlib", "bench").use("Agg")
    return importlib.import_module("matplotlib.pyplot")
