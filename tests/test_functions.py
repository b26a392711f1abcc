"""The functions of the package: the commands without a shell."""

import inspect
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import typer

import cli
import sdfsim
from sdfsim.simulate.simulator import Simulator

ROOT = Path(__file__).resolve().parents[1]
# Options of the shell alone: how it reports, and where.
SHELL = {"as_json", "verbose", "device", "photos", "sources", "scene", "source", "out", "cluster"}
OTHERWISE = {"first": "from_stage", "last": "until_stage"}
OWN = {("export", "scene"): "scene_file"}
# Of folders that `mesh` has written, which `run_stage` does; the photos of another state are `joint` itself.
FOLDERS = {("fit", "sdf"), ("reconstruct", "other")}


@pytest.mark.parametrize("name", ["reconstruct", "fit", "simulate", "export"])
def test_a_function_takes_what_its_command_takes(name):
    (info,) = [c for c in cli.app.registered_commands if c.callback and c.callback.__name__ == name]
    command = typer.main.get_command_from_info(info, pretty_exceptions_short=True, rich_markup_mode=None)
    asked = {OTHERWISE.get(p.name, p.name) for p in command.params if p.name} - SHELL - {"help"}
    asked -= {option for of, option in FOLDERS if of == name}
    asked |= {own for (of, shell), own in OWN.items() if of == name and any(p.name == shell for p in command.params)}
    known = set(inspect.signature(getattr(sdfsim, name)).parameters)
    if name == "reconstruct":
        from pipeline.options import Options

        known |= set(Options.model_fields)
    assert asked - known == set() and len(asked) > 1
    assert (inspect.getdoc(getattr(sdfsim, name)) or "").count("\n") > 2


def test_the_function_simulate_is_not_hidden_by_the_folder_of_that_name():
    code = (
        "import sdfsim\n"
        "from sdfsim.simulate.simulator import Simulator\n"
        "import importlib\nimportlib.import_module('sdfsim.simulate.steppers')\n"
        "assert sdfsim.Simulator is Simulator and callable(sdfsim.simulate)\n"
        "assert sdfsim.simulate.__module__ == 'sdfsim.apps.run'\n"
        "assert set(sdfsim.__all__) <= set(dir(sdfsim))\n"
        "from sdfsim import simulate\nassert simulate is sdfsim.simulate"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_a_run_tells_how_far_it_is(tmp_path):
    scene = sdfsim.Scene(duration=0.05)
    scene.add("ball", sphere={"radius": 0.1}, position=(0, 0, 1))
    told: list[tuple[float, str]] = []
    rollout = Simulator(scene.load()).run(steps=7, on_progress=lambda done, line: told.append((done, line)))
    shares = [done for done, _ in told]
    assert shares == sorted(shares) and shares[-1] == 1.0 and told[-1][1] == "7 of 7 steps" and len(rollout) == 7

    stages: list[str] = []
    scene.save(tmp_path / "scene.yaml")
    report = sdfsim.simulate(
        tmp_path / "scene.yaml", tmp_path / "run", viewer="none", on_progress=lambda stage, *_: stages.append(stage)
    )
    assert report["status"] == "done" and "simulate" in stages
    made = sdfsim.export(tmp_path / "run", tmp_path / "run.csv")
    assert made["frames"] == report["steps"] + 1


def test_a_handle_knows_its_inertia():
    """A box of 1 x 2 x 3 m and 6 kg, turned: m/12 (b^2 + c^2) about its own axes."""
    scene = sdfsim.Scene()
    scene.add("box", box={"size": [1.0, 2.0, 3.0]}, position=(0, 0, 5), mass=6.0, euler_xyz_deg=(30, 40, 50))
    handle = Simulator(scene.load())["box"]
    np.testing.assert_allclose(handle.inertia, 0.5 * np.diag([13.0, 10.0, 5.0]), rtol=1e-9, atol=1e-9)
    before = handle.angular_velocity
    arm, impulse = np.array([0.3, -0.2, 0.5]), np.array([0.0, 2.0, 1.0])
    handle.push(impulse, at=handle.centre + arm)
    from scipy.spatial.transform import Rotation

    axes = Rotation.from_euler("xyz", [30, 40, 50], degrees=True).as_matrix()
    turned = handle.angular_velocity - before
    np.testing.assert_allclose(axes @ handle.inertia @ axes.T @ turned, np.cross(arm, impulse), atol=1e-9)


def test_the_notebook_runs_from_top_to_bottom(tmp_path):
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    shutil.copytree(ROOT / "samples" / "shapes", tmp_path / "shapes")
    book = nbformat.read(ROOT / "samples" / "tour.ipynb", as_version=4)
    assert not [cell for cell in book.cells if cell.get("outputs")]  # it is kept without what it printed
    nbclient.NotebookClient(book, timeout=300, resources={"metadata": {"path": tmp_path}}).execute(
        env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    printed = "".join(o.get("text", "") for cell in book.cells for o in cell.get("outputs", ()))
    slid = [float(line.split()[-2]) for line in printed.splitlines() if line.startswith("friction")]
    assert len(slid) == 5 and slid == sorted(slid, reverse=True)  # the rougher, the shorter
    assert "no law of mechanics is broken" in printed
    assert {file.name for file in (tmp_path / "tour").iterdir()} == {
        *("tour-0.png", "tour-0.25.png", "tour-1.5.png", "tour.glb", "tour.npz", "tour.yaml")
    }


def test_the_types_of_users_are_checked(tmp_path):
    """Names that load lazily have types too: pyright finds what is wrong, and nothing else."""
    good = "import sdfsim\nsimulator = sdfsim.Simulator(sdfsim.load_scene('pile'))\nx: float = simulator['ball'].mass\n"
    good += "report = sdfsim.simulate('pile', 'run', seconds=1.0)\nsdfsim.fit('a.obj', 'a', units='cm')\n"
    good += "sdfsim.export('run', 'run.glb', fps=24)\nsdfsim.reconstruct('photos', 'room', preset='quick')\n"
    good += "sdfsim.reconstruct('shut', 'cupboard', joint='open', drop='none')\n"
    bad = "import sdfsim\nsdfsim.simulate('pile', 'run', secnds=1.0)\nsdfsim.fit('a.obj', 'a', units='miles')\n"
    bad += "x: str = sdfsim.Simulator(sdfsim.load_scene('pile'))['ball'].mass\n"
    (tmp_path / "good.py").write_text(good)
    (tmp_path / "bad.py").write_text(bad)
    (tmp_path / "pyrightconfig.json").write_text(json.dumps({"extraPaths": [str(ROOT)], "typeCheckingMode": "basic"}))
    command = [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    found = json.loads(done.stdout)["generalDiagnostics"]
    lines = sorted(
        (Path(one["file"]).name, one["range"]["start"]["line"]) for one in found if one["severity"] == "error"
    )
    assert lines == [("bad.py", 1), ("bad.py", 2), ("bad.py", 3)]
