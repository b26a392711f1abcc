"""The contact solve: preparation of scenes (`prepare`), and the compiled step (all other files).

Compiled code is cached in the user's cache folder, under a hash of all these files.
"""

import sys
from contextlib import AbstractContextManager
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from sdfsim.base.compiling import cache_of, kept


@cache
def _cache() -> Path:
    """The folder of the compiled step, named after a hash of its source."""
    here = Path(__file__).parent
    files = [*sorted(here.glob("*.py")), here.parent / "joint_columns.py"]
    return cache_of(file for file in files if file.name != "prepare.py")


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


def kept_here() -> AbstractContextManager[None]:
    """Keep the compiled code of functions that are defined in the block in the folder of the compiled step."""
    return kept(_cache())


_without_blas()
with kept_here():
    from sdfsim.physics.solver import edges as edges
    from sdfsim.physics.solver import pieces as pieces
    from sdfsim.physics.solver import run as run
