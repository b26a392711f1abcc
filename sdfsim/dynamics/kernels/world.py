"""What the compiled step works on: bodies, their motion, contacts, rules; model units throughout."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

POINTS = 24  # of a manifold at most
# Columns of a contact point: where it is on either body (about its centre of mass, in its axes), the unit normal from
# the second body to the first (world), the distance, the impulses of the last inner step: along the normal, and the
# tangential one (world); the two patches that meet there, and a place for notes.
FIRST, SECOND, NORMAL, GAP, PUSH, DRAG, KEY, NOTE, COLUMNS = 0, 3, 6, 9, 10, 11, 14, 15, 16


class World(NamedTuple):
    """N bodies, as they stay.

    Attributes:
        shape: [N] int64, -1 for a body that nothing may touch.
        scale: [N].
        com: [N, 3] centre of mass from the shape's origin, scaled.
        centre, half: [N, 3] middle of the box around the solid from the centre of mass, and its half extents.
        radius: [N] how far the solid reaches from the centre of mass.
        inverse_mass: [N], 0 unless dynamic.
        inertia, inverse_inertia: [N, 3, 3] in the body's axes; the inverse is 0 where nothing turns.
        isotropic: [N] bool, whether angular velocity is constant in free flight.
        friction, restitution: [N].
        moves: [N] bool, dynamic.
        scripted: [N] bool, kinematic.
        group: [N] int64; allowed: [G, G] bool, whether two groups may touch.
        realm: [N] int64, bodies of two realms never meet; -1 is in all.
        going: [A] int64, the bodies that move or are scripted.
        plane: [K] int64, the bodies that are infinite.
        still: [M] int64, the other static bodies, in the order of their lower ends along `axis`.
        low, high: [M, 3] their boxes; reach: [M] the highest end so far along `axis`.
        axis: 0, 1 or 2.
    """

    shape: np.ndarray
    scale: np.ndarray
    com: np.ndarray
    centre: np.ndarray
    half: np.ndarray
    radius: np.ndarray
    inverse_mass: np.ndarray
    inertia: np.ndarray
    inverse_inertia: np.ndarray
    isotropic: np.ndarray
    friction: np.ndarray
    restitution: np.ndarray
    moves: np.ndarray
    scripted: np.ndarray
    group: np.ndarray
    allowed: np.ndarray
    realm: np.ndarray
    going: np.ndarray
    plane: np.ndarray
    still: np.ndarray
    low: np.ndarray
    high: np.ndarray
    reach: np.ndarray
    axis: int


class Work(NamedTuple):
    """What a step fills in for the bodies that go, and keeps for all others, so that these cost nothing.

    Attributes:
        matrix, inverse: [N, 3, 3] rotation and inverse inertia, world axes.
        free, change, shift: [N, 6] what an inner step makes of velocities without contact, what contact adds, and
            velocities that only move and are forgotten.
        load: [N, 6] force at the centre of mass and torque, world axes, that pull at a body through the step.
        part: [N] how much of the inner step a body may move.
        ways: [N] how far a body may move until it has to be looked around again; gone: [N] how far it has.
        low, high: [N, 3] the box of all that it may reach till then.
        beside, met: [N] bool, whether somebody is near, and whether contacts acted in this step.
        parent, number: [N] int64 for finding islands.
    """

    matrix: np.ndarray
    inverse: np.ndarray
    free: np.ndarray
    change: np.ndarray
    shift: np.ndarray
    load: np.ndarray
    part: np.ndarray
    ways: np.ndarray
    gone: np.ndarray
    low: np.ndarray
    high: np.ndarray
    beside: np.ndarray
    met: np.ndarray
    parent: np.ndarray
    number: np.ndarray


class Motion(NamedTuple):
    """Where N bodies are and how they move; the step writes to it.

    Attributes:
        position: [N, 3]; orientation: [N, 4] xyzw; velocity, angular: [N, 3] of the centres of mass, world.
        touching: [N] bool, whether contacts acted in the last inner step: the velocity is then that of this whole
            inner step, and not that at its end (what rests has none).
        quiet: [N] int64, for how many steps a body has stayed near its anchor.
        anchor: [N, 7] the pose that it has stayed near.
        island: [N] int64, a number shared by the bodies that fell asleep together, -1 for all that are awake.
    """

    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    angular: np.ndarray
    touching: np.ndarray
    quiet: np.ndarray
    anchor: np.ndarray
    island: np.ndarray


class Manifolds(NamedTuple):
    """The contacts of P pairs of bodies.

    Attributes:
        pair: [P, 2] int64, ordered; the first is a body that moves, or the less of two that do.
        count: [P] int64 points of each.
        point: [P, POINTS, COLUMNS].
    """

    pair: np.ndarray
    count: np.ndarray
    point: np.ndarray


class Rules(NamedTuple):
    """What is in play. Lengths and speeds are those of model units, in which the smallest bodies are about 1.4 wide.

    Attributes:
        gravity: [3].
        inner: the inner step.
        steps: inner steps in a step.
        slow: an approach up to this speed ends at the surface without a rebound.
        friction, restitution, rotation, sleep: whether they are.
        margin: all bodies but planes are larger by this than their distances say.
        adds: whether what is pushed out adds to the speed of a rebound.
        note: whether what contacts did in the step is wanted, see `record`.
        ahead: new points are looked for so much time farther, as fast as two bodies move against each other.
        reach: contacts are kept up to this distance, and while they have slid by no more.
        look: new ones are looked for up to this one and twice the margin.
        still: pairs that have moved by less within a step are not looked at again.
        together: points that are deeper than the deepest less this meet in one impact.
        erp: the share of a penetration that an inner step resolves, through velocity.
        slop: penetration that is left as it is, so that what rests has contacts that do not come and go.
        split: deeper penetration than this is resolved without a lasting velocity.
        rounds: of sequential impulses at most.
        exact: they end when no impulse changes a velocity by more.
        apart: points of a manifold are at least so far from each other.
        stray, rest: who stays within `stray` for `rest` steps falls asleep.
    """

    gravity: np.ndarray
    inner: float
    steps: int
    slow: float
    friction: bool = True
    restitution: bool = True
    rotation: bool = True
    sleep: bool = False
    margin: float = 0.0
    adds: bool = False
    note: bool = False
    ahead: float = 0.0
    reach: float = 0.02
    look: float = 0.004
    still: float = 1e-4
    together: float = 1e-4
    erp: float = 0.08
    slop: float = 5e-4
    split: float = 0.04
    rounds: int = 50
    exact: float = 1e-4
    apart: float = 0.03
    stray: float = 0.005
    rest: int = 25
