"""The best that can be had for the time: the Pareto front, and the spread of repeats."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def front(time: Sequence[float], error: Sequence[float]) -> list[int]:
    """Indices, by time, of the points that no other point beats: none is at most as slow and as wrong, and one less.

    Args:
        time: [P] finite.
        error: [P] finite.
    """
    order = sorted(range(len(time)), key=lambda k: (time[k], error[k]))
    kept: list[int] = []
    for k in order:
        if not kept or error[k] < error[kept[-1]]:
            kept.append(k)
        elif time[k] == time[kept[-1]] and error[k] == error[kept[-1]]:
            kept.append(k)
    return kept


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, 95th percentile and half of the range between the quartiles over the median, of repeats."""
    quartiles = np.percentile(values, [25, 50, 75, 95])
    return {
        "median": float(quartiles[1]),
        "p95": float(quartiles[3]),
        "spread": float((quartiles[2] - quartiles[0]) / (2 * quartiles[1])),
    }
