"""Markdown tables and the look of the charts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

OURS, THEIRS, TRUTH = "#1f6fb4", "#d1602a", "#555555"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A markdown table; the first column holds names, the others numbers."""
    lines = ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * (len(head) - 1)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def number(value: float | None, digits: int = 2) -> str:
    """`digits` significant digits, without an exponent where that stays short; a dash for what is not known."""
    if value is None or not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    if abs(value) < 1e-5:
        return f"{value:.{digits - 1}e}"
    places = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{places}f}"


def factor(value: float | None) -> str:
    """A ratio, as "12 x"."""
    return "-" if value is None else f"{number(value)} x"


def ratio(above: float | None, below: float | None) -> float | None:
    """None where either is unknown or nothing is left to divide by."""
    return above / below if above is not None and below else None


def plain_ticks(axis: Any) -> None:
    """Mark a logarithmic axis with plain numbers, of which powers of ten would show one or two."""
    from matplotlib.ticker import FixedLocator, NullFormatter

    axis.set_major_locator(FixedLocator([step * 10.0**power for power in range(-4, 6) for step in (1, 2, 5)]))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def save_chart(figure: Any, path: Path) -> None:
    """Write a matplotlib figure as PNG."""
    figure.savefig(path, dpi=110, bbox_inches="tight", facecolor="white")
