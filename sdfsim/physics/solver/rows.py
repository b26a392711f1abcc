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

from sdfsim.physics.solver.tolerances import LOCKED, RIGID
from sdfsim.physics.solver.vectors import BARE, INLINED, add, along, cross, dot, scale, sub, three, turn
from sdfsim.physics.solver.world import END, START, kick_of

# Columns of a row. Jacobian: the direction at the first body (its opposite at the second), and about both centres of
# mass; response: what a unit impulse adds to both angular velocities; the effective mass (the inverse of the change of
# the row's velocity by a unit impulse and by its compliance, 0 if nothing moves along it); the wanted change; the
# impulse so far; that of an impact with all of its rebound; and the compliance, by which the row lags behind its wanted
# change for a unit impulse.
LINEAR, ANGULAR, OTHER, TURN, COUNTER, MASS, WANTED, IMPULSE, REBOUND, SOFT, WIDTH = (
    0, 3, 6, 9, 12, 15, 16, 17, 18, 19, 20,
)  # fmt: skip
# Kinds of blocks. A coupling is two blocks, one for each of its joints, with one impulse: the leader's comes after
# the follower's.
CONTACT, LIMIT, MOTOR, GRIP, FOLLOWER, LEADER = range(6)
# Columns of `Rows.own` by kind. Contacts: the wanted change along the normal without rebound, and the speed along it
# without contact.
CALM, BEFORE = range(2)
# Limits: the distance to it that must be left after the inner step (infinite if it rebounds), and 1 for the lower limit
# or -1 for the upper.
LEFT, SIDE = range(2)
# Motors: the speed to reach; the largest impulses of the motor and of friction. Friction of balls has its largest
# impulse in the same column.
AIM, STRONGEST, DRAG = range(3)


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
    """The effect of unit impulses of an island's R rows on all of them through joints, and the velocities along the
    rows so far. [0, 0] and [0] if the island has too many rows."""

    at: np.ndarray  # [C] int64, the first row of each block
    block: np.ndarray  # [R] int64, the block of each row
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
def later(z):
    """The share that the velocity after a kick has in the mean that damps exactly; `z` is the damping relative to what
    stops the row in the kick."""
    return 0.5 + z / 12.0 if z < 0.01 else 1.0 / (1.0 - math.exp(-z)) - 1.0 / z


@njit(**BARE)
def softness(stiff, damping, coarse, away, before, mass, h, phase):
    """The impulse of a spring with damping in a kick as a row: the wanted velocity and the compliance.

    The spring acts with the mean of its forces before and after each move, so that it keeps its energy for any
    stiffness (Newmark's method with beta 1/4): with the kick k h and the row's velocities u before and v after it, the
    impulse is k h stiff away + h^2 stiff / 4 (u - v), without u at the start of a step, where no move comes before, and
    without v at its end. `coarse` adds damping.
    """
    span = kick_of(phase) * h
    late = later(damping * span / mass)
    rate = damping * span * late + RIGID * mass
    push = span * (stiff * away - damping * (1.0 - late) * before)
    if phase != END:
        rate += h * h * stiff * (0.25 + coarse)
    if phase != START:
        push += 0.25 * h * h * stiff * before
    return push / rate, 1.0 / rate


@njit(**BARE)
def soften(row, compliance):
    """Give a row its compliance."""
    row[SOFT] = compliance
    if row[MASS] > 0.0:
        row[MASS] = 1.0 / (1.0 / row[MASS] + compliance)


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
def sweep(rows, work, delassus, lo, hi):
    """Relax the blocks order[lo : hi] one after the other, friction of contacts last. `delassus` is None if no joints
    hold their bodies. Returns the largest change of a velocity."""
    worst = 0.0
    for i in range(lo, hi):
        c = rows.order[i]
        if delassus is None:
            worst = max(worst, _relax(rows.where, rows.row, work.inverse_mass, work.change, c))
        elif rows.kind[c] == GRIP:
            worst = max(worst, _relax_grip(rows, work, delassus, c))
        elif rows.kind[c] == FOLLOWER:
            worst = max(worst, _relax_coupling(rows, work, delassus, c))
        elif rows.kind[c] == LEADER:
            continue
        else:
            worst = max(worst, _relax_one(rows, work, delassus, c))
    for i in range(lo, hi):
        c = rows.order[i]
        if rows.friction[c] > 0.0:
            most = rows.friction[c] * rows.row[c, 0, IMPULSE]
            if delassus is None:
                worst = max(worst, _relax_friction(rows.where, rows.row, work.inverse_mass, work.change, c, most))
            else:
                worst = max(worst, _relax_held_friction(rows, work, delassus, c, most))
    return worst


@njit(**BARE)
def rows_of(rows, c):
    """Number of rows of a block."""
    return 3 if rows.friction[c] > 0.0 or rows.kind[c] == GRIP else 1


@njit(**INLINED)
def _relax(where, row, mass, change, c):
    """Bring a row that only pushes to its wanted velocity. Returns the change of velocity."""
    a, b, own = where[c, 2], where[c, 3], row[c, 0]
    v, w = (change[a, 0], change[a, 1], change[a, 2]), (change[a, 3], change[a, 4], change[a, 5])
    u, z = (change[b, 0], change[b, 1], change[b, 2]), (change[b, 3], change[b, 4], change[b, 5])
    axis = three(own, LINEAR)
    short = own[WANTED] - (dot(axis, sub(v, u)) + dot(three(own, ANGULAR), w) + dot(three(own, OTHER), z))
    short -= own[SOFT] * own[IMPULSE]
    total = max(own[IMPULSE] + short * own[MASS], 0.0)
    step = total - own[IMPULSE]
    if step == 0.0:
        return 0.0
    own[IMPULSE] = total
    v, u = along(v, axis, step * mass[a]), along(u, axis, -step * mass[b])
    w, z = along(w, three(own, TURN), step), along(z, three(own, COUNTER), step)
    for x in range(3):
        change[a, x], change[a, 3 + x], change[b, x], change[b, 3 + x] = v[x], w[x], u[x], z[x]
    return abs(step / own[MASS])


@njit(**INLINED)
def _relax_friction(where, row, mass, change, c, most):
    """Bring both tangential rows of a contact to rest, as far as the cone of friction allows. Returns the change of
    velocity."""
    a, b, p, q = where[c, 2], where[c, 3], row[c, 1], row[c, 2]
    first, second = p[IMPULSE], q[IMPULSE]
    # One effective mass for both, so that friction is opposite to the slip.
    lesser = min(p[MASS], q[MASS])
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


@njit(**INLINED)
def _short(rows, work, delassus, c, e):
    """What row e of a block lacks of its wanted change."""
    wanted = rows.row[c, e, WANTED] - rows.row[c, e, SOFT] * rows.row[c, e, IMPULSE]
    if len(delassus.change):
        return wanted - delassus.change[delassus.at[c] + e]
    return wanted - velocity_of(rows.row[c, e], work.change, rows.where[c, 2], rows.where[c, 3])


@njit(**INLINED)
def _set(rows, work, delassus, c, e, total):
    """Give row e of a block its impulse. Returns the change of its velocity."""
    step = total - rows.row[c, e, IMPULSE]
    if step == 0.0:
        return 0.0
    rows.row[c, e, IMPULSE] = total
    if len(delassus.change):
        now, effect = (
            delassus.change,
            delassus.matrix[delassus.at[c] + e],
        )  # outside of the loop: it becomes vector code
        for q in range(len(now)):
            now[q] += step * effect[q]
    else:
        give(work.inverse_mass, rows.row[c, e], work.change, rows.where[c, 2], rows.where[c, 3], step)
    return abs(step) / rows.row[c, e, MASS] if rows.row[c, e, MASS] > 0.0 else 0.0


@njit(**BARE)
def _relax_one(rows, work, delassus, c):
    """Relax the first row of a contact, a limit or a motor. Returns the change of velocity."""
    mass, before, own = rows.row[c, 0, MASS], rows.row[c, 0, IMPULSE], rows.own[c]
    short, total = _short(rows, work, delassus, c, 0), 0.0
    if mass > 0.0:  # else joints allow no motion along it
        total = before + short * mass
        if rows.kind[c] != MOTOR:
            total = max(total, 0.0)
        elif rows.row[c, 0, SOFT] > 0.0:
            total = min(max(total, -own[STRONGEST]), own[STRONGEST])
        else:
            total = _driven(own[AIM] - total / mass, own[AIM], 1.0 / mass, own[STRONGEST], own[DRAG])
    return _set(rows, work, delassus, c, 0, total)


@njit(**BARE)
def _relax_held_friction(rows, work, delassus, c, most):
    """`_relax_friction` for bodies that joints may hold."""
    mass, other_mass = rows.row[c, 1, MASS], rows.row[c, 2, MASS]
    lesser = min(mass, other_mass)
    lesser = lesser if lesser > 0.0 else max(mass, other_mass)  # joints may allow no motion along one of them
    one = other = 0.0
    if mass > 0.0:
        one = rows.row[c, 1, IMPULSE] + lesser * _short(rows, work, delassus, c, 1)
    if other_mass > 0.0:
        other = rows.row[c, 2, IMPULSE] + lesser * _short(rows, work, delassus, c, 2)
    share = within(one, other, most)
    worst = _set(rows, work, delassus, c, 1, share * one)
    return max(worst, _set(rows, work, delassus, c, 2, share * other))


@njit(**BARE)
def _relax_grip(rows, work, delassus, c):
    """Relax the three rows of a ball joint's friction, which are bounded together. Returns the largest change."""
    row, worst = rows.row[c], 0.0
    known = row[0, IMPULSE], row[1, IMPULSE], row[2, IMPULSE]
    for e in range(3):
        total = row[e, IMPULSE] + _short(rows, work, delassus, c, e) * row[e, MASS]
        _set(rows, work, delassus, c, e, total)
    length = math.sqrt(row[0, IMPULSE] ** 2 + row[1, IMPULSE] ** 2 + row[2, IMPULSE] ** 2)
    for e in range(3):
        if length > rows.own[c, DRAG]:
            _set(rows, work, delassus, c, e, row[e, IMPULSE] * rows.own[c, DRAG] / length)
        if row[e, MASS] > 0.0:
            worst = max(worst, abs(row[e, IMPULSE] - known[e]) / row[e, MASS])
    return worst


@njit(**BARE)
def _relax_coupling(rows, work, delassus, c):
    """Relax the two rows of a coupling, whose velocities add up. Returns the largest change."""
    mass, other = rows.row[c, 0, MASS], rows.row[c + 1, 0, MASS]
    alone = (1.0 / mass if mass > 0.0 else 0.0) + (1.0 / other if other > 0.0 else 0.0)
    effect = 2.0 * alone  # no less than it can be with a body in common
    if len(delassus.change):
        p, q = delassus.at[c], delassus.at[c + 1]
        effect = delassus.matrix[p, p] + delassus.matrix[p, q] + delassus.matrix[q, p] + delassus.matrix[q, q]
    if effect <= LOCKED * alone:
        return 0.0
    short = _short(rows, work, delassus, c, 0) + _short(rows, work, delassus, c + 1, 0)
    total = rows.row[c, 0, IMPULSE] + short / effect
    _set(rows, work, delassus, c, 0, total)
    _set(rows, work, delassus, c + 1, 0, total)
    return abs(short)


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
