"""Work on all cores, in processes that stop when the caller does."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any


def parallel(function: Callable[..., Any], jobs: Sequence[tuple]) -> Iterator[tuple[int, Any]]:
    """Call `function(*job)` for every job; yield (index of the job, result) as they end.

    The first error, or Ctrl-C, cancels what has not begun and is raised.
    """
    if not jobs:
        return
    # torch's thread pool does not survive a fork.
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(len(jobs), os.cpu_count() or 1), mp_context=spawn, initializer=_quiet_worker)
    try:
        numbered = {pool.submit(function, *job): index for index, job in enumerate(jobs)}
        for done in as_completed(numbered):
            yield numbered[done], done.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _quiet_worker() -> None:
    """One thread each, and Ctrl-C is the parent's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import torch

    torch.set_num_threads(1)
