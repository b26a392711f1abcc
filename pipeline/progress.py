"""How long work reports what it has done."""

from collections.abc import Callable

Progress = Callable[[float, str], None]  # called with the fraction that is done, 0 to 1, and a message


def quiet(fraction: float, message: str) -> None:
    """Reports nothing."""


def share_of(progress: Progress, start: float, share: float) -> Progress:
    """Where a part of some work, a share of it from a start (both 0 to 1), reports its progress."""
    return lambda fraction, message: progress(start + share * fraction, message)
