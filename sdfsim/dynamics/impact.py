"""Contact edges as they will be when the surfaces meet, for bodies that come from afar within one step.

At 8 m/s two bodies approach by 16 cm in a step. The points that are closest to one another at its start are not those
that will touch, nor is their normal the one of the impact. So distances are asked again where bodies will have flown to
by then, and taken from there as linear in what is left to go.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.broad import turning
from sdfsim.dynamics.contacts import Contacts, distances, unit

TIMES = 2  # estimates of when a pair meets, each by the normals of the one before
NEAR = 0.005  # model length: who flies no farther before the impact is seen well enough from where it is


def at_impact(bodies: Bodies, state: State, gravity: Tensor, dt: float, contacts: Contacts) -> Contacts:
    """The edges of pairs that approach, as they are when the pair meets or the step ends; the others as they are.

    `distance` stays the one at the start, along the new normal; `arm` and `foot` are those at the impact.

    Args:
        bodies: N bodies.
        state: theirs, at the start.
        gravity: [3], model units.
        dt: the step, model time.
        contacts: edges; all of a pair are looked at together.
    """
    for _ in range(TIMES):
        before = contacts
        contacts = _once(bodies, state, gravity, dt, contacts)
        if contacts is before:
            break
    return contacts


def _once(bodies: Bodies, state: State, gravity: Tensor, dt: float, contacts: Contacts) -> Contacts:
    if not len(contacts):
        return contacts
    when = _meeting(bodies, dt, contacts)
    c = contacts
    speed = (state.velocity[c.owner] - state.velocity[c.body]).norm(dim=-1)
    speed = speed + turning(bodies, state, c.owner) + turning(bodies, state, c.body)
    row = (speed * when > NEAR).nonzero()[:, 0]
    if not len(row):
        return contacts
    owner, other, when = c.owner[row], c.body[row], when[row, None]

    def flown(body: Tensor) -> tuple[Tensor, Tensor]:
        place = state.position[body] + state.velocity[body] * when
        place = place + 0.5 * gravity * when.square() * bodies.moves[body, None]
        turn = pose.from_rotvec(state.angular_velocity[body] * when)
        return place, pose.multiply(turn, state.orientation[body])

    (place, turn), (other_place, other_turn) = flown(owner), flown(other)
    arm = pose.rotate(turn, c.point[row])
    offset = place - other_place + arm
    local = pose.rotate(pose.conjugate(other_turn), offset)
    distance, gradient = distances(bodies, other, local)
    outward = unit(gradient, local)
    before = state.position[owner] - state.position[other]
    before = before + pose.rotate(state.orientation[owner], c.point[row])
    before = pose.rotate(pose.conjugate(state.orientation[other]), before)
    start = distance + (outward * (before - local)).sum(-1)
    # An edge that opens until then was not inside before: only the plane that stands for the surface is.
    start = torch.maximum(start, torch.minimum(distance, c.distance[row]))
    normal = pose.rotate(other_turn, outward)
    half = 0.5 * distance[:, None] * normal
    ahead = torch.minimum(start, start + (distance - start) * dt / when[:, 0])

    def put(old: Tensor, new: Tensor) -> Tensor:
        return old.index_copy(0, row, new)

    return replace(
        c,
        arm=put(c.arm, arm - half),
        foot=put(c.foot, offset - half),
        normal=put(c.normal, normal),
        distance=put(c.distance, start),
        ahead=put(c.ahead, ahead),
        queries=c.queries + len(row),
    )


def _meeting(bodies: Bodies, dt: float, contacts: Contacts) -> Tensor:
    """[E] when the first edge of each edge's pair closes, at most the step; 0 where none ever does."""
    rate = (contacts.distance - contacts.ahead) / dt
    when = torch.where(rate > 0, contacts.distance.clamp_min(0.0) / rate.clamp_min(1e-12), torch.inf)
    pair = torch.unique(contacts.owner * len(bodies) + contacts.body, return_inverse=True)[1]
    first = torch.full((int(pair.max()) + 1,), torch.inf, dtype=when.dtype, device=when.device)
    first = first.scatter_reduce(0, pair, when, "amin")[pair]
    return torch.where(first.isinf(), torch.zeros_like(first), first.clamp_max(dt))
