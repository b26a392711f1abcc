"""The contact solve: scenes as it wants them (`prepare`), and the step, compiled (all other files).

Compiled code is kept in the user's cache folder, under a hash of the files: numba looks only at the file that a
function is in, and would go on with what another one held when it was compiled.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
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


with kept():
    from sdfsim.physics.solver import run as run
