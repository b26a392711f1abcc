"""Bodies so deep inside each other that the nearest surface is the wrong way out.

A node leaves a solid where its surface is nearest. Of a body whose centre is inside another one that is, for the nodes
beyond that one's middle, the far side: such pairs would be drawn together. They part along one direction instead, the
way out for the centre, which an SDF's gradient tells everywhere, on the medial axis too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.contacts import Contacts, distances, find_contacts
from sdfsim.dynamics.graph import number_pairs
from sdfsim.dynamics.memory import Memory

# Part of its largest side by which bodies start inside one another in the training data at most.
DEEPEST = 0.16


def parting(bodies: Bodies, state: State, contacts: Contacts, memory: Memory) -> Contacts:
    """The edges, those of pairs that are swallowed with normals along which the two part.

    Swallowed is a pair of which one body's centre of mass is inside both solids (that of a ring on a peg is not inside
    the ring). Both bodies' edges then have the same direction, opposite ways: the normal of the other one where that
    centre is; of two centres that are inside, the one of the first body counts.
    """
    if not len(contacts):
        return contacts
    owner, body = contacts.owner, contacts.body
    # Only the centre of a body that moves counts, and no plane swallows any: it has one way out for all of a body.
    apart = (state.position[owner] - state.position[body]).norm(dim=-1)
    swallowed = bodies.moves[owner] & (apart < _reach(bodies, body))
    near = swallowed | (bodies.moves[body] & (apart < _reach(bodies, owner)))
    if not bool(near.any()):
        return contacts
    pair, pairs = number_pairs(owner, body, len(bodies))
    first = torch.zeros(pairs, dtype=torch.int64, device=bodies.device).index_copy_(0, pair, torch.minimum(owner, body))
    second = torch.zeros_like(first).index_copy_(0, pair, torch.maximum(owner, body))
    way = torch.zeros(pairs, 3, dtype=torch.float64, device=bodies.device)
    for one, other, sign in ((second, first, -1.0), (first, second, 1.0)):
        rows, out = _inside(bodies, state, one, other, memory)
        way = way.index_copy(0, rows, sign * out)
    towards = torch.where(owner == first[pair], 1.0, -1.0)[:, None] * way[pair]
    swallowed = (towards != 0).any(-1, keepdim=True)
    return replace(contacts, normal=torch.where(swallowed, towards, contacts.normal))


def deep_starts(bodies: Bodies, state: State, names: Sequence[str], metres: float, rows: int | None) -> list[str]:
    """A line where pairs are deeper inside one another than any that models were trained on; empty where none is.

    Args:
        bodies: N bodies.
        state: theirs.
        names: [N] of the bodies.
        metres: in a model unit.
        rows: how many nodes to look at at once, None for all.
    """
    nothing = torch.zeros(3, dtype=torch.float64, device=bodies.device)
    inside = find_contacts(bodies, state, nothing, reach=0.0, dt=0.0, rows=rows)
    if not len(inside):
        return []
    # Of the two the smaller one that moves is what the way out is long or short for.
    size = torch.where(bodies.moves, bodies.size, torch.inf)
    part = -inside.distance / torch.minimum(size[inside.owner], size[inside.body])
    deep = part > DEEPEST
    if not bool(deep.any()):
        return []
    pairs = number_pairs(inside.owner[deep], inside.body[deep], len(bodies))[1]
    worst = int(part.argmax())
    owner, body = (names[int(i[worst])] for i in (inside.owner, inside.body))
    return [
        f"pairs that start inside one another: {pairs} here, {owner!r} in {body!r} by "
        f"{-float(inside.distance[worst]) * metres:.3g} m, {float(part[worst]):.0%} of a body's size; "
        f"trained on up to {DEEPEST:.0%}"
    ]


def _inside(bodies: Bodies, state: State, one: Tensor, other: Tensor, memory: Memory) -> tuple[Tensor, Tensor]:
    """The rows of pairs [P] in which the centre of `one` is inside both solids, and unit ways [K, 3] out of `other`."""
    back = pose.conjugate(state.orientation[other])
    local = pose.rotate(back, state.position[one] - state.position[other])
    box = bodies.bounds[other]
    near = bodies.moves[one] & ((local > box[:, 0]) & (local < box[:, 1])).all(-1)
    near &= bodies.radius[other].isfinite()
    rows = near.nonzero()[:, 0]
    distance, gradient = distances(bodies, other[rows], local[rows])
    own, _ = distances(bodies, one[rows], torch.zeros_like(local[rows]))
    memory.count(sdf_queries=2 * len(rows))
    deep = (distance < 0) & (own < 0)
    rows, gradient = rows[deep], gradient[deep]
    out = pose.rotate(state.orientation[other[rows]], gradient)
    return rows, out / out.norm(dim=-1, keepdim=True)


def _reach(bodies: Bodies, rows: Tensor) -> Tensor:
    """[R] how far the solids of bodies `rows` [R] reach from their centres; nothing for a plane."""
    radius = bodies.radius[rows]
    return torch.where(radius.isfinite(), radius, 0.0)
