"""`python -m benchmarks NAME ...` runs the benchmark of that name, in the folder that holds them all."""

import os
import sys
from importlib import import_module
from pathlib import Path

ALONE = ("contact_step", "effects")  # measured on one thread
SHARED = ("results", "tosses", "baselines")  # modules that the benchmarks share

if __name__ == "__main__":
    if sys.argv[1:2] and sys.argv[1] in ALONE:
        os.environ["NUMBA_NUM_THREADS"] = "1"  # before the first import of numba
    from benchmarks.results import script

    here = sorted(file.stem for file in Path(__file__).parent.glob("[a-z]*.py") if file.stem not in SHARED)
    if not set(sys.argv[1:2]) & set(here):
        sys.exit(f"usage: python -m benchmarks NAME ...   (NAME: {', '.join(here)})")
    module = import_module(f"benchmarks.{sys.argv[1]}")
    sys.argv[:2] = [f"benchmarks {sys.argv[1]}"]
    script(module.__doc__, *getattr(module, "COMMANDS", None) or [module.main])
