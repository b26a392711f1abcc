"""Joints, compiled: the rows that hold bodies together are solved exactly, beside contacts and what else is bounded.

In an inner step, impulses act along the rows where bodies are at its start, and are such that the rows hold where
bodies are at its end (SHAKE, with the exact free rotation in between): this keeps energy as the step without joints
does, and nothing drifts. What bounds them (limits, motors, friction, contacts) is solved in turn, each seeing through
the joints.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from sdfsim.physics.joints import (
    BALL,
    BEND,
    BOUNCE,
    BROKEN,
    COORD,
    DAMPING,
    DISTANCE,
    DRAG,
    DRIVE,
    FORCE,
    FRESH,
    GIVEN,
    HIGH,
    HINGE,
    LENGTH,
    LOW,
    MOST,
    MOTOR,
    PULL,
    REST,
    SLIDER,
    SOFT,
    SPEED,
    STIFFNESS,
    STOP,
    TARGET,
    TIME,
    TORQUE,
    TWIST,
)
from sdfsim.physics.solver.flight import pull_of, torque_free
from sdfsim.physics.solver.impulses import (
    ARM,
    AXIS,
    COUNTER,
    IMPULSE,
    OTHER,
    SPIN,
    WANTED,
    WIDTH,
    System,
    _equations,
    _gains,
    _resolve_penetration,
    _solve,
    _within,
    remembered,
)
from sdfsim.physics.solver.islands import join, root
from sdfsim.physics.solver.vectors import (
    BARE,
    FAST,
    add,
    along,
    cross,
    dot,
    get,
    norm,
    put,
    scale,
    sub,
    to_matrix,
    turn,
    turned_by,
)

ROWS = 6
STRETCH = 1e-7  # model lengths (and rad): rows that hold worse are mended by moving bodies
REACH = 0.05  # by at most so much in an inner step
HOLDS = 1e-11  # model lengths (and rad): better need no row hold
ROUNDS = 6  # of the search for impulses after which rows hold
SOFTEN = 1e-10  # of what a unit of impulse does along a row: where rows say the same twice, both are satisfied
GIVES = 0.2  # the share of what is beyond a limit that an inner step resolves
AHEAD = 0.05  # model lengths (and rad): limits that are nearer are looked at
EXACT = 0.01  # of the precision that impulses of contacts alone are solved to
DENSE = 240  # bounded rows of an island up to which each sees what it does through all joints


class Trial(NamedTuple):
    """Where bodies would be: position [N, 3], orientation [N, 4], velocity and angular [N, 3]."""

    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    angular: np.ndarray


class Held(NamedTuple):
    """J joints of N bodies. The bodies that move and the joints are K nodes of a graph, in the order in which they are
    eliminated; the nodes from comp[c] to comp[c + 1] are connected."""

    body: np.ndarray  # [J, 2] int64, -1 for the world
    kind: np.ndarray  # [J] int64
    anchor: np.ndarray  # [J, 2, 3] from the centres of mass, in the bodies' axes
    axes: np.ndarray  # [J, 2, 3, 3] the joint's three axes in those of the bodies
    number: np.ndarray  # [J, NUMBERS]
    comp: np.ndarray  # [C + 1] int64
    node: np.ndarray  # [K] int64: a body, or -1 - j for joint j
    of_body: np.ndarray  # [N] int64, the node of a body, -1 for those that no joint holds or that do not move
    entry: np.ndarray  # [J, 2] int64, the block where a joint meets its body, -1 where that does not move
    below: np.ndarray  # [K + 1] int64, the blocks below the diagonal of a column
    row: np.ndarray  # [F] int64, the node whose row a block is in
    start: np.ndarray  # [K + 1] int64, the targets of a column
    target: np.ndarray  # [U] int64, block that a pair of blocks of a column adds to; -1 - k for the diagonal of node k
    state: np.ndarray  # [J, STATE]
    # What is made of it in an inner step. line [J, ROWS, 12]: how a row reads the velocities of both bodies; active
    # [J, ROWS] int64: 0 for none, 1 for one that holds, 2 for a spring; soft [J, ROWS]: how much a unit of impulse
    # gives way; wanted, impulse, error, later [J, ROWS]
    line: np.ndarray
    active: np.ndarray
    soft: np.ndarray
    wanted: np.ndarray
    impulse: np.ndarray
    error: np.ndarray
    later: np.ndarray
    axis: np.ndarray  # [J, 1, 12] the row along which a joint moves
    # diagonal, inverse [K, 6, 6]; block, low [F, 6, 6]; x [K, 6]
    diagonal: np.ndarray
    inverse: np.ndarray
    block: np.ndarray
    low: np.ndarray
    x: np.ndarray
    eased: np.ndarray  # [1, 24], its latter half: what a unit of impulse makes of velocities, for a moment
    trial: Trial
    frame: np.ndarray  # [N, 3, 3] of the trial
    # turned [1, 4], tried [1, 3, 3]: of one body amid it
    turned: np.ndarray
    tried: np.ndarray
    reply: np.ndarray  # [N, 6] what an impulse makes of velocities through the joints
    calm: np.ndarray  # [N] bool, whether joints hold a body that nothing else touches


# Kinds of bounded rows: of contacts, normal and tangential (two rows); of joints, limits, motors with friction, and the
# friction of a ball (three rows).
NORMAL_ROW, TANGENT_ROW, STOP_ROW, DRIVE_ROW, GRIP_ROW = range(5)


class Bounded(NamedTuple):
    """R bounded rows of an island."""

    kind: np.ndarray  # [R] int64
    of: np.ndarray  # [R] int64, the contact or the joint
    body: np.ndarray  # [R, 2] int64
    # [R, 24] how a row reads velocities of both bodies, and what a unit of impulse makes of these without the joints
    row: np.ndarray
    want: np.ndarray  # [R] the wanted change of what it reads
    impulse: np.ndarray  # [R]
    # [R] what it reads without any impulse; the impulses of a motor and of friction at most. Of a tangent grip is the
    # coefficient of friction; of a limit strong is what is to be left of the way to it after the inner step (infinite
    # where it rebounds), and grip 1 for the lower one and -1 for the higher.
    base: np.ndarray
    strong: np.ndarray
    grip: np.ndarray
    give: np.ndarray  # [R] what a unit of impulse does along its row, through the joints where that is known
    now: np.ndarray  # [R] the change so far
    see: np.ndarray  # [R, R] or [0, 0]: what a unit of impulse does along all rows, through the joints


@njit(**BARE)
def asleep(world, motion, held, c):
    for k in range(held.comp[c], held.comp[c + 1]):
        if held.node[k] >= 0:
            return motion.island[held.node[k]] >= 0
    return True


@njit(**BARE)
def _arm(matrix, body, anchor, j, s):
    b = body[j, s]
    a = (anchor[j, s, 0], anchor[j, s, 1], anchor[j, s, 2])
    return a if b < 0 else turn(matrix, b, a)


@njit(**BARE)
def _axis(matrix, body, axes, j, s, k):
    b = body[j, s]
    a = (axes[j, s, k, 0], axes[j, s, k, 1], axes[j, s, k, 2])
    return a if b < 0 else turn(matrix, b, a)


@njit(**BARE)
def _between(position, body, j, arm, other):
    """From the second body's anchor to the first's."""
    a, b = body[j, 0], body[j, 1]
    way = sub(arm, other)
    if a >= 0:
        way = add(way, get(position, a))
    if b >= 0:
        way = sub(way, get(position, b))
    return way


@njit(**BARE)
def _unit(k):
    """An axis of the world."""
    return 1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0


@njit(**BARE)
def _errors(held, position, matrix, j, out):
    """By how much the rows of a joint do not hold."""
    kind = held.kind[j]
    way = _between(
        position, held.body, j, _arm(matrix, held.body, held.anchor, j, 0), _arm(matrix, held.body, held.anchor, j, 1)
    )
    for e in range(ROWS):
        out[j, e] = 0.0
    if kind == DISTANCE:
        if held.number[j, LENGTH] >= 0.0:
            out[j, 0] = norm(way) - held.number[j, LENGTH]
        return
    first = 3
    if kind == SLIDER:
        out[j, 0] = dot(_axis(matrix, held.body, held.axes, j, 1, 1), way)
        out[j, 1] = dot(_axis(matrix, held.body, held.axes, j, 1, 2), way)
        first = 2
    else:
        out[j, 0], out[j, 1], out[j, 2] = way[0], way[1], way[2]
    if kind == HINGE:
        a = _axis(matrix, held.body, held.axes, j, 0, 0)
        out[j, 3] = dot(a, _axis(matrix, held.body, held.axes, j, 1, 1))
        out[j, 4] = dot(a, _axis(matrix, held.body, held.axes, j, 1, 2))
    elif kind != BALL:
        for k in range(3):
            out[j, first + k] = dot(
                _axis(matrix, held.body, held.axes, j, 0, (k + 1) % 3),
                _axis(matrix, held.body, held.axes, j, 1, (k + 2) % 3),
            )


@njit(**BARE)
def _write(line, j, e, pull, arm, other):
    """A row along a direction at two places."""
    one, two = cross(arm, pull), cross(other, pull)
    for x in range(3):
        line[j, e, x], line[j, e, 3 + x], line[j, e, 6 + x], line[j, e, 9 + x] = pull[x], one[x], -pull[x], -two[x]


@njit(**BARE)
def _write_turn(line, j, e, axis):
    """A row about an axis."""
    for x in range(3):
        line[j, e, x] = line[j, e, 6 + x] = 0.0
        line[j, e, 3 + x], line[j, e, 9 + x] = axis[x], -axis[x]


@njit(**BARE)
def _coordinate(held, position, matrix, j):
    """The angle, position or length of a joint, and the row along which it changes."""
    kind, state = held.kind[j], held.state
    arm, other = _arm(matrix, held.body, held.anchor, j, 0), _arm(matrix, held.body, held.anchor, j, 1)
    way = _between(position, held.body, j, arm, other)
    one = held.axis
    if kind == HINGE:
        a, b, c = (
            _axis(matrix, held.body, held.axes, j, 0, 1),
            _axis(matrix, held.body, held.axes, j, 1, 1),
            _axis(matrix, held.body, held.axes, j, 1, 2),
        )
        angle = math.atan2(dot(a, c), dot(a, b))
        turns = math.floor((state[j, COORD] - angle) / (2.0 * math.pi) + 0.5)
        state[j, COORD] = angle + 2.0 * math.pi * turns
        _write_turn(one, j, 0, _axis(matrix, held.body, held.axes, j, 0, 0))
    elif kind == SLIDER:
        a = _axis(matrix, held.body, held.axes, j, 1, 0)
        state[j, COORD] = dot(a, way)
        _write(one, j, 0, a, arm, add(other, way))
    elif kind == BALL:
        a, b = _axis(matrix, held.body, held.axes, j, 0, 0), _axis(matrix, held.body, held.axes, j, 1, 0)
        n = cross(a, b)
        s = norm(n)
        state[j, COORD] = math.atan2(s, dot(a, b))
        _write_turn(one, j, 0, scale(n, -1.0 / s) if s > 1e-9 else (0.0, 0.0, 0.0))
    elif kind == DISTANCE:
        length = norm(way)
        state[j, COORD] = length
        _write(one, j, 0, scale(way, 1.0 / length) if length > 1e-12 else (0.0, 0.0, 1.0), arm, other)


@njit(**BARE)
def _rows(held, position, matrix, j):
    """The rows that hold, as bodies are now."""
    kind, line, active = held.kind[j], held.line, held.active
    arm, other = _arm(matrix, held.body, held.anchor, j, 0), _arm(matrix, held.body, held.anchor, j, 1)
    for e in range(ROWS):
        active[j, e] = 0
        held.soft[j, e] = 0.0
    if kind == DISTANCE:
        if held.number[j, LENGTH] >= 0.0:
            for x in range(12):
                line[j, 0, x] = held.axis[j, 0, x]
            active[j, 0] = 1
        return
    first = 3
    if kind == SLIDER:
        far = add(other, _between(position, held.body, j, arm, other))
        _write(line, j, 0, _axis(matrix, held.body, held.axes, j, 1, 1), arm, far)
        _write(line, j, 1, _axis(matrix, held.body, held.axes, j, 1, 2), arm, far)
        first = 2
    else:
        for k in range(3):
            _write(line, j, k, _unit(k), arm, other)
    for e in range(first):
        active[j, e] = 1
    if kind == HINGE:
        a = _axis(matrix, held.body, held.axes, j, 0, 0)
        for k in range(2):
            _write_turn(line, j, 3 + k, cross(a, _axis(matrix, held.body, held.axes, j, 1, 1 + k)))
            active[j, 3 + k] = 1
    elif kind != BALL:
        for k in range(3):
            one, two = (
                _axis(matrix, held.body, held.axes, j, 0, (k + 1) % 3),
                _axis(matrix, held.body, held.axes, j, 1, (k + 2) % 3),
            )
            _write_turn(line, j, first + k, cross(one, two))
            active[j, first + k] = 1


@njit(**BARE)
def _reads(line, j, e, velocity, angular, a, b):
    """What a row says of velocities [N, 3] of both bodies."""
    total = 0.0
    for x in range(3):
        if a >= 0:
            total += line[j, e, x] * velocity[a, x] + line[j, e, 3 + x] * angular[a, x]
        if b >= 0:
            total += line[j, e, 6 + x] * velocity[b, x] + line[j, e, 9 + x] * angular[b, x]
    return total


@njit(**BARE)
def _reads_six(line, j, e, change, a, b):
    """Likewise of [N, 6]."""
    total = 0.0
    for x in range(6):
        if a >= 0:
            total += line[j, e, x] * change[a, x]
        if b >= 0:
            total += line[j, e, 6 + x] * change[b, x]
    return total


@njit(**BARE)
def _eased(world, work, rules, line, j, e, a, b, out, k):
    """Write what a unit of impulse along a row makes of both bodies' velocities by themselves; returns what that does
    along the row."""
    total = 0.0
    for s in range(2):
        body = a if s == 0 else b
        for x in range(6):
            out[k, 12 + 6 * s + x] = 0.0
        if body >= 0 and world.moves[body]:
            first = 6 * s
            spin = turn(work.inverse, body, (line[j, e, first + 3], line[j, e, first + 4], line[j, e, first + 5]))
            for x in range(3):
                out[k, 12 + first + x] = world.inverse_mass[body] * line[j, e, first + x]
                out[k, 15 + first + x] = spin[x] if rules.rotation else 0.0
            for x in range(6):
                total += line[j, e, first + x] * out[k, 12 + first + x]
    return total


@njit(**BARE)
def _springs(world, work, motion, rules, held, j):
    """Springs and damping as soft rows: a force in the middle of what it is before and after the inner step."""
    number, state, kind, h = held.number, held.state, held.kind[j], rules.substep_dt
    stiff, damping = number[j, STIFFNESS], number[j, DAMPING]
    if stiff <= 0.0 and damping <= 0.0:
        return
    a, b = held.body[j, 0], held.body[j, 1]
    for k in range(3 if kind == BALL else 1):
        e = 3 + k if kind == BALL else (5 if kind != DISTANCE else 1)
        if kind == BALL:
            _write_turn(held.line, j, e, _unit(k))
        else:
            for x in range(12):
                held.line[j, e, x] = held.axis[j, 0, x]
        z = damping * h * _eased(world, work, rules, held.line, j, e, a, b, held.eased, 0)
        late = 0.5 + z / 12.0 if z < 0.01 else 1.0 / (1.0 - math.exp(-z)) - 1.0 / z
        give = h * (0.25 * stiff * h + damping * late)
        before = _reads(held.line, j, e, motion.velocity, motion.angular, a, b)
        held.active[j, e] = 2
        held.soft[j, e] = 1.0 / give
        away = state[j, COORD] - number[j, REST] if stiff > 0.0 else 0.0
        held.wanted[j, e] = before - h * (stiff * away + damping * before) / give


@njit(**FAST)
def assemble(world, work, motion, rules, held, springs):
    """Write the rows of all joints that are awake, and factor what they make of velocities. Where rows do not hold,
    bodies are moved. `springs`: whether these are among them."""
    for c in range(len(held.comp) - 1):
        if asleep(world, motion, held, c):
            continue
        for attempt in range(3):
            worst = 0.0
            for k in range(held.comp[c], held.comp[c + 1]):
                if held.node[k] < 0:
                    j = -1 - held.node[k]
                    _coordinate(held, motion.position, work.matrix, j)
                    if held.state[j, BROKEN] > 0.0:
                        for e in range(ROWS):
                            held.active[j, e] = 0
                            held.error[j, e] = held.soft[j, e] = 0.0
                        continue
                    _rows(held, motion.position, work.matrix, j)
                    _errors(held, motion.position, work.matrix, j, held.error)
                    for e in range(ROWS):
                        held.wanted[j, e] = held.state[j, BEND + e] if springs else 0.0
                        worst = max(worst, abs(held.error[j, e]))
                    if springs:
                        _springs(world, work, motion, rules, held, j)
            _factor(world, work, rules, held, c)
            if worst <= STRETCH or attempt == 2:
                break
            _mend(world, work, motion, rules, held, c)


@njit(**FAST)
def _mend(world, work, motion, rules, held, c):
    """Move bodies so that rows hold: as little as their masses ask for."""
    for k in range(held.comp[c], held.comp[c + 1]):
        for e in range(6):
            held.x[k, e] = 0.0
        if held.node[k] < 0:
            j = -1 - held.node[k]
            for e in range(ROWS):
                if held.active[j, e] == 1:
                    held.x[k, e] = held.error[j, e]
    _substitute(held, c, held.comp[c])
    most = 0.0
    for k in range(held.comp[c], held.comp[c + 1]):
        b = held.node[k]
        if b >= 0:
            moved, turned = get(held.x, k), (held.x[k, 3], held.x[k, 4], held.x[k, 5])
            most = max(most, norm(moved), norm(turned))
    share = 1.0 if most <= REACH else REACH / most
    for k in range(held.comp[c], held.comp[c + 1]):
        b = held.node[k]
        if b >= 0:
            moved, turned = get(held.x, k), (held.x[k, 3], held.x[k, 4], held.x[k, 5])
            put(motion.position, b, along(get(motion.position, b), moved, share))
            if rules.rotation:
                q = turned_by(scale(turned, share), motion.orientation, b)
                for x in range(4):
                    motion.orientation[b, x] = q[x]
                to_matrix(motion.orientation, b, work.matrix)
            if world.radius[b] < math.inf:
                work.gone[b] += share * (norm(moved) + norm(turned) * world.radius[b])


@njit(**FAST)
def _factor(world, work, rules, held, c):
    """The matrix of masses and rows, factored block by block."""
    first, last = held.comp[c], held.comp[c + 1]
    for k in range(first, last):
        for p in range(held.below[k], held.below[k + 1]):
            held.block[p] = 0.0
        held.diagonal[k] = 0.0
        b = held.node[k]
        if b >= 0:
            for x in range(3):
                held.diagonal[k, x, x] = 1.0 / world.inverse_mass[b]
                for y in range(3):
                    total = 0.0
                    for u in range(3):
                        for w in range(3):
                            total += work.matrix[b, x, u] * world.inertia[b, u, w] * work.matrix[b, y, w]
                    held.diagonal[k, 3 + x, 3 + y] = total
    for k in range(first, last):
        if held.node[k] >= 0:
            continue
        j = -1 - held.node[k]
        for e in range(ROWS):
            held.diagonal[k, e, e] = -1.0
            if held.active[j, e] > 0:
                eased = _eased(world, work, rules, held.line, j, e, held.body[j, 0], held.body[j, 1], held.eased, 0)
                held.diagonal[k, e, e] = -held.soft[j, e] - SOFTEN * eased
                if eased == 0.0:
                    held.diagonal[k, e, e] = -1.0
        for s in range(2):
            p = held.entry[j, s]
            if p < 0:
                continue
            lower = held.row[p] == k
            for e in range(ROWS):
                if held.active[j, e] == 0:
                    continue
                for x in range(6):
                    value = -held.line[j, e, 6 * s + x] if x < 3 or rules.rotation else 0.0
                    if lower:
                        held.block[p, e, x] = value
                    else:
                        held.block[p, x, e] = value
    for k in range(first, last):
        _invert(held.diagonal, held.inverse, k)
        t = held.start[k]
        for p in range(held.below[k], held.below[k + 1]):
            _multiply(held.low, held.block, held.inverse, p, k)
            for q in range(held.below[k], p + 1):
                target = held.target[t]
                t += 1
                if target < 0:
                    _subtract(held.diagonal, -1 - target, held.low, p, held.block, q)
                else:
                    _subtract(held.block, target, held.low, p, held.block, q)


@njit(**BARE)
def _invert(diagonal, inverse, k):
    """Gauss and Jordan without pivots: the blocks are definite."""
    a = inverse[k]
    for x in range(6):
        for y in range(6):
            a[x, y] = diagonal[k, x, y]
    for i in range(6):
        pivot = 1.0 / a[i, i]
        a[i, i] = 1.0
        for y in range(6):
            a[i, y] *= pivot
        for x in range(6):
            if x != i:
                factor = a[x, i]
                a[x, i] = 0.0
                for y in range(6):
                    a[x, y] -= factor * a[i, y]


@njit(**BARE)
def _multiply(out, block, inverse, p, k):
    for x in range(6):
        for y in range(6):
            total = 0.0
            for u in range(6):
                total += block[p, x, u] * inverse[k, u, y]
            out[p, x, y] = total


@njit(**BARE)
def _subtract(out, t, low, p, block, q):
    for x in range(6):
        for y in range(6):
            total = 0.0
            for u in range(6):
                total += low[p, x, u] * block[q, y, u]
            out[t, x, y] -= total


@njit(**BARE)
def _substitute(held, c, first):
    """Solve for the right side `x`, which is 0 before node `first`."""
    x, last = held.x, held.comp[c + 1]
    for k in range(first, last):
        for p in range(held.below[k], held.below[k + 1]):
            r = held.row[p]
            for i in range(6):
                total = 0.0
                for u in range(6):
                    total += held.low[p, i, u] * x[k, u]
                x[r, i] -= total
    for k in range(last - 1, held.comp[c] - 1, -1):
        a, b, d, e, f, g = x[k, 0], x[k, 1], x[k, 2], x[k, 3], x[k, 4], x[k, 5]
        for i in range(6):
            m = held.inverse[k, i]
            x[k, i] = m[0] * a + m[1] * b + m[2] * d + m[3] * e + m[4] * f + m[5] * g
        for p in range(held.below[k], held.below[k + 1]):
            r = held.row[p]
            for i in range(6):
                total = 0.0
                for u in range(6):
                    total += held.low[p, u, i] * x[r, u]
                x[k, i] -= total


@njit(**FAST)
def _project(world, work, motion, held, c, change, whole):
    """Let the rows hold: what `change` lacks is added. `whole`: of all velocities, as the rows want them; else of the
    change alone, which is to be none along them."""
    free = work.free
    for k in range(held.comp[c], held.comp[c + 1]):
        n = held.node[k]
        for e in range(6):
            held.x[k, e] = 0.0
        if n < 0:
            j = -1 - n
            a, b = held.body[j, 0], held.body[j, 1]
            for e in range(ROWS):
                if held.active[j, e] == 0:
                    continue
                now = _reads_six(held.line, j, e, change, a, b)
                if whole:
                    now += _reads(held.line, j, e, motion.velocity, motion.angular, a, b)
                    now += _reads_six(held.line, j, e, free, a, b)
                    now += held.soft[j, e] * held.impulse[j, e] - held.wanted[j, e]
                held.x[k, e] = now
    _substitute(held, c, held.comp[c])
    for k in range(held.comp[c], held.comp[c + 1]):
        n = held.node[k]
        if n >= 0:
            for x in range(6):
                change[n, x] += held.x[k, x]
        elif whole:
            for e in range(ROWS):
                held.impulse[-1 - n, e] += held.x[k, e]


@njit(**BARE)
def _bend(world, work, motion, rules, held, c):
    """Move the bodies as far as the inner step would, and let rows turn by as much as they do not hold there; returns
    the largest error."""
    h, trial = rules.substep_dt, held.trial
    for k in range(held.comp[c], held.comp[c + 1]):
        n = held.node[k]
        if n >= 0:
            _tried(world, work, motion, rules, held, n)
            continue
        for s in range(2):
            b = held.body[-1 - n, s]
            if b >= 0 and held.of_body[b] < 0:
                _tried(world, work, motion, rules, held, b)
    worst = 0.0
    for k in range(held.comp[c], held.comp[c + 1]):
        if held.node[k] < 0:
            j = -1 - held.node[k]
            if held.state[j, BROKEN] > 0.0:
                continue
            _errors(held, trial.position, held.frame, j, held.later)
            for e in range(ROWS):
                if held.active[j, e] == 1:
                    error = held.later[j, e] - held.error[j, e]
                    held.wanted[j, e] -= error / h
                    worst = max(worst, abs(error))
    return worst


@njit(**BARE)
def _tried(world, work, motion, rules, held, b):
    """Where a body would be after the inner step."""
    h, trial, change, free = rules.substep_dt, held.trial, work.change, work.free
    v, w = get(motion.velocity, b), get(motion.angular, b)
    for x in range(4):
        trial.orientation[b, x] = motion.orientation[b, x]
    for x in range(3):
        for y in range(3):
            held.frame[b, x, y] = work.matrix[b, x, y]
    if world.moves[b]:
        v = add(v, add((free[b, 0], free[b, 1], free[b, 2]), (change[b, 0], change[b, 1], change[b, 2])))
        w = add(w, add((free[b, 3], free[b, 4], free[b, 5]), (change[b, 3], change[b, 4], change[b, 5])))
    put(trial.position, b, along(get(motion.position, b), v, h))
    if not rules.rotation and world.moves[b]:
        return
    put(trial.angular, b, w)
    if world.moves[b] and not world.isotropic[b]:
        torque_free(world, trial, held.frame, h, held.turned, held.tried, b)
    elif w[0] != 0.0 or w[1] != 0.0 or w[2] != 0.0:
        q = turned_by(scale(w, h), trial.orientation, b)
        for x in range(4):
            trial.orientation[b, x] = q[x]
        to_matrix(trial.orientation, b, held.frame)


@njit(**BARE)
def _limited(world, work, motion, rules, held, c, rows, count, steady):
    """Write the bounded rows of joints behind `count` others; returns how many there are then. `steady`: only limits
    that hold, as they are after an inner step."""
    h, number, state = rules.substep_dt, held.number, held.state
    for k in range(held.comp[c], held.comp[c + 1]):
        if held.node[k] >= 0:
            continue
        j = -1 - held.node[k]
        if state[j, BROKEN] > 0.0:
            continue
        a, b, coord = held.body[j, 0], held.body[j, 1], state[j, COORD]
        before = _reads(held.axis, j, 0, motion.velocity, motion.angular, a, b)
        free = before + _reads_six(held.axis, j, 0, work.free, a, b)
        for side in range(2):
            end = number[j, LOW + side]
            sign = 1.0 - 2.0 * side
            gap = sign * (coord - end)
            if not gap < math.inf or (steady and state[j, STOP] * sign <= 0.0):
                continue
            then = sign * free
            if gap + h * then > AHEAD and gap > AHEAD:
                continue
            approach = -sign * before
            left = 0.0 if gap >= 0.0 else (1.0 - GIVES) * gap
            aim = (left - gap) / h
            if steady:
                aim, then = 0.0, sign * before
            elif number[j, BOUNCE] > 0.0 and approach > rules.slow and gap <= h * approach:
                aim, left = number[j, BOUNCE] * approach, math.inf
            for x in range(12):
                rows.row[count, x] = sign * held.axis[j, 0, x]
            _begin(world, work, rules, held, rows, count, STOP_ROW, j, aim, then)
            rows.impulse[count] = 0.0 if steady else max(0.0, sign * state[j, STOP])
            rows.strong[count], rows.grip[count] = left, sign
            count += 1
        if steady or held.kind[j] > BALL:
            continue
        grip, most, motor = h * number[j, DRAG], h * number[j, MOST], number[j, MOTOR]
        if motor == 0.0:
            most = 0.0
        if held.kind[j] == BALL:
            for e in range(3 if grip > 0.0 else 0):
                for x in range(12):
                    rows.row[count, x] = 0.0
                rows.row[count, 3 + e], rows.row[count, 9 + e] = 1.0, -1.0
                now = 0.0
                if a >= 0:
                    now += motion.angular[a, e] + work.free[a, 3 + e]
                if b >= 0:
                    now -= motion.angular[b, e] + work.free[b, 3 + e]
                _begin(world, work, rules, held, rows, count, GRIP_ROW, j, 0.0, now)
                rows.impulse[count], rows.grip[count] = state[j, DRIVE + e], grip
                count += 1
        elif grip > 0.0 or most > 0.0:
            aim = 0.0
            if motor == 1.0:
                aim = state[j, TARGET]
            elif motor == 2.0:
                aim = (state[j, TARGET] - coord) / max(number[j, TIME], h)
            for x in range(12):
                rows.row[count, x] = held.axis[j, 0, x]
            _begin(world, work, rules, held, rows, count, DRIVE_ROW, j, aim, free)
            rows.impulse[count], rows.grip[count], rows.strong[count] = state[j, DRIVE], grip, most
            count += 1
    return count


@njit(**BARE)
def _begin(world, work, rules, held, rows, r, kind, j, aim, base):
    rows.kind[r], rows.of[r] = kind, j
    rows.body[r, 0], rows.body[r, 1] = held.body[j, 0], held.body[j, 1]
    rows.base[r], rows.want[r] = base, aim - base
    rows.strong[r] = rows.grip[r] = 0.0
    rows.give[r] = 0.0
    for s in range(2):
        b = held.body[j, s]
        for x in range(6):
            rows.row[r, 12 + 6 * s + x] = 0.0
        if b >= 0 and world.moves[b]:
            first = 6 * s
            spin = turn(work.inverse, b, (rows.row[r, first + 3], rows.row[r, first + 4], rows.row[r, first + 5]))
            for x in range(3):
                rows.row[r, 12 + first + x] = world.inverse_mass[b] * rows.row[r, first + x]
                rows.row[r, 15 + first + x] = spin[x] if rules.rotation else 0.0
            for x in range(6):
                rows.give[r] += rows.row[r, first + x] * rows.row[r, 12 + first + x]


@njit(**BARE)
def _touched(world, system, island, rows):
    """Write the rows of an island's contacts; returns how many."""
    count = 0
    for o in range(system.start[island], system.start[island + 1]):
        c = system.order[o]
        a, b = system.where[c, 2], system.where[c, 3]
        for e in range(3 if system.friction[c] > 0.0 else 1):
            own = system.row[c, e]
            rows.kind[count], rows.of[count] = NORMAL_ROW if e == 0 else TANGENT_ROW, c
            rows.body[count, 0], rows.body[count, 1] = a, b
            rows.give[count] = 0.0
            for x in range(3):
                rows.row[count, x], rows.row[count, 6 + x] = own[AXIS + x], -own[AXIS + x]
                rows.row[count, 3 + x], rows.row[count, 9 + x] = own[ARM + x], own[OTHER + x]
                rows.row[count, 12 + x] = own[AXIS + x] * world.inverse_mass[a]
                rows.row[count, 18 + x] = -own[AXIS + x] * world.inverse_mass[b]
                rows.row[count, 15 + x], rows.row[count, 21 + x] = own[SPIN + x], own[COUNTER + x]
            for x in range(12):
                rows.give[count] += rows.row[count, x] * rows.row[count, 12 + x]
            rows.want[count], rows.impulse[count] = own[WANTED], own[IMPULSE]
            rows.base[count] = rows.strong[count] = 0.0
            rows.grip[count] = system.friction[c]
            count += 1
    return count


@njit(**BARE)
def _read(rows, r, change):
    total = 0.0
    for s in range(2):
        b = rows.body[r, s]
        if b >= 0:
            for x in range(6):
                total += rows.row[r, 6 * s + x] * change[b, x]
    return total


@njit(**BARE)
def _give(moves, rows, r, impulse, change):
    for s in range(2):
        b = rows.body[r, s]
        if b >= 0 and moves[b]:
            for x in range(6):
                change[b, x] += impulse * rows.row[r, 12 + 6 * s + x]


@njit(**FAST)
def _see(world, held, motion, rows, count):
    """What a unit of impulse along each row does along all, through the joints."""
    reply = held.reply
    for r in range(count):
        for s in range(2):
            b = rows.body[r, s]
            if b >= 0:
                for x in range(6):
                    reply[b, x] = 0.0
    for r in range(count):
        one = other = -1
        for s in range(2):
            b = rows.body[r, s]
            if b < 0 or not world.moves[b]:
                continue
            k = held.of_body[b]
            if k < 0 or motion.island[b] >= 0:
                for x in range(6):
                    reply[b, x] += rows.row[r, 12 + 6 * s + x]
                continue
            c = np.searchsorted(held.comp, k, side="right") - 1
            if c != one and c != other:
                for i in range(held.comp[c], held.comp[c + 1]):
                    for x in range(6):
                        held.x[i, x] = 0.0
                if one < 0:
                    one = c
                else:
                    other = c
            for x in range(6):
                held.x[k, x] += rows.row[r, 6 * s + x]
        for c in (one, other):
            if c >= 0:
                _substitute(held, c, held.comp[c])
                for i in range(held.comp[c], held.comp[c + 1]):
                    if held.node[i] >= 0:
                        for x in range(6):
                            reply[held.node[i], x] = held.x[i, x]
        for q in range(count):
            rows.see[r, q] = _read(rows, q, reply)
        rows.give[r] = rows.see[r, r]
        for s in range(2):
            b = rows.body[r, s]
            if b >= 0:
                for x in range(6):
                    reply[b, x] = 0.0
        for c in (one, other):
            if c >= 0:
                for i in range(held.comp[c], held.comp[c + 1]):
                    if held.node[i] >= 0:
                        for x in range(6):
                            reply[held.node[i], x] = 0.0


@njit(**BARE)
def _step(moves, rows, count, r, total, change):
    """Give a row its impulse; returns by how much that changes what it reads."""
    step = total - rows.impulse[r]
    if step == 0.0:
        return 0.0
    rows.impulse[r] = total
    if len(rows.see):
        for q in range(count):
            rows.now[q] += step * rows.see[r, q]
    else:
        _give(moves, rows, r, step, change)
    return abs(step) * rows.give[r]


@njit(**BARE)
def _short(rows, r, change):
    """What a row lacks of the change that it wants."""
    return rows.want[r] - (rows.now[r] if len(rows.see) else _read(rows, r, change))


@njit(**BARE)
def _driven(now, aim, give, most, grip):
    """The impulse of a motor with friction: `now` is the speed without it."""
    sign = 1.0 if aim >= 0.0 else -1.0
    now, aim = sign * now, sign * aim
    reach = (aim - now) / give
    if reach <= most - grip or aim == 0.0:
        if aim == 0.0:
            return sign * min(max(reach, -most - grip), most + grip)
        return sign * max(reach, -most - grip)
    stay = -now / give
    return sign * min(max(stay, most - grip), most + grip)


@njit(**BARE)
def _sweep(moves, cone, rows, count, change):
    """All bounded rows in turn, friction of contacts last; returns the largest change."""
    worst = 0.0
    for r in range(count):
        kind = rows.kind[r]
        if kind == TANGENT_ROW or rows.give[r] <= 0.0:
            continue
        total = rows.impulse[r] + _short(rows, r, change) / rows.give[r]
        if kind == NORMAL_ROW or kind == STOP_ROW:
            total = max(total, 0.0)
        elif kind == DRIVE_ROW:
            aim = rows.base[r] + rows.want[r]
            now = aim - _short(rows, r, change) - rows.impulse[r] * rows.give[r]
            total = _driven(now, aim, rows.give[r], rows.strong[r], rows.grip[r])
        worst = max(worst, _step(moves, rows, count, r, total, change))
        if kind == GRIP_ROW and (r + 1 == count or rows.of[r + 1] != rows.of[r] or rows.kind[r + 1] != GRIP_ROW):
            length = math.sqrt(rows.impulse[r] ** 2 + rows.impulse[r - 1] ** 2 + rows.impulse[r - 2] ** 2)
            if length > rows.grip[r]:
                for q in range(r - 2, r + 1):
                    _step(moves, rows, count, q, rows.impulse[q] * rows.grip[r] / length, change)
    r = 0
    while r < count:
        if rows.kind[r] != TANGENT_ROW:
            r += 1
            continue
        most = rows.grip[r] * rows.impulse[r - 1]
        if cone:
            give = max(rows.give[r], rows.give[r + 1])
            one = rows.impulse[r] + _short(rows, r, change) / give
            other = rows.impulse[r + 1] + _short(rows, r + 1, change) / give
            share = _within(one, other, most)
            worst = max(worst, _step(moves, rows, count, r, share * one, change))
            worst = max(worst, _step(moves, rows, count, r + 1, share * other, change))
        else:
            for q in range(r, r + 2):
                total = rows.impulse[q] + _short(rows, q, change) / rows.give[q]
                worst = max(worst, _step(moves, rows, count, q, min(max(total, -most), most), change))
        r += 2
    return worst


@njit(**FAST)
def _all_rows(world, work, motion, rules, system, held, comps, lo, hi, island, rows, steady):
    """The bounded rows of an island, and what was known of their impulses, given to the bodies."""
    count = 0 if steady else _touched(world, system, island, rows)
    for i in range(lo, hi):
        count = _limited(world, work, motion, rules, held, comps[i], rows, count, steady)
    for r in range(count):
        if rows.impulse[r] != 0.0:
            _give(world.moves, rows, r, rows.impulse[r], work.change)
    return count


@njit(**FAST)
def _hold(world, work, motion, rules, held, comps, lo, hi, rows, count, steady):
    """Solve for all impulses of an island so that its rows hold after the inner step."""
    change, h = work.change, rules.substep_dt
    for i in range(lo, hi):
        for k in range(held.comp[comps[i]], held.comp[comps[i] + 1]):
            if held.node[k] < 0:
                for e in range(ROWS):
                    held.impulse[-1 - held.node[k], e] = 0.0
        _project(world, work, motion, held, comps[i], change, True)
    for _ in range(ROUNDS):
        if count:
            known = rows.impulse[:count].copy()
            for r in range(count):
                rows.now[r] = _read(rows, r, change)
            for _ in range(rules.rounds):
                worst = _sweep(world.moves, rules.cone, rows, count, change)
                if len(rows.see) == 0:
                    for i in range(lo, hi):
                        _project(world, work, motion, held, comps[i], change, True)
                if worst <= EXACT * rules.exact:
                    break
            if len(rows.see):
                for r in range(count):
                    if rows.impulse[r] != known[r]:
                        _give(world.moves, rows, r, rows.impulse[r] - known[r], change)
                for i in range(lo, hi):
                    _project(world, work, motion, held, comps[i], change, True)
        if steady:
            return
        worst = 0.0
        for i in range(lo, hi):
            worst = max(worst, _bend(world, work, motion, rules, held, comps[i]))
        for r in range(count):
            if rows.kind[r] == STOP_ROW and rows.impulse[r] > 0.0 and rows.strong[r] < math.inf:
                j = rows.of[r]
                coord = held.state[j, COORD]
                _coordinate(held, held.trial.position, held.frame, j)
                sign = rows.grip[r]
                gap = sign * (held.state[j, COORD] - held.number[j, LOW if sign > 0.0 else HIGH])
                held.state[j, COORD] = coord
                for x in range(12):
                    held.axis[j, 0, x] = sign * rows.row[r, x]
                rows.want[r] -= (gap - rows.strong[r]) / h
                worst = max(worst, abs(gap - rows.strong[r]))
        if worst <= HOLDS:
            return
        for i in range(lo, hi):
            _project(world, work, motion, held, comps[i], change, True)


@njit(**BARE)
def _clear(work, held, system, island, comps, lo, hi, change):
    for o in range(system.start[island], system.start[island + 1]):
        c = system.order[o]
        for x in range(6):
            change[system.where[c, 2], x] = change[system.where[c, 3], x] = 0.0
    for i in range(lo, hi):
        for k in range(held.comp[comps[i]], held.comp[comps[i] + 1]):
            if held.node[k] >= 0:
                for x in range(6):
                    change[held.node[k], x] = 0.0


@njit(**FAST)
def _room(count):
    return Bounded(
        np.empty(count, np.int64), np.empty(count, np.int64), np.empty((count, 2), np.int64), np.empty((count, 24)),
        np.empty(count), np.empty(count), np.empty(count), np.empty(count), np.empty(count), np.empty(count),
        np.empty(count), np.empty((0, 0)),
    )  # fmt: skip


@njit(**FAST)
def _solve_island(world, work, motion, rules, system, held, comps, lo, hi, island):
    """An island that joints hold together: as `impulses._solve`, through the joints."""
    contacts = system.start[island + 1] - system.start[island]
    most = 3 * contacts
    for i in range(lo, hi):
        most += 4 * (held.comp[comps[i] + 1] - held.comp[comps[i]])
    lively = deep = False
    for o in range(system.start[island], system.start[island + 1]):
        c = system.order[o]
        deep = deep or system.wanted[c] > 0.0
        lively = lively or system.row[c, 0, WANTED] > system.calm[c, 0]
    if deep:
        _resolve_penetration(world.inverse_mass, rules, system, work.shift, island)
        for i in range(lo, hi):
            _project(world, work, motion, held, comps[i], work.shift, False)
    room = _room(most)
    count = _all_rows(world, work, motion, rules, system, held, comps, lo, hi, island, room, False)
    rows = _seen(room, count if count <= DENSE else 0)
    if len(rows.see):
        _see(world, held, motion, rows, count)
    share = 0.5
    while True:
        _hold(world, work, motion, rules, held, comps, lo, hi, rows, count, False)
        for r in range(count):
            c = rows.of[r]
            if rows.kind[r] == NORMAL_ROW:
                system.row[c, 0, IMPULSE] = rows.impulse[r]
                if rows.grip[r] > 0.0:
                    system.row[c, 1, IMPULSE] = rows.impulse[r + 1]
                    system.row[c, 2, IMPULSE] = rows.impulse[r + 2]
        if not lively or share < 0.0 or not _gains(rules, system, work.change, island):
            break
        _clear(work, held, system, island, comps, lo, hi, work.change)
        for r in range(count):
            rows.impulse[r] = 0.0
            c = rows.of[r]
            if rows.kind[r] == NORMAL_ROW:
                calm = system.calm[c, 0]
                system.row[c, 0, WANTED] = calm + share * (system.row[c, 0, WANTED] - calm)
                rows.want[r] = system.row[c, 0, WANTED]
        share = 0.0 if share > 0.0 else -1.0
    touched = False
    for r in range(count):
        struck = rows.kind[r] == STOP_ROW and rows.strong[r] == math.inf
        touched = touched or ((rows.kind[r] == NORMAL_ROW or struck) and rows.impulse[r] > 0.0)
    for i in range(lo, hi):
        _told(world, work, motion, rules, held, comps[i], touched or deep)
    for r in range(count):
        if rows.kind[r] >= STOP_ROW:
            _tell(motion, work, rules, held, rows, r)
    for i in range(lo, hi):
        _broken(rules, held, comps[i])


@njit(**FAST)
def _seen(rows, count):
    return Bounded(
        rows.kind, rows.of, rows.body, rows.row, rows.want, rows.impulse, rows.base, rows.strong, rows.grip, rows.give,
        rows.now, np.empty((count, count)),
    )  # fmt: skip


@njit(**BARE)
def _told(world, work, motion, rules, held, c, touched):
    """Write down what the rows that hold have done."""
    h, state = rules.substep_dt, held.state
    for k in range(held.comp[c], held.comp[c + 1]):
        n = held.node[k]
        if n >= 0:
            held.calm[n] = not touched
            if touched:
                motion.touching[n] = True
            continue
        j = -1 - n
        a, b = held.body[j, 0], held.body[j, 1]
        speed = _reads(held.axis, j, 0, motion.velocity, motion.angular, a, b)
        state[j, SPEED] = speed + _reads_six(held.axis, j, 0, work.free, a, b)
        state[j, SPEED] += _reads_six(held.axis, j, 0, work.change, a, b)
        for x in range(3):
            state[j, PULL + x] = state[j, TWIST + x] = state[j, DRIVE + x] = state[j, SOFT + x] = 0.0
        state[j, STOP] = state[j, FRESH] = 0.0
        for e in range(ROWS):
            state[j, BEND + e] = held.wanted[j, e] if held.active[j, e] == 1 else 0.0
            if held.active[j, e] == 0:
                continue
            if held.active[j, e] == 2:
                state[j, SOFT + (e - 3 if held.kind[j] == BALL else 0)] = held.impulse[j, e]
            _add_pull(work, held, j, held.line, j, e, held.impulse[j, e] / h)


@njit(**BARE)
def _add_pull(work, held, j, line, i, e, force):
    """Add what a row does to the force and the torque on the first body, about its anchor."""
    pull = (line[i, e, 0], line[i, e, 1], line[i, e, 2])
    twist = sub(
        (line[i, e, 3], line[i, e, 4], line[i, e, 5]), cross(_arm(work.matrix, held.body, held.anchor, j, 0), pull)
    )
    for x in range(3):
        held.state[j, PULL + x] += force * pull[x]
        held.state[j, TWIST + x] += force * twist[x]


@njit(**BARE)
def _tell(motion, work, rules, held, rows, r):
    """Write down what a bounded row of a joint has done."""
    j, kind, impulse, h, state = rows.of[r], rows.kind[r], rows.impulse[r], rules.substep_dt, held.state
    pull = (rows.row[r, 0], rows.row[r, 1], rows.row[r, 2])
    twist = sub(
        (rows.row[r, 3], rows.row[r, 4], rows.row[r, 5]), cross(_arm(work.matrix, held.body, held.anchor, j, 0), pull)
    )
    for x in range(3):
        state[j, PULL + x] += impulse / h * pull[x]
        state[j, TWIST + x] += impulse / h * twist[x]
    if kind == STOP_ROW:
        state[j, STOP] += rows.grip[r] * impulse
    elif kind == DRIVE_ROW:
        state[j, DRIVE] = impulse
        if rows.strong[r] > 0.0:
            before = _reads(held.axis, j, 0, motion.velocity, motion.angular, held.body[j, 0], held.body[j, 1])
            mean = 0.5 * (before + state[j, SPEED])
            own = impulse + (rows.grip[r] if mean > 0.0 else -rows.grip[r])
            state[j, DRIVE + 1] = min(max(own, -rows.strong[r]), rows.strong[r])
            state[j, GIVEN] += state[j, DRIVE + 1] * mean
    else:
        for e in range(3):
            if rows.row[r, 3 + e] != 0.0:
                state[j, DRIVE + e] = impulse


@njit(**BARE)
def _broken(rules, held, c):
    """Joints that bear more than they can are none any more."""
    for k in range(held.comp[c], held.comp[c + 1]):
        if held.node[k] < 0:
            j = -1 - held.node[k]
            own, number = held.state[j], held.number[j]
            pull = norm((own[PULL], own[PULL + 1], own[PULL + 2]))
            twist = norm((own[TWIST], own[TWIST + 1], own[TWIST + 2]))
            if pull > number[FORCE] or twist > number[TORQUE]:
                own[BROKEN] = 1.0


@njit(**FAST)
def _islands(world, work, motion, held, where):
    """Contacts and connected joints ordered by island: bodies that move, joined by both.

    Returns:
        start [I + 1] and order [C] of contacts, and the same of what joints connect, of which those that sleep are left
        out.
    """
    parent, number = work.parent, work.number
    connected = len(held.comp) - 1
    for k in range(len(held.node)):
        if held.node[k] >= 0:
            parent[held.node[k]], number[held.node[k]] = held.node[k], -1
    for c in range(len(where)):
        for e in range(2, 4):
            parent[where[c, e]], number[where[c, e]] = where[c, e], -1
    own = np.empty(connected, np.int64)
    for c in range(connected):
        own[c] = -1
        for k in range(held.comp[c], held.comp[c + 1]):
            if held.node[k] >= 0:
                if own[c] >= 0:
                    join(parent, own[c], held.node[k])
                own[c] = held.node[k]
        if asleep(world, motion, held, c):
            own[c] = -1
    for c in range(len(where)):
        a, b = where[c, 2], where[c, 3]
        if world.moves[a] and world.moves[b]:
            join(parent, a, b)
    islands = 0
    label, group = np.empty(len(where), np.int64), np.empty(connected, np.int64)
    for c in range(len(where) + connected):
        b = where[c, 2] if c < len(where) else own[c - len(where)]
        if b < 0:
            group[c - len(where)] = -1
            continue
        a = root(parent, b)
        if number[a] < 0:
            number[a] = islands
            islands += 1
        if c < len(where):
            label[c] = number[a]
        else:
            group[c - len(where)] = number[a]
    start, order = _sorted(label, islands)
    begin, comps = _sorted(group, islands)
    return start, order, begin, comps


@njit(**FAST)
def _sorted(label, count):
    """Where each label begins, and the numbers of those that have it; -1 is none."""
    start = np.zeros(count + 1, np.int64)
    for c in range(len(label)):
        if label[c] >= 0:
            start[label[c] + 1] += 1
    for i in range(count):
        start[i + 1] += start[i]
    fill, order = start[:-1].copy(), np.empty(len(label), np.int64)
    for c in range(len(label)):
        if label[c] >= 0:
            order[fill[label[c]]] = c
            fill[label[c]] += 1
    return start, order


@njit(**FAST)
def solve_with_joints(world, work, motion, rules, manifolds, held):
    """Solve for the impulses of all contacts and joints, as `impulses.solve_contacts`, which it returns what of."""
    found = _equations(world, work, motion, rules, manifolds)
    start, order, begin, comps = _islands(world, work, motion, held, found.where)
    system = System(found.where, found.row, found.friction, found.wanted, found.pushed, found.calm, start, order)
    for i in range(len(start) - 1):
        if begin[i + 1] > begin[i]:
            _solve_island(world, work, motion, rules, system, held, comps, begin[i], begin[i + 1], np.int64(i))
        else:
            _solve(world.inverse_mass, rules, system, work.change, work.shift, np.int64(i))
    remembered(manifolds, system)
    return system


@njit(**BARE)
def _ready(world, work, motion, rules, held, c, share):
    """Inverse inertias of bodies in world axes as they lie, and what pulls at them in a share of an inner step."""
    for k in range(held.comp[c], held.comp[c + 1]):
        b = held.node[k]
        if b < 0:
            continue
        for x in range(3):
            for y in range(3):
                total = 0.0
                for i in range(3):
                    for j in range(3):
                        total += work.matrix[b, x, i] * world.inverse_inertia[b, i, j] * work.matrix[b, y, j]
                work.inverse[b, x, y] = total
        v, w = pull_of(world, work.matrix, work.wrench, rules, share, b)
        for x in range(3):
            work.free[b, x], work.free[b, 3 + x] = v[x], w[x]
            work.change[b, x] = work.change[b, 3 + x] = work.shift[b, x] = work.shift[b, 3 + x] = 0.0


@njit(**BARE)
def _resting(motion, held, c):
    """Whether contacts have a say in what joints connect: its velocities are then those of a whole inner step."""
    for k in range(held.comp[c], held.comp[c + 1]):
        if held.node[k] >= 0 and motion.touching[held.node[k]]:
            return True
    return False


@njit(**BARE)
def _kick(world, work, motion, rules, held, c, share):
    """A share of what springs, damping, motors and friction have given in the last inner step, to velocities."""
    state = held.state
    for k in range(held.comp[c], held.comp[c + 1]):
        if held.node[k] >= 0:
            continue
        j = -1 - held.node[k]
        if state[j, BROKEN] > 0.0:
            continue
        a, b = held.body[j, 0], held.body[j, 1]
        for e in range(3 if held.kind[j] == BALL else 1):
            impulse = share * (state[j, SOFT + e] + state[j, DRIVE + e])
            if impulse == 0.0:
                continue
            line, i, row = held.axis, j, 0
            if held.kind[j] == BALL:
                row = 3 + e
                line = held.line
                _write_turn(line, j, row, _unit(e))
            eased = _eased(world, work, rules, line, i, row, a, b, held.eased, 0)
            if held.kind[j] != BALL and state[j, DRIVE + 1] != 0.0:  # of which the motor's work is told
                before = _reads(line, i, row, motion.velocity, motion.angular, a, b)
                state[j, GIVEN] += share * state[j, DRIVE + 1] * (before + 0.5 * impulse * eased)
            for s in range(2):
                body = held.body[j, s]
                if body >= 0 and world.moves[body]:
                    for x in range(3):
                        motion.velocity[body, x] += impulse * held.eased[0, 12 + 6 * s + x]
                        motion.angular[body, x] += impulse * held.eased[0, 15 + 6 * s + x]


@njit(**FAST)
def begin_step(world, work, motion, rules, held):
    """Velocities at an instant become those of the inner step before it, see `advance._shifted`. Where nothing is known
    of impulses they are found first."""
    fresh = False
    for j in range(len(held.body)):
        held.state[j, GIVEN] = 0.0
        fresh = fresh or held.state[j, FRESH] > 0.0
    for c in range(len(held.comp) - 1):
        if not asleep(world, motion, held, c):
            _ready(world, work, motion, rules, held, c, 1.0)
    if fresh:
        _find_first(world, work, motion, rules, held)
    for c in range(len(held.comp) - 1):
        if not asleep(world, motion, held, c) and not _resting(motion, held, c):
            for k in range(held.comp[c], held.comp[c + 1]):
                if held.node[k] < 0:
                    _coordinate(held, motion.position, work.matrix, -1 - held.node[k])
            _kick(world, work, motion, rules, held, c, -0.5)


@njit(**FAST)
def _find_first(world, work, motion, rules, held):
    """The impulses of joints that nothing is known of, as if there were no contact."""
    from_contacts = System(
        np.empty((0, 4), np.int64), np.empty((0, 3, WIDTH)), np.empty(0), np.empty(0), np.empty(0), np.empty((0, 3)),
        np.zeros(2, np.int64), np.empty(0, np.int64),
    )  # fmt: skip
    assemble(world, work, motion, rules, held, True)
    one = np.empty(1, np.int64)
    for c in range(len(held.comp) - 1):
        fresh = False
        for k in range(held.comp[c], held.comp[c + 1]):
            fresh = fresh or (held.node[k] < 0 and held.state[-1 - held.node[k], FRESH] > 0.0)
        if not fresh or asleep(world, motion, held, c):
            continue
        one[0] = c
        _solve_island(world, work, motion, rules, from_contacts, held, one, np.int64(0), np.int64(1), np.int64(0))
        for k in range(held.comp[c], held.comp[c + 1]):
            if held.node[k] >= 0:
                motion.touching[held.node[k]] = False
            else:
                held.state[-1 - held.node[k], GIVEN] = 0.0


@njit(**FAST)
def end_step(world, work, motion, rules, held):
    """Velocities of the last inner step become those at its end, which joints let be."""
    one = np.empty(1, np.int64)
    for c in range(len(held.comp) - 1):
        if not asleep(world, motion, held, c):
            _ready(world, work, motion, rules, held, c, 0.0)
    assemble(world, work, motion, rules, held, False)
    for c in range(len(held.comp) - 1):
        if asleep(world, motion, held, c) or _resting(motion, held, c):
            continue
        _kick(world, work, motion, rules, held, c, 0.5)
        one[0] = c
        rows = _room(np.int64(2 * (held.comp[c + 1] - held.comp[c])))
        count = _limited(world, work, motion, rules, held, c, rows, np.int64(0), True)
        rows = _seen(rows, count if count <= DENSE else 0)
        if len(rows.see):
            _see(world, held, motion, rows, count)
        _hold(world, work, motion, rules, held, one, np.int64(0), np.int64(1), rows, count, True)
        for k in range(held.comp[c], held.comp[c + 1]):
            n = held.node[k]
            if n >= 0:
                for x in range(3):
                    motion.velocity[n, x] += work.change[n, x]
                    if rules.rotation:
                        motion.angular[n, x] += work.change[n, 3 + x]
            else:
                j = -1 - n
                a, b = held.body[j, 0], held.body[j, 1]
                speed = _reads(held.axis, j, 0, motion.velocity, motion.angular, a, b)
                held.state[j, SPEED] = speed + _reads_six(held.axis, j, 0, work.change, a, b)
    for j in range(len(held.body)):
        a, b = held.body[j, 0], held.body[j, 1]
        held.state[j, SPEED] = _reads(held.axis, j, 0, motion.velocity, motion.angular, a, b)


@njit(**BARE)
def kept_together(held, part):
    """What joints connect goes the same part of an inner step."""
    for c in range(len(held.comp) - 1):
        least = 1.0
        for k in range(held.comp[c], held.comp[c + 1]):
            if held.node[k] >= 0:
                least = min(least, part[held.node[k]])
        for k in range(held.comp[c], held.comp[c + 1]):
            if held.node[k] >= 0:
                part[held.node[k]] = least


@njit(**BARE)
def roused(world, motion, held):
    """Wake what sleeps on a joint to a body that is led along; whether there was any."""
    found = False
    for j in range(len(held.body)):
        for s in range(2):
            a, b = held.body[j, s], held.body[j, 1 - s]
            if a < 0 or b < 0 or motion.island[a] < 0 or not world.scripted[b]:
                continue
            if norm(get(motion.velocity, b)) + norm(get(motion.angular, b)) > 0.0:
                found = True
                island = motion.island[a]
                for c in range(len(motion.island)):
                    if motion.island[c] == island:
                        motion.island[c] = -1
                        motion.quiet[c] = 0
                        motion.touching[c] = True
    return found


@njit(**BARE)
def given(held):
    """What motors have given in a step."""
    total = 0.0
    for j in range(len(held.body)):
        total += held.state[j, GIVEN]
    return total


@njit(**BARE)
def stored(held):
    """The energy of springs."""
    total = 0.0
    for j in range(len(held.body)):
        if held.number[j, STIFFNESS] > 0.0 and not held.state[j, BROKEN] > 0.0:
            total += 0.5 * held.number[j, STIFFNESS] * (held.state[j, COORD] - held.number[j, REST]) ** 2
    return total
