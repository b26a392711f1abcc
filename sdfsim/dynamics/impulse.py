"""The *impulse* network: message passing between bodies over contact edges, whose decoded quantities are impulses.

An impulse acts on both bodies of an edge, equal and opposite, at the contact point, with their true mass and
inertia. So linear momentum is conserved exactly, angular momentum exactly at the instant the impulses act, and the
step turns with the scene, whatever the weights are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import cast

import torch
from torch import Tensor, nn

from sdfsim.dynamics.graph import EDGE_FEATURES, ContactGraph, EdgeFrames, edge_frames

# Relative velocities that a round sees are no larger than this, in units of the fastest motion before the step (1.7 in
# training). Larger ones are a prediction that runs away, which the rounds after it must not feed on.
FASTEST = 3.0
# Longest latent vector of a body (5 in training). One among many more neighbours than there were hears so much that the
# next rounds would amplify it without end.
LOUDEST = 6.0


@dataclass(frozen=True)
class ImpulseConfig:
    """Sizes of the network.

    Attributes:
        width: of every latent and hidden layer.
        rounds: of message passing, each with weights of its own.
    """

    width: int = 64
    rounds: int = 6


@dataclass(frozen=True)
class Velocities:
    """What the network predicts for N bodies, model units, world frame.

    Attributes:
        velocity, angular: [N, 3] at the end of the step.
        mean_velocity, mean_angular: [N, 3] over the step: they move position and orientation.
    """

    velocity: Tensor
    angular: Tensor
    mean_velocity: Tensor
    mean_angular: Tensor


def mlp(inputs: int, width: int, outputs: int) -> nn.Sequential:
    """Two hidden layers."""
    return nn.Sequential(
        nn.Linear(inputs, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, outputs)
    )


def by_rows(function: Callable[..., Tensor], rows: int | None, *inputs: Tensor) -> Tensor:
    """`function` of inputs [E, ...] that treats every row alone, on at most `rows` of them at once."""
    if rows is None or len(inputs[0]) <= rows:
        return function(*inputs)
    return torch.cat([function(*part) for part in zip(*(v.split(rows) for v in inputs), strict=True)])


class Round(nn.Module):
    """One round: edges read both bodies and the current relative velocities, then push and inform them."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.normalise = nn.LayerNorm(width)
        self.edge = nn.Sequential(nn.Linear(3 * width + 6, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU())
        self.latent = nn.Linear(width, width)
        self.message = nn.Linear(width, 2 * width)
        self.body = mlp(2 * width, width, width)
        self.attention = nn.Linear(width, 1)
        self.normal_impulse = nn.Linear(width, 2)
        self.tangent_impulse = nn.Linear(width, 4)
        for head in (self.normal_impulse, self.tangent_impulse):
            nn.init.normal_(head.weight, std=0.01)
            nn.init.zeros_(head.bias)

    def read(self, body: Tensor, edge: Tensor, first: Tensor, second: Tensor, relative: Tensor) -> Tensor:
        """[E, width] of the edges' own latents, those of their bodies, and [E, 6] what is seen of their motion."""
        return self.edge(torch.cat([self.normalise(edge), body[first], body[second], relative], -1))

    def impulse(self, hidden: Tensor, friction: bool) -> Tensor:
        """[E, axis, end | mean] changes of velocity; without friction the normal is the only axis."""
        change = self.normal_impulse(hidden)[:, None]
        if not friction:
            return change
        return torch.cat([change, self.tangent_impulse(hidden).reshape(-1, 2, 2).mT], 1)

    def tell(
        self, edge: Tensor, body: Tensor, hidden: Tensor, weight: Tensor, graph: ContactGraph
    ) -> tuple[Tensor, Tensor]:
        """Latents of edges and bodies for the next round."""
        to_first, to_second = (self.message(hidden) * weight).chunk(2, -1)
        heard = torch.zeros_like(body).index_add_(0, graph.first, to_first).index_add_(0, graph.second, to_second)
        body = body + self.body(torch.cat([body, heard], -1))
        body = body * (LOUDEST / body.norm(dim=-1, keepdim=True).clamp_min(LOUDEST))
        # Scenery carries no message from one body to another.
        return edge + self.latent(hidden), body * (graph.inverse_mass > 0)[:, None]


class ImpulseNetwork(nn.Module):
    """Encode edges, then `rounds` of pushing; see the module's docstring.

    Args:
        config: sizes.
    """

    def __init__(self, config: ImpulseConfig) -> None:
        super().__init__()
        self.config = config
        self.encode = mlp(EDGE_FEATURES, config.width, config.width)
        self.rounds = nn.ModuleList(Round(config.width) for _ in range(config.rounds))

    def forward(
        self, graph: ContactGraph, *, friction: bool = True, mirrored: bool = False, rows: int | None = None
    ) -> Velocities:
        """Velocities after the contacts have acted.

        Args:
            graph: bodies and edges.
            friction: False computes no tangential impulse at all.
            mirrored: see `edge_frames`.
            rows: update no more than that many edges at once; None for all.
        """
        frames = edge_frames(graph, mirrored=mirrored)
        edge = by_rows(self.encode, rows, frames.start)
        body = edge.new_zeros(len(graph.inverse_mass), self.config.width)
        end = torch.cat([graph.free_velocity, graph.free_angular], -1)
        mean = torch.cat([graph.mean_velocity, graph.mean_angular], -1)
        twist = torch.stack([end, mean], -1)
        for number, layer in enumerate(cast("Iterable[Round]", self.rounds), start=1):
            seen = _relative(graph, frames, twist)
            hidden = by_rows(partial(layer.read, body), rows, edge, graph.first, graph.second, seen)
            weight = _share_of_pair(layer.attention(hidden)[:, 0], graph)[:, None]
            twist = _push(graph, frames, layer.impulse(hidden, friction) * weight[..., None], twist)
            if number < len(self.rounds):  # nobody reads what the last round would tell
                edge, body = layer.tell(edge, body, hidden, weight, graph)
        end, mean = twist.unbind(-1)
        return Velocities(end[:, :3], end[:, 3:], mean[:, :3], mean[:, 3:])


def _relative(graph: ContactGraph, frames: EdgeFrames, twist: Tensor) -> Tensor:
    """[E, 6] dimensionless relative velocities at the contact points along the edges' axes: end, then mean."""
    relative = frames.read_first @ twist[graph.first] - frames.read_second @ twist[graph.second]
    return (relative / frames.speed[..., None]).clamp(-FASTEST, FASTEST).mT.flatten(1)


def _push(graph: ContactGraph, frames: EdgeFrames, change: Tensor, twist: Tensor) -> Tensor:
    """Twists [N, 6, 2] after changes of velocity [E, axis, 2] in units of `speed`, as impulses on both bodies."""
    axes = change.shape[1]
    impulse = change * (frames.speed * frames.mass[:, :axes])[..., None]
    twist = twist.index_add(0, graph.first, frames.give_first[..., :axes] @ impulse)
    return twist.index_add(0, graph.second, frames.give_second[..., :axes] @ impulse)


def _share_of_pair(logit: Tensor, graph: ContactGraph) -> Tensor:
    """[E] softmax over the edges of each pair, so that more nodes do not mean more push."""
    top = torch.full((graph.pairs,), -torch.inf, dtype=logit.dtype, device=logit.device)
    top = top.scatter_reduce(0, graph.pair, logit.detach(), "amax")
    raised = (logit - top[graph.pair]).exp()
    total = torch.zeros(graph.pairs, dtype=logit.dtype, device=logit.device).index_add(0, graph.pair, raised)
    return raised / total[graph.pair]
