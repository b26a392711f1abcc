"""Work on all cores, in processes that stop when the caller does, or unchanged on a cluster; and how many threads."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from functools import partial
from timeit import timeit
from typing import TYPE_CHECKING, Any

from sdfsim.base.errors import SdfsimError

if TYPE_CHECKING:
    import torch
else:
    from sdfsim.base.lazy import torch

Progress = Callable[[float, str], None]  # called with the fraction of the work that is done, and a message
StageProgress = Callable[[str, float, str], None]  # the same, behind the name of one stage of several

TIMED = 3  # calls, after one that is not timed
SCHEDULER_ANSWERS = 10.0  # s, within which


def silent(fraction: float, message: str) -> None:
    """Progress that is not shown: what takes long, and what a command would print, is then warned of."""


def share_of(progress: Progress, start: float, share: float) -> Progress:
    """The progress of a part of some work: a share of it from a start, both 0 to 1."""
    return lambda fraction, message: progress(start + share * fraction, message)


def silent_stages(stage: str, fraction: float, message: str) -> None:
    """The same of several stages."""


def of_stage(on_progress: StageProgress, stage: str) -> Progress:
    """The progress of one of several stages."""
    return silent if on_progress is silent_stages else partial(on_progress, stage)


_most = 0  # threads that torch has by default; 0 before `choose_threads` asks


def parallel(function: Callable[..., Any], jobs: Sequence[tuple]) -> Iterator[tuple[int, Any]]:
    """Call `function(*job)` for every job; yield (index of the job, result) as they end.

    The work goes to processes of this machine, one a core and of one thread each, or to whatever engine
    `joblib.parallel_config` names around the call (see `cluster`). The first error, or Ctrl-C, cancels what has not
    begun and is raised.
    """
    from joblib import Parallel, delayed

    if not jobs:
        return
    calls = (delayed(_one)(function, index, job, os.getpid()) for index, job in enumerate(jobs))
    ended: Any = Parallel(n_jobs=-1, return_as="generator_unordered")(calls)
    yield from ended


def threads(function: Callable[..., Any], jobs: Sequence[tuple]) -> Iterator[tuple[int, Any]]:
    """As `parallel`, in threads of this process, for functions that spend their time in compiled code which other
    threads need not wait for."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        ahead = {pool.submit(function, *job): index for index, job in enumerate(jobs)}
        try:
            for future in as_completed(ahead):
                yield ahead[future], future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _one(function: Callable[..., Any], index: int, job: tuple, caller: int) -> tuple[int, Any]:
    """In a worker: one thread, and Ctrl-C is left to the caller. On a single core the caller itself runs this."""
    global _most
    if os.getpid() != caller:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        _most = 1
        os.environ["OMP_NUM_THREADS"] = "1"  # of torch, where it is not there yet
        if "torch" in sys.modules:
            torch.set_num_threads(1)
    return index, function(*job)


@contextmanager
def cluster(address: str | None) -> Iterator[None]:
    """Let `parallel` work on the Dask cluster of a scheduler, such as tcp://host:8786, inside the block; None leaves it
    on this machine.

    Its workers need this package, and see the files of a job under the same paths. Raises SdfsimError if Dask is not
    installed, or no scheduler answers.
    """
    if address is None:
        yield
        return
    from joblib import parallel_config

    try:
        from distributed import Client
    except ImportError as error:
        raise SdfsimError("a cluster needs Dask", "pip install 'sdfsim[cluster]'") from error
    try:
        client = Client(address, timeout=SCHEDULER_ANSWERS)
    except (OSError, TimeoutError, ValueError) as error:
        raise SdfsimError(f"{address}: no scheduler of a Dask cluster answers there") from error
    with client, parallel_config(backend="dask"):
        yield


def choose_threads(work: Callable[[], object], threads: int | None = None) -> float:
    """Time `work`, typically of tens of milliseconds, with one thread and with all; leave torch set to the faster (or
    to `threads`), and return the seconds that one call takes.

    On a busy machine a second thread slows a computation down by up to ten times.
    """
    global _most
    _most = _most or torch.get_num_threads()
    took = {}
    for count in {threads} if threads else {1, _most}:
        torch.set_num_threads(count)
        work()
        took[count] = timeit(work, number=TIMED) / TIMED
    best = min(took, key=lambda count: took[count])
    torch.set_num_threads(best)
    return took[best]
