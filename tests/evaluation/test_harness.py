"""Results and their records are kept and resumed; digests tell contents apart; the front is what brute force finds."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import records
from benchmarks.records import read_record, write_record
from benchmarks.render import rendered
from sdfsim.base.errors import SdfsimError
from sdfsim.evaluation.harness import Job, digest, front, measure
from sdfsim.learned.model import new_network
from sdfsim.physics.solver import code_cache
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import with_sdf
from tests.helpers.recordings import trajectory


def noted(file: Path, value: float) -> dict:
    """A result that leaves a line behind when it is made."""
    with open(file, "a") as handle:
        handle.write("ran\n")
    if value < 0:
        raise SdfsimError("below zero\nand more")
    return {"value": value, "pair": (value, value)}


@pytest.mark.parametrize("where", ["here", "cores", pytest.param("fresh", marks=pytest.mark.slow)])
def test_results_are_made_once_and_again_when_their_content_changes(tmp_path, where):
    ran = tmp_path / "ran"
    jobs = [Job(f"case {k}", "method", [k], noted, (ran, float(k))) for k in range(2)]
    first = measure(jobs, tmp_path / "out", where=where)
    assert first["case 1", "method"] == {"value": 1.0, "pair": [1.0, 1.0]}
    assert measure(jobs, tmp_path / "out", where=where) == first and ran.read_text().count("ran") == 2
    damaged = tmp_path / "out" / "method" / "case 0.json"
    damaged.write_text(damaged.read_text()[:-20])
    changed = [jobs[0], replace(jobs[1], content=["other"])]
    assert measure(changed, tmp_path / "out", where=where) == first and ran.read_text().count("ran") == 4


def test_results_are_made_again_when_the_compiled_step_is_another_one(tmp_path, monkeypatch):
    ran = tmp_path / "ran"
    job = Job("case", "method", [], noted, (ran, 1.0))
    for expected, name in ((1, "one"), (1, "one"), (2, "two")):
        monkeypatch.setattr(code_cache, "code_folder", lambda name=name: Path(name))
        measure([job], tmp_path / "out")
        assert ran.read_text().count("ran") == expected


def test_failures_are_reported_and_tried_again(tmp_path):
    ran, seen = tmp_path / "ran", []
    jobs = [Job("case", name, [], noted, (ran, value)) for name, value in (("good", 1.0), ("bad", -1.0))]
    for _ in range(2):
        results = measure(jobs, tmp_path / "out", on_progress=lambda fraction, message: seen.append(fraction))
        assert results["case", "bad"] == {"failed": "below zero"}
    assert ran.read_text().count("ran") == 3 and seen == [0.5, 1.0, 1.0, 1.0, 1.0]


def test_what_was_finished_outlives_an_interruption(tmp_path):
    def interrupt() -> dict:
        raise KeyboardInterrupt

    ran = tmp_path / "ran"
    jobs = [Job("a", "m", [], noted, (ran, 1.0)), Job("b", "m", [], interrupt)]
    with pytest.raises(KeyboardInterrupt):
        measure(jobs, tmp_path / "out")
    measure(jobs[:1], tmp_path / "out")
    assert ran.read_text().count("ran") == 1


def test_digests_change_with_whatever_a_result_depends_on():
    box = analytic_shape("box", size=(1.0, 1.0, 1.0))
    grid = with_sdf(box, "grid", resolution=8)
    other = replace(grid, sdf=replace(grid.sdf, values=grid.sdf.values + 1e-3))
    contents = [box, grid, other, replace(grid, nodes=grid.nodes[:-1]), replace(grid, inertia=2 * grid.inertia)]
    start = trajectory()
    contents += [start, replace(start, dt=0.01), replace(start, mass=2 * start.mass)]
    contents += [[1, [2]], [[1], 2], {"a": 1}, {"a": 2}, "1", 1, 1.0, None]
    for seed in range(2):
        torch.manual_seed(seed)
        contents.append(new_network("impulse", {"width": 8, "rounds": 1}))
    assert len({digest(content) for content in contents}) == len(contents)
    assert digest(start) == digest(trajectory())
    with pytest.raises(TypeError):
        digest(object())


@given(st.lists(st.tuples(st.integers(1, 9), st.integers(1, 9)), min_size=1, max_size=30))
def test_front_is_what_nothing_beats(points):
    time, error = zip(*points, strict=True)
    beaten = [any(b[0] <= a[0] and b[1] <= a[1] and b != a for b in points) for a in points]
    found = front(time, error)
    assert sorted(found) == [k for k, lost in enumerate(beaten) if not lost]
    assert [time[k] for k in found] == sorted(time[k] for k in found)


@pytest.fixture
def written(tmp_path, monkeypatch):
    monkeypatch.setattr(records, "RECORDS", tmp_path)
    rows = [("a, b", "x", [1234.5, 0.123456, np.float64(2)], 7), ("c", "y", None, np.nan), ("c", "z", "none", 1e-5)]
    write_record("speed", "python -m benchmarks speed", "Balls.", ("case", "of", "ms", "lost"), rows, ["- a note"])
    return tmp_path / "speed.json"


def test_a_record_says_what_was_measured_and_how(written):
    record = read_record("speed")
    assert record.rows == [["a, b", "x", [1234.0, 0.123, 2.0], 7], ["c", "y", None, None], ["c", "z", "none", 1e-5]]
    assert {"command", "day", "commit", "machine", "data"} < set(json.loads(written.read_text()))
    assert record.day.startswith("20") and "cores" in record.machine


@pytest.mark.parametrize(
    ("mark", "shown"),
    [
        ("speed[a, b][ms]", "1,234"),
        ("speed[c, z][lost]", "1e-05"),
        ("speed[a, b; c, z][case;lost]", "\n\n| case | lost |\n| --- | ---: |\n| a, b | 7 |\n| c | 1e-05 |\n\n"),
        ("speed[c, y][]", "\n\n| case | of | ms | lost |\n| --- | ---: | ---: | ---: |\n| c | y | - | - |\n\n"),
    ],
)
def test_a_mark_names_a_part_of_a_record(written, mark, shown):
    page = f"before <!-- {mark} -->old<!-- end --> after <!-- other -->"
    new = f"before <!-- {mark} -->{shown}<!-- end --> after <!-- other -->"
    assert rendered(page) == rendered(new) == new


def test_a_whole_record_has_its_command_day_and_notes(written):
    text = rendered("<!-- speed --><!-- end -->")
    assert (
        "    python -m benchmarks speed        # " in text and " 20" in text and "Balls." in text and "- a note" in text
    )
    assert "1,234 (0.123 to 2)" in text


@pytest.mark.parametrize("mark", ["speed[c][ms]", "speed[a, b][none]", "nothing"])
def test_what_is_not_there_is_told(written, mark):
    with pytest.raises(SdfsimError, match=r"rows or columns are called|no such file"):
        rendered(f"<!-- {mark} --><!-- end -->")
