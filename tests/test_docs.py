"""The documents: examples run, the functions that they name exist, links lead somewhere, numbers are those of records,
pages are few and short."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks import render
from benchmarks.records import RECORDS
from sdfsim.apps.import_robot import import_robot
from sdfsim.scene.load import load_scene
from sdfsim.shape.shape import load_shape

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "benchmarks" / "RESULTS.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
OURS = re.compile(r"(?<![\w./-])(?:sdfsim|pipeline|benchmarks|tests|samples)/[\w/]+\.py\b")


def examples(name: str, folder: Path) -> dict:
    """The names that the Python blocks of a page leave, run in order in a folder with the samples."""
    shutil.copytree(ROOT / "samples", folder / "samples", ignore=shutil.ignore_patterns("photos"))
    text = (ROOT / name).read_text(encoding="utf-8")
    names: dict = {}
    for block in re.finditer(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        # Blank lines in front give tracebacks the line of the page.
        lines = "\n" * (text.count("\n", 0, block.start()) + 1) + block[1]
        exec(compile(lines, name, "exec"), names)
    return names


def test_the_python_examples_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert len(examples("docs/python.md", tmp_path)["rollout"]) > 0


@pytest.mark.parametrize(("page", "name", "is_there"), [
    ("README.md", "rollout", lambda rollout: rollout.position[-1, 1, 2] == pytest.approx(0.1, abs=2e-3)),
    ("docs/joints.md", "door", lambda door: door.angle == pytest.approx(1.2, abs=0.1)),
])  # fmt: skip
def test_a_short_example_does_what_it_says(tmp_path, monkeypatch, page, name, is_there):
    monkeypatch.chdir(tmp_path)
    assert is_there(examples(page, tmp_path)[name])


def test_the_examples_for_robotics_do_what_they_say(tmp_path, monkeypatch):
    """The ball comes to rest in the bowl, in both engines; the bowl slides the less the rougher it is; the dog
    stands."""
    monkeypatch.chdir(tmp_path)
    import pybullet_data

    import_robot(Path(pybullet_data.getDataPath()) / "a1" / "a1.urdf", tmp_path / "dog.yaml", floor=True)
    names = examples("docs/robotics.md", tmp_path)
    bowl, ball = names["rollout"].position[-1, 2:4]
    assert np.linalg.norm((ball - bowl)[:2]) < 0.05 and ball[2] == pytest.approx(0.45, abs=0.01)  # it rolls to and fro
    np.testing.assert_allclose(names["there"], names["ours"], atol=0.06)
    assert names["there"][2] == pytest.approx(names["ours"][2], abs=0.01)
    assert names["touching"] and names["bowl"].velocity[0] > 0.05
    assert len(names["slid"]) == 10
    dog, bends = names["dog"], {"hip": 0.0, "upper": 0.8, "lower": -1.6}
    held = {f"{leg}_{part}_joint": bend for leg in ("FR", "FL", "RR", "RL") for part, bend in bends.items()}
    assert {name: dog.joint(name).angle for name in held} == pytest.approx(held, abs=0.05)
    # Of the thigh and the calf, 0.2 m each, above a foot of 2 cm.
    assert dog["trunk"].position[2] == pytest.approx(0.4 * np.cos(0.8) + 0.02, abs=0.03)
    assert (tmp_path / "dog.png").exists()


@pytest.mark.parametrize(
    ("page", "shape", "place", "bodies"), [("tutorial", "ring", "shapes/ring", 18), ("vfx", "vase", "vase", 13)]
)
def test_the_scene_of_a_page_loads(tmp_path, monkeypatch, page, shape, place, bodies):
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    block = re.search(r"^    version: 1\n(?:    .*\n)+", text, re.MULTILINE)
    assert block
    shutil.copytree(ROOT / "samples" / "shapes" / shape, tmp_path / place)
    if page == "vfx":  # a mesh in place of a folder
        import trimesh

        mesh = load_shape(tmp_path / place).mesh
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / "vase.glb")
        monkeypatch.setattr("sdfsim.shape.make.user_cache", lambda name: tmp_path / name)
    (tmp_path / "mine.yaml").write_text("".join(line[4:] for line in block[0].splitlines(keepends=True)))
    assert len(load_scene(tmp_path / "mine.yaml").bodies) == bodies


def test_the_functions_that_how_it_works_names_exist():
    text = (ROOT / "docs" / "how-it-works.md").read_text(encoding="utf-8")
    named = {name.rpartition(".")[2] for name in re.findall(r"`([A-Za-z_.]+)`", text)}
    named = {name for name in named if name != "yaml" and (name != name.lower() or "_" in name)}
    folders = (ROOT / "sdfsim", ROOT / "pipeline")
    sources = "\n".join(file.read_text(encoding="utf-8") for folder in folders for file in folder.rglob("*.py"))
    there = set(re.findall(r"(?:def|class) (\w+)|^(\w+)\b", sources, re.MULTILINE))
    assert len(named) > 40
    assert not named - {name for pair in there for name in pair}


def test_the_files_that_pages_name_exist():
    named = {(page.name, path) for page in PAGES for path in re.findall(OURS, page.read_text(encoding="utf-8"))}
    assert len(named) > 40
    assert not [pair for pair in sorted(named) if not (ROOT / pair[1]).exists()]


def anchors(file: Path) -> set[str]:
    """What its headings are called in links, as GitHub makes them."""
    heads = re.findall(r"^#+ (.+)$", file.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_files_and_headings(page):
    links = re.findall(r"\]\((?!https?:)([^)#]*)(?:#([^)]+))?\)", page.read_text(encoding="utf-8"))
    targets = [((page.parent / target) if target else page, anchor) for target, anchor in links]
    assert not [target for target, _ in targets if not target.exists()]
    assert not [
        (target.name, to) for target, to in targets if to and target.suffix == ".md" and to not in anchors(target)
    ]


def test_rendering_changes_nothing():
    """`python -m benchmarks render` has written all tables and numbers of pages, and every record can be shown."""
    texts = [page.read_text(encoding="utf-8") for page in render.PAGES]
    assert [render.rendered(text) for text in texts] == texts
    assert all("| --- |" in render.rendered(f"<!-- {file.stem} --><!-- end -->") for file in RECORDS.glob("*.json"))


def test_pages_are_few_and_short():
    """A reader can go through all of them: nineteen pages, and a README of one screen or two."""
    assert len(PAGES) <= 19
    assert sum(page.read_text(encoding="utf-8").count("\n") for page in PAGES) <= 2800
    assert (ROOT / "README.md").stat().st_size <= 6500


@pytest.mark.parametrize(
    "pattern",
    [r"(?i)\b\d{1,2} (January|February|November|December)\b|earlier version|not kept|used to ",
     r"(?m)^[ >]*<!-- \w+\S*\[.*?-->\S"],
    ids=["days", "numbers"],
)  # fmt: skip
def test_pages_say_what_holds_today_and_begin_no_line_with_a_number_of_a_record(pattern):
    """Days and earlier versions are in records and in the log of commits; Markdown takes a line that begins with a
    comment for HTML, and shows the rest of it as it is."""
    texts = {page.name: page.read_text(encoding="utf-8") for page in PAGES}
    assert not [(name, found[0]) for name, text in texts.items() for found in re.finditer(pattern, text)]


def test_presets_and_recipes_in_documents_exist():
    from typing import get_args

    from pipeline.options import Preset
    from sdfsim.sdf.fit.train import Recipe
    from sdfsim.training.presets import PRESETS as TRAINED

    known = {"reconstruct": get_args(Preset), "train": tuple(TRAINED), "fit": get_args(Recipe)}
    named = set()
    for file in (*PAGES, ROOT / "sdfsim" / "models" / "gnn.md"):
        for line in file.read_text(encoding="utf-8").splitlines():
            for found in re.finditer(r"(reconstruct|train|fit)\b[^`|]*?--(?:preset|recipe) ([\w-]+)", line):
                assert found[2] in known[found[1]], f"{file.name}: {line}"
                named.add((found[1], found[2]))
    assert {("train", "sdf-sim"), ("reconstruct", "quick")} <= named


def test_no_temporary_file_is_among_the_sources() -> None:
    """Outputs are written to `.NAME.NUMBER-LETTERS.part` first."""
    folders = ("docs", "samples", "benchmarks", "sdfsim", "pipeline", "tests")
    assert not [file for folder in folders for file in (ROOT / folder).rglob(".*.part")]
