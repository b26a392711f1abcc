"""Rows, compiled: the one form of all that is solved by sequential impulses.

A row is a linear function of the velocities of two bodies (its Jacobian), with the velocities that a unit impulse along
it gives them (its response), a wanted change and an impulse. Contacts are blocks of three rows (a normal and two
tangents), limits and motors of joints blocks of one, friction of ball joints blocks of three.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from sdfsim.physics.solver.vectors import BARE, INLINED, add, along, cross, dot, scale, sub, turn

# Columns of a row. Jacobian: the direction at the first body (its opposite at the second), and about both centres of
# mass; response: what a unit impulse adds to both angular velocities; the effective mass (the inverse of the change of
# the row's velocity by a unit impulse, 0 if nothing moves along it); the wanted change; the impulse so far.
LINEAR, ANGULAR, OTHER, TURN, COUNTER, MASS, WANTED, IMPULSE, WIDTH = 0, 3, 6, 9, 12, 15, 16, 17, 18
# Kinds of blocks.
CONTACT, LIMIT, MOTOR, GRIP = range(4)
# Columns of `Rows.own` by kind. Contacts: the wanted change along the normal without rebound and without resolving
# penetration; the speed along it without contact; the lasting speed that resolves penetration; the point's share of the
# energy that the points of two bodies may gain.
CALM, BEFORE, PUSH, SHARE = range(4)
# Limits: the distance to it that must be left after the inner step (infinite if it rebounds), and 1 for the lower limit
# or -1 for the upper.
LEFT, SIDE = range(2)
# Motors: the speed to reach; the largest impulses of the motor and of friction; and the compliance of a motor with a
# gain, by which its speed lags behind for a unit impulse. Friction of balls has its largest impulse in the same column.
AIM, STRONGEST, DRAG, COMPLIANCE = range(4)


class Rows(NamedTuple):
    """The rows of C blocks in an inner step. Body -1 is the world."""

    kind: np.ndarray  # [C] int64
    where: np.ndarray  # [C, 4] int64: manifold and point, or joint and 0; first and second body
    row: np.ndarray  # [C, 3, WIDTH]
    friction: np.ndarray  # [C] product of friction coefficients, 0 except for contacts
    own: np.ndarray  # [C, 4] see the columns
    deep: np.ndarray  # [C] speed that resolves penetration and does not last
    parted: np.ndarray  # [C] impulse for it so far
    start: np.ndarray  # [I + 1] int64, island i has the blocks order[start[i] : start[i + 1]]
    order: np.ndarray  # [C] int64
    # first, component: [I + 1] and [K] int64, likewise the components of joints
    first: np.ndarray
    component: np.ndarray


class Delassus(NamedTuple):
    """The effect of unit impulses of an island's R rows (three for a block) on all of them through joints, and the
    velocities along the rows so far. [0, 0] and [0] if the island has too many rows."""

    matrix: np.ndarray  # [R, R]
    change: np.ndarray  # [R]
    known: np.ndarray  # [R] impulses that the bodies have received


@njit(**BARE)
def write_point(row, axis, arm, other):
    """Write the Jacobian along a direction at two points."""
    one, two = cross(arm, axis), cross(axis, other)
    for x in range(3):
        row[LINEAR + x], row[ANGULAR + x], row[OTHER + x] = axis[x], one[x], two[x]


@njit(**BARE)
def write_turn(row, axis):
    """Write the Jacobian about an axis."""
    for x in range(3):
        row[LINEAR + x], row[ANGULAR + x], row[OTHER + x] = 0.0, axis[x], -axis[x]


@njit(**BARE)
def three(row, column):
    return row[column], row[column + 1], row[column + 2]


@njit(**BARE)
def velocity_of(row, twist, a, b):
    """The velocity of a row from velocities [N + 1, 6]; the last entry is the world's."""
    total = 0.0
    for x in range(3):
        total += row[LINEAR + x] * (twist[a, x] - twist[b, x])
        total += row[ANGULAR + x] * twist[a, 3 + x] + row[OTHER + x] * twist[b, 3 + x]
    return total


@njit(**BARE)
def respond(work, rules, row, a, b):
    """Complete a row by its response and effective mass."""
    if not rules.options.rotation:
        for x in range(ANGULAR, OTHER + 3):
            row[x] = 0.0
    one, two = three(row, ANGULAR), three(row, OTHER)
    spin, back = turn(work.inverse, a, one), turn(work.inverse, b, two)
    for x in range(3):
        row[TURN + x], row[COUNTER + x] = spin[x], back[x]
    axis = three(row, LINEAR)
    total = (work.inverse_mass[a] + work.inverse_mass[b]) * dot(axis, axis) + dot(one, spin) + dot(two, back)
    row[MASS] = 1.0 / total if total > 0.0 else 0.0


@njit(**BARE)
def give(mass, row, twist, a, b, impulse):
    """Add the effect of an impulse along a row to velocities [N + 1, 6]."""
    one, other = impulse * mass[a], impulse * mass[b]
    for x in range(3):
        twist[a, x] += one * row[LINEAR + x]
        twist[b, x] -= other * row[LINEAR + x]
        twist[a, 3 + x] += impulse * row[TURN + x]
        twist[b, 3 + x] += impulse * row[COUNTER + x]


@njit(**BARE)
def within(one, other, most):
    """The factor that shortens a tangential impulse to the cone of friction."""
    length = math.sqrt(one * one + other * other)
    return 1.0 if length <= most else most / length


@njit(**BARE)
def sweep(rows, mass, change, delassus, lo, hi):
    """Relax the blocks order[lo : hi] one after the other, friction of contacts last. Returns the largest change of a
    velocity."""
    worst = 0.0
    for i in range(hi - lo):
        c = rows.order[lo + i]
        kind = rows.kind[c]
        if kind == GRIP:
            worst = max(worst, _relax_grip(rows, mass, change, delassus, c, 3 * i))
        elif kind == MOTOR:
            worst = max(worst, _relax_motor(rows, mass, change, delassus, c, 3 * i))
        else:
            worst = max(worst, _relax(rows.where, rows.row, mass, change, delassus, c, 3 * i))
    for i in range(hi - lo):
        c = rows.order[lo + i]
        if rows.friction[c] > 0.0:
            most = rows.friction[c] * rows.row[c, 0, IMPULSE]
            worst = max(worst, _relax_friction(rows.where, rows.row, mass, change, delassus, c, 3 * i, most))
    return worst


@njit(**BARE)
def _short(rows, change, delassus, c, e, r):
    """What row e of a block lacks of its wanted change; r is its number in the island."""
    row = rows.row[c, e]
    if delassus is not None:
        if len(delassus.change):
            return row[WANTED] - delassus.change[r + e]
    return row[WANTED] - velocity_of(row, change, rows.where[c, 2], rows.where[c, 3])


@njit(**BARE)
def _set(rows, mass, change, delassus, c, e, r, total):
    """Give row e of a block its impulse. Returns the change of its velocity."""
    row = rows.row[c, e]
    step = total - row[IMPULSE]
    if step == 0.0:
        return 0.0
    row[IMPULSE] = total
    _spread(rows.where, row, mass, change, delassus, c, r + e, step)
    return abs(step) / row[MASS] if row[MASS] > 0.0 else 0.0


@njit(**BARE)
def _spread(where, row, mass, change, delassus, c, r, step):
    if delassus is not None:
        if len(delassus.change):
            now, effect = delassus.change, delassus.matrix[r]  # names outside of the loop: it becomes vector code
            for q in range(len(now)):
                now[q] += step * effect[q]
            return
    give(mass, row, change, where[c, 2], where[c, 3], step)


@njit(**INLINED)
def _relax(where, row, mass, change, delassus, c, r):
    """Bring a row that only pushes to its wanted velocity. Returns the change of velocity."""
    a, b, own = where[c, 2], where[c, 3], row[c, 0]
    if delassus is not None:
        if len(delassus.change):
            total = max(own[IMPULSE] + (own[WANTED] - delassus.change[r]) * own[MASS], 0.0) if own[MASS] > 0.0 else 0.0
            step = total - own[IMPULSE]
            if step == 0.0:
                return 0.0
            own[IMPULSE] = total
            _spread(where, own, mass, change, delassus, c, r, step)
            return abs(step) / own[MASS] if own[MASS] > 0.0 else 0.0
    v, w = (change[a, 0], change[a, 1], change[a, 2]), (change[a, 3], change[a, 4], change[a, 5])
    u, z = (change[b, 0], change[b, 1], change[b, 2]), (change[b, 3], change[b, 4], change[b, 5])
    axis = three(own, LINEAR)
    short = own[WANTED] - (dot(axis, sub(v, u)) + dot(three(own, ANGULAR), w) + dot(three(own, OTHER), z))
    total = max(own[IMPULSE] + short * own[MASS], 0.0)
    step = total - own[IMPULSE]
    if step == 0.0:
        return 0.0
    own[IMPULSE] = total
    v, u = along(v, axis, step * mass[a]), along(u, axis, -step * mass[b])
    w, z = along(w, three(own, TURN), step), along(z, three(own, COUNTER), step)
    for x in range(3):
        change[a, x], change[a, 3 + x], change[b, x], change[b, 3 + x] = v[x], w[x], u[x], z[x]
    return abs(step / own[MASS]) if own[MASS] > 0.0 else 0.0


@njit(**INLINED)
def _relax_friction(where, row, mass, change, delassus, c, r, most):
    """Bring both tangential rows of a contact to rest, as far as the cone of friction allows. Returns the change of
    velocity."""
    a, b, p, q = where[c, 2], where[c, 3], row[c, 1], row[c, 2]
    first, second = p[IMPULSE], q[IMPULSE]
    # One effective mass for both, so that friction is opposite to the slip.
    lesser = min(p[MASS], q[MASS])
    if delassus is not None:
        if len(delassus.change):
            lesser = lesser if lesser > 0.0 else max(p[MASS], q[MASS])  # joints allow no motion along one of them
            one = first + lesser * (p[WANTED] - delassus.change[r + 1]) if p[MASS] > 0.0 else 0.0
            other = second + lesser * (q[WANTED] - delassus.change[r + 2]) if q[MASS] > 0.0 else 0.0
            share = within(one, other, most)
            one, other = share * one - first, share * other - second
            p[IMPULSE], q[IMPULSE] = first + one, second + other
            if one != 0.0:
                _spread(where, p, mass, change, delassus, c, r + 1, one)
            if other != 0.0:
                _spread(where, q, mass, change, delassus, c, r + 2, other)
            return max(abs(one), abs(other)) / lesser if lesser > 0.0 else 0.0
    v, w = (change[a, 0], change[a, 1], change[a, 2]), (change[a, 3], change[a, 4], change[a, 5])
    u, z = (change[b, 0], change[b, 1], change[b, 2]), (change[b, 3], change[b, 4], change[b, 5])
    between = sub(v, u)
    now = dot(three(p, LINEAR), between) + dot(three(p, ANGULAR), w) + dot(three(p, OTHER), z)
    across = dot(three(q, LINEAR), between) + dot(three(q, ANGULAR), w) + dot(three(q, OTHER), z)
    one, other = first + lesser * (p[WANTED] - now), second + lesser * (q[WANTED] - across)
    share = within(one, other, most)
    one, other = share * one, share * other
    p[IMPULSE], q[IMPULSE] = one, other
    one, other = one - first, other - second
    if one == 0.0 and other == 0.0:
        return 0.0
    pull = add(scale(three(p, LINEAR), one), scale(three(q, LINEAR), other))
    v, u = along(v, pull, mass[a]), along(u, pull, -mass[b])
    w = along(along(w, three(p, TURN), one), three(q, TURN), other)
    z = along(along(z, three(p, COUNTER), one), three(q, COUNTER), other)
    for x in range(3):
        change[a, x], change[a, 3 + x], change[b, x], change[b, 3 + x] = v[x], w[x], u[x], z[x]
    return max(abs(one), abs(other)) / lesser


@njit(**BARE)
def _relax_motor(rows, mass, change, delassus, c, r):
    """Relax a motor with friction. Returns the change of velocity."""
    row, own = rows.row[c, 0], rows.own[c]
    if row[MASS] <= 0.0:
        return _set(rows, mass, change, delassus, c, 0, r, 0.0)
    effect, aim = 1.0 / row[MASS], own[AIM]
    now = aim - _short(rows, change, delassus, c, 0, r) - row[IMPULSE] * effect  # the speed without it
    if own[COMPLIANCE] > 0.0:
        total = min(max((aim - now) / (effect + own[COMPLIANCE]), -own[STRONGEST]), own[STRONGEST])
    else:
        total = _driven(now, aim, effect, own[STRONGEST], own[DRAG])
    return _set(rows, mass, change, delassus, c, 0, r, total)


@njit(**BARE)
def _driven(now, aim, effect, most, grip):
    """The impulse of a motor with friction; `now` is the speed without it."""
    sign = 1.0 if aim >= 0.0 else -1.0
    now, aim = sign * now, sign * aim
    reach = (aim - now) / effect
    if reach <= most - grip or aim == 0.0:
        if aim == 0.0:
            return sign * min(max(reach, -most - grip), most + grip)
        return sign * max(reach, -most - grip)
    stay = -now / effect
    return sign * min(max(stay, most - grip), most + grip)


@njit(**BARE)
def _relax_grip(rows, mass, change, delassus, c, r):
    """Relax the three rows of a ball joint's friction, which are bounded together. Returns the largest change."""
    row, worst = rows.row[c], 0.0
    known = row[0, IMPULSE], row[1, IMPULSE], row[2, IMPULSE]
    for e in range(3):
        total = row[e, IMPULSE] + _short(rows, change, delassus, c, e, r) * row[e, MASS]
        _set(rows, mass, change, delassus, c, e, r, total)
    length = math.sqrt(row[0, IMPULSE] ** 2 + row[1, IMPULSE] ** 2 + row[2, IMPULSE] ** 2)
    for e in range(3):
        if length > rows.own[c, DRAG]:
            _set(rows, mass, change, delassus, c, e, r, row[e, IMPULSE] * rows.own[c, DRAG] / length)
        if row[e, MASS] > 0.0:
            worst = max(worst, abs(row[e, IMPULSE] - known[e]) / row[e, MASS])
    return worst
