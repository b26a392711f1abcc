"""Energy: what contact makes of it in a step, and how a step that makes energy is held back.

Contact can only take energy away, but for the work of bodies on paths. A network does not know this. Every step is
therefore compared with free flight, which keeps energy exactly, island by island (bodies joined by contact edges).

Where a step has made more than is allowed, the velocities at its end are blended back towards those of free flight,
by one share for a whole island. That makes the impulses behind them smaller by this share, so momentum is kept as well
as before. The way made in the step is only held to what does not run away: what overlaps goes on being resolved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Bodies, State, awake
from sdfsim.dynamics.check import FASTEST
from sdfsim.dynamics.contacts import Contacts
from sdfsim.dynamics.memory import Memory
from sdfsim.dynamics.sleep import islands

Guard = Literal["none", "energy"]
Motion = tuple[Tensor, Tensor]  # velocities and angular velocities [R, 3]
# Model units: by how much the root mean square speed of an island may go beyond what energy allows, at the end of a
# step (where nothing guards energy; three times what gravity adds in a step of training) and on average on its way
# through it (overlaps are left in few steps). On its test data the bundled model makes 0.08 and 0.14 at most.
ESCAPE, LEAVE = 0.6, 6.0
WILD = 2.0  # times the energy that is allowed: a pose with that much is not to be kept
ROUNDING = 1e-6  # of the energies compared: velocities come out of a network in single precision


@dataclass(frozen=True)
class Balance:
    """R dynamic bodies in K islands, in free flight and after contact has acted; energies in model units.

    Attributes:
        rows: [R] int64, the bodies.
        island: [R] int64, 0 ... K - 1.
        mass: [K].
        flown: [K] kinetic energy at the end of the step in free flight.
        allowed: [K] the most kinetic energy there may be: that, less what lifting took, and the work of paths.
        reached: [K] kinetic energy there is.
        jumped: whether a body may have gone farther in the step than is allowed.
    """

    rows: Tensor
    island: Tensor
    mass: Tensor
    flown: Tensor
    allowed: Tensor
    reached: Tensor
    jumped: bool

    @property
    def gain(self) -> Tensor:
        """[K] energy made from nothing."""
        made = self.reached - self.allowed
        return torch.where(made > ROUNDING * (self.flown + self.reached), made, 0.0)

    def total(self, values: Tensor) -> Tensor:
        """[K] sums over the islands of `values` [R]."""
        return torch.zeros_like(self.mass).index_add_(0, self.island, values)


def hold_back(
    bodies: Bodies,
    state: State,
    flown: State,
    after: State,
    contacts: Contacts,
    gravity: Tensor,
    dt: float,
    guard: Guard,
    memory: Memory,
) -> State:
    """The state after a step, held to what is allowed; the energy that contact made, and who was held, are counted.

    Args:
        bodies: N bodies.
        state: before the step.
        flown: after it in free flight.
        after: after it as predicted.
        contacts: the edges that acted.
        gravity: [3].
        dt: the step.
        guard: "energy" allows no gain at all; "none" only stops what runs away (`ESCAPE`).
        memory: counts.
    """
    found = balance(bodies, state, flown, after, contacts, gravity, dt)
    if found is None:
        return after
    rows, most = found.rows, found.allowed.clamp_min(0.0)
    root, mass = (2.0 * most).sqrt(), found.mass.sqrt()
    fast, far = (0.5 * (root + mass * v).square() for v in (0.0 if guard == "energy" else ESCAPE, LEAVE))
    end = _share(bodies, found, after, _end(flown, rows), _end(after, rows), fast)
    way = torch.ones_like(end)
    if found.jumped:
        way = _share(bodies, found, after, _way(state, flown, rows, dt), _way(state, after, rows, dt), far)
        way = way.clamp_min(0.0)
    if state.earlier_position is not None:
        way = torch.minimum(way, end)  # the paper network takes its velocities from the poses
    way = torch.where(end < 0.0, 0.0, way)  # turned by what contact made of it, it has too much energy at any speed
    end = end.clamp_min(0.0)
    held = (torch.minimum(end, way) < 1.0)[found.island]
    if bool(held.any()):
        after = _blend(flown, after, rows, end[found.island, None], way[found.island, None])
        memory.count(held_back=int(held.sum()))
        found = balance(bodies, state, flown, after, contacts, gravity, dt)
    memory.count(energy_gain=0.0 if found is None else float(found.gain.sum()))
    return after


def balance(
    bodies: Bodies, state: State, flown: State, after: State, contacts: Contacts, gravity: Tensor, dt: float
) -> Balance | None:
    """Energies of the islands that contact has changed; None where no body of any has gained, or jumped."""
    changed = (after.velocity != flown.velocity) | (after.angular_velocity != flown.angular_velocity)
    rows = awake(bodies, state)
    rows = rows[changed[rows].any(-1)]
    (one, spin), (other, turn) = _end(flown, rows), _end(after, rows)
    mass, both = bodies.mass[rows], torch.cat([rows, rows])
    orientation = torch.cat([flown.orientation[rows], after.orientation[rows]])
    before, reached = kinetic(bodies, both, orientation, (torch.cat([one, other]), torch.cat([spin, turn]))).chunk(2)
    # Differences of positions, so that a far origin costs no precision.
    lifted = -mass * ((after.position - flown.position)[rows] @ gravity)
    # Cheap, and enough: an island can only have gained, or be over a limit, when one of its bodies is.
    jump = (after.position - state.position)[rows].norm(dim=-1)
    jump = jump + 2.0 * (after.orientation - state.orientation)[rows].norm(dim=-1) * bodies.radius[rows]
    wild = 0.5 * mass * ((jump / dt).square() - LEAVE**2)
    jumped = bool((wild + lifted > before).any())
    if not jumped and not bool((reached + lifted > before).any()):
        return None
    label = islands(bodies, contacts)
    numbers, island = torch.unique(label[rows], return_inverse=True)
    none = mass.new_zeros(len(numbers))
    found = Balance(rows, island, none, none, none, none, jumped)
    speed = _path_speed(bodies, state, contacts, label)[numbers]
    masses, flying = found.total(mass), found.total(before)
    # A wall of speed V adds 2 V to the speed of what bounces off it.
    driven = 0.5 * ((2.0 * flying).sqrt() + 2.0 * masses.sqrt() * speed).square()
    allowed = driven - found.total(lifted)
    return replace(found, mass=masses, flown=flying, allowed=allowed, reached=found.total(reached))


def kinetic(bodies: Bodies, rows: Tensor, orientation: Tensor, motion: Motion) -> Tensor:
    """[R] kinetic energy of bodies `rows` [R] at `orientation` [R, 4] with the `motion` of each."""
    velocity, angular = motion
    spin = pose.rotate(pose.conjugate(orientation), angular)
    turning = (spin * (bodies.inertia[rows] @ spin[..., None])[..., 0]).sum(-1)
    return 0.5 * (bodies.mass[rows] * velocity.square().sum(-1) + turning)


def _share(bodies: Bodies, found: Balance, after: State, start: Motion, stop: Motion, most: Tensor) -> Tensor:
    """[K] how much of the way from `start` to `stop` keeps the kinetic energy of an island to `most` [K]: 1 for all.

    Along it the energy is a parabola (at the orientations after the step). Where none of it keeps to `most`, its lowest
    point is taken; the share is -1 where that has more than `WILD` times as much. What is far beyond reason is left as
    it is, for the check of the state to name.
    """

    def energy(motion: Motion) -> Tensor:
        return found.total(kinetic(bodies, found.rows, after.orientation[found.rows], motion))

    reached = energy(stop)
    over = (reached - most > ROUNDING * (found.flown + reached)) & (reached < 0.5 * found.mass * FASTEST**2)
    if not bool(over.any()):
        return torch.ones_like(most)
    lowest = energy(start)
    square = energy((stop[0] - start[0], stop[1] - start[1])).clamp_min(torch.finfo(most.dtype).tiny)
    middle = -0.5 * (reached - lowest - square) / square
    inside = middle.square() + (most - lowest) / square
    share = (middle + inside.clamp_min(0.0).sqrt()).clamp(0.0, 1.0)
    left = lowest + square * (share.square() - 2.0 * middle * share)
    return torch.where(over, torch.where(left > WILD * most, -1.0, share), 1.0)


def _blend(flown: State, after: State, rows: Tensor, end: Tensor, way: Tensor) -> State:
    """Bodies `rows` [R] with shares [R, 1] of the change that contact makes: `end` of velocities, `way` of poses."""

    def between(name: str, share: Tensor) -> Tensor:
        one, other = getattr(flown, name)[rows], getattr(after, name)[rows]
        return getattr(after, name).index_copy(0, rows, torch.where(share < 1.0, torch.lerp(one, other, share), other))

    start = flown.orientation[rows]
    turn = pose.to_rotvec(pose.multiply(after.orientation[rows], pose.conjugate(start)))
    turned = pose.normalise(pose.multiply(pose.from_rotvec(way * turn), start))
    orientation = torch.where(way < 1.0, turned, after.orientation[rows])
    return replace(
        after,
        position=between("position", way),
        orientation=after.orientation.index_copy(0, rows, orientation),
        velocity=between("velocity", end),
        angular_velocity=between("angular_velocity", end),
    )


def _end(state: State, rows: Tensor) -> Motion:
    return state.velocity[rows], state.angular_velocity[rows]


def _way(state: State, after: State, rows: Tensor, dt: float) -> Motion:
    """The mean velocities that lead from `state` to `after`."""
    turn = pose.multiply(after.orientation[rows], pose.conjugate(state.orientation[rows]))
    return (after.position - state.position)[rows] / dt, pose.to_rotvec(turn) / dt


def _path_speed(bodies: Bodies, state: State, contacts: Contacts, label: Tensor) -> Tensor:
    """[N] by number of island, the fastest that any point of a body on a path moves that one of it touches."""
    fastest = torch.zeros(len(bodies), dtype=torch.float64, device=bodies.device)
    if bodies.tracks is None:
        return fastest
    own = state.velocity.norm(dim=-1) + state.angular_velocity.norm(dim=-1) * bodies.radius
    scripted = torch.zeros_like(bodies.moves).index_fill_(0, bodies.tracks.body, True)
    for one, other in ((contacts.owner, contacts.body), (contacts.body, contacts.owner)):
        met = scripted[other] & bodies.moves[one]
        fastest = fastest.scatter_reduce(0, label[one[met]], own[other[met]], "amax")
    return fastest
