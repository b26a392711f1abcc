"""The best that can be had for the time: Pareto fronts, and the three points of them that `--quality` stands for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

BEARABLE = 1.5  # a draft's error is at most so many times the least


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


def qualities(time: Sequence[float], error: Sequence[float]) -> dict[str, int]:
    """The points of the front that the three qualities stand for.

    fine is the most accurate; draft the fastest whose error is at most `BEARABLE` times that of fine; standard the one
    with the least product of time and error between them (one of the two where nothing is between).
    """
    best = front(time, error)
    fine = best[-1]
    draft = next(k for k in best if error[k] <= BEARABLE * error[fine])
    between = best[best.index(draft) + 1 : best.index(fine)] or [draft, fine]
    standard = min(between, key=lambda k: time[k] * error[k])
    return {"draft": draft, "standard": standard, "fine": fine}


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, 95th percentile and half of the range between the quartiles over the median, of repeats."""
    quartiles = np.percentile(values, [25, 50, 75, 95])
    return {
        "median": float(quartiles[1]),
        "p95": float(quartiles[3]),
        "spread": float((quartiles[2] - quartiles[0]) / (2 * quartiles[1])),
    }
