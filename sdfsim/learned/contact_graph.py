"""The contact graph of the *impulse* network: bodies joined by contact edges, each of which has its own frame.

Everything a network sees is a scalar in an edge's frame, made dimensionless by a speed and the time step, so that
the prediction turns with the scene and does not depend on the choice of units.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

REST_SPEED = 0.2  # model units: the speed that gravity adds in one training step; slower counts as resting
EDGE_FEATURES = 27
NEVER = 2.0  # steps: the time of touch that is told of surfaces that would not touch within this
# The tensors of a graph with one row per edge, except its ends, and those with one row per body.
OF_EDGES = ("normal", "arm_first", "arm_second", "gap", "when", "friction", "restitution")
OF_BODIES = (
    "inverse_mass", "inverse_inertia", "velocity", "angular", "free_velocity", "free_angular", "mean_velocity",
    "mean_angular",
)  # fmt: skip


@dataclass(frozen=True)
class ContactGraph:
    """N bodies and E points at which two of them are near each other at the start of a step, or come near in it."""

    inverse_mass: Tensor  # [N], 0 for bodies that are not dynamic
    inverse_inertia: Tensor  # [N, 3, 3], world axes, 0 for bodies that are not dynamic
    # velocity, angular: [N, 3] at the start of the step
    velocity: Tensor
    angular: Tensor
    # free_velocity, free_angular: [N, 3] at its end in free flight
    free_velocity: Tensor
    free_angular: Tensor
    # mean_velocity, mean_angular: [N, 3] mean over the step in free flight
    mean_velocity: Tensor
    mean_angular: Tensor
    # first, second: [E] int64
    first: Tensor
    second: Tensor
    pair: Tensor  # [E] int64, number of the unordered pair of bodies, 0 ... pairs - 1.
    pairs: int  # number of pairs
    normal: Tensor  # [E, 3], from `second` to `first`
    # arm_first, arm_second: [E, 3] from the centres of mass
    arm_first: Tensor
    arm_second: Tensor
    gap: Tensor  # [E] signed distance at the instant at which the edge was found
    when: Tensor  # [E] the part of the step that had passed by then
    # friction, restitution: [E] products of the two bodies' coefficients
    friction: Tensor
    restitution: Tensor
    dt: float  # the step


@dataclass(frozen=True)
class EdgeFrames:
    """Data of every edge that the rounds of message passing need, computed once a step. A body's twist is its velocity
    and angular velocity, stacked. Rows and columns of three are the edge's axes: normal, tangent, binormal."""

    speed: Tensor  # [E, 1], the scale that makes velocities dimensionless
    mass: Tensor  # [E, 3] effective mass along each axis; 0 along axes on which no impulse may act
    # jacobian_first, jacobian_second: [E, 3, 6] J, from a twist to the velocity of the contact point along each axis
    jacobian_first: Tensor
    jacobian_second: Tensor
    # response_first, response_second: [E, 6, 3] M^-1 J^T, change of twist by a unit impulse along each axis; for the
    # second body, by the opposite
    response_first: Tensor
    response_second: Tensor
    # [E, 3, 4] relative velocities along each axis: at the start of the step, what gravity and free spin add over the
    # step, what the turn of the arms adds, and the one that closes the gap within the step, bounded by `speed`
    told: Tensor
    start: Tensor  # [E, EDGE_FEATURES] input features


def number_pairs(first: Tensor, second: Tensor, bodies: int) -> tuple[Tensor, int]:
    """Number the unordered pairs {first, second} of [E] edges consecutively. Returns the numbers [E] and the number of
    pairs."""
    key = torch.minimum(first, second) * bodies + torch.maximum(first, second)
    unique, pair = torch.unique(key, return_inverse=True)
    return pair, len(unique)


def edge_frames(graph: ContactGraph, *, mirrored: bool = False) -> EdgeFrames:
    """Frames, effective masses and input features of all edges; `mirrored` frames are left-handed, as the mirror image
    of the scene would show them (augmentation)."""
    g = graph
    slip = relative_velocity(g, g.velocity, g.angular)
    lift = relative_velocity(g, g.free_velocity, g.free_angular) - slip  # the change by gravity and free spin
    axes, tangential = _axes(g, slip, lift)
    if mirrored:
        axes = axes * axes.new_tensor([1.0, 1.0, -1.0])[:, None]
    speed = _speed_scale(g, slip)

    moment_first, turn_first, twist_first = _response(g.inverse_inertia[g.first], g.arm_first, axes)
    moment_second, turn_second, twist_second = _response(g.inverse_inertia[g.second], g.arm_second, axes)
    push_first, push_second = g.inverse_mass[g.first, None], g.inverse_mass[g.second, None]
    # Inverse effective mass matrix in the frame: how an impulse along one axis changes the velocity along another.
    compliance = twist_first + twist_second
    direct = compliance.diagonal(dim1=-2, dim2=-1) + push_first + push_second
    mass = 1.0 / direct.clamp_min(1e-12)
    root = mass.sqrt()
    coupling = torch.stack(
        [compliance[:, a, b] * root[:, a] * root[:, b] for a, b in ((0, 1), (0, 2), (1, 2))],
        -1,
    )
    share = torch.cat(
        [push_first * mass[:, :1], push_second * mass[:, :1], twist_first[:, 0, 0, None] * mass[:, :1]], -1
    )
    count = torch.zeros(g.pairs, dtype=g.gap.dtype, device=g.gap.device).index_add_(0, g.pair, torch.ones_like(g.gap))
    in_frame = axes @ torch.stack([slip, lift, _centripetal(g)], -1)  # [E, axis, quantity]
    scaled = (in_frame / speed[..., None]).flatten(1)
    gap = g.gap[:, None] / (speed * g.dt)
    closing = torch.nn.functional.pad(speed * torch.tanh(gap), (0, 2))[..., None]
    fixed = torch.stack([(push_first == 0)[:, 0], (push_second == 0)[:, 0]], -1).to(gap.dtype)
    start = torch.cat(
        [
            torch.asinh(gap),
            g.gap[:, None] * 10.0,
            scaled,
            torch.log(speed / REST_SPEED),
            torch.log(mass[:, 1:] / mass[:, :1]),
            coupling,
            share,
            g.friction[:, None],
            g.restitution[:, None],
            torch.log(count[g.pair])[:, None] * 0.5,
            fixed,
            g.when[:, None],
            _touch(g.gap, in_frame[:, 0], g.dt)[:, None],
        ],
        -1,
    )
    return EdgeFrames(
        speed=speed,
        mass=torch.cat([mass[:, :1], mass[:, 1:] * tangential], -1),
        jacobian_first=torch.cat([axes, moment_first], -1),
        jacobian_second=torch.cat([axes, moment_second], -1),
        response_first=torch.cat([axes * push_first[..., None], turn_first], -1).mT,
        response_second=torch.cat([axes * push_second[..., None], turn_second], -1).mT.neg(),
        told=torch.cat([in_frame, closing], -1),
        start=start,
    )


def relative_velocity(graph: ContactGraph, velocity: Tensor, angular: Tensor) -> Tensor:
    """[E, 3] velocity of `first`'s surface relative to `second`'s at the contact point, for body velocities [N, 3]."""
    g = graph
    one = velocity[g.first] + torch.linalg.cross(angular[g.first], g.arm_first)
    two = velocity[g.second] + torch.linalg.cross(angular[g.second], g.arm_second)
    return one - two


def _axes(g: ContactGraph, slip: Tensor, lift: Tensor) -> tuple[Tensor, Tensor]:
    """[E, 3, 3] frames: normal, tangent, binormal; and [E, 1] whether the tangent has a meaning.

    The tangent is along the sliding velocity. If that is zero, it is along the tangential part of the velocity that
    gravity adds; else along the motion of the contact point when it is pushed along the normal; else along the motion
    at the two bodies' other contacts. All of these rotate with the scene. If none exists, the direction of a tangential
    impulse is not determined.
    """
    n = g.normal

    def tangential(v: Tensor) -> Tensor:
        return v - (v * n).sum(-1, keepdim=True) * n

    def pushed(body: Tensor, arm: Tensor) -> Tensor:
        turn = (g.inverse_inertia[body] @ torch.linalg.cross(arm, n)[..., None])[..., 0]
        return torch.linalg.cross(turn, arm)

    moves = (g.inverse_mass > 0)[:, None]
    around = torch.zeros_like(g.velocity).index_add_(0, g.first, slip).index_add_(0, g.second, slip) * moves
    lightest = torch.maximum(g.inverse_mass[g.first], g.inverse_mass[g.second])[:, None].clamp_min(1e-12)
    given = (pushed(g.first, g.arm_first) + pushed(g.second, g.arm_second)) / lightest
    ways = ((slip, 1e-4), (lift, 1e-5), (given, 1e-3), (around[g.first] + around[g.second], 1e-4))
    axis = torch.zeros_like(n).scatter_(1, n.abs().argmin(1, keepdim=True), 1.0)
    tangent, known = tangential(axis), torch.zeros_like(n[:, :1], dtype=torch.bool)
    for way, least in reversed(ways):
        along = tangential(way)
        there = along.norm(dim=-1, keepdim=True) > least
        tangent, known = torch.where(there, along, tangent), known | there
    tangent = tangent / tangent.norm(dim=-1, keepdim=True)
    return torch.stack([n, tangent, torch.linalg.cross(n, tangent)], 1), known.to(n.dtype)


def _speed_scale(g: ContactGraph, slip: Tensor) -> Tensor:
    """[E, 1]: the fastest relative motion among the edges of the two bodies, at least `REST_SPEED`."""
    own = (slip.square().sum(-1) + REST_SPEED**2).sqrt()
    body = torch.full_like(g.inverse_mass, REST_SPEED)
    body = body.scatter_reduce(0, g.first, own, "amax").scatter_reduce(0, g.second, own, "amax")
    body = torch.where(g.inverse_mass > 0, body, torch.full_like(body, REST_SPEED))
    return torch.maximum(body[g.first], body[g.second])[:, None]


def _response(inverse_inertia: Tensor, arm: Tensor, axes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """[E, 3, 3] each, of unit impulses along the axes: their moments, the angular velocities they give, and the
    velocities these give the contact point along the axes."""
    moment = torch.linalg.cross(arm[:, None].expand_as(axes), axes)
    turn = moment @ inverse_inertia.mT
    return moment, turn, turn @ moment.mT


def _centripetal(g: ContactGraph) -> Tensor:
    """[E, 3] relative velocity that the rotation of the arms adds over the step."""

    def part(body: Tensor, arm: Tensor) -> Tensor:
        w = g.angular[body]
        return torch.linalg.cross(w, torch.linalg.cross(w, arm)) * g.dt

    return part(g.first, g.arm_first) - part(g.second, g.arm_second)


def _touch(gap: Tensor, along: Tensor, dt: float) -> Tensor:
    """[E] when surfaces would touch in free motion, in steps from then, at most `NEVER`; 0 if they do already.
    `along` [E, quantity] are relative velocities along the normal, as in `EdgeFrames.told`."""
    speed, pull = along[:, 0], along[:, 1:].sum(-1)
    away = gap / dt
    # away + speed t + pull t^2 / 2 = 0, t in steps, in the form that is exact for small pulls
    root = (speed.square() - 2.0 * pull * away).clamp_min(0.0).sqrt()
    when = 2.0 * away / (root - speed).clamp_min(1e-9)
    meets = (speed.square() >= 2.0 * pull * away) & (root > speed)
    return torch.where(gap <= 0.0, 0.0, torch.where(meets, when, NEVER).clamp(0.0, NEVER))
