"""Contact edges: which surface nodes are within reach of which other body's surface (paper, section 3)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Bodies, State

DEPTH_PULL = 5.0  # how much farther out (in lengths) a node must be to be kept for each length it is higher
_GOLDEN = (1.0 + 5.0**0.5) / 2.0
_ICOSAHEDRON = [
    [axis[(k - i) % 3] / (1.0 + _GOLDEN**2) ** 0.5 for k in range(3)]
    for i in range(3)
    for axis in ((0.0, a, b * _GOLDEN) for a in (-1.0, 1.0) for b in (-1.0, 1.0))
]


@dataclass(frozen=True)
class Contacts:
    """E contact edges, each from a surface node to the closest point on another body; model units, world frame.

    Attributes:
        owner: [E] int64, the body whose node it is.
        node: [E] int64, index into `Bodies.node`.
        body: [E] int64, the body it meets.
        arm: [E, 3] float64, from the owner's centre of mass to the node.
        distance: [E] float64, signed distance of the node from `body`.
        normal: [E, 3] float64, unit outward normal of `body` at the closest point.
        ahead: [E] float64, the distance there will be after the step if the node keeps closing in.
        queries: how many signed distances were evaluated to find them.
    """

    owner: Tensor
    node: Tensor
    body: Tensor
    arm: Tensor
    distance: Tensor
    normal: Tensor
    ahead: Tensor
    queries: int = 0

    def __len__(self) -> int:
        return len(self.owner)


def find_contacts(bodies: Bodies, state: State, gravity: Tensor, reach: float, dt: float) -> Contacts:
    """All contact edges of a state.

    An edge exists where d + min(0, closing velocity * dt) <= reach: a fixed threshold would let a fast body bounce
    inside one step without ever having had an edge.

    Args:
        bodies: N bodies.
        state: their state.
        gravity: [3], model units.
        reach: contact radius D, model length.
        dt: the step, model time.
    """
    first, second = _near_pairs(bodies, state, gravity, reach, dt)
    pair, node = _expand(bodies.node_start[first], bodies.node_start[first + 1])
    owner, other = first[pair], second[pair]
    arm = pose.rotate(state.orientation[owner], bodies.node[node])
    # Differences are taken in float64 before anything is cast, so that a far origin costs no precision.
    offset = state.position[owner] - state.position[other] + arm
    local = pose.rotate(pose.conjugate(state.orientation[other]), offset)
    approach = _approach(bodies, state, gravity, owner, other, dt)
    box = bodies.bounds[other]
    margin = (reach + approach)[:, None]
    near = ((local >= box[:, 0] - margin) & (local <= box[:, 1] + margin)).all(-1)
    owner, other, node, arm, local = owner[near], other[near], node[near], arm[near], local[near]

    scale = bodies.scale[other]
    query = (local + bodies.com[other]) / scale[:, None]
    distance, gradient = bodies.bank(bodies.shape[other], query)
    distance = distance * scale
    normal = pose.rotate(state.orientation[other], _unit(gradient, local))

    velocity = node_velocity(state, owner, arm) + gravity * dt * bodies.moves[owner, None]
    arm_other = offset[near] - distance[:, None] * normal
    velocity = velocity - node_velocity(state, other, arm_other) - gravity * dt * bodies.moves[other, None]
    closing = (velocity * normal).sum(-1).clamp_max(0.0)
    ahead = distance + closing * dt
    touching = ahead <= reach
    return Contacts(
        owner=owner[touching],
        node=node[touching],
        body=other[touching],
        arm=arm[touching],
        distance=distance[touching],
        normal=normal[touching],
        ahead=ahead[touching],
        queries=len(query),
    )


def thin_contacts(bodies: Bodies, contacts: Contacts) -> Contacts:
    """At most 13 edges for each owner and the body it meets: the deepest, and the outermost that are nearly as deep.

    A face at rest brings hundreds of nodes within reach, of which the corners decide what it can do. Outermost is
    measured along the twelve corners of an icosahedron fixed in the owner, so that the choice turns with the scene
    and stays the same from step to step.
    """
    if len(contacts) == 0:
        return contacts
    pair = torch.unique(contacts.owner * len(bodies) + contacts.body, return_inverse=True)[1]
    ways = torch.tensor(_ICOSAHEDRON, dtype=torch.float64, device=bodies.device)
    outward = bodies.node[contacts.node] @ ways.T
    score = torch.cat([outward - DEPTH_PULL * contacts.ahead[:, None], -contacts.ahead[:, None]], 1)
    pairs, edges = int(pair.max()) + 1, len(contacts)
    group = pair[:, None].expand_as(score)
    best = torch.full((pairs, score.shape[1]), -torch.inf, dtype=score.dtype, device=score.device)
    best = best.scatter_reduce(0, group, score, "amax")
    # Of equal scores the first counts, so that the result does not depend on the order of execution.
    number = torch.arange(edges, device=score.device)[:, None].expand_as(score)
    number = torch.where(score >= best[pair], number, edges)
    winner = torch.full((pairs, score.shape[1]), edges, device=score.device).scatter_reduce(0, group, number, "amin")
    kept = torch.unique(winner)
    arrays = {k: getattr(contacts, k)[kept] for k in ("owner", "node", "body", "arm", "distance", "normal", "ahead")}
    return replace(contacts, **arrays)


def node_velocity(state: State, body: Tensor, arm: Tensor) -> Tensor:
    """Velocity [E, 3] of material points of `body` [E] at `arm` [E, 3] from its centre of mass."""
    return state.velocity[body] + torch.linalg.cross(state.angular_velocity[body], arm)


def _near_pairs(bodies: Bodies, state: State, gravity: Tensor, reach: float, dt: float) -> tuple[Tensor, Tensor]:
    """Ordered pairs (owner of nodes, other) whose swept, grown boxes overlap: [P], [P]."""
    low, high = _world_boxes(bodies, state)
    sweep = (state.velocity * dt).abs() + (gravity * dt * dt).abs() * bodies.moves[:, None]
    # Turning moves a corner by at most |w| dt times its distance from the centre.
    radius = bodies.bounds.abs().amax(1).norm(dim=-1)
    turn = torch.where(bodies.moves, state.angular_velocity.norm(dim=-1) * dt * radius, torch.zeros_like(radius))
    grow = sweep + turn[:, None] + 0.5 * reach
    low, high = low - grow, high + grow
    overlap = (low[:, None] <= high[None]).all(-1) & (high[:, None] >= low[None]).all(-1)
    overlap &= bodies.moves[:, None] | bodies.moves[None]
    overlap &= (bodies.node_start[1:] > bodies.node_start[:-1])[:, None]
    overlap.fill_diagonal_(False)
    if bodies.may_touch is not None:
        overlap &= bodies.may_touch
    first, second = overlap.nonzero(as_tuple=True)
    return first, second


def _world_boxes(bodies: Bodies, state: State) -> tuple[Tensor, Tensor]:
    """Axis-aligned boxes [N, 3], [N, 3] of the turned bounds."""
    finite = bodies.bounds.isfinite().all(-1).all(-1)
    box = torch.where(finite[:, None, None], bodies.bounds, torch.zeros_like(bodies.bounds))
    centre = state.position + pose.rotate(state.orientation, box.mean(1))
    half = (pose.to_matrix(state.orientation).abs() @ (0.5 * (box[:, 1] - box[:, 0]))[..., None])[..., 0]
    half = torch.where(finite[:, None], half, torch.full_like(half, torch.inf))
    return centre - half, centre + half


def _approach(bodies: Bodies, state: State, gravity: Tensor, owner: Tensor, other: Tensor, dt: float) -> Tensor:
    """Upper bound [Q] on how far a node of `owner` and the surface of `other` approach in one step."""
    radius = bodies.bounds.abs().amax(1).norm(dim=-1)
    turn = torch.where(bodies.moves, state.angular_velocity.norm(dim=-1) * radius, torch.zeros_like(radius))
    relative = (state.velocity[owner] - state.velocity[other]).norm(dim=-1)
    return (relative + turn[owner] + turn[other]) * dt + gravity.norm() * dt * dt


def _expand(start: Tensor, stop: Tensor) -> tuple[Tensor, Tensor]:
    """For ranges start[k]:stop[k], the range index and the value of every element, in order."""
    count = stop - start
    which = torch.repeat_interleave(torch.arange(len(count), device=count.device), count)
    first = torch.repeat_interleave(count.cumsum(0) - count, count)
    return which, start[which] + torch.arange(len(which), device=count.device) - first


def _unit(gradient: Tensor, fallback: Tensor) -> Tensor:
    """Gradients as unit normals; where one vanishes, the direction from the body's centre, else straight up."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=gradient.dtype, device=gradient.device).expand_as(gradient)
    length = gradient.norm(dim=-1, keepdim=True)
    away = fallback.norm(dim=-1, keepdim=True)
    safe = torch.where(away > 1e-9, fallback / away.clamp_min(1e-30), up)
    return torch.where(length > 1e-6, gradient / length.clamp_min(1e-30), safe)
