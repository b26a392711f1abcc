"""Torch, imported on first use: simulations with the solver alone never import it."""

import importlib
from typing import Any


class _Torch:
    def __getattr__(self, name: str) -> Any:
        found = getattr(importlib.import_module("torch"), name)
        setattr(self, name, found)
        return found


torch = _Torch()
