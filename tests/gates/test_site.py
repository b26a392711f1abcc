"""The site of the documents: built without a warning, complete, and searched in a browser."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import cli
import sdfsim
from tests.helpers.browser import Browser

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.gate


def test_the_site_has_every_name_and_command_and_finds_words(tmp_path):
    """A broken link is a warning, and ends the build."""
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "-c", "docs", ".", str(tmp_path / "site")]
    at = os.environ | {"PYTHONPATH": str(ROOT)}
    built = subprocess.run(command, cwd=ROOT, env=at, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    reference = tmp_path / "site" / "build" / "reference"
    for name in sdfsim.__all__:
        assert f'id="sdfsim.{name}"' in (reference / f"{name}.html").read_text(encoding="utf-8")
    commands = (reference / "commands.html").read_text(encoding="utf-8")
    names = [info.name or info.callback.__name__ for info in cli.app.registered_commands]
    assert len(names) > 15 and all(f"sdfsim {name}" in commands for name in names)
    with Browser(tmp_path / "profile") as browser:  # from a file, without the excerpts that a server gives
        browser.open((tmp_path / "site" / "search.html").as_uri() + "?q=restitution")
        browser.wait("document.querySelectorAll('ul.search li').length > 5")
