"""The data of the compiled step: bodies, their motion, contacts, rules; model units throughout."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from sdfsim.physics.solver.vectors import BARE

POINTS = 24  # largest number of points of a manifold
# Columns of a contact point: its position on each body (about its centre of mass, in its axes); the unit normal from
# the second body to the first (world); the distance; the impulses of a whole inner step, along the normal and
# tangential (world); the two patches that meet there; the factor by which friction acts nearer to the middle of the
# patch than the point is; whether it is void, see `internal_edges`; and whose surface it was found on (0 or 1).
FIRST, SECOND, NORMAL, GAP, NORMAL_IMPULSE, TANGENTIAL, KEY, TORSION, VOID, OWNER, COLUMNS = (
    0, 3, 6, 9, 10, 11, 14, 15, 16, 17, 18,
)  # fmt: skip


# Phases of a step. Its kicks (changes of velocity) and moves alternate: half a kick at the start, a move, whole kicks
# between moves, and half a kick at the end. So velocities between steps are those at an instant, and free flight is an
# exact parabola (velocity Verlet; RATTLE for joints).
START, BETWEEN, END = range(3)


@njit(**BARE)
def kick_of(phase):
    """The part of an inner step for which forces act before the next move."""
    return 1.0 if phase == BETWEEN else 0.5


class World(NamedTuple):
    """The constants of N bodies."""

    shape: np.ndarray  # [N] int64, -1 for a body that nothing may touch
    scale: np.ndarray  # [N]
    com: np.ndarray  # [N, 3] centre of mass from the shape's origin, scaled
    # centre, half: [N, 3] middle of the box around the solid, relative to the centre of mass, and its half extents
    centre: np.ndarray
    half: np.ndarray
    radius: np.ndarray  # [N] distance of the solid's farthest point from the centre of mass
    thickness: np.ndarray  # [N] of its thinnest walls
    inverse_mass: np.ndarray  # [N], 0 unless dynamic
    # inertia, inverse_inertia: [N, 3, 3] in the body's axes; the inverse is 0 for bodies that do not turn
    inertia: np.ndarray
    inverse_inertia: np.ndarray
    isotropic: np.ndarray  # [N] bool, whether angular velocity is constant in free flight
    # friction, restitution: [N]
    friction: np.ndarray
    restitution: np.ndarray
    # compliance (0 if rigid), damping: [N] of contacts
    compliance: np.ndarray
    damping: np.ndarray
    moves: np.ndarray  # [N] bool, dynamic
    scripted: np.ndarray  # [N] bool, kinematic
    group: np.ndarray  # [N] int64
    allowed: np.ndarray  # [G, G] bool, whether two groups may touch
    world: np.ndarray  # [N] int64, bodies of different worlds never meet; -1 is in all
    going: np.ndarray  # [A] int64, the bodies that are dynamic or scripted
    plane: np.ndarray  # [K] int64, the infinite bodies
    still: np.ndarray  # [M] int64, the other static bodies, in the order of their lower ends along `axis`
    # low, high: [M, 3] their boxes
    low: np.ndarray
    high: np.ndarray
    reach: np.ndarray  # [M] the highest upper end so far along `axis`
    axis: int  # 0, 1 or 2
    apart: np.ndarray  # [E] int64, the bodies that joints keep from touching, see `physics.joints.apart`


class Work(NamedTuple):
    """Buffers that a step fills for dynamic and scripted bodies; others keep their values, so that they cost
    nothing."""

    # matrix [N, 3, 3], inverse [N + 1, 3, 3]: rotation and inverse inertia, world axes
    matrix: np.ndarray
    inverse: np.ndarray
    inverse_mass: np.ndarray  # [N + 1]
    # matrix_before [N, 3, 3], position_before [N, 3]: before the last move
    matrix_before: np.ndarray
    position_before: np.ndarray
    # All velocities that follow have a last entry for the world, which stays 0: joints to it have the body -1.
    # twist [N + 1, 6]: velocities before the inner step. free [N + 1, 9]: their change without contacts and joints; and
    # that of the angular one by the gyroscopic torque. change, shift [N + 1, 6]: what contacts and joints add; and
    # velocities that move bodies once and do not last
    twist: np.ndarray
    free: np.ndarray
    change: np.ndarray
    shift: np.ndarray
    wrench: np.ndarray  # [N, 6] force at the centre of mass and torque, world axes, that pull at a body during the step
    part: np.ndarray  # [N] part of the inner step by which a body may move
    motion_bound: np.ndarray  # [N] how far a body may move until the next search for near bodies
    moved: np.ndarray  # [N] how far it has moved since
    # low, high: [N, 3] the box of everything that it may reach until then
    low: np.ndarray
    high: np.ndarray
    # beside, acted, met: [N] bool, whether another body is near, and whether contacts or joints acted in this inner
    # step, and in any of this step
    beside: np.ndarray
    acted: np.ndarray
    met: np.ndarray
    # parent, number: [N] int64 for finding islands
    parent: np.ndarray
    number: np.ndarray
    latest: np.ndarray  # [N] int64 for finding the contacts of a body
    # turned, frame: [1, 4] and [1, 3, 3] a pose on trial
    turned: np.ndarray
    frame: np.ndarray
    scratch: NamedTuple  # `manifold.Scratch`


class Motion(NamedTuple):
    """Poses and velocities of N bodies; the step writes to it."""

    position: np.ndarray  # [N, 3]
    orientation: np.ndarray  # [N, 4] xyzw
    # velocity, angular: [N, 3] of the centres of mass, world
    velocity: np.ndarray
    angular: np.ndarray
    quiet: np.ndarray  # [N] int64, number of steps that a body has stayed near its anchor
    anchor: np.ndarray  # [N, 14] the pose that it has stayed near, and its pose half of that time later
    island: np.ndarray  # [N] int64, a number shared by the bodies that fell asleep together, -1 if awake


class Manifolds(NamedTuple):
    """The contacts of P pairs of bodies."""

    pair: np.ndarray  # [P, 2] int64, ordered; the first is dynamic, or the one with the lower number if both are
    count: np.ndarray  # [P] int64, number of points of each
    point: np.ndarray  # [P, POINTS, COLUMNS]
