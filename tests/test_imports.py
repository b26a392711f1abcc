"""Imports go one way: cli -> pipeline -> sdfsim, inside sdfsim down to shape and errors; help loads nothing heavy."""

from __future__ import annotations

import ast
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FILES = [ROOT / "cli.py", *sorted((ROOT / "sdfsim").rglob("*.py")), *sorted((ROOT / "pipeline").rglob("*.py"))]
HEAVY = (
    "torch",
    "open3d",
    "pycolmap",
    "cv2",
    "rerun",
    "scipy",
    "trimesh",
    "skimage",
    "matplotlib",
    "pybullet",
    "numpy",
)

# A room may import itself and rooms further down. Rooms of one level may not import each other,
# but the rooms of the top level share what they have to (a run writes a recording, a viewer shows one).
LEVELS = {
    "errors": 0,
    "files": 1,
    "parallel": 1,
    "shape": 2,
    "scene": 3,
    "dynamics": 4,
    "data": 6,
    "training": 7,
    "evaluation": 8,
    "commands": 9,
}
TOP = 5  # run, recording and the other modules directly in sdfsim


def room(module: str) -> tuple[str, int]:
    """Name and level of the room that a module of sdfsim lives in."""
    parts = module.split(".")
    if len(parts) == 1:
        return "sdfsim", 0  # its names are loaded on use; the version is all that others take from it
    return (parts[1], LEVELS[parts[1]]) if parts[1] in LEVELS else ("top", TOP)


def imported(file: Path) -> list[str]:
    """Every module of ours that a file imports, anywhere in it, type checking blocks left out."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    hidden = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    found = []
    for node in ast.walk(tree):
        if id(node) in hidden:
            continue
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}:{node.lineno}: relative import"
            found += [f"{node.module}.{a.name}" if is_package(node.module or "") else node.module for a in node.names]
    return [name for name in found if name and name.split(".")[0] in ("cli", "pipeline", "sdfsim")]


def is_package(module: str) -> bool:
    return (ROOT / Path(*module.split(".")) / "__init__.py").exists()


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(ROOT)))
def test_imports_go_one_way(file):
    if file.name == "cli.py":
        return
    here = ".".join(file.relative_to(ROOT).with_suffix("").parts)
    for name in imported(file):
        package = name.split(".")[0]
        assert package != "cli", f"{here} imports {name}"
        if here.startswith("pipeline"):
            continue
        assert package == "sdfsim", f"{here} imports {name}"
        (my_room, mine), (other_room, other) = room(here), room(name)
        if here.startswith("sdfsim.") and name != "sdfsim":
            assert other < mine or other_room == my_room, f"{here} imports {name}"


def test_no_room_is_forgotten():
    rooms = {p.name for p in (ROOT / "sdfsim").iterdir() if (p / "__init__.py").exists()}
    assert rooms <= set(LEVELS) | {"models"}


@pytest.mark.parametrize("command", ["--help", "simulate --help", "reconstruct --help"])
def test_help_loads_nothing_heavy(command):
    code = (
        "import sys, cli\n"
        f"sys.argv = ['sdfsim', *{command.split()!r}]\n"
        "try:\n    cli.app()\nexcept SystemExit as end:\n    assert not end.code, end.code\n"
        f"print('loaded:', *[m for m in {HEAVY!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1].split() == ["loaded:"]


def test_the_library_itself_is_light():
    code = f"import sys, sdfsim; print([m for m in {HEAVY!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_training_needs_torch_and_numpy_only():
    code = (
        "import importlib.metadata as m, re, sys\n"
        "ours = [re.match(r'[\\w.-]+', r)[0] for r in m.requires('sdfsim')]\n"
        "names = {'PyYAML': 'yaml', 'scikit-image': 'skimage', 'libigl': 'igl', 'rerun-sdk': 'rerun'}\n"
        "for name in {names.get(n, n) for n in ours} - {'torch', 'numpy'}:\n    sys.modules[name] = None\n"
        "import sdfsim.training.train"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


@pytest.mark.parametrize("folder", ["benchmarks", "samples", "scripts"])
def test_what_scripts_import_is_there(folder):
    """Nothing else runs all of them, and a module that moves would break them unseen."""
    for file in sorted((ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith(("sdfsim", "pipeline", "tests")):
                module = importlib.import_module(str(node.module))
                for name in (alias.name for alias in node.names):
                    there = hasattr(module, name) or importlib.util.find_spec(f"{node.module}.{name}")
                    assert there, f"{file}: from {node.module} import {name}"
