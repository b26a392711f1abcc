"""The contact solve: preparation of scenes (`prepare`), and the compiled step (all other files).

Compiled code is cached in the user's cache folder, under a hash of all files: numba checks only the file that a
function is in, and would use outdated code if another file changed.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from numba.core import config


def _cache() -> Path:
    hashed = hashlib.sha256()
    here = Path(__file__).parent
    for file in [*sorted(here.glob("*.py")), here.parent / "joint_columns.py"]:
        if file.name != "prepare.py":
            hashed.update(file.read_bytes())
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return home / "sdfsim" / "kernels" / hashed.hexdigest()[:16]


@contextmanager
def kept() -> Iterator[None]:
    """Cache the compiled code of functions that are defined in the block: modules with such functions are imported
    inside it."""
    settings: Any = config
    before = settings.CACHE_DIR
    settings.CACHE_DIR = before or str(_cache())
    try:
        yield
    finally:
        settings.CACHE_DIR = before


def _without_blas() -> None:
    """Load numba's arrays without SciPy's BLAS, which numba loads only to check for it. That takes a tenth of a second,
    and no kernel needs it. Code that does need it loads it later."""
    linalg: Any = import_module("numba.np.linalg")
    asked = getattr(linalg, "ensure_blas", None)
    if asked is None or "numba.np.arraymath" in sys.modules:
        return
    linalg.ensure_blas = lambda: None
    try:
        arrays: Any = import_module("numba.np.arraymath")
    finally:
        linalg.ensure_blas = asked
    arrays.ensure_blas = asked


_without_blas()
with kept():
    from sdfsim.physics.solver import run as run
