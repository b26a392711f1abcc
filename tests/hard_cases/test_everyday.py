"""Everyday scenes: what holds today goes on holding, and what begins to hold is put on the list.

`everyday_holds.txt` is written by `python -m sdfsim.evaluation.everyday ROW ... --update FILE`.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from sdfsim.evaluation.everyday import ROWS, Check, Setting, changed, checks, most, near, update

HOLDS = Path(__file__).with_name("everyday_holds.txt")
FAST = ("slender", "edges", "gentle", "bullets", "elastic", "before_touch", "thin_floors", "flat_drops")
# Three sizes and orientations, and what solids are made of.
SETTINGS = (
    Setting(), Setting(kind="mesh"), Setting(size=0.02, yaw=37.0), Setting(size=1.0, yaw=121.0), Setting(kind="grid"),
)  # fmt: skip


@pytest.fixture(scope="module")
def listed() -> list[str]:
    return HOLDS.read_text(encoding="utf-8").splitlines()


CASES = [
    pytest.param(row, at, marks=[] if row in FAST and at == Setting() else [pytest.mark.slow], id=f"{row}-{at}")
    for at in SETTINGS
    for row in ROWS
]


@pytest.mark.parametrize(("row", "at"), CASES)
def test_what_holds_is_what_is_listed(row, at, listed):
    told = changed(list(checks(row, at)), listed)
    how = f"{row} --size {at.size:g} --yaw {at.yaw:g} --kind {at.kind} --update {HOLDS}"
    assert told == [], f"{len(told)} changed: python -m sdfsim.evaluation.everyday {how}"


# --- the list itself ---

GOOD, BAD, CLOSE = most("good", 0.5, 1.0), most("bad", 2.0, 1.0), most("close", 1.05, 1.0)


def named(*found: Check) -> list[tuple[str, Check]]:
    return [(f"row: {check.name} [{Setting()}]", check) for check in found]


def test_a_list_tells_what_no_longer_holds_what_holds_now_and_what_is_gone():
    good, bad, close = (name for name, _ in named(GOOD, BAD, CLOSE))
    assert changed(named(GOOD, BAD, CLOSE), [good]) == []
    assert changed(named(GOOD, BAD), [bad, good])[0].startswith("is listed, and does not hold: row: bad")
    assert changed(named(GOOD), [])[0].startswith("holds, and is not listed: row: good")
    assert changed(named(GOOD), [good, bad])[0].startswith("is listed, and there is no such check: row: bad")
    # What stands within a tenth of its limit may go either way, and other settings were not run.
    assert changed(named(CLOSE), [close]) == []
    assert changed(named(GOOD), [good, bad.replace("0.1 m", "1 m"), "other: bad [0.1 m, 0 degrees, analytic]"]) == []


def test_an_update_keeps_what_was_not_run(tmp_path):
    file = tmp_path / "holds.txt"
    file.write_text(f"other: kept [{Setting()}]\nrow: bad [{Setting()}]\n")
    update(file, named(GOOD, BAD))
    assert file.read_text().splitlines() == [f"other: kept [{Setting()}]", f"row: good [{Setting()}]"]


def test_checks_hold_between_their_limits():
    assert near("a", 1.02, 1.0, 0.03).holds and not near("a", 1.04, 1.0, 0.03).holds
    assert not near("a", float("nan"), 1.0, 0.5).holds and not most("a", float("inf"), 1.0).holds
    assert Check("a", 0.0, -1.0, 0.2).holds and not Check("a", 0.3, -1.0, 0.2).holds
