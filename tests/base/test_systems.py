"""What Windows and macOS do otherwise, as far as Linux can try it: consoles, locks, paths; packages that are not
there."""

import ntpath
import os
import subprocess
import sys
from pathlib import Path, PureWindowsPath
from types import SimpleNamespace
from typing import Any

import pytest

from sdfsim import Scene, SdfsimError, load_scene
from sdfsim.apps.export import plain_names
from sdfsim.base import files
from sdfsim.base.files import path_from
from sdfsim.base.lazy import NotInstalled, optional

ROOT = Path(__file__).resolve().parents[2]


def test_text_files_are_opened_with_an_encoding():
    """What only Unix has is refused by the linter's settings; this rule of it is not stable yet."""
    command = [sys.executable, "-m", "ruff", "check", "--isolated", "--preview", "--select", "PLW1514"]
    folders = ["sdfsim", "pipeline", "samples", "scripts", "cli.py"]
    done = subprocess.run([*command, *folders], cwd=ROOT, capture_output=True)
    assert done.returncode == 0, done.stdout


def test_paths_in_files_have_slashes_and_drives(monkeypatch):
    monkeypatch.setattr(files, "os", SimpleNamespace(path=ntpath))
    monkeypatch.setattr(files, "Path", PureWindowsPath)
    home: Any = PureWindowsPath("C:\\work\\room")
    assert path_from(home, "C:\\work\\shapes\\ring") == "../shapes/ring"
    assert path_from(home, "D:\\scans\\cup.obj") == "D:/scans/cup.obj"


def test_a_scene_that_names_files_with_backslashes_is_read(tmp_path):
    (tmp_path / "shapes").mkdir()
    (tmp_path / "shapes" / "ring").symlink_to(ROOT / "samples" / "shapes" / "ring")
    body = "bodies:\n  - {name: ring, shape: ring}\n"
    (tmp_path / "a.yaml").write_text("version: 1\nshapes:\n  ring: {asset: 'shapes\\ring'}\n" + body)
    assert load_scene(tmp_path / "a.yaml", allow_outside=True).shapes[0].volume > 0
    (tmp_path / "b.yaml").write_text("version: 1\nshapes:\n  ring: {asset: '..\\ring'}\n" + body)
    with pytest.raises(SdfsimError, match="leads out of the scene's folder"):
        load_scene(tmp_path / "b.yaml")


def test_no_exported_file_has_the_name_of_a_device():
    assert plain_names(["torus[0]", "torus[1]", "the ring", "!", "a_"]) == ["torus_0", "torus_1", "the_ring", "_", "a_"]
    assert plain_names(["con", "NUL", "com1", "cup"]) == ["con_1", "NUL_1", "com1_1", "cup"]
    # Nor of another one, where case does not count.
    assert plain_names(["a b", "a_b", "A.b", "world", "é"], True) == ["a_b", "a_b_1", "A_b_2", "world_1", "_"]


def test_a_console_that_knows_few_characters_shows_the_others_escaped(tmp_path):
    scene = Scene(duration=0.01)
    scene.add("ваза ☕", sphere={"radius": 0.1}, position=(0, 0, 1))
    scene.save(tmp_path / "scene.yaml")
    command = [sys.executable, "-m", "cli", "simulate", str(tmp_path / "scene.yaml"), "-o", str(tmp_path / "run")]
    narrow = {"PYTHONIOENCODING": "cp1252", "PYTHONUTF8": "0", "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [*command, "--viewer", "none"], cwd=ROOT, capture_output=True, encoding="cp1252", env={**os.environ, **narrow}
    )
    assert done.returncode == 0, done.stderr
    assert "\\u0432\\u0430\\u0437\\u0430 \\u2615" in done.stdout and "0 of 1 bodies rest" in done.stdout


def test_a_missing_package_is_told_how_to_get(tmp_path):
    with pytest.raises(NotInstalled, match="Gizmo is not installed") as error:
        optional("gizmo_that_is_nowhere.part", "Gizmo", "bench")
    assert error.value.hint == "pip install 'sdfsim[bench]'"


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("raise ImportError('libGL.so.1: cannot open shared object file')", "ImportError: libGL.so.1: cannot open"),
        ("import gears_that_are_nowhere", "ModuleNotFoundError: No module named 'gears_that_are_nowhere'"),
        ("raise OSError('undefined symbol: mj_step')", "OSError: undefined symbol: mj_step"),
        ("raise AttributeError('_ARRAY_API not found')", "AttributeError: _ARRAY_API not found"),
    ],
)
def test_a_broken_package_is_told_with_its_own_error(tmp_path, monkeypatch, fault, told):
    (tmp_path / "gizmo.py").write_text(fault)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "gizmo", raising=False)
    with pytest.raises(NotInstalled) as error:
        optional("gizmo", "Gizmo", "bench")
    assert "Gizmo is installed, but does not load" in error.value.message and told in error.value.message
    assert "not installed" not in error.value.message
