"""What a run keeps from step to step, and what it counts. Nothing here changes a result."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from torch import nn

from sdfsim.learned.impulse import ImpulseNetwork
from sdfsim.physics.bodies import Bodies, State

if TYPE_CHECKING:
    from sdfsim.physics.options import StepOptions
    from sdfsim.physics.solver.impulse import Weights
    from sdfsim.physics.solver.prepare import Compiled

COUNTS = {
    "pairs": "pairs of bodies that the broad phase let through",
    "contacts": "contact points that the solve held",
    "nodes": "nodes of the graph that the network saw",
    "edges": "edges of that graph",
    "free": "dynamic bodies in free flight",
    "active": "dynamic bodies awake that contacts moved",
    "asleep": "dynamic bodies asleep",
}
PHASES = {
    "flight_ms": "free flight",
    "contact_ms": "contact solve",
    "network_ms": "network",
}


class Memory:
    """Of one run: the compiled scene, the packed network, and `counts` of the present step, by the names of `COUNTS`
    and `PHASES` (ms)."""

    def __init__(self) -> None:
        self.counts = dict.fromkeys((*COUNTS, *PHASES), 0.0)
        self._compiled: Compiled | None = None
        self._packed: tuple[nn.Module, bool, Weights] | None = None

    def compiled(self, bodies: Bodies, state: State) -> Compiled:
        """The bodies as compiled code wants them, made once."""
        from sdfsim.physics.solver.prepare import Compiled

        if self._compiled is None or self._compiled.bodies is not bodies:
            self._compiled = Compiled(bodies, state)
        return self._compiled

    def weights(self, network: nn.Module, rules: StepOptions) -> Weights:
        """Those of an *impulse* network as compiled code wants them, taken once."""
        from sdfsim.learned.inference import packed

        if self._packed is None or self._packed[0] is not network or self._packed[1] != rules.friction:
            weights = packed(cast("ImpulseNetwork", network), friction=rules.friction)
            self._packed = network, rules.friction, weights
        return self._packed[2]

    def begin(self) -> None:
        """Start counting a step."""
        self.counts = dict.fromkeys(self.counts, 0.0)

    def end(self, bodies: Bodies, state: State) -> None:
        """The step led to `state`."""
        asleep = 0 if state.touch is None else int(np.count_nonzero(state.touch.island.numpy() >= 0))
        moving = np.count_nonzero(bodies.moves.cpu().numpy())
        self.count(asleep=asleep, free=moving - asleep - self.counts["active"])

    def count(self, **more: float) -> None:
        """Add to counters."""
        for name, value in more.items():
            self.counts[name] += value

    @contextmanager
    def timed(self, phase: str) -> Iterator[None]:
        """Add the time that a block takes to a phase."""
        started = time.perf_counter()
        yield
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
        self.counts[phase] += 1e3 * (time.perf_counter() - started)
