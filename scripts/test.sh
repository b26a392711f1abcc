#!/usr/bin/env bash
# Set-up with the test extras, then linter, type checker and tests. Arguments go to pytest, such as -m slow.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash scripts/setup.sh test
.venv/bin/ruff check .
.venv/bin/pyright
.venv/bin/pytest "$@"
