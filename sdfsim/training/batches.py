"""The batches of a training run, in the order of its steps: drawn on demand, or in advance by worker processes."""

import contextlib
import signal
import sys
import time
from collections.abc import Generator
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from sdfsim.base.errors import SdfsimError

AHEAD = 4  # batches that each worker draws in advance


@dataclass(frozen=True)
class Drawn:
    """The batch of a step."""

    batch: Any  # the task's batch
    mirrored: bool  # whether to train on its mirror image
    seconds: float  # s of processor time that drawing took


@dataclass(frozen=True)
class Draws(Dataset):
    """The batch of every step, which depends only on (seed, step)."""

    task: Any
    count: int  # frames in a batch
    seed: int

    def __getitem__(self, step: int) -> Drawn:
        started = time.process_time()
        rng = np.random.default_rng([self.seed, 0, step])
        mirrored = bool(rng.integers(2))
        batch = self.task.draw(rng, self.count)
        return Drawn(batch, mirrored, time.process_time() - started)


def batches(draws: Draws, first: int, workers: int = 0) -> Generator[Drawn, None, None]:
    """The batches of the steps from `first` on, the same for any number of `workers`, processes that draw in advance.
    They have ended once the generator is closed. Raises SdfsimError if one of them ended."""
    steps = range(first, sys.maxsize)
    if not workers:
        yield from map(draws.__getitem__, steps)
        return
    # Spawned, not forked, so that no CUDA context or running thread is copied.
    loader = DataLoader(
        draws, batch_size=None, sampler=steps, collate_fn=_as_it_is, num_workers=workers, prefetch_factor=AHEAD,
        worker_init_fn=_deaf, multiprocessing_context="spawn",
    )  # fmt: skip
    drawing: Any = iter(loader)
    try:
        yield from drawing
    except RuntimeError as error:
        if "DataLoader worker" not in str(error).partition("\n")[0]:
            raise
        raise SdfsimError("a process that draws batches has ended", "fewer --workers use less memory") from error
    finally:
        # Joined here, not when the loader is collected: a worker may crash on its way out, after its last batch, and
        # torch would print the error that it raises for this.
        with contextlib.suppress(RuntimeError):
            drawing._shutdown_workers()


def moved(value: Any, device: torch.device) -> Any:
    """Move a batch, its parts or a tensor to a device."""
    if isinstance(value, torch.Tensor):
        return value.to(device)
    if isinstance(value, dict):
        return {name: moved(part, device) for name, part in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: moved(getattr(value, f.name), device) for f in fields(value)})
    return value


def _as_it_is(value: Any) -> Any:
    return value


def _deaf(_: int) -> None:
    """Ignore Ctrl-C in workers: the training process handles it and ends them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
