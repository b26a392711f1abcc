"""Sleep: bodies that rest together freeze exactly, until something touches or changes them.

An island is a set of dynamic bodies joined by contact edges. It falls asleep as a whole when all of it has stayed where
it is for a while (networks tremble at rest: what counts is the way made, not the speed of a step). It wakes as a whole:
when anything that moves gets a contact edge with one of it, when one of it or what it rests on is changed from outside,
or when gravity changes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sdfsim.dynamics.bodies import Bodies, Sleep, State, awake
from sdfsim.dynamics.contacts import Contacts

STEPS = 25  # for so many steps a body has to stay
STRAY = 0.05  # model lengths: within so much of where it was, its farthest point included


def nobody_asleep(bodies: Bodies, gravity: Tensor) -> Sleep:
    """The start of a run in which bodies may fall asleep."""
    number = torch.zeros(len(bodies), dtype=torch.int64, device=bodies.device)
    held = torch.zeros(len(bodies), 13, dtype=torch.float64, device=bodies.device)
    return Sleep(number, held[:, :7], number - 1, number[:0, None].expand(0, 2), held, gravity)


def stir(bodies: Bodies, state: State, gravity: Tensor, *, edited: bool) -> State:
    """Wake the islands that something outside the steps has changed.

    Args:
        bodies: N bodies.
        state: as the step finds it.
        gravity: [3] of the coming step.
        edited: whether the state comes from elsewhere than the step before.
    """
    sleep = state.sleep
    if sleep is None or bool((sleep.island < 0).all()):
        return state
    if not torch.equal(sleep.gravity, gravity):
        return wake(state, sleep.island[sleep.island >= 0])
    if not edited:
        return state
    changed = (_held(state) != sleep.held).any(-1)
    mine = sleep.island[changed]
    below = sleep.island[sleep.link[changed[sleep.link[:, 1]], 0]]
    return wake(state, torch.cat([mine[mine >= 0], below[below >= 0]]))


def touched(state: State, contacts: Contacts) -> Tensor:
    """The islands that have a contact edge with a body that moves (none was looked for between bodies that do not)."""
    if state.sleep is None:
        return contacts.owner[:0]
    island = state.sleep.island[torch.cat([contacts.owner, contacts.body])]
    return island[island >= 0]


def wake(state: State, islands: Tensor) -> State:
    """Wake every body of `islands` (numbers, repeated or none)."""
    assert state.sleep is not None
    if not len(islands):
        return state
    up = torch.isin(state.sleep.island, islands)
    island = torch.where(up, -1, state.sleep.island)
    quiet = torch.where(up, 0, state.sleep.quiet)
    return replace(state, sleep=replace(state.sleep, island=island, quiet=quiet))


def settle(bodies: Bodies, state: State, contacts: Contacts, gravity: Tensor) -> State:
    """Freeze the islands that have been slow for long enough after the step that `contacts` led through."""
    sleep = state.sleep
    if sleep is None:
        return state
    rows = awake(bodies, state)
    met = torch.zeros(len(bodies), dtype=torch.bool, device=bodies.device)
    met[contacts.owner] = True
    met[contacts.body] = True
    pose = torch.cat([state.position[rows], state.orientation[rows]], -1)
    calm = met[rows] & (_strayed(sleep.anchor[rows], pose, bodies.radius[rows]) < STRAY)
    count = torch.where(calm, sleep.quiet[rows] + 1, 0)
    # Where it is now is what counts for the next while, so that slow creep does not add up.
    kept = (count % STEPS != 0)[:, None]
    anchor = sleep.anchor.index_copy(0, rows, torch.where(kept, sleep.anchor[rows], pose))
    quiet = torch.zeros_like(sleep.quiet).index_copy_(0, rows, count)
    state = replace(state, sleep=replace(sleep, quiet=quiet, anchor=anchor))
    if not bool((quiet >= STEPS).any()):
        return state
    label = islands(bodies, contacts)
    busy = bodies.moves & (quiet < STEPS)
    scripted = bodies.tracks.body if bodies.tracks is not None else rows[:0]
    going = (state.velocity[scripted] != 0).any(-1) | (state.angular_velocity[scripted] != 0).any(-1)
    pushed = _beside(contacts, scripted[going], len(bodies))
    restless = torch.isin(label, label[busy | (bodies.moves & pushed)])
    tired = bodies.moves & ~restless & (sleep.island < 0)
    return _freeze(bodies, state, contacts, label, tired, gravity) if bool(tired.any()) else state


def _freeze(bodies: Bodies, state: State, contacts: Contacts, label: Tensor, tired: Tensor, gravity: Tensor) -> State:
    """`tired` [N] bodies stop where they are; their islands are numbered by `label` [N]."""
    assert state.sleep is not None
    free = int(state.sleep.island.max()) + 1
    still = tired[:, None]
    state = replace(
        state,
        velocity=torch.where(still, 0.0, state.velocity),
        angular_velocity=torch.where(still, 0.0, state.angular_velocity),
        earlier_position=_stopped(state.earlier_position, state.position, still),
        earlier_orientation=_stopped(state.earlier_orientation, state.orientation, still),
    )
    ends = torch.stack([torch.cat([contacts.owner, contacts.body]), torch.cat([contacts.body, contacts.owner])], 1)
    rests = ends[tired[ends[:, 0]] & ~bodies.moves[ends[:, 1]]].unique(dim=0)
    assert state.sleep is not None
    sleep = replace(
        state.sleep,
        island=torch.where(tired, label + free, state.sleep.island),
        link=torch.cat([state.sleep.link[state.sleep.island[state.sleep.link[:, 0]] >= 0], rests]),
        held=_held(state),
        gravity=gravity,
    )
    return replace(state, sleep=sleep)


def _strayed(before: Tensor, now: Tensor, radius: Tensor) -> Tensor:
    """Upper bound [A] on how far any point within `radius` [A] is from where it was, for poses [A, 7]."""
    cosine = (before[:, 3:] * now[:, 3:]).sum(-1)
    chord = 2.0 * (1.0 - cosine * cosine).clamp_min(0.0).sqrt()
    return (now[:, :3] - before[:, :3]).norm(dim=-1) + chord * radius


def _stopped(earlier: Tensor | None, now: Tensor, still: Tensor) -> Tensor | None:
    return None if earlier is None else torch.where(still, now, earlier)


def _held(state: State) -> Tensor:
    return torch.cat([state.position, state.orientation, state.velocity, state.angular_velocity], -1)


def _beside(contacts: Contacts, bodies: Tensor, count: int) -> Tensor:
    """[N] bool, who has a contact edge with one of `bodies`."""
    beside = torch.zeros(count, dtype=torch.bool, device=bodies.device)
    beside[contacts.owner[torch.isin(contacts.body, bodies)]] = True
    beside[contacts.body[torch.isin(contacts.owner, bodies)]] = True
    return beside


def islands(bodies: Bodies, contacts: Contacts) -> Tensor:
    """[N] int64, the same number for dynamic bodies that contact edges join."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    both = bodies.moves[contacts.owner] & bodies.moves[contacts.body]
    owner, body = contacts.owner[both].cpu().numpy(), contacts.body[both].cpu().numpy()
    graph = coo_array(([True] * len(owner), (owner, body)), shape=(len(bodies), len(bodies)))
    _, label = connected_components(graph, directed=False)
    return torch.as_tensor(label, dtype=torch.int64, device=bodies.device)


@dataclass(frozen=True)
class Rest:
    """For how long everything has rested: no point of a dynamic body has gone beyond `STRAY` of where it was.

    Attributes:
        anchor: [D, 7] float64, the poses of the dynamic bodies that they have stayed near; None before the first state.
        quiet: for how many steps.
    """

    anchor: Tensor | None = None
    quiet: int = 0

    @property
    def settled(self) -> bool:
        """Whether that is long enough."""
        return self.quiet >= STEPS

    def after(self, bodies: Bodies, state: State) -> Rest:
        """What is so with `state`, the one that follows."""
        pose = torch.cat([state.position, state.orientation], -1)[bodies.moves]
        if self.anchor is None or bool((_strayed(self.anchor, pose, bodies.radius[bodies.moves]) >= STRAY).any()):
            return Rest(pose)
        return replace(self, quiet=self.quiet + 1)
