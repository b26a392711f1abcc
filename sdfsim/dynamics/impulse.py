"""The *impulse* network: message passing between bodies over contact edges, whose decoded quantities are impulses.

An impulse acts on both bodies of an edge, equal and opposite, at the contact point, with their true mass and
inertia. So linear momentum is conserved exactly, angular momentum exactly at the instant the impulses act, and the
step turns with the scene, whatever the weights are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from sdfsim.dynamics.graph import EDGE_FEATURES, ContactGraph, EdgeFrames, edge_frames, relative_velocity

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
        now = Velocities(graph.free_velocity, graph.free_angular, graph.mean_velocity, graph.mean_angular)
        for layer in self.rounds:
            edge, body, now = self._round(layer, graph, frames, edge, body, now, friction, rows)
        return now

    def _round(self, layer, graph: ContactGraph, frames: EdgeFrames, edge, body, now: Velocities, friction, rows):
        end = _in_frame(graph, frames, now.velocity, now.angular)
        mean = _in_frame(graph, frames, now.mean_velocity, now.mean_angular)
        first, second = graph.first, graph.second

        def read(edge: Tensor, first: Tensor, second: Tensor, end: Tensor, mean: Tensor) -> Tensor:
            return layer.edge(torch.cat([layer.normalise(edge), body[first], body[second], end, mean], -1))

        hidden = by_rows(read, rows, edge, first, second, end, mean)
        edge = edge + layer.latent(hidden)
        weight = _share_of_pair(layer.attention(hidden)[:, 0], graph)[:, None]

        # [E, end | mean, axis] velocity change, units of `speed`; without friction the normal is the only axis.
        change = layer.normal_impulse(hidden)[..., None]
        if friction:
            change = torch.cat([change, layer.tangent_impulse(hidden).reshape(-1, 2, 2)], -1)
        impulse = change * (weight * frames.speed)[..., None] * frames.mass[:, None, : change.shape[-1]]
        now = Velocities(
            *_push(graph, frames, impulse[:, 0], now.velocity, now.angular),
            *_push(graph, frames, impulse[:, 1], now.mean_velocity, now.mean_angular),
        )
        to_first, to_second = (layer.message(hidden) * weight).chunk(2, -1)
        heard = torch.zeros_like(body).index_add_(0, first, to_first).index_add_(0, second, to_second)
        body = body + layer.body(torch.cat([body, heard], -1))
        body = body * (LOUDEST / body.norm(dim=-1, keepdim=True).clamp_min(LOUDEST))
        # Scenery carries no message from one body to another.
        return edge, body * (graph.inverse_mass > 0)[:, None], now


def _in_frame(graph: ContactGraph, frames: EdgeFrames, velocity: Tensor, angular: Tensor) -> Tensor:
    """[E, 3] dimensionless relative velocity in the edge's frame."""
    v = relative_velocity(graph, velocity, angular)
    return ((frames.axes @ v[..., None])[..., 0] / frames.speed).clamp(-FASTEST, FASTEST)


def _share_of_pair(logit: Tensor, graph: ContactGraph) -> Tensor:
    """[E] softmax over the edges of each pair, so that more nodes do not mean more push."""
    top = torch.full((graph.pairs,), -torch.inf, dtype=logit.dtype, device=logit.device)
    top = top.scatter_reduce(0, graph.pair, logit.detach(), "amax")
    raised = (logit - top[graph.pair]).exp()
    total = torch.zeros(graph.pairs, dtype=logit.dtype, device=logit.device).index_add(0, graph.pair, raised)
    return raised / total[graph.pair]


def _push(graph: ContactGraph, frames: EdgeFrames, impulse: Tensor, velocity: Tensor, angular: Tensor):
    """Apply impulses [E, 3] (edge frames; [E, 1] along the normal) to both: new velocities, linear and angular."""
    world = _along(impulse, frames.axes)
    velocity = velocity.index_add(0, graph.first, world * frames.push_first)
    velocity = velocity.index_add(0, graph.second, -world * frames.push_second)
    angular = angular.index_add(0, graph.first, _along(impulse, frames.turn_first))
    angular = angular.index_add(0, graph.second, -_along(impulse, frames.turn_second))
    return velocity, angular


def _along(impulse: Tensor, vectors: Tensor) -> Tensor:
    """[E, 3]: vectors [E, 3, 3] of the axes, each times the impulse [E, 3] along it; [E, 1]: of the first alone."""
    if impulse.shape[-1] == 1:
        return impulse * vectors[:, 0]
    return (impulse[:, None] @ vectors)[:, 0]
