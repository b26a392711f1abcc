"""Numbers in the compiled step that have no name.

    python scripts/kernel_numbers.py

Every tolerance stands in sdfsim/physics/solver/tolerances.py. What may stand in a formula: small whole numbers, halves
and quarters, and the numbers below, which are part of a formula and not chosen. Exits with 1 if there are others.
"""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

SOLVER = Path(__file__).parents[1] / "sdfsim/physics/solver"
PLAIN = {0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0}
FORMULAS = {
    "clipping.py": {0.6, 0.8},  # directions in which no two corners of a box are equally far
    "contacts.py": {0.7, 1e-30},  # an axis that is not along the normal; no gravity
    "convex.py": {1e-300},  # no division by zero
    "distance.py": {8.0},  # cells of a brick
    "flight.py": {12.0},  # the Magnus series
    "rows.py": {0.01, 12.0},  # the series of a quotient near 0
    "vectors.py": {1e-4, 12.0},  # likewise
}


def unnamed() -> Iterator[str]:
    """`file:line: number` for each other number in a function."""
    for path in sorted({*SOLVER.glob("*.py")} - {SOLVER / "prepare.py"}):  # which is not compiled
        functions = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)]
        for node in {node for function in functions for node in ast.walk(function)}:
            if isinstance(node, ast.Constant) and isinstance(node.value, float):
                if node.value not in PLAIN | FORMULAS.get(path.name, set()):
                    yield f"{path.name}:{node.lineno}: {node.value}"


if __name__ == "__main__":
    found = sorted(unnamed())
    print("\n".join(found))
    sys.exit(bool(found))
