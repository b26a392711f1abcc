"""A measurement is a record, and pages show what their marks name of it."""

import json

import numpy as np
import pytest

from benchmarks import records
from benchmarks.records import read_record, write_record
from benchmarks.render import rendered
from sdfsim.base.errors import SdfsimError


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
