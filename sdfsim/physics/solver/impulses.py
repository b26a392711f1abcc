"""Sequential impulses, compiled: the effect of contacts on velocities in one inner step, island by island."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from sdfsim.physics.solver.broad_phase import frozen
from sdfsim.physics.solver.islands import islands_of
from sdfsim.physics.solver.references import reference
from sdfsim.physics.solver.vectors import (
    BARE,
    FAST,
    INLINED,
    add,
    along,
    cross,
    dot,
    get,
    norm,
    scale,
    sub,
    turn,
    vector,
)
from sdfsim.physics.solver.world import (
    FIRST,
    GAP,
    KEY,
    NORMAL,
    NORMAL_IMPULSE,
    SECOND,
    TANGENTIAL,
    TORSION,
    VOID,
)

# Columns of a row: its direction; its lever arms for the first and the second body; the change of their angular
# velocities by a unit impulse; the effective mass (the inverse of the change of the relative velocity by a unit
# impulse); the wanted change; the impulse so far.
AXIS, ARM, OTHER, SPIN, COUNTER, MASS, WANTED, IMPULSE, WIDTH = 0, 3, 6, 9, 12, 15, 16, 17, 18
TOUCH = 1e-6  # model lengths: nearer is touching, so that rounding does not decide when bodies in contact meet
AT_REST = 1e-9  # squared speed: slower tangential motion has no direction
# Limits of the energy that an island may gain: a multiple of what resolving its penetrations would give each contact
# alone; a share of the energy that its contacts bring with them; and the energy that lifts it by some slops (a stack
# lifts everything above). At most this many contacts of two bodies count: the many points of a hollow shape may gain no
# more than the corners of a box.
SPARE, ROUNDING, LIFT, FEW = 4.0, 0.01, 10.0, 4
# Bodies that approach by more than this part of their thickness in an inner step rebound before they have touched, else
# after: thin bodies would overlap deeply.
THIN = 0.005
# The larger the ratio of masses, the more slowly sweeps carry a load to lighter bodies. The number of sweeps of an
# island is multiplied by its ratio divided by the first number, at most by the second.
EVEN, OFTEN = 30.0, 30.0
MANY = 64  # number of islands from which threads pay off


class System(NamedTuple):
    """The equations for C contact points."""

    where: np.ndarray  # [C, 4] int64: manifold, point, first and second body
    row: np.ndarray  # [C, 3, WIDTH]: along the normal and two tangents
    friction: np.ndarray  # [C] product of friction
    wanted: np.ndarray  # [C] speed that resolves penetration and does not last
    pushed: np.ndarray  # [C] impulse for it so far
    # [C, 4]: the wanted change along the normal without rebound and without resolving penetration; the speed along it
    # without contact; the lasting speed that resolves penetration; and the point's share of the energy that the points
    # of two bodies may gain
    calm: np.ndarray
    start: np.ndarray  # [I + 1] int64, island i has the contacts order[start[i] : start[i + 1]]
    order: np.ndarray  # [C] int64


@njit(**FAST)
def solve_contacts(world, work, motion, rules, manifolds, threads):
    """Solve for the impulses of all contacts, and write them to the manifolds, and to `change` and `shift` of `work`.

    Returns:
        The equations that were solved.
    """
    mass, change, shift = world.inverse_mass, work.change, work.shift
    system = _equations(world, work, motion, rules, manifolds)
    rows, islands, many = reference(system), len(system.start) - 1, False
    if threads is not None:  # known when it is compiled
        many = islands >= MANY
        if many:
            _solve_many(mass, rules, rows, change, shift)
    if not many:
        for i in range(islands):
            _solve(mass, rules, rows, change, shift, i)
    remembered(manifolds, rows)
    return system


@njit(**BARE)
def remembered(manifolds, system):
    """Write impulses to the manifolds."""
    for c in range(len(system.where)):
        point = manifolds.point[system.where[c, 0], system.where[c, 1]]
        point[NORMAL_IMPULSE] = system.row[c, 0, IMPULSE]
        for x in range(3):
            one, other = system.row[c, 1], system.row[c, 2]
            point[TANGENTIAL + x] = one[IMPULSE] * one[AXIS + x] + other[IMPULSE] * other[AXIS + x]


@njit(**FAST)
def _equations(world, work, motion, rules, manifolds):
    matrix, inverse, free = work.matrix, work.inverse, work.free
    most = 0
    for m in range(len(manifolds.count)):
        if not frozen(world, motion, manifolds.pair[m, 0], manifolds.pair[m, 1]):
            most += manifolds.count[m]
    where = np.empty((most, 4), np.int64)
    row = np.zeros((most, 3, WIDTH))
    mu, wanted, pushed, calm = np.empty(most), np.empty(most), np.zeros(most), np.ones((most, 4))
    count = np.int64(0)  # a literal would be a type of its own, for which all is compiled once more
    for m in range(len(manifolds.count)):
        a, b = manifolds.pair[m, 0], manifolds.pair[m, 1]
        if frozen(world, motion, a, b):
            continue
        friction = world.friction[a] * world.friction[b] if rules.options.friction else 0.0
        bounce = world.restitution[a] * world.restitution[b] if rules.options.restitution else 0.0
        between = sub(get(motion.position, a), get(motion.position, b))
        thin = THIN * min(world.thickness[a], world.thickness[b])
        first_of_pair = count
        for k in range(manifolds.count[m]):
            point = manifolds.point[m, k]
            n = (point[NORMAL], point[NORMAL + 1], point[NORMAL + 2])
            arm = turn(matrix, a, (point[0], point[1], point[2]))
            other = turn(matrix, b, (point[3], point[4], point[5]))
            arm, other = met_half_way(between, arm, other)
            now = _relative(motion.velocity, motion.angular, a, b, arm, other)
            free_fall = add(now, _coming(free, a, b, arm, other))
            then = add(free_fall, _turning(free, a, b, arm, other))
            approach = dot(now, n)
            gap = point[GAP]
            way = -dot(then, n) * rules.substep_dt
            early = way > thin
            if point[VOID] > 0.0 or (gap > TOUCH and ((-approach > rules.slow and not early) or gap > way)):
                point[NORMAL_IMPULSE] = point[TANGENTIAL] = point[TANGENTIAL + 1] = point[TANGENTIAL + 2] = 0.0
                continue
            _row(world.inverse_mass, inverse, a, b, arm, other, n, row, count, 0)
            # Newton's rule for all contacts of one impact: without friction and with e = 1, energy is conserved.
            target, rebounds = 0.0, bounce > 0.0 and abs(approach) > rules.slow
            if rebounds:
                # Bodies that rebound before they have touched get the speed that they will have here on their way back.
                pull = (dot(free_fall, n) - approach) / rules.substep_dt
                fall = 2.0 * pull * max(gap, 0.0) * (1.0 - bounce * bounce)
                square = bounce * bounce * approach * approach + (fall if early else 0.0)
                target, rebounds = -math.copysign(math.sqrt(max(square, 0.0)), approach), square > 0.0
            # An impact is over before a body has turned: the gyroscopic torque acts after it.
            before = dot(free_fall, n) if rebounds else dot(then, n)
            deep = push = rest = 0.0
            if gap > TOUCH:
                rest = -gap / rules.substep_dt
                target = target if rebounds else rest
            elif gap > -rules.split:
                if gap < -rules.slop:
                    push = (-gap - rules.slop) * rules.erp / rules.substep_dt
                    target = max(push, target)
            else:
                deep = -gap * rules.erp / rules.substep_dt
            row[count, 0, WANTED] = target - before
            row[count, 0, IMPULSE] = point[NORMAL_IMPULSE]
            wanted[count] = deep
            calm[count, 0], calm[count, 1], calm[count, 2] = rest - before, before, push
            mu[count] = friction
            if friction > 0.0:
                if point[TORSION] < 1.0:
                    arm, other = _drawn_in(matrix, manifolds.point, m, manifolds.count[m], k, a, b, between)
                    then = add(
                        _relative(motion.velocity, motion.angular, a, b, arm, other), _coming(free, a, b, arm, other)
                    )
                    then = add(then, _turning(free, a, b, arm, other))
                slip = along(then, n, -dot(then, n))
                one = _tangent(n, slip, vector(rules.options.gravity))
                two = cross(n, one)
                _row(world.inverse_mass, inverse, a, b, arm, other, one, row, count, 1)
                _row(world.inverse_mass, inverse, a, b, arm, other, two, row, count, 2)
                row[count, 1, WANTED] = -dot(then, one)
                row[count, 2, WANTED] = -dot(then, two)
                drag = (point[TANGENTIAL], point[TANGENTIAL + 1], point[TANGENTIAL + 2])
                most_drag = friction * point[NORMAL_IMPULSE]
                first, second = dot(drag, one), dot(drag, two)
                share = _within(first, second, most_drag)
                row[count, 1, IMPULSE], row[count, 2, IMPULSE] = share * first, share * second
            where[count, 0], where[count, 1], where[count, 2], where[count, 3] = m, k, a, b
            count += 1
        for c in range(first_of_pair, count):
            calm[c, 3] = min(FEW / (count - first_of_pair), 1.0)
    start, order = islands_of(world, work.parent, work.number, where[:count])
    return System(where[:count], row[:count], mu[:count], wanted[:count], pushed[:count], calm[:count], start, order)


@njit(**BARE)
def met_half_way(between, arm, other):
    """Move both ends of a contact half way towards each other: an impulse at one point conserves angular momentum."""
    apart = add(between, sub(arm, other))
    return along(arm, apart, -0.5), along(other, apart, 0.5)


@njit(**BARE)
def _drawn_in(matrix, point, m, count, k, a, b, between):
    """Where friction acts for a point that bounds a face: nearer to the middle of the points of the same two
    patches."""
    middle, opposite, alike = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0
    for e in range(count):
        if point[m, e, KEY] == point[m, k, KEY]:
            middle = add(middle, (point[m, e, FIRST], point[m, e, FIRST + 1], point[m, e, FIRST + 2]))
            opposite = add(opposite, (point[m, e, SECOND], point[m, e, SECOND + 1], point[m, e, SECOND + 2]))
            alike += 1
    own, share = point[m, k], point[m, k, TORSION]
    arm = along(scale(middle, (1.0 - share) / alike), (own[FIRST], own[FIRST + 1], own[FIRST + 2]), share)
    other = along(scale(opposite, (1.0 - share) / alike), (own[SECOND], own[SECOND + 1], own[SECOND + 2]), share)
    return met_half_way(between, turn(matrix, a, arm), turn(matrix, b, other))


@njit(**BARE)
def _within(one, other, most):
    """The factor by which to shorten a tangential impulse so that it is within the cone of friction."""
    length = math.sqrt(one * one + other * other)
    return 1.0 if length <= most else most / length


@njit(**BARE)
def _relative(velocity, angular, a, b, arm, other):
    """Velocity of the point of the first body relative to that of the second."""
    one = add(get(velocity, a), cross(get(angular, a), arm))
    two = add(get(velocity, b), cross(get(angular, b), other))
    return sub(one, two)


@njit(**BARE)
def _coming(free, a, b, arm, other):
    one = add((free[a, 0], free[a, 1], free[a, 2]), cross((free[a, 3], free[a, 4], free[a, 5]), arm))
    two = add((free[b, 0], free[b, 1], free[b, 2]), cross((free[b, 3], free[b, 4], free[b, 5]), other))
    return sub(one, two)


@njit(**BARE)
def _turning(free, a, b, arm, other):
    """Change of the relative velocity by the gyroscopic torque."""
    return sub(cross((free[a, 6], free[a, 7], free[a, 8]), arm), cross((free[b, 6], free[b, 7], free[b, 8]), other))


@njit(**BARE)
def _tangent(n, slip, gravity):
    """The first direction of friction: along the slip, else along gravity's tangential part, else any."""
    length = dot(slip, slip)
    if length < AT_REST:
        slip = along(gravity, n, -dot(gravity, n))
        length = dot(slip, slip)
        if length < 1e-6 * dot(gravity, gravity) + 1e-30:
            axis = (1.0, 0.0, 0.0) if abs(n[0]) < 0.7 else (0.0, 1.0, 0.0)
            slip = cross(n, axis)
            length = dot(slip, slip)
    return scale(slip, 1.0 / math.sqrt(length))


@njit(**BARE)
def _row(inverse_mass, inverse, a, b, arm, other, axis, row, c, e):
    lever = cross(arm, axis)
    counter = cross(axis, other)
    spin = turn(inverse, a, lever)
    back = turn(inverse, b, counter)
    for x in range(3):
        row[c, e, AXIS + x], row[c, e, ARM + x], row[c, e, OTHER + x] = axis[x], lever[x], counter[x]
        row[c, e, SPIN + x], row[c, e, COUNTER + x] = spin[x], back[x]
    row[c, e, MASS] = 1.0 / (inverse_mass[a] + inverse_mass[b] + dot(lever, spin) + dot(counter, back))


@njit(parallel=True, **FAST)
def _solve_many(mass, rules, system, change, shift):
    for i in prange(len(system.start) - 1):
        _solve(mass, rules, system, change, shift, np.int64(i))


@njit(**BARE)
def _solve(mass, rules, system, change, shift, island):
    """Solve one island. If it would gain energy from nothing, solve it again with half of the rebounds and pushes, then
    without.

    Otherwise contradictory contacts, as of bodies that are wedged into each other, would throw them apart.
    """
    where, row, order = system.where, system.row, system.order
    lively = deep = False
    rounds = _sweeps(mass, rules, system, island)
    for o in range(system.start[island], system.start[island + 1]):
        c = order[o]
        deep = deep or system.wanted[c] > 0.0
        lively = lively or row[c, 0, WANTED] > system.calm[c, 0]
        for e in range(3 if system.friction[c] > 0.0 else 1):
            if row[c, e, IMPULSE] != 0.0:
                _apply(where, row, mass, change, c, e, row[c, e, IMPULSE])
    if deep:
        _resolve_penetration(mass, rules, system, shift, island, rounds)
    _balance(mass, rules, system, change, island, rounds)
    for share in (0.5, 0.0):
        if not lively or not _gains(rules, system, change, island):
            return
        for o in range(system.start[island], system.start[island + 1]):
            c = order[o]
            for x in range(6):
                change[where[c, 2], x] = change[where[c, 3], x] = 0.0
            for e in range(3):
                row[c, e, IMPULSE] = 0.0
            # The first time half of the difference remains, then none.
            row[c, 0, WANTED] = system.calm[c, 0] + share * (row[c, 0, WANTED] - system.calm[c, 0])
            if system.calm[c, 2] > 0.0:
                system.wanted[c] = (1.0 - share) * system.calm[c, 2]
        _resolve_penetration(mass, rules, system, shift, island, rounds)
        _balance(mass, rules, system, change, island, rounds)


@njit(**BARE)
def _sweeps(mass, rules, system, island):
    """Largest number of sweeps of an island."""
    heaviest, lightest = math.inf, 0.0  # inverse masses
    for o in range(system.start[island], system.start[island + 1]):
        for x in (2, 3):
            inverse = mass[system.where[system.order[o], x]]
            if inverse > 0.0:
                heaviest, lightest = min(heaviest, inverse), max(lightest, inverse)
    return np.int64(rules.rounds * min(max(lightest / (EVEN * heaviest), 1.0), OFTEN))


@njit(**BARE)
def _gains(rules, system, change, island):
    """Whether contacts have given an island more energy than allowed: the sum of impulses times mean velocities."""
    where, row = system.where, system.row
    work = spare = 0.0
    lift = 2.0 * norm(vector(rules.options.gravity)) * LIFT * rules.slop
    for o in range(system.start[island], system.start[island + 1]):
        c = system.order[o]
        before, push, share = system.calm[c, 1], system.calm[c, 2], system.calm[c, 3]
        spare += 0.5 * share * row[c, 0, MASS] * (SPARE * push * push + ROUNDING * before * before + lift)
        work += row[c, 0, IMPULSE] * (before + 0.5 * _speed(where, row, change, c, 0))
        for e in range(1, 3 if system.friction[c] > 0.0 else 1):
            work += row[c, e, IMPULSE] * (0.5 * _speed(where, row, change, c, e) - row[c, e, WANTED])
    return work > spare


@njit(**BARE)
def _resolve_penetration(mass, rules, system, shift, island, rounds):
    """Separate bodies that overlap deeply, by velocities that move them once and do not last."""
    where, row, order = system.where, system.row, system.order
    for _ in range(rounds):
        worst = 0.0
        for o in range(system.start[island], system.start[island + 1]):
            c = order[o]
            if system.wanted[c] > 0.0:
                short = system.wanted[c] - _speed(where, row, shift, c, 0)
                total = max(system.pushed[c] + short * row[c, 0, MASS], 0.0)
                step = total - system.pushed[c]
                system.pushed[c] = total
                _apply(where, row, mass, shift, c, 0, step)
                worst = max(worst, abs(step / row[c, 0, MASS]))
        if worst <= rules.exact:
            break


@njit(**BARE)
def _balance(mass, rules, system, change, island, rounds):
    """Relax all normals, then all friction, until no impulse changes a velocity by more than `exact`."""
    where, row, order, friction = system.where, system.row, system.order, system.friction
    first, last = system.start[island], system.start[island + 1]
    for _ in range(rounds):
        worst = 0.0
        for o in range(first, last):
            c = order[o]
            worst = max(worst, _relax(where, row, mass, change, c))
        for o in range(first, last):
            c = order[o]
            if friction[c] > 0.0:
                most = friction[c] * row[c, 0, IMPULSE]
                worst = max(worst, _relax_friction(where, row, mass, change, c, most))
        if worst <= rules.exact:
            break


@njit(**INLINED)
def _relax(where, row, mass, change, c):
    """Bring the normal row of a contact to its wanted velocity, by a push. Returns the change of velocity."""
    a, b = where[c, 2], where[c, 3]
    v, w = (change[a, 0], change[a, 1], change[a, 2]), (change[a, 3], change[a, 4], change[a, 5])
    u, z = (change[b, 0], change[b, 1], change[b, 2]), (change[b, 3], change[b, 4], change[b, 5])
    axis = _three(row, c, 0, AXIS)
    short = row[c, 0, WANTED] - _along_row(row, c, 0, sub(v, u), w, z)
    total = max(row[c, 0, IMPULSE] + short * row[c, 0, MASS], 0.0)
    step = total - row[c, 0, IMPULSE]
    if step == 0.0:
        return 0.0
    row[c, 0, IMPULSE] = total
    v, u = along(v, axis, step * mass[a]), along(u, axis, -step * mass[b])
    w, z = along(w, _three(row, c, 0, SPIN), step), along(z, _three(row, c, 0, COUNTER), step)
    for x in range(3):
        change[a, x], change[a, 3 + x], change[b, x], change[b, 3 + x] = v[x], w[x], u[x], z[x]
    return abs(step / row[c, 0, MASS])


@njit(**INLINED)
def _relax_friction(where, row, mass, change, c, most):
    """Bring both tangential rows of a contact to rest, as far as the cone of friction allows. Returns the change of
    velocity."""
    a, b = where[c, 2], where[c, 3]
    v, w = (change[a, 0], change[a, 1], change[a, 2]), (change[a, 3], change[a, 4], change[a, 5])
    u, z = (change[b, 0], change[b, 1], change[b, 2]), (change[b, 3], change[b, 4], change[b, 5])
    first, second = row[c, 1, IMPULSE], row[c, 2, IMPULSE]
    # One effective mass for both, so that friction is opposite to the slip.
    lesser = min(row[c, 1, MASS], row[c, 2, MASS])
    between = sub(v, u)
    one = first + lesser * (row[c, 1, WANTED] - _along_row(row, c, 1, between, w, z))
    other = second + lesser * (row[c, 2, WANTED] - _along_row(row, c, 2, between, w, z))
    share = _within(one, other, most)
    one, other = share * one, share * other
    row[c, 1, IMPULSE], row[c, 2, IMPULSE] = one, other
    one, other = one - first, other - second
    if one == 0.0 and other == 0.0:
        return 0.0
    pull = add(scale(_three(row, c, 1, AXIS), one), scale(_three(row, c, 2, AXIS), other))
    v, u = along(v, pull, mass[a]), along(u, pull, -mass[b])
    w = along(along(w, _three(row, c, 1, SPIN), one), _three(row, c, 2, SPIN), other)
    z = along(along(z, _three(row, c, 1, COUNTER), one), _three(row, c, 2, COUNTER), other)
    for x in range(3):
        change[a, x], change[a, 3 + x], change[b, x], change[b, 3 + x] = v[x], w[x], u[x], z[x]
    return max(abs(one), abs(other)) / lesser


@njit(**BARE, inline="always")
def _three(row, c, e, column):
    return row[c, e, column], row[c, e, column + 1], row[c, e, column + 2]


@njit(**BARE)
def _along_row(row, c, e, between, w, z):
    """The relative velocity along a row, from the difference of two bodies' velocities and from their angular
    velocities."""
    return dot(_three(row, c, e, AXIS), between) + dot(_three(row, c, e, ARM), w) + dot(_three(row, c, e, OTHER), z)


@njit(**BARE)
def _speed(where, row, change, c, e):
    """The effect of `change` on the relative velocity along a row."""
    a, b = where[c, 2], where[c, 3]
    total = 0.0
    for x in range(3):
        total += row[c, e, AXIS + x] * (change[a, x] - change[b, x])
        total += row[c, e, ARM + x] * change[a, 3 + x] + row[c, e, OTHER + x] * change[b, 3 + x]
    return total


@njit(**BARE)
def _apply(where, row, mass, change, c, e, impulse):
    a, b = where[c, 2], where[c, 3]
    one, other = impulse * mass[a], impulse * mass[b]
    for x in range(3):
        change[a, x] += one * row[c, e, AXIS + x]
        change[b, x] -= other * row[c, e, AXIS + x]
        change[a, 3 + x] += impulse * row[c, e, SPIN + x]
        change[b, 3 + x] += impulse * row[c, e, COUNTER + x]
