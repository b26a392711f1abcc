"""The wheel that this repository builds is whole: installed into an empty folder, away from the checkout, it works."""

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

from sdfsim import Rollout
from sdfsim.base.version import __version__

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.gate


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    home = tmp_path_factory.mktemp("wheel")
    left_out = shutil.ignore_patterns(".*", "tests", "docs", "benchmarks", "runs", "build", "*.egg-info", "__pycache__")
    shutil.copytree(ROOT, home / "source", ignore=left_out)
    build = [sys.executable, "-m", "pip", "wheel", "-v", "--no-deps", "--no-build-isolation", "-w", str(home)]
    done = subprocess.run([*build, str(home / "source")], check=True, cwd=home, capture_output=True, text=True)
    assert "would be ignored" not in done.stdout + done.stderr  # what setuptools says of folders that it does not know
    (made,) = home.glob("*.whl")
    return made


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """A folder with nothing but what the wheel holds."""
    target = tmp_path_factory.mktemp("installed")
    command = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", str(target)]
    subprocess.run([*command, str(wheel)], check=True)
    return target


def call(installed: Path, folder: Path, *arguments: str) -> str:
    """What a command of the installed program prints, called from another folder."""
    own = {"PYTHONPATH": str(installed), "NUMBA_DISABLE_JIT": "1", "XDG_CACHE_HOME": str(folder / "cache")}
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=folder, env=os.environ | own, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_what_the_wheel_is_and_needs(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        about = Parser().parsestr(archive.read(f"sdfsim-{__version__}.dist-info/METADATA").decode())
    folders = {name.partition("/")[0] for name in names}
    assert folders == {"cli.py", "pipeline", "sdfsim", f"sdfsim-{__version__}.dist-info"}
    code = {str(f.relative_to(ROOT).as_posix()) for room in ("sdfsim", "pipeline") for f in (ROOT / room).rglob("*.py")}
    assert code <= names and {"sdfsim/py.typed", "sdfsim/models/gnn.safetensors"} <= names
    samples = [f for f in (ROOT / "samples").rglob("*") if f.is_file() and "__pycache__" not in f.parts]
    missing = {path for f in samples if f"sdfsim/{(path := f.relative_to(ROOT).as_posix())}" not in names}
    assert missing == {"samples/photos/make.py", "samples/photos/phone.py"}  # these draw the photos for tests
    told = re.search(rf"{re.escape(wheel.name)}, (\d+) MB", (ROOT / "docs" / "install.md").read_text(encoding="utf-8"))
    assert told and wheel.stat().st_size / 1e6 == pytest.approx(int(told[1]), abs=1.0)
    assert set(about["Requires-Python"].split(",")) == {">=3.11", "<3.14"}


def test_a_sample_is_simulated_by_its_name_outside_of_the_checkout(installed, tmp_path):
    where = "import cli, pipeline, sdfsim; print(cli.__file__, pipeline.__file__, sdfsim.__file__, sep='\\n')"
    assert all(Path(line).is_relative_to(installed) for line in call(installed, tmp_path, "-c", where).splitlines())
    program = str(installed / "bin" / "sdfsim")
    options = ["--seconds", "0.05", "-o", "run", "--json"]
    report = json.loads(call(installed, tmp_path, program, "simulate", "tower", *options))
    rollout = Rollout.load(tmp_path / "run" / "rollout.npz")
    assert report["steps"] == len(rollout) > 0 and rollout.names[1] == "first"
    assert (tmp_path / "run" / "rollout.rrd").stat().st_size > 1000


def test_samples_are_copied_to_be_changed(installed, tmp_path):
    program = str(installed / "bin" / "sdfsim")
    call(installed, tmp_path, program, "samples", "-o", "samples")
    call(installed, tmp_path, "-c", "import sdfsim; assert len(sdfsim.load_scene('samples/pile.yaml').shapes) > 5")
    assert len(list((tmp_path / "samples" / "photos" / "table_vase" / "images").glob("*.jpg"))) == 48
    assert "gnn" in call(installed, tmp_path, program, "info")


def test_a_users_type_checker_knows_what_functions_take_and_give(installed, tmp_path):
    """Each line that ends in `# wrong` has one error, and no other line has any."""
    text = """\
import sdfsim

scene = sdfsim.Scene(duration=1.0).add("ball", sphere={"radius": 0.1}, mass=0.2)
scene.add("cup", mesh="cup.obj", weight=2.0)  # wrong
simulator = sdfsim.Simulator(scene)
ball = simulator["ball"]
ball.velocity = (1.0, 0.0, 0.0)
ball.speed  # wrong
rollout = simulator.run(seconds=0.2, on_progress=lambda share, line: None)
height: float = rollout.position[-1, 0, 2]
names: int = rollout.names  # wrong
sdfsim.reconstruct("PHOTOS", "room", preset="quick", distance=("a.jpg:1,2", "a.jpg:3,4", 1.2), progress=print)
sdfsim.reconstruct("PHOTOS", "room", preset="quickest")  # wrong
sdfsim.reconstruct("PHOTOS", "room", sise=1.2)  # wrong
sdfsim.simulate("tower", "run", viewer="none", second=0.1)  # wrong
sdfsim.export("run", "run.glb", fps=24)["files"]
"""
    (tmp_path / "mine.py").write_text(text)
    (tmp_path / "pyrightconfig.json").write_text(json.dumps({"extraPaths": [str(installed)]}))
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "--outputjson", "-p", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    found = [d for d in json.loads(done.stdout)["generalDiagnostics"] if d["severity"] == "error"]
    assert {Path(d["file"]).name for d in found} == {"mine.py"}
    wrong = [k for k, line in enumerate(text.splitlines()) if line.endswith("# wrong")]
    assert sorted(d["range"]["start"]["line"] for d in found) == wrong
