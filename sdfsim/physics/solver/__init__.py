"""The contact solve: scenes as it wants them (`prepare`), and the step, compiled (all other files).

Compiled code is kept in the user's cache folder, under a hash of the files: numba looks only at the file that a
function is in, and would go on with what another one held when it was compiled.
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
    told = hashlib.sha256()
    here = Path(__file__).parent
    for file in [*sorted(here.glob("*.py")), here.parent / "joint_columns.py"]:
        if file.name != "prepare.py":
            told.update(file.read_bytes())
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return home / "sdfsim" / "kernels" / told.hexdigest()[:16]


@contextmanager
def kept() -> Iterator[None]:
    """What is compiled of functions defined in the block is kept: modules that have some are imported in it."""
    settings: Any = config
    before = settings.CACHE_DIR
    settings.CACHE_DIR = before or str(_cache())
    try:
        yield
    finally:
        settings.CACHE_DIR = before


def _without_blas() -> None:
    """Load numba's arrays without SciPy's BLAS, which numba loads to see whether it is there: it takes a tenth of a
    second, and no kernel asks for it. Who does asks for it again."""
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
