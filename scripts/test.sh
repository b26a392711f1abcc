#!/usr/bin/env bash
# Set-up with the test extras, then linter, type checker and tests. Arguments go to pytest, such as -m slow.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash scripts/setup.sh test
.venv/bin/ruff check .
.venv/bin/pyright
# Compiles and keeps the code for hollow shapes and joints once, so that the two test processes do not both compile it.
warm() { .venv/bin/python -c 'import sys, sdfsim; sdfsim.Simulator(f"samples/{sys.argv[1]}.yaml", sys.argv[2]).step(2)' "$@"; }
warm door solver &
warm knocked_vase solver
warm knocked_vase gnn
wait $!
# Two processes with one thread each are faster than one with two, because most tests are too small for threads.
OMP_NUM_THREADS=1 .venv/bin/pytest -n 2 --dist worksteal "$@"
