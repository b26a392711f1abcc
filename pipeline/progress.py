"""How long work tells what it has done."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[float, str], None]  # called with the fraction that is done, 0 to 1, and a message


def quiet(fraction: float, message: str) -> None:
    """Tells nobody."""


def share_of(progress: Progress, start: float, share: float) -> Progress:
    """What a part of some work, a share of it from a start (both 0 to 1), tells its progress to."""
    return lambda fraction, message: progress(start + share * fraction, message)
