"""Contact edges: which surface nodes are within reach of which other body's surface (paper, section 3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.broad import expand, near_pairs, turning
from sdfsim.dynamics.clusters import Layer
from sdfsim.dynamics.graph import number_pairs
from sdfsim.dynamics.memory import PIECE, Memory, Waits, least

FEW_PAIRS = 32  # of bodies near each other
DEPTH_PULL = 5.0  # how much farther out (in lengths) a node must be to be kept for each length it is higher
_GOLDEN = (1.0 + 5.0**0.5) / 2.0
_ICOSAHEDRON = [
    [axis[(k - i) % 3] / (1.0 + _GOLDEN**2) ** 0.5 for k in range(3)]
    for i in range(3)
    for axis in ((0.0, a, b * _GOLDEN) for a in (-1.0, 1.0) for b in (-1.0, 1.0))
]

ARRAYS = ("owner", "node", "body", "point", "arm", "foot", "distance", "normal", "ahead")


@dataclass(frozen=True)
class Contacts:
    """E contact edges, each from a surface node to the closest point on another body; model units, world frame.

    Attributes:
        owner: [E] int64, the body whose node it is.
        node: [E] int64, index into `Bodies.node`.
        body: [E] int64, the body it meets.
        point: [E, 3] float64, the node about the owner's centre of mass in its axes, or where its surface is nearest.
        arm: [E, 3] float64, from the owner's centre of mass to midway between the node and the closest point.
        foot: [E, 3] float64, to there from the centre of mass of `body`.
        distance: [E] float64, signed distance of the node from `body`.
        normal: [E, 3] float64, unit outward normal of `body` at the closest point.
        ahead: [E] float64, the distance there will be after the step if the node keeps closing in.
        queries: how many signed distances were evaluated to find them.
        waiting: how many were not, because an earlier answer says that there can be no edge yet.
    """

    owner: Tensor
    node: Tensor
    body: Tensor
    point: Tensor
    arm: Tensor
    foot: Tensor
    distance: Tensor
    normal: Tensor
    ahead: Tensor
    queries: int = 0
    waiting: int = 0

    def __len__(self) -> int:
        return len(self.owner)

    def only(self, rows: Tensor) -> Contacts:
        """The edges `rows` [K] of them."""
        return replace(self, **{name: getattr(self, name)[rows] for name in ARRAYS})


def find_contacts(
    bodies: Bodies,
    state: State,
    gravity: Tensor,
    reach: float,
    dt: float,
    memory: Memory | None = None,
    rows: int | None = None,
    *,
    thin: bool = False,
    rounded: bool = True,
) -> Contacts:
    """All contact edges of a state from its nodes; or few, from where round surfaces will be nearest when they meet.

    An edge exists where d + min(0, closing velocity * dt) <= reach: a fixed threshold would let a fast body bounce
    inside one step without ever having had an edge.

    Args:
        bodies: N bodies.
        state: their state.
        gravity: [3], model units.
        reach: contact radius D, model length.
        dt: the step, model time.
        memory: of the run; it saves work and counts it.
        rows: look at no more than that many nodes at once (but at all of a body's), None for `PIECE`.
        thin: `round_off`, `at_impact` and `thin_contacts`, piece by piece, so that all edges are never there at once.
        rounded: False leaves out the first of these.
    """
    from sdfsim.dynamics.impact import at_impact
    from sdfsim.dynamics.rounding import round_off

    memory = memory or Memory()
    with memory.timed("pairs_ms"):
        going, still = memory.surroundings(bodies, state, gravity, reach, dt)
        first, second = near_pairs(bodies, state, gravity, reach, dt, going, still)
    if not len(first):
        memory.turn()
        return no_contacts(bodies)
    with memory.timed("distances_ms"):
        approach = _approach(bodies, state, gravity, first, second, dt)
        cuts = _cuts(bodies, first, min(rows or PIECE, PIECE))
        parts = []
        for pairs in zip(first.split(cuts), second.split(cuts), approach.split(cuts), strict=True):
            few = len(first) <= FEW_PAIRS
            part = _edges(bodies, state, gravity, reach, dt, Pairs(bodies, state, *pairs), memory, few=few)
            if thin:
                part = round_off(bodies, state, part, reach, memory) if rounded else part
                part = thin_contacts(bodies, at_impact(bodies, state, gravity, dt, part))
            parts.append(part)
        memory.turn()
        found = _joined(parts)
    near = number_pairs(first, second, len(bodies))[1]
    memory.count(pairs=near, sdf_queries=found.queries, sdf_waiting=found.waiting)
    return found


class Pairs:
    """P pairs of bodies, and how the frame of the first lies in that of the second.

    Args:
        bodies: N bodies.
        state: theirs.
        first, second: [P] int64, owner of nodes and the body they may meet.
        approach: [P] how far they may approach in the step.
    """

    def __init__(self, bodies: Bodies, state: State, first: Tensor, second: Tensor, approach: Tensor) -> None:
        self.first, self.second, self.approach = first, second, approach
        back = pose.conjugate(state.orientation[second])
        self.turn = pose.to_matrix(pose.multiply(back, state.orientation[first]))
        # Differences are taken in float64 before anything is cast, so that a far origin costs no precision.
        self.shift = pose.rotate(back, state.position[first] - state.position[second])
        self.number = first * len(bodies) + second
        self.box = bodies.bounds[second]
        self.trust = bodies.bank.trust[bodies.shape[second]]


def _edges(
    bodies: Bodies, state: State, gravity: Tensor, reach: float, dt: float, pairs: Pairs, memory: Memory, *, few: bool
) -> Contacts:
    """The edges from nodes of the first bodies of `pairs` to the second: balls of nodes first, then what is near.

    Where there are `few` pairs in all, the balls around whole bodies are not worth a query of their own.
    """
    pair, parent = torch.arange(len(pairs.first), device=bodies.device), pairs.first
    queries = waiting = 0
    tree = memory.tree(bodies)
    for layer, waits in zip(tree, memory.waits, strict=True):
        if layer is tree[0] and few:
            row, parent = expand(layer.start[parent], layer.start[parent + 1])
            pair = pair[row]
            continue
        pair, item, local, distance, gradient, waited = _sift(bodies, layer, reach, pairs, pair, parent, waits)
        queries, waiting = queries + len(pair), waiting + waited
        if layer is not tree[-1]:
            trust, most = pairs.trust[pair], reach + pairs.approach[pair]
            close = (least(trust, distance, layer.radius[item]) <= most).nonzero()[:, 0]
            pair, parent = pair[close], item[close]
    owner, other, node = pairs.first[pair], pairs.second[pair], tree[-1].node[item]
    point = bodies.node[node]
    arm = pose.rotate(state.orientation[owner], point)
    offset = state.position[owner] - state.position[other] + arm
    normal = pose.rotate(state.orientation[other], unit(gradient, local))
    velocity = node_velocity(state, owner, arm) + gravity * dt * bodies.moves[owner, None]
    arm_other = offset - distance[:, None] * normal
    velocity = velocity - node_velocity(state, other, arm_other) - gravity * dt * bodies.moves[other, None]
    closing = (velocity * normal).sum(-1).clamp_max(0.0)
    ahead = distance + closing * dt
    touching = (ahead <= reach).nonzero()[:, 0]
    half = 0.5 * distance[:, None] * normal
    found = (owner, node, other, point, arm - half, offset - half, distance, normal, ahead)
    return Contacts(**dict(zip(ARRAYS, found, strict=True)), queries=queries, waiting=waiting).only(touching)


def _sift(
    bodies: Bodies, layer: Layer, reach: float, pairs: Pairs, pair: Tensor, parent: Tensor, waits: Waits
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, int]:
    """The balls of `layer` under `parent` [B] of `pair` [B] that are near, asked for their distances.

    Returns:
        For each of the Q asked its pair, its number in the layer, its place [Q, 3] in the other's frame, distance and
        gradient [Q, 3]; and how many were not asked, since they cannot be near yet.
    """
    row, item = expand(layer.start[parent], layer.start[parent + 1])
    pair = pair[row]
    local = (pairs.turn[pair] * layer.centre[item, None]).sum(-1) + pairs.shift[pair]
    radius, most = layer.radius[item], reach + pairs.approach[pair]
    margin, box = (most + radius)[:, None], pairs.box[pair]
    near = ((local >= box[:, 0] - margin) & (local <= box[:, 1] + margin)).all(-1).nonzero()[:, 0]
    pair, item, local, radius, most = pair[near], item[near], local[near], radius[near], most[near]

    key, trust = pairs.number[pair] * len(layer) + item, pairs.trust[pair]
    wait, place, known = waits.may_wait(key, local, radius, trust, most)
    asked = (~wait).nonzero()[:, 0]
    distance, gradient = distances(bodies, pairs.second[pair[asked]], local[asked])
    place, known = place.index_copy(0, asked, local[asked]), known.index_copy(0, asked, distance)
    waits.note(key, place, known, least(trust, known, radius) > reach)
    return pair[asked], item[asked], local[asked], distance, gradient, len(wait) - len(asked)


def distances(bodies: Bodies, other: Tensor, local: Tensor) -> tuple[Tensor, Tensor]:
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
    empty = number[:, None].expand(0, 3)
    return Contacts(index, index, index, empty, empty, empty, number, empty, number)


def _cuts(bodies: Bodies, first: Tensor, rows: int) -> list[int]:
    """How many pairs to look at together: their owners have at most `rows` nodes, or it is one pair."""
    nodes = bodies.node_start[first + 1] - bodies.node_start[first]
    # Pairs whose nodes end in the same stretch go together; what the first of them has before it is one body's at most.
    stretch = max(1, rows - int(nodes.max()))
    return torch.unique_consecutive(nodes.cumsum(0) // stretch, return_counts=True)[1].tolist()


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
    ways = _icosahedron(bodies.device)
    outward = contacts.point @ ways.T
    score = torch.cat([outward - DEPTH_PULL * contacts.ahead[:, None], -contacts.ahead[:, None]], 1)
    pairs, edges = int(pair.max()) + 1, len(contacts)
    group = pair[:, None].expand_as(score)
    best = torch.full((pairs, score.shape[1]), -torch.inf, dtype=score.dtype, device=score.device)
    best = best.scatter_reduce(0, group, score, "amax")
    # Of equal scores the first counts, so that the result does not depend on the order of execution.
    number = torch.arange(edges, device=score.device)[:, None].expand_as(score)
    number = torch.where(score >= best[pair], number, edges)
    winner = torch.full((pairs, score.shape[1]), edges, device=score.device).scatter_reduce(0, group, number, "amin")
    return contacts.only(torch.unique(winner))


@cache
def _icosahedron(device: torch.device) -> Tensor:
    """[12, 3] its corners."""
    return torch.tensor(_ICOSAHEDRON, dtype=torch.float64, device=device)


def node_velocity(state: State, body: Tensor, arm: Tensor) -> Tensor:
    """Velocity [E, 3] of material points of `body` [E] at `arm` [E, 3] from its centre of mass."""
    return state.velocity[body] + torch.linalg.cross(state.angular_velocity[body], arm)


def _approach(bodies: Bodies, state: State, gravity: Tensor, owner: Tensor, other: Tensor, dt: float) -> Tensor:
    """Upper bound [P] on how far a node of `owner` and the surface of `other` approach in one step."""
    relative = (state.velocity[owner] - state.velocity[other]).norm(dim=-1)
    turn = turning(bodies, state, owner) + turning(bodies, state, other)
    return (relative + turn) * dt + gravity.norm() * dt * dt


def unit(gradient: Tensor, fallback: Tensor) -> Tensor:
    """Gradients as unit normals; where one vanishes, the direction from the body's centre, else straight up."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=gradient.dtype, device=gradient.device).expand_as(gradient)
    length = gradient.norm(dim=-1, keepdim=True)
    away = fallback.norm(dim=-1, keepdim=True)
    safe = torch.where(away > 1e-9, fallback / away.clamp_min(1e-30), up)
    return torch.where(length > 1e-6, gradient / length.clamp_min(1e-30), safe)
