"""The front is what brute force finds; the spread of repeats is that of their quartiles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sdfsim.evaluation.tradeoff_front import front, spread

VALUES = st.lists(st.tuples(st.integers(1, 9), st.integers(1, 9)), min_size=1, max_size=30)


def beaten(a: tuple[float, float], b: tuple[float, float]) -> bool:
    return b[0] <= a[0] and b[1] <= a[1] and b != a


@given(VALUES)
def test_front_is_what_nothing_beats(points):
    time, error = zip(*points, strict=True)
    expected = {k for k, p in enumerate(points) if not any(beaten(p, other) for other in points)}
    found = front(time, error)
    assert set(found) == expected and len(found) == len(expected)
    assert [time[k] for k in found] == sorted(time[k] for k in found)


def test_spread_of_repeats():
    found = spread([1.0, 2.0, 3.0, 4.0, 5.0])
    assert found == pytest.approx({"median": 3.0, "p95": 4.8, "spread": (4.0 - 2.0) / 6.0})
    assert np.isclose(spread([7.0])["spread"], 0.0)
