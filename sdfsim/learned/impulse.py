"""The *impulse* network: message passing between bodies over contact edges, on top of the contact solve.

The network decodes impulses. They act on both bodies of an edge, equal and opposite, at the contact point, with the
bodies' true mass and inertia. So linear momentum is conserved exactly, angular momentum exactly at the instant at which
the impulses act, and the step rotates with the scene, whatever the weights are.

The rounds start from the solve's result for the step, and what they add stays within a trust region (`bounded`).

This is the form for training; `inference` uses it in simulations.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import cast

import torch
from torch import Tensor, nn

from sdfsim.learned.contact_graph import EDGE_FEATURES, ContactGraph, EdgeFrames, edge_frames

# Model units, relative speeds of two surfaces before the step: up to the first the network adds nothing, from the
# second on it has its full effect. So bodies that rest, roll or stand in a tower move as the solve has it.
CALM, LIVELY = 0.05, 0.5
LEVER = 0.5  # relative to the distance from a centre of mass to a contact: how far from the contact an impact may act


@dataclass(frozen=True)
class ImpulseConfig:
    width: int = 64  # width of every latent and hidden layer
    rounds: int = 6  # rounds of message passing, each with its own weights
    # 1 for a network that gets the contacts, but not the solve's impulses, and is not bounded: learning alone, for
    # comparison
    alone: int = 0
    # 1 for a network that acts where surfaces strike each other, and also turns bodies there, see `struck`
    impacts: int = 0

    def __post_init__(self) -> None:
        if min(self.width, self.rounds) < 1:
            raise ValueError(f"width and rounds must be at least 1 (got {self.width} and {self.rounds})")
        if self.alone and self.impacts:
            raise ValueError("a network that is alone has no solve whose impacts it could change")


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

    def __init__(self, width: int, moments: bool = False) -> None:
        super().__init__()
        self.normalise = nn.LayerNorm(width)
        self.edge = nn.Sequential(
            nn.Linear(3 * width + (12 if moments else 6), width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
        )
        self.latent = nn.Linear(width, width)
        self.message = nn.Linear(width, 2 * width)
        self.body = mlp(2 * width, width, width)
        self.attention = nn.Linear(width, 1)
        self.normal_impulse = nn.Linear(width, 2)
        self.tangent_impulse = nn.Linear(width, 4)
        # moments on both bodies, as from a contact that is a patch and not a point
        self.moment = nn.Linear(width, 6) if moments else None
        for head in (self.normal_impulse, self.tangent_impulse, self.moment):
            if head is not None:
                nn.init.normal_(head.weight, std=0.001 if moments else 0.01)
                nn.init.zeros_(head.bias)

    def read(self, body: Tensor, edge: Tensor, first: Tensor, second: Tensor, relative: Tensor) -> Tensor:
        """[E, width] from the edges' own latents, those of their bodies, and the relative motion [E, 6]."""
        return self.edge(torch.cat([self.normalise(edge), body[first], body[second], relative], -1))

    def impulse(self, hidden: Tensor, friction: bool) -> Tensor:
        """[E, axis, end | mean] changes of velocity; without friction the normal is the only axis."""
        change = self.normal_impulse(hidden)[:, None]
        if not friction:
            return change
        change = torch.cat([change, self.tangent_impulse(hidden).reshape(-1, 2, 2).mT], 1)
        if self.moment is None:
            return change
        return torch.cat([change, self.moment(hidden).reshape(-1, 3, 2)], 1)

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
        self.rounds = nn.ModuleList(Round(config.width, config.impacts > 0) for _ in range(config.rounds))

    def forward(
        self,
        graph: ContactGraph,
        *,
        friction: bool = True,
        mirrored: bool = False,
        trust: float = 1.0,
    ) -> Velocities:
        """Velocities after the contacts have acted; `mirrored` as for `edge_frames`. With a `trust` of 0 the network
        adds nothing to the solve."""
        alone = bool(self.config.alone)
        graph = without_solve(graph) if alone else graph
        frames = edge_frames(graph, mirrored=mirrored)
        edge = self.encode(frames.start)
        if self.config.impacts:
            frames = with_moments(graph, frames)
        body = edge.new_zeros(len(graph.inverse_mass), self.config.width)
        end = torch.cat([graph.solved_velocity, graph.solved_angular], -1)
        mean = torch.cat([graph.mean_velocity, graph.mean_angular], -1)
        start = twist = torch.stack([end, mean], -1)
        axes = (6 if self.config.impacts else 3) if friction else 1
        added = edge.new_zeros(len(edge), axes, 2)
        for number, layer in enumerate(cast("Iterable[Round]", self.rounds), start=1):
            seen = relative(graph, frames, twist) / frames.speed[..., None]
            if self.config.impacts:
                seen = torch.cat([seen[:, :3], seen[:, 3:] * _arm(graph)[:, None, None]], 1)
            seen = seen.mT.flatten(1)
            hidden = layer.read(body, edge, graph.first, graph.second, seen)
            weight = _share_of_pair(layer.attention(hidden)[:, 0], graph)[:, None]
            change = layer.impulse(hidden, friction) * weight[..., None]
            added = added + change * (frames.speed * frames.mass[:, : added.shape[1]])[..., None]
            twist = pushed(graph, frames, added, start)
            if number < len(self.rounds):  # the last round's latents are not read
                edge, body = layer.update(edge, body, hidden, weight, graph)
        if self.config.impacts:
            twist = pushed(graph, frames, struck(graph, frames, added, start, trust), start)
        elif not alone:
            twist = pushed(graph, frames, bounded(graph, frames, added, start, trust), start)
        end, mean = twist.unbind(-1)
        return Velocities(end[:, :3], end[:, 3:], mean[:, :3], mean[:, 3:])


def without_solve(graph: ContactGraph) -> ContactGraph:
    """The graph with free flight in place of the solve's result."""
    return replace(
        graph,
        solved_velocity=graph.free_velocity,
        solved_angular=graph.free_angular,
        mean_velocity=0.5 * (graph.velocity + graph.free_velocity),
        mean_angular=0.5 * (graph.angular + graph.free_angular),
        impulse=torch.zeros_like(graph.impulse),
    )


def relative(graph: ContactGraph, frames: EdgeFrames, twist: Tensor) -> Tensor:
    """[E, 3, K] relative velocities at the contact points along the edges' axes, for twists [N, 6, K]."""
    return frames.jacobian_first @ twist[graph.first] - frames.jacobian_second @ twist[graph.second]


def pushed(graph: ContactGraph, frames: EdgeFrames, impulse: Tensor, twist: Tensor) -> Tensor:
    """Twists [N, 6, K] after impulses [E, axis, K] on the first bodies; the second get the opposite."""
    axes = impulse.shape[1]
    twist = twist.index_add(0, graph.first, frames.response_first[..., :axes] @ impulse)
    return twist.index_add(0, graph.second, frames.response_second[..., :axes] @ impulse)


def bounded(graph: ContactGraph, frames: EdgeFrames, added: Tensor, start: Tensor, trust: float) -> Tensor:
    """Bound what the network adds to the solve: impulses [E, axis, 2], at the end of the step and those that move
    bodies in it. `start` are twists [N, 6, 2] from the solve, `trust` is 0 to 1.

    - Only where surfaces moved against each other before the step, see `CALM`.

    - Solve and network together never pull, keep to the friction cone, and push at most twice as hard as the solve, or
    as hard as restitution allows to separate surfaces that would overlap at the end of the step.

    - No more kinetic energy than the solve took, island by island.
    """
    lively = ((frames.slip.norm(dim=-1) - CALM) / (LIVELY - CALM)).clamp(0.0, 1.0) * trust
    added = added * lively[:, None, None]
    seen = relative(graph, frames, start)
    push, drag = frames.solved[:, 0], frames.solved[:, 1:]
    left = graph.gap + seen[:, 0, 1] * (1.0 - graph.when) * graph.dt
    parting = (-left / graph.dt).clamp_min(0.0) + (1.0 + graph.restitution) * (-seen[:, 0, 0]).clamp_min(0.0)
    most = 2.0 * push + frames.mass[:, 0] * torch.where(left < 0.0, parting, torch.zeros_like(parting))
    normal = torch.minimum((push + added[:, 0, 0]).clamp_min(0.0), most)
    ends = [(normal - push)[:, None]]
    if added.shape[1] == 3:
        # If the solve bounds its two axes of friction separately, as PyBullet does, both together may exceed the cone.
        grip = torch.where(push > 0.0, drag.norm(dim=-1) / push.clamp_min(1e-12), 0.0)
        hold = torch.maximum(graph.friction, grip) * normal
        total = drag + added[:, 1:, 0]
        ends.append(_shortened(total, hold) - drag)
    end = torch.cat(ends, 1)
    end = end * _energy_share(graph, frames, end, seen[..., 0], start)[:, None]
    return torch.stack([end, _shortened(added[..., 1], most)], -1)


def with_moments(graph: ContactGraph, frames: EdgeFrames) -> EdgeFrames:
    """Frames with three more axes: moments about the edges' axes on the first bodies, opposite on the second. Their
    effective mass converts a change of angular velocity to that of the speed at the end of the lever."""
    axes = frames.jacobian_first[..., :3]
    axes = axes * torch.linalg.det(axes)[:, None, None]  # a mirror image turns the other way
    none = torch.zeros_like(axes)
    about = torch.cat([none, axes], -1)
    turn_first, turn_second = (
        torch.cat([none, axes @ graph.inverse_inertia[body].mT], -1).mT for body in (graph.first, graph.second)
    )
    turning = LEVER * _arm(graph) * frames.mass[:, 0]
    known = turning * (frames.mass[:, 1] > 0)
    return replace(
        frames,
        mass=torch.cat([frames.mass, torch.stack([turning, known, known], -1)], -1),
        jacobian_first=torch.cat([frames.jacobian_first, about], 1),
        jacobian_second=torch.cat([frames.jacobian_second, about], 1),
        response_first=torch.cat([frames.response_first, turn_first], -1),
        response_second=torch.cat([frames.response_second, -turn_second], -1),
    )


def _arm(graph: ContactGraph) -> Tensor:
    """[E] distance of a contact from the centre of mass of the dynamic body, or of the nearer one."""
    far = torch.full_like(graph.gap, torch.inf)
    ways = [
        torch.where(graph.inverse_mass[body] > 0, arm.norm(dim=-1), far)
        for body, arm in ((graph.first, graph.arm_first), (graph.second, graph.arm_second))
    ]
    return torch.minimum(*ways)


def struck(graph: ContactGraph, frames: EdgeFrames, added: Tensor, start: Tensor, trust: float) -> Tensor:
    """Bound what the network adds to the solve where surfaces strike each other: impulses and moments [E, axis, 2].
    `start` are twists [N, 6, 2] from the solve, `trust` is 0 to 1.

    - Only between bodies that approach each other at one of their edges, see `CALM`.

    - Solve and network together rebound with a restitution of 0 to 1, keep to the friction cone, and turn bodies at
    most as a push does that acts beside the contact, by `LEVER` of the arm.

    - No more kinetic energy than the solve took, island by island.
    """
    push, drag = frames.solved[:, 0], frames.solved[:, 1:3]
    lively = ((-frames.slip[:, 0] - CALM) / (LIVELY - CALM)).clamp(0.0, 1.0) * trust
    lively = lively.new_zeros(graph.pairs).scatter_reduce(0, graph.pair, lively, "amax")[graph.pair]
    wanted = added[..., 0] * lively[:, None]
    least = push / (1.0 + graph.restitution)
    normal = torch.maximum(torch.minimum(push + wanted[:, 0], 2.0 * least), least)
    ends = [(normal - push)[:, None]]
    if wanted.shape[1] > 1:
        grip = torch.where(push > 0.0, drag.norm(dim=-1) / push.clamp_min(1e-12), 0.0)
        hold = torch.maximum(graph.friction, grip) * normal
        ends += [
            _shortened(drag + wanted[:, 1:3], hold) - drag,
            _shortened(wanted[:, 3:], LEVER * _arm(graph) * normal),
        ]
    end = torch.cat(ends, 1)
    end = end * _energy_share(graph, frames, end, relative(graph, frames, start)[..., 0], start)[:, None]
    return torch.stack([end, end * (1.0 - graph.when)[:, None]], -1)


def _shortened(vector: Tensor, most: Tensor) -> Tensor:
    """[E, K] vectors, shortened to at most `most` [E]."""
    length = vector.square().sum(-1).clamp_min(1e-24).sqrt()
    return vector * (most / length).clamp_max(1.0)[:, None]


def _energy_share(graph: ContactGraph, frames: EdgeFrames, end: Tensor, seen: Tensor, start: Tensor) -> Tensor:
    """[E] the share of impulses `end` [E, axis] that adds no more energy to an island than the solve took from it. The
    work of an impulse is its product with the mean of the relative velocities before and after."""
    with torch.no_grad():
        free = torch.cat([graph.free_velocity, graph.free_angular], -1)
        taken = kinetic(graph, free) - kinetic(graph, start[..., 0])
        nothing = torch.zeros_like(start[..., :1])
        change = relative(graph, frames, pushed(graph, frames, end[..., None], nothing))[..., 0]
        axes, label = end.shape[1], islands(graph)
        of_edge = torch.where(graph.inverse_mass[graph.first] > 0, label[graph.first], label[graph.second])

        def total(values: Tensor, index: Tensor) -> Tensor:
            zero = torch.zeros(len(label), dtype=values.dtype, device=values.device)
            return zero.index_add_(0, index, values)

        least = total(taken, label).clamp_min(0.0)
        linear = total((end * seen[:, :axes]).sum(-1), of_edge)
        square = total(0.5 * (end * change[:, :axes]).sum(-1), of_edge)
        root = (linear.square() + 4.0 * square * least).clamp_min(0.0).sqrt()
        share = torch.where(linear + square <= least, 1.0, (root - linear) / (2.0 * square).clamp_min(1e-30))
        return share.clamp(0.0, 1.0)[of_edge]


def kinetic(graph: ContactGraph, twist: Tensor) -> Tensor:
    """[N] kinetic energy of the dynamic bodies, for twists [N, 6]."""
    moves = graph.inverse_mass > 0
    turns = (graph.inverse_inertia.diagonal(dim1=-2, dim2=-1) > 0).all(-1)
    unit = torch.eye(3, dtype=twist.dtype, device=twist.device)
    inertia = torch.linalg.inv(torch.where(turns[:, None, None], graph.inverse_inertia, unit))
    turning = (twist[:, 3:] * (inertia @ twist[:, 3:, None])[..., 0]).sum(-1) * turns
    mass = torch.where(moves, 1.0 / graph.inverse_mass.clamp_min(1e-12), 0.0)
    return 0.5 * (mass * twist[:, :3].square().sum(-1) + turning * moves)


def islands(graph: ContactGraph) -> Tensor:
    """[N] the lowest number among the dynamic bodies that edges join to this one."""
    moves = graph.inverse_mass > 0
    label = torch.arange(len(moves), device=moves.device)
    one = torch.where(moves[graph.first], graph.first, graph.second)
    other = torch.where(moves[graph.second], graph.second, graph.first)
    while True:
        least = torch.minimum(label[one], label[other])
        lower = label.scatter_reduce(0, one, least, "amin").scatter_reduce(0, other, least, "amin")
        lower = lower[lower]
        if torch.equal(lower, label):
            return label
        label = lower


def _share_of_pair(logit: Tensor, graph: ContactGraph) -> Tensor:
    """[E] softmax over the edges of each pair, so that more nodes do not mean more push."""
    top = torch.full((graph.pairs,), -torch.inf, dtype=logit.dtype, device=logit.device)
    top = top.scatter_reduce(0, graph.pair, logit.detach(), "amax")
    raised = (logit - top[graph.pair]).exp()
    total = torch.zeros(graph.pairs, dtype=logit.dtype, device=logit.device).index_add(0, graph.pair, raised)
    return raised / total[graph.pair]
