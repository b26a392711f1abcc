"""The table of laws: all checks hold but those that are listed, and none of them has gone."""

import runpy
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from sdfsim.evaluation.laws.assembly import ASSEMBLY
from sdfsim.evaluation.laws.everyday import EVERYDAY
from sdfsim.evaluation.laws.joints import JOINTS
from sdfsim.evaluation.laws.scenes import Check, Setting, most, near
from sdfsim.evaluation.laws.table import ROWS, checks, laws
from sdfsim.evaluation.laws.textbook import TEXTBOOK
from tests.helpers.everyday import COUNTS, MISSED

SLOW = {
    "slender", "heaps", "seams", "rolling", "facets", "round_on_meshes", "flat_drops", "slabs", "spins", "bullets",
    "chains", "rollers", "nuts", "bearings", "links", "keys", "puzzles",
}  # fmt: skip
FAST_GROUPS = ("overlap", "thin")  # of hard cases
# Three sizes and orientations, and what solids are made of.
SETTINGS = (
    Setting(), Setting(kind="mesh"), Setting(size=0.02, yaw=37.0), Setting(size=1.0, yaw=121.0), Setting(kind="grid"),
)  # fmt: skip
HARD = [law for law in laws(quick=True) if not law.counted]


def close(check: Check) -> bool:
    """Whether another machine's rounding may decide: within a tenth of a limit, or of the range between two."""
    finite = [limit for limit in (check.low, check.high) if np.isfinite(limit)]
    width = check.high - check.low if len(finite) == 2 else abs(finite[0])
    return any(abs(check.measured - limit) < 0.1 * width for limit in finite)


CASES = [
    pytest.param(law, at, marks=[pytest.mark.slow] if name in SLOW or at != Setting() else [], id=f"{name}-{at}")
    for at in SETTINGS
    for name, law in ROWS.items()
    if law.group == "everyday" or at == Setting() or (law.group == "textbook" and at.kind == "analytic")
]


@pytest.mark.parametrize(("law", "at"), CASES)
def test_all_checks_hold_but_those_that_are_listed(law, at):
    found = list(checks(law, at))
    missed = MISSED.get(at.kind, set())
    assert len(found) == COUNTS.get(law.name, (len(found) or 1,) * 2)[at.kind != "analytic"]
    changed = [str(c) for name, c in found if not close(c) and c.holds == (name.rpartition(" [")[0] in missed)]
    assert changed == []


@pytest.mark.parametrize(
    "law",
    [pytest.param(law, marks=[] if law.group in FAST_GROUPS else [pytest.mark.slow], id=law.name) for law in HARD],
)
def test_hard_cases_are_within_their_limits(law):
    found = list(law.checks(Setting()))
    assert found and not [str(check) for check in found if not check.holds]


def test_checks_hold_between_their_limits():
    assert near("a", 1.02, 1.0, 0.03).holds and not near("a", 1.04, 1.0, 0.03).holds
    assert not near("a", float("nan"), 1.0, 0.5).holds and not most("a", float("inf"), 1.0).holds
    assert Check("a", 0.0, -1.0, 0.2).holds and not Check("a", 0.3, -1.0, 0.2).holds
    assert close(most("a", 1.05, 1.0)) and not close(most("a", 0.5, 1.0))


def test_every_law_has_a_name_of_its_own_and_the_short_form_is_shorter():
    names = [[law.name for law in laws(quick=quick)] for quick in (False, True)]
    assert len(set(names[0])) == len(names[0]) and set(names[1]) < set(names[0])
    assert len(ROWS) == sum(map(len, (EVERYDAY, TEXTBOOK, JOINTS, ASSEMBLY)))


ROOT = Path(__file__).resolve().parents[2]
SOLVER = ROOT / "sdfsim" / "physics" / "solver"
FAULTS = runpy.run_path(str(ROOT / "scripts" / "seeded_faults.py"))["FAULTS"]


def test_each_fault_replaces_what_is_there_once_and_names_laws_of_the_table():
    assert len(FAULTS) >= 20 and max(Counter(one.name for one in FAULTS).values()) == 1
    known = {law.name for law in laws()}
    for one in FAULTS:
        text = (SOLVER / one.file).read_text(encoding="utf-8")
        for right, wrong in one.edits:
            assert text.count(right) == 1 and right != wrong, one.name
        assert set(one.laws.split()) <= known, one.name


def test_all_tolerances_of_the_compiled_step_have_names():
    assert not [*runpy.run_path(str(ROOT / "scripts" / "kernel_numbers.py"))["unnamed"]()]
