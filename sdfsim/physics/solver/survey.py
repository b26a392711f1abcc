"""Checks and measures after every step, compiled: whether the state is valid, its energy, and where bodies touch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from sdfsim.physics.solver.manifold import points_of
from sdfsim.physics.solver.vectors import BARE, ENTRY, add, dot, get, put, rotated, scale, sub, turn, vector
from sdfsim.physics.solver.world import GAP, NORMAL, NORMAL_IMPULSE, TANGENTIAL


class Touching(NamedTuple):
    """E places where bodies touch, model units."""

    pair: np.ndarray  # [E, 2] int64, the two bodies
    point: np.ndarray  # [E, 3] on the first, world
    normal: np.ndarray  # [E, 3] from the second to the first
    impulse: np.ndarray  # [E, 3] on the first in the last inner step
    gap: np.ndarray  # [E] distance, below 0 if they overlap


@njit(**BARE)
def broken(position, orientation, velocity, angular, before, i, b, dt, most):
    """What is wrong with the state of body b, which was at `before` [i] at the start of a step of `dt`; -1 if it is
    valid. 0: |q|^2 differs from 1 by more than most[0]. 1 to 4: the position, velocity, angular velocity or the speed
    of its displacement is above most[1] to most[4], or not a number."""
    x, y, z, w = orientation[b, 0], orientation[b, 1], orientation[b, 2], orientation[b, 3]
    if not abs(x * x + y * y + z * z + w * w - 1.0) <= most[0]:
        return 0
    way = scale(sub(get(position, b), get(before, i)), 1.0 / dt)
    for k, v in enumerate((get(position, b), get(velocity, b), get(angular, b), way)):
        if not dot(v, v) <= most[k + 1] * most[k + 1]:
            return k + 1
    return -1


@njit(**ENTRY)
def first_fault(looked_at, position, orientation, velocity, angular, before, dt, most):
    """The first of the bodies `looked_at` [N] bool with an invalid state, -1 if all are valid; and what is wrong, see
    `broken`. Bodies were at `before` [N, 3]."""
    for b in range(len(looked_at)):
        if looked_at[b]:
            wrong = broken(position, orientation, velocity, angular, before, b, b, dt, most)
            if wrong >= 0:
                return b, wrong
    return -1, 0


@njit(**BARE)
def energy(mass, inertia, gravity, position, orientation, velocity, angular, b):
    """Kinetic and potential energy of body b."""
    v, spin = get(velocity, b), rotated(orientation, b, get(angular, b), -1.0)
    kinetic = 0.5 * (mass * dot(v, v) + dot(spin, turn(inertia, b, spin)))
    return kinetic, -mass * dot(vector(gravity), get(position, b))


@njit(**ENTRY)
def energies(mass, inertia, gravity, position, orientation, velocity, angular):
    """Kinetic and potential energy of all bodies with a mass."""
    kinetic = potential = 0.0
    for b in range(len(mass)):
        if mass[b] > 0.0:
            moving, lifted = energy(mass[b], inertia, gravity, position, orientation, velocity, angular, b)
            kinetic, potential = kinetic + moving, potential + lifted
    return kinetic, potential


@njit(**ENTRY)
def touching(manifolds, position, orientation, within):
    """The contacts of bodies that are no farther apart than `within`."""
    most = points_of(manifolds, len(manifolds.count))
    pair, gap = np.empty((most, 2), np.int64), np.empty(most)
    place, normal, impulse = np.empty((most, 3)), np.empty((most, 3)), np.empty((most, 3))
    e = 0
    for m in range(len(manifolds.pair)):
        first = manifolds.pair[m, 0]
        for k in range(manifolds.count[m]):
            point = manifolds.point[m, k]
            if point[GAP] <= within:
                n = (point[NORMAL], point[NORMAL + 1], point[NORMAL + 2])
                drag = (point[TANGENTIAL], point[TANGENTIAL + 1], point[TANGENTIAL + 2])
                pair[e, 0], pair[e, 1], gap[e] = first, manifolds.pair[m, 1], point[GAP]
                put(place, e, add(get(position, first), rotated(orientation, first, vector(point), 1.0)))
                put(normal, e, n)
                put(impulse, e, add(scale(n, point[NORMAL_IMPULSE]), drag))
                e += 1
    return Touching(pair[:e], place[:e], normal[:e], impulse[:e], gap[:e])
