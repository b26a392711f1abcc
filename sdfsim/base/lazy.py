"""Packages that are imported on first use: torch, which simulations with the solver alone never need, and those of
extras."""

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
    """A package of an extra is not there."""


def optional(module: str, title: str, extra: str) -> Any:
    """A module of a package that an extra brings. Raises NotInstalled."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise NotInstalled(f"{title} is not installed", f"pip install 'sdfsim[{extra}]'") from error


def pyplot() -> Any:
    """That of matplotlib, drawing into files. Raises NotInstalled."""
    optional("matplotlib", "matplotlib", "bench").use("Agg")
    return importlib.import_module("matplotlib.pyplot")
