"""Contact edges: which surface nodes are within reach of which other body's surface (paper, section 3)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.broad import expand, near_pairs, turning
from sdfsim.dynamics.graph import number_pairs
from sdfsim.dynamics.memory import Memory, Waits

DEPTH_PULL = 5.0  # how much farther out (in lengths) a node must be to be kept for each length it is higher
_GOLDEN = (1.0 + 5.0**0.5) / 2.0
_ICOSAHEDRON = [
    [axis[(k - i) % 3] / (1.0 + _GOLDEN**2) ** 0.5 for k in range(3)]
    for i in range(3)
    for axis in ((0.0, a, b * _GOLDEN) for a in (-1.0, 1.0) for b in (-1.0, 1.0))
]

ARRAYS = ("owner", "node", "body", "arm", "distance", "normal", "ahead")


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
        waiting: how many were not, because an earlier answer says that there can be no edge yet.
    """

    owner: Tensor
    node: Tensor
    body: Tensor
    arm: Tensor
    distance: Tensor
    normal: Tensor
    ahead: Tensor
    queries: int = 0
    waiting: int = 0

    def __len__(self) -> int:
        return len(self.owner)


def find_contacts(
    bodies: Bodies,
    state: State,
    gravity: Tensor,
    reach: float,
    dt: float,
    memory: Memory | None = None,
    rows: int | None = None,
) -> Contacts:
    """All contact edges of a state.

    An edge exists where d + min(0, closing velocity * dt) <= reach: a fixed threshold would let a fast body bounce
    inside one step without ever having had an edge.

    Args:
        bodies: N bodies.
        state: their state.
        gravity: [3], model units.
        reach: contact radius D, model length.
        dt: the step, model time.
        memory: of the run; it saves work and counts it.
        rows: look at no more than that many nodes at once (but at all of a body's), None for all.
    """
    memory = memory or Memory()
    with memory.timed("pairs_ms"):
        going, still = memory.surroundings(bodies, state, gravity, reach, dt)
        first, second = near_pairs(bodies, state, gravity, reach, dt, going, still)
    if not len(first):
        memory.waits.turn()
        return no_contacts(bodies)
    with memory.timed("distances_ms"):
        approach = _approach(bodies, state, gravity, first, second, dt)
        cuts = _cuts(bodies, first, rows)
        pairs = zip(first.split(cuts), second.split(cuts), approach.split(cuts), strict=True)
        parts = [_edges(bodies, state, gravity, reach, dt, *part, memory.waits) for part in pairs]
        memory.waits.turn()
        found = _joined(parts)
    near = number_pairs(first, second, len(bodies))[1]
    memory.count(pairs=near, sdf_queries=found.queries, sdf_waiting=found.waiting)
    return found


def _edges(
    bodies: Bodies,
    state: State,
    gravity: Tensor,
    reach: float,
    dt: float,
    first: Tensor,
    second: Tensor,
    approach: Tensor,
    waits: Waits,
) -> Contacts:
    """The edges from nodes of bodies `first` to bodies `second` [P], which approach by at most `approach` [P]."""
    pair, node = expand(bodies.node_start[first], bodies.node_start[first + 1])
    owner, other, approach = first[pair], second[pair], approach[pair]
    arm = pose.rotate(state.orientation[owner], bodies.node[node])
    # Differences are taken in float64 before anything is cast, so that a far origin costs no precision.
    offset = state.position[owner] - state.position[other] + arm
    local = pose.rotate(pose.conjugate(state.orientation[other]), offset)
    box = bodies.bounds[other]
    margin = (reach + approach)[:, None]
    near = ((local >= box[:, 0] - margin) & (local <= box[:, 1] + margin)).all(-1).nonzero()[:, 0]
    owner, other, node, local, approach = owner[near], other[near], node[near], local[near], approach[near]

    key = (owner * len(bodies) + other) * len(bodies.node) + node
    trust = bodies.bank.trust[bodies.shape[other]]
    wait, place, known = waits.may_wait(key, local, trust, reach + approach)
    asked = (~wait).nonzero()[:, 0]
    distance, gradient = _distances(bodies, other[asked], local[asked])
    place, known = place.index_copy(0, asked, local[asked]), known.index_copy(0, asked, distance)
    waits.note(key, place, known, trust * known > reach)

    owner, other, node, local = owner[asked], other[asked], node[asked], local[asked]
    arm, offset = arm[near[asked]], offset[near[asked]]
    normal = pose.rotate(state.orientation[other], _unit(gradient, local))
    velocity = node_velocity(state, owner, arm) + gravity * dt * bodies.moves[owner, None]
    arm_other = offset - distance[:, None] * normal
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
        queries=len(asked),
        waiting=len(wait) - len(asked),
    )


def _distances(bodies: Bodies, other: Tensor, local: Tensor) -> tuple[Tensor, Tensor]:
    """Distance [Q] and gradient [Q, 3] of bodies `other` [Q] at `local` [Q, 3] about their centres of mass."""
    if not len(other):
        return local[:, 0], local
    scale = bodies.scale[other]
    distance, gradient = bodies.bank(bodies.shape[other], (local + bodies.com[other]) / scale[:, None])
    return distance * scale, gradient


def no_contacts(bodies: Bodies) -> Contacts:
    """None at all."""
    index = torch.zeros(0, dtype=torch.int64, device=bodies.device)
    number = torch.zeros(0, dtype=torch.float64, device=bodies.device)
    return Contacts(index, index, index, number[:, None].expand(0, 3), number, number[:, None].expand(0, 3), number)


def _cuts(bodies: Bodies, first: Tensor, rows: int | None) -> list[int]:
    """How many pairs to look at together: their owners have at most `rows` nodes, or it is one pair."""
    if rows is None:
        return [len(first)]
    sizes, total = [0], 0
    for nodes in (bodies.node_start[first + 1] - bodies.node_start[first]).tolist():
        if sizes[-1] and total + nodes > rows:
            sizes.append(0)
            total = 0
        sizes[-1] += 1
        total += nodes
    return sizes


def _joined(parts: list[Contacts]) -> Contacts:
    if len(parts) == 1:
        return parts[0]
    arrays = {k: torch.cat([getattr(part, k) for part in parts]) for k in ARRAYS}
    return Contacts(**arrays, queries=sum(p.queries for p in parts), waiting=sum(p.waiting for p in parts))


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
    arrays = {k: getattr(contacts, k)[kept] for k in ARRAYS}
    return replace(contacts, **arrays)


def node_velocity(state: State, body: Tensor, arm: Tensor) -> Tensor:
    """Velocity [E, 3] of material points of `body` [E] at `arm` [E, 3] from its centre of mass."""
    return state.velocity[body] + torch.linalg.cross(state.angular_velocity[body], arm)


def _approach(bodies: Bodies, state: State, gravity: Tensor, owner: Tensor, other: Tensor, dt: float) -> Tensor:
    """Upper bound [P] on how far a node of `owner` and the surface of `other` approach in one step."""
    relative = (state.velocity[owner] - state.velocity[other]).norm(dim=-1)
    turn = turning(bodies, state, owner) + turning(bodies, state, other)
    return (relative + turn) * dt + gravity.norm() * dt * dt


def _unit(gradient: Tensor, fallback: Tensor) -> Tensor:
    """Gradients as unit normals; where one vanishes, the direction from the body's centre, else straight up."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=gradient.dtype, device=gradient.device).expand_as(gradient)
    length = gradient.norm(dim=-1, keepdim=True)
    away = fallback.norm(dim=-1, keepdim=True)
    safe = torch.where(away > 1e-9, fallback / away.clamp_min(1e-30), up)
    return torch.where(length > 1e-6, gradient / length.clamp_min(1e-30), safe)
