"""Rows of contacts, compiled: today's law of contact, one block of rows for each point."""

from __future__ import annotations

import math

from numba import njit

from sdfsim.physics.solver.broad_phase import frozen
from sdfsim.physics.solver.rows import (
    BEFORE,
    CALM,
    CONTACT,
    IMPULSE,
    LINEAR,
    MASS,
    WANTED,
    respond,
    soften,
    softness,
    within,
    write_point,
)
from sdfsim.physics.solver.tolerances import EVENED, MET, NO_PULL, NO_SLIP, RESOLVED, THIN_EARLY, TOGETHER
from sdfsim.physics.solver.vectors import BARE, add, along, cross, dot, get, scale, sub, three, turn, vector
from sdfsim.physics.solver.world import (
    END,
    FIRST,
    GAP,
    KEY,
    NORMAL,
    NORMAL_IMPULSE,
    SECOND,
    START,
    TANGENTIAL,
    TORSION,
    VOID,
    kick_of,
)


@njit(**BARE)
def most_contacts(world, motion, manifolds):
    """Number of contact points of bodies that are awake."""
    most = 0
    for m in range(len(manifolds.count)):
        if not frozen(world, motion, manifolds.pair[m, 0], manifolds.pair[m, 1]):
            most += manifolds.count[m]
    return most


@njit(**BARE)
def contact_rows(world, work, motion, rules, manifolds, rows, phase):
    """Write the rows of all contacts that act. Returns the number of blocks.

    At the end of a step the contacts act that have pushed in its last inner step, and those that rest on each other
    within the slop: bodies do not approach there.
    """
    free, h, kick = work.free, rules.substep_dt, kick_of(phase)
    # At the end of a step, contact points have not been searched again after the last move. They are taken where they
    # were before it: at a body that rolls, they would have moved backwards with its surface, and their push would drive
    # it.
    matrix = work.matrix_before if phase == END else work.matrix
    position = work.position_before if phase == END else motion.position
    row, count = rows.row, 0
    for m in range(len(manifolds.count)):
        a, b = manifolds.pair[m, 0], manifolds.pair[m, 1]
        if frozen(world, motion, a, b):
            continue
        friction = world.friction[a] * world.friction[b] if rules.options.friction else 0.0
        bounce = world.restitution[a] * world.restitution[b] if rules.options.restitution else 0.0
        stiff, damping = _stiffness(world, manifolds, m, a, b)
        between = sub(get(position, a), get(position, b))
        thin = THIN_EARLY * min(world.thickness[a], world.thickness[b])
        first = count
        for k in range(manifolds.count[m]):
            point = manifolds.point[m, k]
            n = three(point, NORMAL)
            mine, theirs = turn(matrix, a, three(point, FIRST)), turn(matrix, b, three(point, SECOND))
            arm, other = met_half_way(between, mine, theirs)
            now = _relative(motion.velocity, motion.angular, a, b, arm, other)
            coming = _coming(free, a, b, arm, other)
            free_fall = add(now, coming)
            then = add(free_fall, _turning(free, a, b, arm, other))
            # The mean over the inner step before: velocities are those at an instant only at the start of a step.
            approach = dot(sub(now, coming), n) if phase == START else dot(now, n)
            gap = point[GAP]
            way = -dot(then, n) * h
            early = way > thin
            too_far = gap > MET and ((-approach > rules.slow and not early) or gap > way)
            if phase == END:
                too_far = point[NORMAL_IMPULSE] == 0.0 and (gap + h * approach > rules.slop or -approach > rules.slow)
            if stiff < math.inf:
                too_far = gap > 0.0
            if point[VOID] > 0.0 or too_far:
                continue
            # Newton's rule for all contacts of one impact: without friction and with e = 1, energy is conserved.
            target, rebounds = 0.0, phase != END and bounce > 0.0 and abs(approach) > rules.slow and stiff == math.inf
            if rebounds:
                # Bodies that rebound before they have touched get the speed that they will have here on their way back.
                fall = 2.0 * dot(coming, n) / (kick * h) * max(gap, 0.0) * (1.0 - bounce * bounce)
                square = bounce * bounce * approach * approach + (fall if early else 0.0)
                target, rebounds = -math.copysign(math.sqrt(max(square, 0.0)), approach), square > 0.0
            # What rebounds from the ground does so where its surface meets it, however far that is now. The ground
            # takes any angular momentum; between two bodies an impulse at two places would not conserve it.
            if rebounds and (work.inverse_mass[a] == 0.0 or work.inverse_mass[b] == 0.0):
                arm, other = mine, theirs
            # An impact is over before a body has turned: the gyroscopic torque acts after it.
            before = dot(free_fall, n) if rebounds else dot(then, n)
            deep = rest = 0.0
            if phase != END and stiff == math.inf:
                if gap > MET:
                    rest = -gap / h
                    target = target if rebounds else rest
                else:
                    deep = max(-gap - rules.slop, 0.0) * rules.erp / h
                    # What rolls along a hollow goes inwards as the surface turns. That much of the speed may last: it
                    # leads along the chord, where moving the body alone would lift it for nothing.
                    inwards = -dot(now, n)
                    if 0.0 < inwards <= rules.slow and not rebounds:
                        target = rest = min(deep, inwards)
            rows.kind[count] = CONTACT
            rows.where[count, 0], rows.where[count, 1], rows.where[count, 2], rows.where[count, 3] = m, k, a, b
            write_point(row[count, 0], n, arm, other)
            respond(work, rules, row[count, 0], a, b)
            if stiff < math.inf and row[count, 0, MASS] > 0.0:
                # At the end of a step the distance is that before the last move.
                away = -gap - (h * dot(now, n) if phase == END else 0.0)
                coarse = max(0.0, 1.0 - RESOLVED * row[count, 0, MASS] / (stiff * h * h))
                target, soft = softness(stiff, damping, coarse, away, dot(now, n), row[count, 0, MASS], h, phase)
                soften(row[count, 0], soft)
                rest = target
            row[count, 0, WANTED] = target - before
            row[count, 0, IMPULSE] = kick * point[NORMAL_IMPULSE]
            rows.deep[count], rows.parted[count], rows.friction[count] = deep, 0.0, friction
            rows.own[count, CALM], rows.own[count, BEFORE] = rest - before, before
            for e in range(1, 3):
                row[count, e, IMPULSE] = 0.0
            if friction > 0.0:
                if point[TORSION] < 1.0:
                    arm, other = _drawn_in(matrix, manifolds.point, m, manifolds.count[m], k, a, b, between)
                if point[TORSION] < 1.0 or rebounds:
                    then = add(
                        _relative(motion.velocity, motion.angular, a, b, arm, other), _coming(free, a, b, arm, other)
                    )
                    then = add(then, _turning(free, a, b, arm, other))
                # At the end of a step the arms are those before its last move.
                then = add(then, _bending(motion.angular, a, b, arm, other, h if phase == END else 0.5 * h))
                one = _tangent(n, along(then, n, -dot(then, n)), vector(rules.options.gravity))
                drag = three(point, TANGENTIAL)
                for e in range(1, 3):
                    axis = one if e == 1 else cross(n, one)
                    write_point(row[count, e], axis, arm, other)
                    respond(work, rules, row[count, e], a, b)
                    row[count, e, WANTED] = -dot(then, axis)
                    row[count, e, IMPULSE] = kick * dot(drag, axis)
                share = within(row[count, 1, IMPULSE], row[count, 2, IMPULSE], friction * row[count, 0, IMPULSE])
                row[count, 1, IMPULSE] *= share
                row[count, 2, IMPULSE] *= share
            count += 1
        for k in range(manifolds.count[m]):
            if first < count and rows.where[first, 1] == k:
                first += 1
            else:  # it does not act
                for x in range(NORMAL_IMPULSE, KEY):
                    manifolds.point[m, k, x] = 0.0
    return count


@njit(**BARE)
def even_out(manifolds, graph, rules):
    """Move the impulses from which the points of a body in a joint begin towards their mean. What a joint keeps from
    turning may press with any one of its corners, and the first row would take it all: friction would then act there
    alone, and a body in a grip turn about that corner."""
    for m in range(len(manifolds.count)):
        if graph.of_body[manifolds.pair[m, 0]] < 0 and graph.of_body[manifolds.pair[m, 1]] < 0:
            continue
        points, count = manifolds.point[m], manifolds.count[m]
        for k in range(count):
            total, others, first = 0.0, 0, k
            for e in range(count):
                if points[e, KEY] == points[k, KEY] and points[e, GAP] <= rules.slop:
                    total, others, first = total + points[e, NORMAL_IMPULSE], others + 1, min(first, e)
            if first == k and others > 1:  # once for all points of two patches
                for e in range(k, count):
                    if points[e, KEY] == points[k, KEY] and points[e, GAP] <= rules.slop:
                        points[e, NORMAL_IMPULSE] += EVENED * (total / others - points[e, NORMAL_IMPULSE])


@njit(**BARE)
def _stiffness(world, manifolds, m, a, b):
    """The stiffness and the damping of each point of two bodies: those of both bodies in series, shared by the points
    that touch. Infinite and 0 for rigid bodies."""
    compliance = world.compliance[a] + world.compliance[b]
    if compliance == 0.0:
        return math.inf, 0.0
    points = 0
    for k in range(manifolds.count[m]):
        points += manifolds.point[m, k, GAP] <= 0.0 and manifolds.point[m, k, VOID] == 0.0
    one, other = world.compliance[a] / compliance, world.compliance[b] / compliance
    damping = world.damping[a] * one * one + world.damping[b] * other * other
    return 1.0 / (compliance * max(points, 1)), damping / max(points, 1)


@njit(**BARE)
def remember(manifolds, rows, phase):
    """Write impulses to the manifolds, as those of a whole inner step."""
    whole = 1.0 / kick_of(phase)
    for c in range(len(rows.where)):
        if rows.kind[c] != CONTACT:
            continue
        point = manifolds.point[rows.where[c, 0], rows.where[c, 1]]
        point[NORMAL_IMPULSE] = whole * rows.row[c, 0, IMPULSE]
        for x in range(3):
            one, other = rows.row[c, 1], rows.row[c, 2]
            drag = one[IMPULSE] * one[LINEAR + x] + other[IMPULSE] * other[LINEAR + x]
            point[TANGENTIAL + x] = whole * drag if rows.friction[c] > 0.0 else 0.0


@njit(**BARE)
def met_half_way(between, arm, other):
    """Move both ends of a contact half way towards each other: an impulse at one point conserves angular momentum."""
    apart = add(between, sub(arm, other))
    return along(arm, apart, -0.5), along(other, apart, 0.5)


@njit(**BARE)
def _drawn_in(matrix, point, m, count, k, a, b, between):
    """Where friction acts for a point that bounds a face: nearer to the middle of the points of the same two
    patches."""
    middle, opposite, total = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
    # Each point counts as it is loaded, so that friction keeps the resultant of the load.
    loaded = point[m, k, NORMAL_IMPULSE] > 0.0
    for e in range(count):
        if point[m, e, KEY] == point[m, k, KEY]:
            load = point[m, e, NORMAL_IMPULSE] if loaded else 1.0
            middle = along(middle, three(point[m, e], FIRST), load)
            opposite = along(opposite, three(point[m, e], SECOND), load)
            total += load
    own, share = point[m, k], point[m, k, TORSION]
    arm = along(scale(middle, (1.0 - share) / total), three(own, FIRST), share)
    other = along(scale(opposite, (1.0 - share) / total), three(own, SECOND), share)
    return met_half_way(between, turn(matrix, a, arm), turn(matrix, b, other))


@njit(**BARE)
def _relative(velocity, angular, a, b, arm, other):
    """Velocity of the point of the first body relative to that of the second."""
    one = add(get(velocity, a), cross(get(angular, a), arm))
    two = add(get(velocity, b), cross(get(angular, b), other))
    return sub(one, two)


@njit(**BARE)
def _coming(free, a, b, arm, other):
    """Change of the relative velocity by gravity and pulls."""
    one = add((free[a, 0], free[a, 1], free[a, 2]), cross((free[a, 3], free[a, 4], free[a, 5]), arm))
    two = add((free[b, 0], free[b, 1], free[b, 2]), cross((free[b, 3], free[b, 4], free[b, 5]), other))
    return sub(one, two)


@njit(**BARE)
def _turning(free, a, b, arm, other):
    """Change of the relative velocity by the gyroscopic torque."""
    return sub(cross((free[a, 6], free[a, 7], free[a, 8]), arm), cross((free[b, 6], free[b, 7], free[b, 8]), other))


@njit(**BARE)
def _bending(angular, a, b, arm, other, later):
    """Change of the relative velocity a little `later`, as both arms turn, for bodies that turn together: what sticks
    to a turntable moves along its circle and not along the tangent. (What rolls touches elsewhere then.) Bounded for
    bodies that turn far in that time."""
    one, two = get(angular, a), get(angular, b)
    off = sub(one, two)
    if dot(off, off) >= TOGETHER * (dot(one, one) + dot(two, two)):
        return 0.0, 0.0, 0.0
    mine = scale(cross(one, cross(one, arm)), later / (1.0 + dot(one, one) * later * later))
    return sub(mine, scale(cross(two, cross(two, other)), later / (1.0 + dot(two, two) * later * later)))


@njit(**BARE)
def _tangent(n, slip, gravity):
    """The first direction of friction: along the slip, else along gravity's tangential part, else any."""
    length = dot(slip, slip)
    if length < NO_SLIP:
        slip = along(gravity, n, -dot(gravity, n))
        length = dot(slip, slip)
        if length < NO_PULL * dot(gravity, gravity) + 1e-30:
            axis = (1.0, 0.0, 0.0) if abs(n[0]) < 0.7 else (0.0, 1.0, 0.0)
            slip = cross(n, axis)
            length = dot(slip, slip)
    return scale(slip, 1.0 / math.sqrt(length))
