"""Work on all cores, in processes that stop when the caller does, or on a cluster; and the number of threads."""

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
StageProgress = Callable[[str, float, str], None]  # the same, with the name of a stage first

TIMED = 3  # calls that are timed, after one that is not
SCHEDULER_ANSWERS = 10.0  # s that a scheduler has to answer


def silent(fraction: float, message: str) -> None:
    """Progress that is not shown. Functions then log a warning for what takes long."""


def share_of(progress: Progress, start: float, share: float) -> Progress:
    """Progress of one part of some work, mapped to the fractions from `start` to `start + share` of the whole (0 to
    1)."""
    return lambda fraction, message: progress(start + share * fraction, message)


def silent_stages(stage: str, fraction: float, message: str) -> None:
    """The same for several stages."""


def of_stage(on_progress: StageProgress, stage: str) -> Progress:
    """The progress of one of several stages."""
    return silent if on_progress is silent_stages else partial(on_progress, stage)


_most = 0  # threads that torch uses by default; 0 until `choose_threads` asks


def parallel(function: Callable[..., Any], jobs: Sequence[tuple]) -> Iterator[tuple[int, Any]]:
    """Call `function(*job)` for every job; yield (index of the job, result) as jobs end.

    The work runs in processes of this machine, one per core with one thread each, or in the backend that
    `joblib.parallel_config` sets around the call (see `cluster`). The first error, or Ctrl-C, cancels the jobs that
    have not begun, and is raised.
    """
    from joblib import Parallel, delayed

    if not jobs:
        return
    calls = (delayed(_one)(function, index, job, os.getpid()) for index, job in enumerate(jobs))
    ended: Any = Parallel(n_jobs=-1, return_as="generator_unordered")(calls)
    yield from ended


def threads(function: Callable[..., Any], jobs: Sequence[tuple]) -> Iterator[tuple[int, Any]]:
    """As `parallel`, in threads of this process: for functions that spend their time in compiled code that releases the
    GIL."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        ahead = {pool.submit(function, *job): index for index, job in enumerate(jobs)}
        try:
            for future in as_completed(ahead):
                yield ahead[future], future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _one(function: Callable[..., Any], index: int, job: tuple, caller: int) -> tuple[int, Any]:
    """Run one job in a worker, with one thread; Ctrl-C is left to the caller. On a single core the caller runs this
    itself."""
    global _most
    if os.getpid() != caller:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        _most = 1
        os.environ["OMP_NUM_THREADS"] = "1"  # for torch, if it is not imported yet
        if "torch" in sys.modules:
            torch.set_num_threads(1)
    return index, function(*job)


@contextmanager
def cluster(address: str | None) -> Iterator[None]:
    """Inside the block `parallel` uses the Dask cluster of the scheduler at `address`, such as tcp://host:8786; with
    None it stays on this machine.

    The workers need this package, and must see the files of a job under the same paths. Raises SdfsimError if Dask is
    not installed, or no scheduler answers.
    """
    if address is None:
        yield
        return
    from joblib import parallel_config

    try:
        from distributed import Client
    except ImportError as error:
        raise SdfsimError("a cluster needs Dask", "pip install 'sdfsim[learn]'") from error
    try:
        client = Client(address, timeout=SCHEDULER_ANSWERS)
    except (OSError, TimeoutError, ValueError) as error:
        raise SdfsimError(f"{address}: no scheduler of a Dask cluster answers there") from error
    with client, parallel_config(backend="dask"):
        yield


def choose_threads(work: Callable[[], object], threads: int | None = None) -> float:
    """Time `work`, typically tens of milliseconds, with one thread and with all. Set torch to the faster of the two (or
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
