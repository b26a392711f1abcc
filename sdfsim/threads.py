"""How many CPU threads to use: on a busy machine a second one slows a computation down by up to ten times."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

_most = torch.get_num_threads()  # Before anything here has changed it.


def limit_threads(count: int) -> None:
    """Use no more than `count` threads in this process from now on."""
    global _most
    _most = count
    torch.set_num_threads(count)


def choose_threads(work: Callable[[], object], threads: int | None = None, *, repeat: int = 3) -> float:
    """Times `work` with one thread and with all, and leaves torch set to the faster.

    Args:
        work: a typical piece of work, tens of milliseconds.
        threads: take this number without comparing.
        repeat: timed calls for each number, after one that is not timed.

    Returns:
        Seconds one call takes with the number chosen.
    """
    took = {}
    for count in sorted({threads} if threads else {1, _most}):
        torch.set_num_threads(count)
        work()
        began = time.monotonic()
        for _ in range(repeat):
            work()
        took[count] = (time.monotonic() - began) / repeat
    best = min(took, key=lambda count: took[count])
    torch.set_num_threads(best)
    return took[best]


def network_work() -> None:
    """A training step of a small network, for `choose_threads`."""
    rng = torch.Generator().manual_seed(0)
    points = torch.rand(8192, 64, generator=rng)
    weights = [torch.rand(64, 64, generator=rng, requires_grad=True) for _ in range(4)]
    values = points
    for weight in weights:
        values = torch.sin(values @ weight)
    torch.autograd.grad(values.sum(), weights)
