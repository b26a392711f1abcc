"""The *impulse* network: message passing between bodies over contact edges.

The network decodes impulses. They act on both bodies of an edge, equal and opposite, at the contact point, with the
bodies' true mass and inertia. So linear momentum is conserved exactly, angular momentum exactly at the instant at which
the impulses act, and the step rotates with the scene, whatever the weights are.

An impulse is a sum of relative velocities at the contact point, each times the effective mass and a learned factor, and
each round sees what the rounds before it have left of the motion. So an error of a factor leaves a part of a motion, as
in a relaxation, and no push where nothing moves: bodies at rest stay where they are.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn

from sdfsim.learned.contact_graph import EDGE_FEATURES, ContactGraph, EdgeFrames, edge_frames

# The relative velocities of `EdgeFrames.told`, those that are left at the end and in the mean, and the latter two as
# directions: `EdgeFrames.speed` along them, less below `STICK`. Coulomb's friction is of this form.
QUANTITIES = 8
STICK = 0.05  # model units of speed


@dataclass(frozen=True)
class ImpulseConfig:
    width: int = 32  # width of every latent and hidden layer
    rounds: int = 4  # rounds of message passing, each with its own weights

    def __post_init__(self) -> None:
        if min(self.width, self.rounds) < 1:
            raise ValueError(f"width and rounds must be at least 1 (got {self.width} and {self.rounds})")


@dataclass(frozen=True)
class Velocities:
    """The network's predictions for N bodies, model units, world frame."""

    # velocity, angular: [N, 3] at the end of the step
    velocity: Tensor
    angular: Tensor
    # mean_velocity, mean_angular: [N, 3] over the step: they move position and orientation
    mean_velocity: Tensor
    mean_angular: Tensor


def mlp(inputs: int, width: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, outputs)
    )


class Round(nn.Module):
    """One round: edges read both bodies and the present relative velocities, then give them impulses and messages."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.normalise = nn.LayerNorm(width)
        self.edge = nn.Sequential(nn.Linear(3 * width + 6, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU())
        self.latent = nn.Linear(width, width)
        self.message = nn.Linear(width, 2 * width)
        self.body = mlp(2 * width, width, width)
        self.attention = nn.Linear(width, 1)
        self.factor = nn.Linear(width, 2 * 3 * QUANTITIES)
        nn.init.normal_(self.factor.weight, std=0.01)
        nn.init.zeros_(self.factor.bias)

    def read(self, body: Tensor, edge: Tensor, first: Tensor, second: Tensor, relative: Tensor) -> Tensor:
        """[E, width] from the edges' own latents, those of their bodies, and the relative motion [E, 6]."""
        return self.edge(torch.cat([self.normalise(edge), body[first], body[second], relative], -1))

    def change(self, hidden: Tensor, velocities: Tensor) -> Tensor:
        """[E, axis, end | mean] changes of velocity: sums of `velocities` [E, axis, QUANTITIES] times factors."""
        factor = self.factor(hidden).reshape(-1, 2, 3, QUANTITIES)
        return (factor * velocities[:, None]).sum(-1).mT

    def update(
        self, edge: Tensor, body: Tensor, hidden: Tensor, weight: Tensor, graph: ContactGraph
    ) -> tuple[Tensor, Tensor]:
        to_first, to_second = (self.message(hidden) * weight).chunk(2, -1)
        received = torch.zeros_like(body).index_add_(0, graph.first, to_first).index_add_(0, graph.second, to_second)
        body = body + self.body(torch.cat([body, received], -1))
        # Static bodies carry no message from one body to another.
        return edge + self.latent(hidden), body * (graph.inverse_mass > 0)[:, None]


class ImpulseNetwork(nn.Module):
    """Encode edges, then `rounds` of message passing; see the module's docstring."""

    def __init__(self, config: ImpulseConfig) -> None:
        super().__init__()
        self.config = config
        self.encode = mlp(EDGE_FEATURES, config.width, config.width)
        self.rounds = nn.ModuleList(Round(config.width) for _ in range(config.rounds))

    def forward(self, graph: ContactGraph, *, friction: bool = True, mirrored: bool = False) -> Velocities:
        """Velocities after the contacts have acted; `mirrored` as for `edge_frames`."""
        frames = edge_frames(graph, mirrored=mirrored)
        edge = self.encode(frames.start)
        body = edge.new_zeros(len(graph.inverse_mass), self.config.width)
        end = torch.cat([graph.free_velocity, graph.free_angular], -1)
        mean = torch.cat([graph.mean_velocity, graph.mean_angular], -1)
        twist = torch.stack([end, mean], -1)
        mass = frames.mass if friction else frames.mass * frames.mass.new_tensor([1.0, 0.0, 0.0])
        for number, layer in enumerate(cast("Iterable[Round]", self.rounds), start=1):
            seen = relative(graph, frames, twist)
            hidden = layer.read(body, edge, graph.first, graph.second, (seen / frames.speed[..., None]).mT.flatten(1))
            weight = _share_of_pair(layer.attention(hidden)[:, 0], graph)[:, None]
            along = frames.speed[..., None] * torch.tanh(seen / STICK)
            change = layer.change(hidden, torch.cat([frames.told, seen, along], -1))
            twist = pushed(graph, frames, change * (weight * mass)[..., None], twist)
            if number < len(self.rounds):  # the last round's latents are not read
                edge, body = layer.update(edge, body, hidden, weight, graph)
        end, mean = twist.unbind(-1)
        return Velocities(end[:, :3], end[:, 3:], mean[:, :3], mean[:, 3:])


def relative(graph: ContactGraph, frames: EdgeFrames, twist: Tensor) -> Tensor:
    """[E, 3, K] relative velocities at the contact points along the edges' axes, for twists [N, 6, K]."""
    return frames.jacobian_first @ twist[graph.first] - frames.jacobian_second @ twist[graph.second]


def pushed(graph: ContactGraph, frames: EdgeFrames, impulse: Tensor, twist: Tensor) -> Tensor:
    """Twists [N, 6, K] after impulses [E, axis, K] on the first bodies; the second get the opposite."""
    twist = twist.index_add(0, graph.first, frames.response_first @ impulse)
    return twist.index_add(0, graph.second, frames.response_second @ impulse)


def _share_of_pair(logit: Tensor, graph: ContactGraph) -> Tensor:
    """[E] softmax over the edges of each pair, so that more nodes do not mean more push."""
    top = torch.full((graph.pairs,), -torch.inf, dtype=logit.dtype, device=logit.device)
    top = top.scatter_reduce(0, graph.pair, logit.detach(), "amax")
    raised = (logit - top[graph.pair]).exp()
    total = torch.zeros(graph.pairs, dtype=logit.dtype, device=logit.device).index_add(0, graph.pair, raised)
    return raised / total[graph.pair]
