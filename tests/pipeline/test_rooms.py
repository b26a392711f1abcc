"""Rooms of the pipeline import only from rooms below them."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MODULES = {
    ".".join(file.relative_to(ROOT).with_suffix("").parts): file
    for file in sorted((ROOT / "pipeline").rglob("*.py")) if file.name != "__init__.py"
}  # fmt: skip
# From the ground up. What lies in no folder is a room of its own.
FLOORS = (
    ("records", "materials", "naming", "cameras", "grids", "clearing"), ("options",), ("inputs",), ("sfm",),
    ("stereo",), ("field",), ("mesh",), ("scene_writer", "report", "measure"), ("stages",), ("states",), ("commands",),
)  # fmt: skip
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}


def imported(module: str) -> set[str]:
    """The pipeline's modules that a module imports: anywhere in it, lazily and for types as well."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found & set(MODULES)


def room(module: str) -> str:
    return module.split(".")[1]


@pytest.mark.parametrize("module", MODULES)
def test_a_room_imports_only_from_rooms_below(module):
    for other in imported(module):
        assert room(other) == room(module) or FLOOR[room(other)] < FLOOR[room(module)], f"{module} imports {other}"
