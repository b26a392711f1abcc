"""Work on all cores, in processes that stop when the caller does; or, unchanged, on a cluster."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from sdfsim.errors import SdfsimError


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


@contextmanager
def cluster(address: str | None) -> Iterator[None]:
    """Let `parallel` work on a Dask cluster inside the block; None leaves it on this machine.

    Args:
        address: of the scheduler, such as tcp://host:8786. Its workers need this package, and see the files of a job
            under the same paths.

    Raises:
        SdfsimError: Dask is not installed, or no scheduler answers.
    """
    if address is None:
        yield
        return
    from joblib import parallel_config

    try:
        from distributed import Client
    except ImportError as error:
        raise SdfsimError("a cluster needs Dask", "pip install -e '.[cluster]'") from error
    try:
        client = Client(address, timeout=10)
    except (OSError, TimeoutError, ValueError) as error:
        raise SdfsimError(f"{address}: no scheduler of a Dask cluster answers there") from error
    with client, parallel_config(backend="dask"):
        yield


def _one(function: Callable[..., Any], index: int, job: tuple, caller: int) -> tuple[int, Any]:
    """In a worker: one thread, and Ctrl-C is the caller's business. On a single core the caller works itself."""
    from sdfsim.threads import limit_threads

    if os.getpid() != caller:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        limit_threads(1)
    return index, function(*job)
