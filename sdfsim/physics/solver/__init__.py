"""The contact solve: preparation of scenes (`prepare`), and the compiled step (all other files).

Compiled code is cached in the user's cache folder, under a hash of all these files.
"""

import sys
from importlib import import_module
from typing import Any

from sdfsim.physics.solver.code_cache import kept_here


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
with kept_here():
    from sdfsim.physics.solver import edges as edges
    from sdfsim.physics.solver import pieces as pieces
    from sdfsim.physics.solver import run as run
