"""Training one network with several processes or GPUs that `torchrun` starts."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import nn


@dataclass(frozen=True)
class Team:
    """One of `size` processes that share every batch: each works on its part, gradients are added up."""

    rank: int = 0  # 0 ... size - 1
    size: int = 1

    @property
    def leads(self) -> bool:
        return self.rank == 0

    @contextmanager
    def in_turn(self) -> Iterator[None]:
        """The first process runs the block alone, then the others run it together."""
        if not self.leads:
            self.wait()
        yield
        if self.leads:
            self.wait()

    def share(self, count: int) -> slice:
        """This process's part of a batch of `count`."""
        return slice(self.rank * count // self.size, (self.rank + 1) * count // self.size)

    def total(self, value: float, device: torch.device) -> float:
        """The sum of `value` over all processes."""
        if self.size == 1:
            return value
        whole = torch.tensor([value], dtype=torch.float64, device=device)
        torch.distributed.all_reduce(whole)
        return float(whole)

    def add_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace the gradients of every process by their sum."""
        if self.size == 1:
            return
        gradients = [p.grad if p.grad is not None else torch.zeros_like(p) for p in parameters]
        flat = nn.utils.parameters_to_vector(gradients)
        torch.distributed.all_reduce(flat)
        nn.utils.vector_to_parameters(flat, gradients)

    def wait(self) -> None:
        if self.size > 1:
            torch.distributed.barrier()


ALONE = Team()


def gather_team(device: str) -> tuple[Team, str]:
    """The team to which this process belongs if `torchrun` started it, else a team of one; and the process's device."""
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        return ALONE, device
    cuda = device != "cpu" and torch.cuda.is_available()
    if not torch.distributed.is_initialized():
        torch.distributed.init_process_group("nccl" if cuda else "gloo")
    if cuda:
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    return Team(torch.distributed.get_rank(), size), "cuda" if cuda else "cpu"
