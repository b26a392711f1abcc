"""The documents: examples run, the functions that they name exist, links lead somewhere, the README stays short."""

import re
import shutil
from pathlib import Path

import pytest

from sdfsim.scene.scene_file import load_scene

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "benchmarks" / "RESULTS.md",
    *sorted((ROOT / "docs").glob("*.md")),
]


def test_the_python_examples_run(tmp_path, monkeypatch):
    shutil.copytree(ROOT / "samples", tmp_path / "samples", ignore=shutil.ignore_patterns("photos"))
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    names: dict = {}
    for block in re.finditer(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        # Blank lines in front give tracebacks the line of the page.
        lines = "\n" * (text.count("\n", 0, block.start()) + 1) + block[1]
        exec(compile(lines, "docs/python.md", "exec"), names)
    assert len(names["rollout"]) > 0


def test_the_scene_of_the_tutorial_loads(tmp_path):
    text = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    block = re.search(r"^    version: 1\n(?:    .*\n)+", text, re.MULTILINE)
    assert block
    shutil.copytree(ROOT / "samples" / "shapes" / "ring", tmp_path / "shapes" / "ring")
    (tmp_path / "mine.yaml").write_text("".join(line[4:] for line in block[0].splitlines(keepends=True)))
    assert len(load_scene(tmp_path / "mine.yaml").bodies) == 18


def test_the_functions_that_how_it_works_names_exist():
    text = (ROOT / "docs" / "how-it-works.md").read_text(encoding="utf-8")
    named = {name.rpartition(".")[2] for name in re.findall(r"`([A-Za-z_.]+)`", text)}
    named = {name for name in named if name != "yaml" and (name != name.lower() or "_" in name)}
    folders = (ROOT / "sdfsim", ROOT / "pipeline")
    sources = "\n".join(file.read_text(encoding="utf-8") for folder in folders for file in folder.rglob("*.py"))
    there = set(re.findall(r"(?:def|class) (\w+)|^(\w+)\b", sources, re.MULTILINE))
    assert len(named) > 40
    assert not named - {name for pair in there for name in pair}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files(page):
    targets = re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text(encoding="utf-8"))
    assert not [target for target in targets if not (page.parent / target).exists()]


def test_the_readme_is_short():
    assert (ROOT / "README.md").stat().st_size <= 5000
