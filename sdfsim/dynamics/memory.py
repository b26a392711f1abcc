"""What a run keeps from step to step to compute less, and what it counts. Nothing here changes a result."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.broad import Still, moving, swept_boxes
from sdfsim.dynamics.clusters import Layer, layers
from sdfsim.scene.scene import Limits

if TYPE_CHECKING:
    from sdfsim.dynamics.rounding import Curvature
    from sdfsim.dynamics.solver import Compiled

COUNTS = {
    "pairs": "pairs of bodies that the broad phase let through",
    "sdf_queries": "signed distances asked for",
    "sdf_waiting": "nodes, or balls of them, near a surface that cannot reach it yet, by an earlier answer",
    "nodes": "nodes of the graph that the network saw",
    "edges": "edges of that graph",
    "contacts": "contact points that the solver held",
    "free": "dynamic bodies in free flight",
    "active": "dynamic bodies that the network moved",
    "asleep": "dynamic bodies asleep",
    "held_back": "dynamic bodies whose velocities were held back",
}
PHASES = {
    "pairs_ms": "broad phase",
    "distances_ms": "signed distances",
    "flight_ms": "free flight",
    "network_ms": "network",
    "contact_ms": "contact solve",
    "sleep_ms": "sleep",
}
PIECE = 2**20  # nodes that are gone through together at most; in smaller parts a large scene takes twice the time
_SLACK = 1e-9  # model lengths, for the rounding of distances
BYTES_A_ROW = 4096  # what an edge of the network takes; a node near a surface takes no more while it is worked on
# What a run takes beside its scene, as measured on scenes of docs/scale.md: torch's own at the first step, the working
# memory of fitted distances, a body, a surface node with its place among the balls, a point while it is looked at.
BYTES_AT_LEAST, BYTES_FITTED = 71 * 2**20, 16 * 2**20
BYTES_A_BODY, BYTES_A_NODE, BYTES_A_POINT = 22_000, 110, 200


def row_limit(limits: Limits) -> int | None:
    """How many nodes or edges may be worked on at once, so that a step keeps to its memory; None for all."""
    return None if limits.memory_gib is None else max(1, int(limits.memory_gib * 2**30 / BYTES_A_ROW))


def peak_bytes(*, bodies: int, nodes: int, edges: float, points: float, fitted: bool, rows: int | None) -> float:
    """What a run will take at its largest step, beside the loaded scene and the rollout that it keeps.

    Args:
        bodies: of the scene.
        nodes: surface nodes of all bodies.
        edges: of the impulse network.
        points: nodes and balls near a surface, asked or waiting.
        fitted: whether some of the distances are networks.
        rows: see `row_limit`.
    """
    at_once = min(points, PIECE // 4, rows or PIECE)  # of a piece seldom more than a quarter comes near
    standing = BYTES_AT_LEAST + BYTES_FITTED * fitted + BYTES_A_BODY * bodies + BYTES_A_NODE * nodes
    return standing + BYTES_A_ROW * edges + BYTES_A_POINT * at_once


def least(trust: Tensor, distance: Tensor, way: Tensor) -> Tensor:
    """[Q] what a signed distance [Q] has left at least after a `way` [Q], see `SdfBank.trust`."""
    return trust * distance - way / trust - _SLACK


class Waits:
    """Signed distances from earlier steps: a node at distance d has to move by d - D before it is within reach.

    What was asked is kept in the other body's frame, where the way from there to here is all that the distance can have
    shrunk by, whatever has moved. A ball of nodes reaches as much farther as its radius.
    """

    def __init__(self) -> None:
        self._rows: tuple[Tensor, Tensor, Tensor] | None = None
        self._noted: list[tuple[Tensor, Tensor, Tensor]] = []

    def may_wait(
        self, key: Tensor, place: Tensor, radius: Tensor, trust: Tensor, most: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Which of Q balls near a surface cannot have come within `most` of it.

        Args:
            key: [Q] int64, ascending, of the ball and the other body.
            place: [Q, 3] its middle in the other body's frame.
            radius: [Q] of it; 0 for a node.
            trust: [Q] how exact that body's distances are, see `SdfBank.trust`.
            most: [Q] a smaller distance may make an edge.

        Returns:
            [Q] bool; and where [Q, 3] and what [Q] the last answer was, for those that wait.
        """
        if self._rows is None or not len(self._rows[0]):
            return torch.zeros_like(key, dtype=torch.bool), place, torch.zeros_like(most)
        keys, places, distances = self._rows
        at = torch.searchsorted(keys, key).clamp_max(len(keys) - 1)
        before, distance = places[at], distances[at]
        left = least(trust, distance, (place - before).norm(dim=-1) + radius)
        return (keys[at] == key) & (left > most), before, distance

    def note(self, key: Tensor, place: Tensor, distance: Tensor, worth: Tensor) -> None:
        """Keep the answers that are `worth` it for the next step; keys come in ascending order."""
        self._noted.append((key[worth], place[worth], distance[worth]))

    def turn(self) -> None:
        """What was noted since the last call replaces what was known."""
        keys, places, distances = zip(*self._noted, strict=True) if self._noted else ((), (), ())
        self._rows = (torch.cat(keys), torch.cat(places), torch.cat(distances)) if keys else None
        self._noted = []


class Memory:
    """Of one run: caches, counters and timers.

    Attributes:
        waits: earlier distances, of each of the layers of `tree`.
        counts: what the present step has counted so far, by the names of `COUNTS` and `PHASES` (ms), and the
            `energy_gain` (model units) of contact.
    """

    def __init__(self) -> None:
        self.waits = (Waits(), Waits(), Waits())
        self.counts = dict.fromkeys((*COUNTS, *PHASES, "energy_gain"), 0.0)
        self._tree: tuple[Tensor, tuple[Layer, Layer, Layer]] | None = None
        self._bend: tuple[Tensor, Curvature] | None = None
        self._compiled: Compiled | None = None
        self._last: State | None = None
        self._still: tuple[Tensor, Still] | None = None
        self._cuda = False

    def tree(self, bodies: Bodies) -> tuple[Layer, Layer, Layer]:
        """The bodies' nodes in balls, sorted out once."""
        if self._tree is None or self._tree[0] is not bodies.node:
            self._tree = (bodies.node, layers(bodies))
        return self._tree[1]

    def compiled(self, bodies: Bodies, state: State) -> Compiled:
        """The bodies as the contact solve wants them, made once."""
        from sdfsim.dynamics.solver import Compiled

        if self._compiled is None or self._compiled.bodies is not bodies:
            self._compiled = Compiled(bodies, state)
        return self._compiled

    def curvature(self, bodies: Bodies) -> Curvature:
        """How the bodies' surfaces bend around their nodes, measured once."""
        from sdfsim.dynamics.rounding import curvature

        if self._bend is None or self._bend[0] is not bodies.node:
            self._bend = (bodies.node, curvature(bodies))
        return self._bend[1]

    def turn(self) -> None:
        """A search is over: what it noted replaces what was known."""
        for waits in self.waits:
            waits.turn()

    def begin(self, bodies: Bodies, state: State) -> bool:
        """Start counting a step. Returns whether `state` comes from elsewhere than the step before."""
        self.counts = dict.fromkeys(self.counts, 0.0)
        self._cuda = bodies.device.type == "cuda"
        edited = state is not self._last
        if edited:
            self._still = None
        return edited

    def end(self, bodies: Bodies, state: State) -> None:
        """The step led to `state`."""
        self._last = state
        of = state.touch or state.sleep
        asleep = 0 if of is None else int((of.island >= 0).sum())
        self.count(asleep=asleep, free=int(bodies.moves.sum()) - asleep - self.counts["active"])

    def count(self, **more: float) -> None:
        """Add to counters."""
        for name, value in more.items():
            self.counts[name] += value

    @contextmanager
    def timed(self, phase: str) -> Iterator[None]:
        """Add the time that a block takes to a phase."""
        started = time.perf_counter()
        yield
        if self._cuda:
            torch.cuda.synchronize()
        self.counts[phase] += 1e3 * (time.perf_counter() - started)

    def surroundings(
        self, bodies: Bodies, state: State, gravity: Tensor, reach: float, dt: float
    ) -> tuple[Tensor, Still]:
        """The bodies that move, and the others, sorted again only when it is not the same bodies as before."""
        going = moving(bodies, state)
        if self._still is None or not torch.equal(self._still[0], going):
            stays = torch.ones(len(bodies), dtype=torch.bool, device=bodies.device)
            stays[going] = False
            boxes = swept_boxes(bodies, state, gravity, reach, dt, stays.nonzero()[:, 0])
            self._still = (going, Still(boxes))
        return going, self._still[1]
