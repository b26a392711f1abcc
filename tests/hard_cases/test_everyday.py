"""Everyday scenes: all checks hold but those listed here, and none of them has gone."""

import numpy as np
import pytest

from sdfsim.evaluation.everyday import ROWS, Check, Setting, checks, most, near
from tests.helpers.everyday import COUNTS, MISSED

FAST = ("slender", "edges", "gentle", "bullets", "elastic", "before_touch", "thin_floors", "flat_drops")
# Three sizes and orientations, and what solids are made of.
SETTINGS = (
    Setting(), Setting(kind="mesh"), Setting(size=0.02, yaw=37.0), Setting(size=1.0, yaw=121.0), Setting(kind="grid"),
)  # fmt: skip


def close(check: Check) -> bool:
    """Whether another machine's rounding may decide: within a tenth of a limit, or of the range between two."""
    finite = [limit for limit in (check.low, check.high) if np.isfinite(limit)]
    width = check.high - check.low if len(finite) == 2 else abs(finite[0])
    return any(abs(check.measured - limit) < 0.1 * width for limit in finite)


CASES = [
    pytest.param(row, at, marks=[] if row in FAST and at == Setting() else [pytest.mark.slow], id=f"{row}-{at}")
    for at in SETTINGS
    for row in ROWS
]


@pytest.mark.parametrize(("row", "at"), CASES)
def test_all_checks_hold_but_those_that_are_listed(row, at):
    found = list(checks(row, at))
    missed = MISSED.get(at.kind, set())
    assert len(found) == COUNTS[row][at.kind != "analytic"]
    changed = [str(c) for name, c in found if not close(c) and c.holds == (name.rpartition(" [")[0] in missed)]
    assert changed == []


def test_checks_hold_between_their_limits():
    assert near("a", 1.02, 1.0, 0.03).holds and not near("a", 1.04, 1.0, 0.03).holds
    assert not near("a", float("nan"), 1.0, 0.5).holds and not most("a", float("inf"), 1.0).holds
    assert Check("a", 0.0, -1.0, 0.2).holds and not Check("a", 0.3, -1.0, 0.2).holds
    assert close(most("a", 1.05, 1.0)) and not close(most("a", 0.5, 1.0))
