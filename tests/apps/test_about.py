"""`sdfsim info` names what is missing here and how to get it."""

import json
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from sdfsim.apps import about
from tests.helpers.command import run

ROOT = Path(__file__).resolve().parents[2]


def test_extras_are_those_of_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    optional = project["optional-dependencies"]
    extras = {name: {re.split(r"[<>=]", one)[0] for one in listed} for name, listed in optional.items()}
    for package, (extra, _) in about.EXTRAS.items():
        assert package in extras[extra]
    known = {re.split(r"[<>=]", one)[0] for one in project["dependencies"]}
    assert set(about.NEEDED) <= known


def test_what_is_not_installed_is_told_with_what_it_is_for(monkeypatch):
    real = metadata.version

    def version(name: str) -> str:
        if name in ("usd-core", "mujoco", "xatlas", "pi-heif"):
            raise metadata.PackageNotFoundError(name)
        return real(name)

    monkeypatch.setattr(metadata, "version", version)
    report = json.loads(run("info", "--json").stdout)
    assert report["versions"]["usd-core"] == "missing" and report["versions"]["torch"] == real("torch")
    told = [line for line in report["missing"] if "pip install" in line]
    assert told == [
        "pi-heif: pip install pi-heif",
        "xatlas: pip install xatlas",
        "usd-core, for export of .usd: pip install 'sdfsim[export]'",
        "mujoco, for import of MJCF, and comparisons with MuJoCo: pip install 'sdfsim[export]'",
    ]
    shown = run("info").stdout
    assert all(f"not here: {line}" in shown for line in told) and "usd-core missing" not in shown


@pytest.mark.parametrize(
    ("why", "told"),
    [
        ("libGL.so.1: cannot open shared object file", "libGL.so.1, which open3d loads: apt-get install libgl1"),
        ("libusb-1.0.so.0: cannot open", "libusb-1.0.so.0, which open3d loads: apt-get install libusb-1.0-0"),
        ("DLL load failed\nwhile importing", "open3d does not load: DLL load failed while importing"),
    ],
)
def test_a_library_of_the_system_that_is_missing_is_named_with_its_package(why, told):
    assert about._unloaded("open3d", why) == told


def test_the_systems_libraries_are_those_that_the_set_up_installs():
    text = (ROOT / "scripts" / "setup.sh").read_text(encoding="utf-8")
    pairs = dict(pair.split(":") for pair in re.findall(r"lib[\w.+-]+\.so[\w.]*:[\w.+-]+", text))
    assert about.LIBRARIES.items() <= pairs.items()


def test_info_goes_on_where_a_package_does_not_load():
    code = (
        "import sys; sys.modules['open3d'] = None\nfrom sdfsim.apps.about import about\n"
        "print(*[line for line in about()['missing'] if 'open3d' in line])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("open3d does not load")
