"""What the compiled step works on: bodies, their motion, contacts, rules; model units throughout."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sdfsim.physics.options import Options

POINTS = 24  # of a manifold at most
# Columns of a contact point: where it is on either body (about its centre of mass, in its axes), the unit normal from
# the second body to the first (world), the distance, the impulses of the last inner step: along the normal, and the
# tangential one (world); the two patches that meet there; by which factor friction acts nearer to the middle of the
# patch than the point is; and whether it is void, see `internal_edges`.
FIRST, SECOND, NORMAL, GAP, NORMAL_IMPULSE, TANGENTIAL, KEY, TORSION, VOID, COLUMNS = (
    0,
    3,
    6,
    9,
    10,
    11,
    14,
    15,
    16,
    17,
)


class World(NamedTuple):
    """N bodies, as they stay."""

    shape: np.ndarray  # [N] int64, -1 for a body that nothing may touch
    scale: np.ndarray  # [N]
    com: np.ndarray  # [N, 3] centre of mass from the shape's origin, scaled
    # centre, half: [N, 3] middle of the box around the solid from the centre of mass, and its half extents
    centre: np.ndarray
    half: np.ndarray
    radius: np.ndarray  # [N] how far the solid reaches from the centre of mass
    thickness: np.ndarray  # [N] of its thinnest walls
    inverse_mass: np.ndarray  # [N], 0 unless dynamic
    # inertia, inverse_inertia: [N, 3, 3] in the body's axes; the inverse is 0 where nothing turns
    inertia: np.ndarray
    inverse_inertia: np.ndarray
    isotropic: np.ndarray  # [N] bool, whether angular velocity is constant in free flight
    # friction, restitution: [N]
    friction: np.ndarray
    restitution: np.ndarray
    moves: np.ndarray  # [N] bool, dynamic
    scripted: np.ndarray  # [N] bool, kinematic
    group: np.ndarray  # [N] int64
    allowed: np.ndarray  # [G, G] bool, whether two groups may touch
    world: np.ndarray  # [N] int64, bodies of two worlds never meet; -1 is in all
    going: np.ndarray  # [A] int64, the bodies that move or are scripted
    plane: np.ndarray  # [K] int64, the bodies that are infinite
    still: np.ndarray  # [M] int64, the other static bodies, in the order of their lower ends along `axis`
    # low, high: [M, 3] their boxes
    low: np.ndarray
    high: np.ndarray
    reach: np.ndarray  # [M] the highest end so far along `axis`
    axis: int  # 0, 1 or 2
    apart: np.ndarray  # [E] int64, which bodies joints keep from touching, see `physics.joints.apart`


class Work(NamedTuple):
    """What a step fills in for the bodies that go, and keeps for all others, so that these cost nothing."""

    # matrix, inverse: [N, 3, 3] rotation and inverse inertia, world axes
    matrix: np.ndarray
    inverse: np.ndarray
    # free [N, 9]: what an inner step makes of velocities without contact; by the gyroscopic torque of the angular one
    # change, shift [N, 6]: what contact adds, and velocities that only move and are forgotten
    free: np.ndarray
    change: np.ndarray
    shift: np.ndarray
    wrench: (
        np.ndarray
    )  # [N, 6] force at the centre of mass and torque, world axes, that pull at a body through the step
    part: np.ndarray  # [N] how much of the inner step a body may move
    ways: np.ndarray  # [N] how far a body may move until it has to be looked around again
    gone: np.ndarray  # [N] how far it has
    # low, high: [N, 3] the box of all that it may reach till then
    low: np.ndarray
    high: np.ndarray
    # beside, met: [N] bool, whether somebody is near, and whether contacts acted in this step
    beside: np.ndarray
    met: np.ndarray
    # parent, number: [N] int64 for finding islands
    parent: np.ndarray
    number: np.ndarray
    latest: np.ndarray  # [N] int64 for finding the contacts of a body
    scratch: NamedTuple  # `manifold.Scratch`


class Motion(NamedTuple):
    """Where N bodies are and how they move; the step writes to it."""

    position: np.ndarray  # [N, 3]
    orientation: np.ndarray  # [N, 4] xyzw
    # velocity, angular: [N, 3] of the centres of mass, world
    velocity: np.ndarray
    angular: np.ndarray
    # [N] bool, whether contacts acted in the last inner step: the velocity is then that of this whole inner step,
    # and not that at its end (what rests has none)
    touching: np.ndarray
    quiet: np.ndarray  # [N] int64, for how many steps a body has stayed near its anchor
    anchor: np.ndarray  # [N, 14] the pose that it has stayed near, and that half of that time later
    island: np.ndarray  # [N] int64, a number shared by the bodies that fell asleep together, -1 for all that are awake


class Manifolds(NamedTuple):
    """The contacts of P pairs of bodies."""

    pair: np.ndarray  # [P, 2] int64, ordered; the first is a body that moves, or the less of two that do
    count: np.ndarray  # [P] int64 points of each
    point: np.ndarray  # [P, POINTS, COLUMNS]


class Rules(NamedTuple):
    """How the solve does what is in play. Lengths and speeds are those of model units, in which the smallest bodies are
    about 1.4 wide."""

    options: Options
    substep_dt: float  # the inner step
    slow: float  # an approach up to this speed ends at the surface without a rebound
    ahead: float = 0.0  # new points are looked for so much time farther, as fast as two bodies move against each other
    contact_margin: float = 0.02  # contacts are kept up to this distance, and while they have slid by no more
    search_margin: float = 0.006  # new ones are looked for up to this one and twice the margin
    still: float = 1e-4  # pairs that have moved by less within a step are not looked at again
    erp: float = 0.08  # the share of a penetration that an inner step resolves, through velocity
    slop: float = 5e-4  # penetration that is left as it is
    split: float = 0.04  # deeper penetration than this is resolved without a lasting velocity
    rounds: int = 100  # of sequential impulses at most
    exact: float = 2e-5  # they end when no impulse changes a velocity by more
    apart: float = 0.03  # points of a manifold are at least so far from each other
    # stray, rest: who stays within `stray` for `rest` steps falls asleep, if its forces are so nearly in balance that
    # they move it by less than `drift` in as long a time
    stray: float = 0.005
    rest: int = 25
    drift: float = 2e-4
