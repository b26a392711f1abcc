"""The documents: examples run, the functions that they name exist, links lead somewhere, the README stays short."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.results import section as measured
from benchmarks.summary import cells_of, summary
from sdfsim.apps.import_robot import import_robot
from sdfsim.scene.load import load_scene
from sdfsim.shape.shape import load_shape
from tests.helpers.everyday import COUNTS, MISSED

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "benchmarks" / "RESULTS.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
RESULTS = "benchmarks/RESULTS.md"


OURS = re.compile(r"(?<![\w./-])(?:sdfsim|pipeline|benchmarks|tests|samples)/[\w/]+\.py\b")


def examples(name: str, folder: Path) -> dict:
    """The names that the Python blocks of a page leave, run in order in a folder with the samples."""
    shutil.copytree(ROOT / "samples", folder / "samples", ignore=shutil.ignore_patterns("photos"))
    text = (ROOT / "docs" / name).read_text(encoding="utf-8")
    names: dict = {}
    for block in re.finditer(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        # Blank lines in front give tracebacks the line of the page.
        lines = "\n" * (text.count("\n", 0, block.start()) + 1) + block[1]
        exec(compile(lines, f"docs/{name}", "exec"), names)
    return names


def test_the_python_examples_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert len(examples("python.md", tmp_path)["rollout"]) > 0


def test_the_examples_for_robotics_do_what_they_say(tmp_path, monkeypatch):
    """The ball comes to rest in the bowl, in both engines; the bowl slides the less the rougher it is; the dog
    stands."""
    monkeypatch.chdir(tmp_path)
    import pybullet_data

    import_robot(Path(pybullet_data.getDataPath()) / "a1" / "a1.urdf", tmp_path / "dog.yaml", floor=True)
    names = examples("robotics.md", tmp_path)
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
    assert len(named) > 60
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


def test_results_are_short_and_every_table_says_when_and_how():
    text = (ROOT / RESULTS).read_text(encoding="utf-8")
    assert text.count("\n") <= 250
    for file in PAGES:
        for found in re.finditer(r"<!-- (?!end of )(.+) -->\n\n(.*)\n", file.read_text(encoding="utf-8")):
            known = re.fullmatch(r"    (python .+?)        # (\d+ \w+ 20\d\d)(, .+)?", found[2])
            assert known, f"{file.name}: {found[1]}: no command and day"


def test_the_first_lists_of_results_are_what_the_tables_say():
    """Run `python -m benchmarks summary` after any table was measured again."""
    assert measured("summary").partition("\n\n")[2].strip() == summary().strip()


def test_the_readme_is_short():
    """With its pictures, three ways in and the readers' pages it needs more than the 5,000 bytes of a bare one."""
    assert (ROOT / "README.md").stat().st_size <= 6500


# --- numbers and names that stand in two places ---


def page(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def cells(text: str, first: str) -> list[str]:
    """The other cells of the row of a table whose first cell begins so."""
    found = [line for line in text.splitlines() if line.startswith(f"| {first}")]
    assert found, first
    return [cell.strip() for cell in found[0].strip("|").split("|")[1:]]


def numbers(text: str) -> list[float]:
    return [float(found.replace(",", "")) for found in re.findall(r"\d[\d,]*\.?\d*", text)]


@pytest.mark.parametrize(
    ("row", "other"),
    [("`solver`", "`solver`"), ("`gnn`", "`gnn`"), ("the physics engine again", "the engine again, starts 1e-3")],
)
def test_the_readmes_errors_are_the_results(row, other):
    """To the digits that the README has; it leaves out the intervals."""
    shown = [numbers(cell) for cell in cells(page("README.md"), row)]
    told = [numbers(cell)[0] for cell in cells(measured("MOVi-B"), other)]
    assert len(shown) == 2
    for (metres, degrees), (true_metres, true_degrees) in zip(shown, [told[:2], told[2:]], strict=True):
        assert metres == pytest.approx(true_metres, abs=0.0006)
        assert degrees == pytest.approx(true_degrees, abs=0.06)


@pytest.mark.parametrize("engine", ["sdfsim", "MuJoCo", "Drake", "PyBullet"])
def test_the_readmes_errors_on_real_tosses_are_the_results(engine):
    """MuJoCo's with its better cone."""
    name = "MuJoCo, elliptic" if engine == "MuJoCo" else f"{engine} |"
    told = [numbers(cell)[0] for cell in cells(measured("reality"), name)[:2]]
    at = cells(page("README.md"), "mean error").index(engine)
    shown = [cells(page("README.md"), row)[at] for row in ("position, % of its side", "rotation, degrees")]
    assert [float(cell) for cell in shown] == told


def test_errors_on_movi_b_are_the_results_on_every_page():
    table = measured("MOVi-B")
    short, turn, long, further = (numbers(cell)[0] for cell in cells(table, "`solver`"))
    assert f"the contact solve as users run it {short:g} m, {turn:g}°" in page("docs/paper.md")
    for name in ("gnn", "sdf-sim"):
        told = [numbers(cell)[0] for cell in cells(page(f"sdfsim/models/{name}.md"), "`solver` on the same")]
        assert told == [short, turn, long, further][: len(told)] and len(told) >= 3


def test_errors_on_real_tosses_are_the_same_everywhere():
    """On the page about them to the digits that it has; `identify` found on all of them, and on a few."""
    rows = {row[0]: row[1:] for row in cells_of(measured("reality"))[1:]}
    text, identify = page("docs/reality.md").partition("## The table")[2], page("docs/identify.md")
    for name, row in rows.items():
        if "found on" in name:
            few = [numbers(cell)[0] for cell in row[:2]]
            continue
        first, second, less, *_ = cells(text, "Drake, point contact" if name == "Drake" else name)
        for told, true in zip((first, second), row[:2], strict=True):
            assert numbers(told)[0] == pytest.approx(numbers(true)[0], rel=6e-3)
        assert numbers(less) == pytest.approx(numbers(row[2]), abs=6e-3)
    place, turn = (numbers(cell)[0] for cell in rows["sdfsim"][:2])
    told = [numbers(cell) for cell in cells(identify, "`sdfsim identify`, its own solve")[:2]]
    assert [one[0] for one in told] == [place, turn]
    assert f"where those of all 60 come to {place:.2f} and {turn:.2f}" in identify
    assert f"{few[0]:.2f} % of the side and {few[1]:.2f}" in " ".join(identify.split())
    mujoco = [numbers(cell)[0] for cell in rows["MuJoCo, elliptic cone"][:2]]
    assert f"came to {mujoco[0]:g} and {mujoco[1]:g}" in " ".join(identify.split())


# What the numbers are, and where on each page they stand; the groups of all pages are alike.
SAME = {
    "how deep the demo's vase is hollow": {
        "README.md": r"a hollow 32 cm deep is reconstructed (\d+) cm deep",
        RESULTS: r"a body of its own, hollow by \| (\d+) cm",
        "docs/photos.md": r"\| vase, hollow below its rim \(the true one: 32 cm\) \| [\d.]+ cm \| (\d+) cm",
    },
    "errors of the network that is bundled as sdf-sim": {
        "docs/paper.md": r"bundled as `sdf-sim`\): (0\.\d+) m \((0\.\d+) to (0\.\d+)\), ([\d.]+)°",
        "docs/gpu.md": r"(0\.\d+) m \[(0\.\d+), (0\.\d+)\], ([\d.]+)° and 1\.\d+ m",
        "sdfsim/models/sdf-sim.md": r"\| this model \| (0\.\d+) \((0\.\d+) to (0\.\d+)\) \| ([\d.]+) \|",
    },
    "how long seventeen fits take": {
        RESULTS: r"in (\d+) to (\d+) s on one core, median (\d+) s",
        "docs/sdf.md": r"(\d+) to (\d+) s each on its core, (\d+) s in the median",
    },
    "the paper's errors": {
        "README.md": r"SDF-Sim, the paper's network, on its own recordings \| (0\.160) m, (18)\.0",
        "docs/paper.md": r"SDF-Sim (0\.160) m, (18)\.0°",
        "sdfsim/models/sdf-sim.md": r"published network has (0\.160) m and (18)\.0 degrees",
    },
}


@pytest.mark.parametrize("places", SAME.values(), ids=list(SAME))
def test_numbers_are_the_same_on_every_page(places):
    found = {name: re.search(pattern, " ".join(page(name).split())) for name, pattern in places.items()}
    assert all(found.values()), found
    assert len({one.groups() for one in found.values() if one}) == 1, found


def test_times_and_errors_of_large_scenes_are_the_same_everywhere():
    paper = page("docs/paper.md")
    seconds = {row[0]: float(numbers(row[4])[0]) for row in cells_of(measured("large scenes"))[1:]}
    told = "{:.0f}, {:.0f} and {:.0f} s from command".format(*(seconds[n] for n in ("shoes", "knots", "heaps")))
    assert told in paper
    steps = {row[0]: numbers(row[5])[0] for row in cells_of(measured("contact step"))[1:]}
    simulator = page("docs/simulator.md")
    assert 0.55 < steps["a MOVi-B step"] < 0.78 and "about two thirds of PyBullet's time" in simulator
    assert 0.8 < steps["16 spheres in a bowl"] < 1.2 and steps["512 spheres in a bowl"] < 0.5
    assert "spheres in a bowl take about as long in both, 512 less than half of the time in ours" in simulator


def test_what_far_scenery_costs_is_the_same_everywhere():
    solver = numbers(cells(measured("contact step"), "the same with all of `Simulator`, solver")[-1])[0]
    assert solver <= 1.1 and "costs the same beside 10,000 static bodies as beside 10" in page("docs/scale.md")


def test_how_many_everyday_checks_hold_is_the_same_everywhere():
    totals = [sum(count) for count in zip(*COUNTS.values(), strict=True)]
    of = {kind: totals[kind != "analytic"] for kind in MISSED}
    held = {kind: f"{of[kind] - len(missed)} of {of[kind]}" for kind, missed in MISSED.items()}
    row = cells(measured("everyday"), "all")[0]
    assert row == held["analytic"].replace("of", "/")
    stability, readme = (" ".join(page(name).split()) for name in ("docs/stability.md", "README.md"))
    assert f"{held['analytic']} checks hold" in stability
    assert f"With meshes {held['mesh']} hold, with grids {held['grid']}." in stability
    told = f"hold with closed forms, {held['mesh']} with meshes and {held['grid']} with sampled grids"
    assert f"{held['analytic']} {told}" in readme


def test_errors_of_reconstructions_name_one_direction():
    """*quick* has the same figures, for the same direction, on both pages."""
    results, photos = page(RESULTS), page("docs/photos.md").partition("## Depth from photos alone")[2]
    for here, there in (
        ("error, median", "reconstructed surface to the true one"), ("missing, median", "true surface to the"),
        ("share of the true surface", "share of the true surface"), ("its vase, 32 cm hollow", "vase, hollow below"),
    ):  # fmt: skip
        assert cells(results, here)[0] == cells(photos, there)[1]
    whole = re.search(r"whole in (\d+) s on two cores", results)
    assert whole and f"two cores it took {whole[1]} s" in photos
    said = [re.findall(r"PSNR of ([\d.]+) dB at 480 px", text) for text in (results, photos)]
    assert len(said[0]) == 1 and said[0] == said[1]


def test_steps_in_documents_are_those_of_the_presets():
    from pipeline.field.training import PRESETS

    text = page("benchmarks/RESULTS.md").partition("## Reconstruction\n")[2]
    assert f"*quick*, {PRESETS['quick'].iterations:,} steps" in text
    assert f"the preset has {PRESETS['standard'].iterations:,}" in page("docs/photos.md")
    assert f"now it stops at {PRESETS['quick'].iterations:,}" in page("docs/tradeoff.md")
    sides = [f"{PRESETS[name].long_side // 3} px" for name in ("quick", "standard")]
    assert all(side in page("docs/tradeoff.md") for side in sides) and sides[0] in page("docs/notes/photos.md")


def test_the_bundled_model_is_said_to_learn_from_what_it_learned_from():
    """The tutorial's commands and the card's make as many trajectories as the file of the model knows."""
    from sdfsim.learned.model import load_model

    made = [known["trajectories"] for known in load_model("gnn").card["data"]]
    loops = re.findall(r"for split in (.*?); do.*\n.*?-o (\S+)", page("docs/tutorial.md"))
    tutorial = {out: dict(pair.split(":") for pair in splits.split()) for splits, out in loops}
    card = page("sdfsim/models/gnn.md")
    for counts, out, name in zip(made, ("data", "data-v"), ("MOVI-B", "VARIED"), strict=True):
        for split in ("train", "validation"):
            assert int(tutorial[out][split]) == counts[split]
            assert f"'{split}': {counts[split]}" in card, name


def test_hard_cases_are_summed_up_alike():
    lines = re.findall(r"^- .* 0 cases.*$|^- \w+: \d+ figures.*$", measured("hard cases"), re.M)
    assert len(lines) == 4
    assert all(line in measured("hard cases", ROOT / "docs" / "stability.md") for line in lines)


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
    assert {("train", "sdf-sim"), ("reconstruct", "volsdf"), ("reconstruct", "quick")} <= named
