"""Imports go one way, from floor to floor and without circles; help loads nothing heavy.

`python -m tests.test_imports` prints the rooms floor by floor, the imports that go upwards, and the circles.
"""

import ast
import importlib.util
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
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

# The rooms of sdfsim from the ground up. A room imports itself and rooms on floors below it.
FLOORS = [
    ["base"],
    ["geometry"],
    ["sdf"],
    ["shape"],
    ["scene"],
    ["physics"],
    ["learned"],
    ["simulate"],
    ["data", "envs"],
    ["training"],
    ["evaluation"],
    ["apps"],
    ["commands"],
]


# The same of the pipeline's.
PIPELINE = (
    ("records", "materials", "naming", "cameras", "grids", "clearing"), ("options",), ("inputs",), ("sfm",),
    ("stereo",), ("field",), ("mesh",), ("scene_writer", "report", "measure"), ("stages",), ("states",), ("commands",),
)  # fmt: skip


@cache
def modules() -> dict[str, Path]:
    """The files of our modules by name."""
    files = [ROOT / "cli.py", *(ROOT / "sdfsim").rglob("*.py"), *(ROOT / "pipeline").rglob("*.py")]
    names = [".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for file in files]
    return dict(sorted(zip(names, files, strict=True)))


@cache
def imports() -> dict[str, set[str]]:
    """The modules of ours that each module imports, anywhere in its file: in functions and for types only as well."""
    found: dict[str, set[str]] = {}
    for module, file in modules().items():
        found[module] = set()
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{file}:{node.lineno}: relative import"
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            for name in names:
                while name and name not in modules():  # what is imported from a module
                    name = name.rpartition(".")[0]
                found[module] |= {name} - {"", module}
    return found


def floor(module: str) -> tuple[int, str]:
    """The floor and the name of a module's room. `pipeline` is beside `commands`, `cli` above. The package itself is
    below all: its names load on use."""
    package, _, rest = module.partition(".")
    if package != "sdfsim":
        return len(FLOORS) - (package == "pipeline"), package
    room = rest.partition(".")[0]
    return next((level for level, rooms in enumerate(FLOORS) if room in rooms), -1), room


def upwards() -> set[tuple[str, str]]:
    """The imports of a room above, or of another one on the same floor."""
    return {
        (module, other)
        for module, others in imports().items()
        for other in others
        if module != "sdfsim" and floor(other) != floor(module) and floor(other)[0] >= floor(module)[0]
    }


def circles() -> list[set[str]]:
    """The sets of modules that import each other, directly or through others."""
    reached: dict[str, set[str]] = {}
    for module in modules():
        reached[module], ahead = set(), [module]
        while ahead:
            fresh = imports()[ahead.pop()] - reached[module]
            reached[module] |= fresh
            ahead += fresh
    rings = [frozenset(other for other in reached[m] if m in reached[other]) for m in modules() if m in reached[m]]
    return sorted(map(set, set(rings)), key=sorted)


def test_imports_go_down():
    assert not upwards()


def test_imports_of_the_pipeline_go_down():
    level = {room: number for number, rooms in enumerate(PIPELINE) for room in rooms}
    for module, others in imports().items():
        for other in others:
            if module.startswith("pipeline.") and other.startswith("pipeline."):
                rooms = [name.split(".")[1] for name in (module, other)]
                assert rooms[0] == rooms[1] or level[rooms[0]] > level[rooms[1]], f"{module} imports {other}"


def test_there_are_no_circles():
    assert not circles()


def test_every_room_has_a_floor():
    rooms = {p.stem for p in (ROOT / "sdfsim").iterdir() if any(p.glob("*.py")) or p.suffix == ".py"} - {"__init__"}
    assert sorted(rooms) == sorted(room for rooms in FLOORS for room in rooms)


NOT_SOLVING = ("torch", "open3d", "rerun", "trimesh", "skimage", "scipy.linalg", "scipy.spatial", "scipy.sparse")


@pytest.mark.parametrize(
    ("does", "without"),
    [
        ("import sdfsim", HEAVY), ("from cli import app; app(['--help'])", HEAVY),
        ("from cli import app; app(['simulate', '--help'])", HEAVY),
        ("from cli import app; app(['reconstruct', '--help'])", HEAVY),
        ("from cli import app; app('simulate samples/tower.yaml --seconds 0.02 --viewer none -o'.split() + [OUT])",
         NOT_SOLVING),
    ],
    ids=["the library", "help", "help of simulate", "help of reconstruct", "the solver"],
)  # fmt: skip
def test_nothing_heavy_is_loaded_that_is_not_needed(tmp_path, does, without):
    """The solver runs a scene of closed forms without torch, as `sdfsim simulate` does."""
    said = f"atexit.register(lambda: print('loaded:', *[m for m in {without!r} if m in sys.modules]))"
    code = f"import atexit, sys\nOUT = {str(tmp_path / 'run')!r}\n{said}\n{does}"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1].split() == ["loaded:"] and ("app" in does or done.stdout == "loaded:\n")


def test_training_needs_torch_and_numpy_only():
    code = (
        "import importlib.metadata as m, re, sys\n"
        "ours = [re.match(r'[\\w.-]+', r)[0] for r in m.requires('sdfsim')]\n"
        "names = {'PyYAML': 'yaml', 'scikit-image': 'skimage', 'libigl': 'igl', 'rerun-sdk': 'rerun'}\n"
        "for name in {names.get(n, n) for n in ours} - {'torch', 'numpy', 'sdfsim'}:\n    sys.modules[name] = None\n"
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


if __name__ == "__main__":
    for rooms in FLOORS[::-1]:
        print("  ".join(rooms))
    for module, other in sorted(upwards()):
        print(f"upwards: {module} -> {other}")
    for ring in circles():
        print("circle:", " ".join(sorted(ring)))
