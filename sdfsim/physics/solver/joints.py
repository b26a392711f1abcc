"""Joints, compiled: the rows that hold bodies together are solved exactly, together with contacts and other bounded
rows.

In an inner step, impulses act along the rows at the poses of its start, and are such that the rows hold at the poses of
its end (SHAKE, with the exact free rotation in between). This conserves energy as well as the step without joints does,
and nothing drifts. Bounded rows (limits, motors, friction, contacts) are solved one after the other; each takes the
joints into account.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from sdfsim.physics.joint_columns import (
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
    GAIN,
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
from sdfsim.physics.solver.references import reference
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
    vector,
)

ROWS = 6
STRETCH = 1e-7  # model lengths (and rad): rows with a larger error are repaired by moving bodies
REACH = 0.05  # largest repair in an inner step, model lengths (and rad)
HOLDS = 1e-11  # model lengths (and rad): rows need not hold more exactly
ROUNDS = 6  # rounds of the search for impulses after which rows hold
BREAKS = 4  # rounds in which joints may break in one inner step
SOFTEN = 1e-10  # relative to the effect of a unit impulse along a row: makes redundant rows solvable
GIVES = 0.2  # share of an overrun limit that an inner step resolves
# (Phase of a motor with a gain in an inner step)^2 up to which it is not damped: ten inner steps a period.
RESOLVED = 0.4
AHEAD = 0.05  # model lengths (and rad): nearer limits are taken into account
EXACT = 0.01  # relative to the precision to which contacts without joints are solved
# Relative to its effect without joints: if the effect of a bounded row is less, joints allow no motion along it, and
# what is left is rounding. The joints then bear all of it.
BLOCKED = 1e-7
DENSE = 240  # largest number of bounded rows of an island for which all effects through the joints are stored


class Graph(NamedTuple):
    """The dynamic bodies and the joints as K nodes of a graph, in the order in which they are eliminated. The nodes
    from comp[c] to comp[c + 1] are connected."""

    comp: np.ndarray  # [C + 1] int64
    node: np.ndarray  # [K] int64: a body, or -1 - j for joint j
    of_body: np.ndarray  # [N] int64, the node of a body; -1 if no joint holds it or it does not move
    of_comp: np.ndarray  # [N] int64, likewise the number of its connected component
    entry: np.ndarray  # [J, 2] int64, the block of a joint and its body; -1 if the body does not move
    below: np.ndarray  # [K + 1] int64, the blocks below the diagonal of a column
    row: np.ndarray  # [F] int64, the node of a block's row
    start: np.ndarray  # [K + 1] int64, the targets of a column
    target: np.ndarray  # [U] int64, the block to which a pair of a column's blocks adds; -1 - k: diagonal of node k


class Factors(NamedTuple):
    """The matrix of masses and rows: diagonal, inverse [K, 6, 6]; block, low [F, 6, 6]; and the right-hand side x [K,
    6]."""

    diagonal: np.ndarray
    inverse: np.ndarray
    block: np.ndarray
    low: np.ndarray
    x: np.ndarray


class Each(NamedTuple):
    """The constants and the state of J joints."""

    body: np.ndarray  # [J, 2] int64, -1 for the world
    kind: np.ndarray  # [J] int64
    anchor: np.ndarray  # [J, 2, 3] from the centres of mass, in the bodies' axes
    axes: np.ndarray  # [J, 2, 3, 3] the joint's three axes in body axes
    number: np.ndarray  # [J, NUMBERS]
    state: np.ndarray  # [J, STATE]
    axis: np.ndarray  # [J, 1, 12] the row along which it moves


class Rows(NamedTuple):
    """The rows that joints hold, in an inner step."""

    line: np.ndarray  # [J, ROWS, 12] coefficients of a row for the velocities of both bodies
    active: np.ndarray  # [J, ROWS] int64: 0 unused, 1 for a row that holds, 2 for a spring
    # [J, ROWS]: compliance; wanted value of the row; its impulse; its error before and after the inner step
    soft: np.ndarray
    wanted: np.ndarray
    impulse: np.ndarray
    error: np.ndarray
    later: np.ndarray
    eased: np.ndarray  # [1, 24], in its second half temporarily the effect of a unit impulse on velocities


class Trial(NamedTuple):
    """Trial poses of bodies: position [N, 3], orientation [N, 4], velocity and angular [N, 3], frame [N, 3, 3]; turned
    [1, 4] and tried [1, 3, 3] are buffers for one body."""

    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    angular: np.ndarray
    frame: np.ndarray
    turned: np.ndarray
    tried: np.ndarray


class Held(NamedTuple):
    """All joints of a scene, with buffers for an inner step."""

    graph: Graph
    factors: Factors
    each: Each
    rows: Rows
    trial: Trial
    reply: np.ndarray  # [N, 6] effect of an impulse on velocities through the joints
    calm: np.ndarray  # [N] bool, whether a body is held by joints and touched by nothing else


# Kinds of bounded rows. Contacts: normal and tangential (two rows). Joints: limits, motors with friction, and the
# friction of a ball (three rows).
NORMAL_ROW, TANGENT_ROW, STOP_ROW, DRIVE_ROW, GRIP_ROW = range(5)


class Bounded(NamedTuple):
    """R bounded rows of an island."""

    kind: np.ndarray  # [R] int64
    of: np.ndarray  # [R] int64, the contact or the joint
    body: np.ndarray  # [R, 2] int64
    # [R, 24] coefficients of a row for the velocities of both bodies, and the effect of a unit impulse on these without
    # joints
    row: np.ndarray
    want: np.ndarray  # [R] the wanted change of the row's velocity
    impulse: np.ndarray  # [R]
    # [R] the row's velocity without any impulse; the largest impulses of a motor and of friction. For a tangent, grip
    # is the coefficient of friction. For a limit, strong is the distance to it that must be left after the inner step
    # (infinite if it rebounds), and grip is 1 for the lower limit and -1 for the upper.
    base: np.ndarray
    strong: np.ndarray
    grip: np.ndarray
    soft: np.ndarray  # [R] compliance of a motor with a gain: how much its speed lags behind for a unit impulse
    give: np.ndarray  # [R] effect of a unit impulse along its own row, through the joints if that is known
    now: np.ndarray  # [R] the change so far
    known: np.ndarray  # [R] the impulses before
    see: np.ndarray  # [R, R] or [0, 0]: effect of a unit impulse along all rows, through the joints


@njit(**BARE)
def asleep(island, graph, c):
    for k in range(graph.comp[c], graph.comp[c + 1]):
        if graph.node[k] >= 0:
            return island[graph.node[k]] >= 0
    return True


@njit(**BARE)
def _in_world(matrix, b, v):
    """A vector [3] from the axes of body b (below 0: the world) to those of the world."""
    return vector(v) if b < 0 else turn(matrix, b, vector(v))


@njit(**BARE)
def _arms(each, matrix, j):
    """From the centres of mass to the anchors of a joint."""
    body, anchor = each.body, each.anchor
    return _in_world(matrix, body[j, 0], anchor[j, 0]), _in_world(matrix, body[j, 1], anchor[j, 1])


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
def _errors(each, position, matrix, j, out):
    """The errors of the rows of a joint."""
    kind = each.kind[j]
    arm, other = _arms(each, matrix, j)
    way = _between(position, each.body, j, arm, other)
    for e in range(ROWS):
        out[j, e] = 0.0
    if kind == DISTANCE:
        if each.number[j, LENGTH] >= 0.0:
            out[j, 0] = norm(way) - each.number[j, LENGTH]
        return
    first = 3
    if kind == SLIDER:
        out[j, 0] = dot(_in_world(matrix, each.body[j, 1], each.axes[j, 1, 1]), way)
        out[j, 1] = dot(_in_world(matrix, each.body[j, 1], each.axes[j, 1, 2]), way)
        first = 2
    else:
        out[j, 0], out[j, 1], out[j, 2] = way[0], way[1], way[2]
    if kind == HINGE:
        a = _in_world(matrix, each.body[j, 0], each.axes[j, 0, 0])
        out[j, 3] = dot(a, _in_world(matrix, each.body[j, 1], each.axes[j, 1, 1]))
        out[j, 4] = dot(a, _in_world(matrix, each.body[j, 1], each.axes[j, 1, 2]))
    elif kind != BALL:
        for k in range(3):
            out[j, first + k] = dot(
                _in_world(matrix, each.body[j, 0], each.axes[j, 0, (k + 1) % 3]),
                _in_world(matrix, each.body[j, 1], each.axes[j, 1, (k + 2) % 3]),
            )


@njit(**BARE)
def _write(row, pull, arm, other):
    """Write a row [12] along a direction at two points."""
    one, two = cross(arm, pull), cross(other, pull)
    for x in range(3):
        row[x], row[3 + x], row[6 + x], row[9 + x] = pull[x], one[x], -pull[x], -two[x]


@njit(**BARE)
def _write_turn(row, axis):
    """Write a row [12] about an axis."""
    for x in range(3):
        row[x] = row[6 + x] = 0.0
        row[3 + x], row[9 + x] = axis[x], -axis[x]


@njit(**BARE)
def _coordinate(each, position, matrix, j):
    """The angle, position or length of a joint, and the row along which it changes."""
    kind, state = each.kind[j], each.state
    arm, other = _arms(each, matrix, j)
    way = _between(position, each.body, j, arm, other)
    if kind == HINGE:
        a, b, c = (
            _in_world(matrix, each.body[j, 0], each.axes[j, 0, 1]),
            _in_world(matrix, each.body[j, 1], each.axes[j, 1, 1]),
            _in_world(matrix, each.body[j, 1], each.axes[j, 1, 2]),
        )
        angle = math.atan2(dot(a, c), dot(a, b))
        turns = math.floor((state[j, COORD] - angle) / (2.0 * math.pi) + 0.5)
        state[j, COORD] = angle + 2.0 * math.pi * turns
        _write_turn(each.axis[j, 0], _in_world(matrix, each.body[j, 0], each.axes[j, 0, 0]))
    elif kind == SLIDER:
        a = _in_world(matrix, each.body[j, 1], each.axes[j, 1, 0])
        state[j, COORD] = dot(a, way)
        _write(each.axis[j, 0], a, arm, add(other, way))
    elif kind == BALL:
        a = _in_world(matrix, each.body[j, 0], each.axes[j, 0, 0])
        b = _in_world(matrix, each.body[j, 1], each.axes[j, 1, 0])
        n = cross(a, b)
        s = norm(n)
        state[j, COORD] = math.atan2(s, dot(a, b))
        _write_turn(each.axis[j, 0], scale(n, -1.0 / s) if s > 1e-9 else (0.0, 0.0, 0.0))
    elif kind == DISTANCE:
        length = norm(way)
        state[j, COORD] = length
        _write(each.axis[j, 0], scale(way, 1.0 / length) if length > 1e-12 else (0.0, 0.0, 1.0), arm, other)


@njit(**BARE)
def _rows(each, lines, position, matrix, j):
    """Write the rows that hold, at the present poses."""
    kind, line, active = each.kind[j], lines.line, lines.active
    arm, other = _arms(each, matrix, j)
    for e in range(ROWS):
        active[j, e] = 0
        lines.soft[j, e] = 0.0
    if kind == DISTANCE:
        if each.number[j, LENGTH] >= 0.0:
            for x in range(12):
                line[j, 0, x] = each.axis[j, 0, x]
            active[j, 0] = 1
        return
    first = 3
    if kind == SLIDER:
        far = add(other, _between(position, each.body, j, arm, other))
        _write(line[j, 0], _in_world(matrix, each.body[j, 1], each.axes[j, 1, 1]), arm, far)
        _write(line[j, 1], _in_world(matrix, each.body[j, 1], each.axes[j, 1, 2]), arm, far)
        first = 2
    else:
        for k in range(3):
            _write(line[j, k], _unit(k), arm, other)
    for e in range(first):
        active[j, e] = 1
    if kind == HINGE:
        a = _in_world(matrix, each.body[j, 0], each.axes[j, 0, 0])
        for k in range(2):
            _write_turn(line[j, 3 + k], cross(a, _in_world(matrix, each.body[j, 1], each.axes[j, 1, 1 + k])))
            active[j, 3 + k] = 1
    elif kind != BALL:
        for k in range(3):
            one, two = (
                _in_world(matrix, each.body[j, 0], each.axes[j, 0, (k + 1) % 3]),
                _in_world(matrix, each.body[j, 1], each.axes[j, 1, (k + 2) % 3]),
            )
            _write_turn(line[j, first + k], cross(one, two))
            active[j, first + k] = 1


@njit(**BARE)
def _reads(row, motion, a, b):
    """The velocity of a row [12], from the velocities of both bodies."""
    total = 0.0
    for x in range(3):
        if a >= 0:
            total += row[x] * motion.velocity[a, x] + row[3 + x] * motion.angular[a, x]
        if b >= 0:
            total += row[6 + x] * motion.velocity[b, x] + row[9 + x] * motion.angular[b, x]
    return total


@njit(**BARE)
def _reads_six(row, change, a, b):
    """Likewise from changes [N, 6]."""
    total = 0.0
    for x in range(6):
        if a >= 0:
            total += row[x] * change[a, x]
        if b >= 0:
            total += row[6 + x] * change[b, x]
    return total


@njit(**BARE)
def _eased(world, work, rules, row, a, b, out):
    """Write the effect of a unit impulse along a row [12] on both bodies' velocities, without joints, after the first
    12 numbers of `out` [24]. Returns its effect along the row."""
    total = 0.0
    for s in range(2):
        body, first = (a, 0) if s == 0 else (b, 6)
        for x in range(6):
            out[12 + first + x] = 0.0
        if body >= 0 and world.moves[body]:
            spin = turn(work.inverse, body, (row[first + 3], row[first + 4], row[first + 5]))
            for x in range(3):
                out[12 + first + x] = world.inverse_mass[body] * row[first + x]
                out[15 + first + x] = spin[x] if rules.options.rotation else 0.0
            for x in range(6):
                total += row[first + x] * out[12 + first + x]
    return total


@njit(**BARE)
def _late(z):
    """The share that the velocity after an inner step has in the mean that damps exactly; `z` is the damping relative
    to what stops the row in an inner step."""
    return 0.5 + z / 12.0 if z < 0.01 else 1.0 / (1.0 - math.exp(-z)) - 1.0 / z


@njit(**BARE)
def _springs(world, work, motion, rules, each, lines, j):
    """Springs and damping as soft rows, with the mean of the forces before and after the inner step."""
    number, state, kind, h = each.number, each.state, each.kind[j], rules.substep_dt
    stiff, damping = number[j, STIFFNESS], number[j, DAMPING]
    if stiff <= 0.0 and damping <= 0.0:
        return
    a, b = each.body[j, 0], each.body[j, 1]
    for k in range(3 if kind == BALL else 1):
        e = 3 + k if kind == BALL else (5 if kind != DISTANCE else 1)
        if kind == BALL:
            _write_turn(lines.line[j, e], _unit(k))
        else:
            for x in range(12):
                lines.line[j, e, x] = each.axis[j, 0, x]
        late = _late(damping * h * _eased(world, work, rules, lines.line[j, e], a, b, lines.eased[0]))
        give = h * (0.25 * stiff * h + damping * late)
        before = _reads(lines.line[j, e], motion, a, b)
        lines.active[j, e] = 2
        lines.soft[j, e] = 1.0 / give
        away = state[j, COORD] - number[j, REST] if stiff > 0.0 else 0.0
        lines.wanted[j, e] = before - h * (stiff * away + damping * before) / give


@njit(**FAST)
def assemble(world, work, motion, rules, held, springs):
    """Write the rows of all joints that are awake, and factor their matrix. Bodies are moved if rows do not hold.
    `springs`: whether to include springs."""
    graph, factors, each, lines = held.graph, held.factors, held.each, held.rows
    for c in range(len(graph.comp) - 1):
        if asleep(motion.island, graph, c):
            continue
        for attempt in range(3):
            worst = 0.0
            for k in range(graph.comp[c], graph.comp[c + 1]):
                if graph.node[k] < 0:
                    j = -1 - graph.node[k]
                    _coordinate(each, motion.position, work.matrix, j)
                    if each.state[j, BROKEN] > 0.0:
                        for e in range(ROWS):
                            lines.active[j, e] = 0
                            lines.error[j, e] = lines.soft[j, e] = 0.0
                        continue
                    _rows(each, lines, motion.position, work.matrix, j)
                    _errors(each, motion.position, work.matrix, j, lines.error)
                    for e in range(ROWS):
                        lines.wanted[j, e] = each.state[j, BEND + e] if springs else 0.0
                        worst = max(worst, abs(lines.error[j, e]))
                    if springs:
                        _springs(world, work, motion, rules, each, lines, j)
            _factor(world, work, motion, rules, graph, factors, each, lines, c)
            if worst <= STRETCH or attempt == 2:
                break
            _mend(world, work, motion, rules, graph, factors, lines, c)


@njit(**BARE)
def _mend(world, work, motion, rules, graph, factors, lines, c):
    """Move bodies so that rows hold, by the smallest change in the metric of their masses."""
    for k in range(graph.comp[c], graph.comp[c + 1]):
        for e in range(6):
            factors.x[k, e] = 0.0
        if graph.node[k] < 0:
            j = -1 - graph.node[k]
            for e in range(ROWS):
                if lines.active[j, e] == 1:
                    factors.x[k, e] = lines.error[j, e]
    _substitute(graph, factors, c, graph.comp[c])
    most = 0.0
    for k in range(graph.comp[c], graph.comp[c + 1]):
        b = graph.node[k]
        if b >= 0:
            moved, turned = get(factors.x, k), (factors.x[k, 3], factors.x[k, 4], factors.x[k, 5])
            most = max(most, norm(moved), norm(turned))
    share = 1.0 if most <= REACH else REACH / most
    for k in range(graph.comp[c], graph.comp[c + 1]):
        b = graph.node[k]
        if b >= 0:
            moved, turned = get(factors.x, k), (factors.x[k, 3], factors.x[k, 4], factors.x[k, 5])
            put(motion.position, b, along(get(motion.position, b), moved, share))
            if rules.options.rotation:
                q = turned_by(scale(turned, share), motion.orientation, b)
                for x in range(4):
                    motion.orientation[b, x] = q[x]
                to_matrix(motion.orientation, b, work.matrix)
            if world.radius[b] < math.inf:
                work.gone[b] += share * (norm(moved) + norm(turned) * world.radius[b])


@njit(**BARE)
def _factor(world, work, motion, rules, graph, factors, each, lines, c):
    """The matrix of masses and rows, factored block by block."""
    first, last = graph.comp[c], graph.comp[c + 1]
    for k in range(first, last):
        for p in range(graph.below[k], graph.below[k + 1]):
            for x in range(6):
                for y in range(6):
                    factors.block[p, x, y] = 0.0
        for x in range(6):
            for y in range(6):
                factors.diagonal[k, x, y] = 0.0
        b = graph.node[k]
        if b >= 0:
            for x in range(3):
                factors.diagonal[k, x, x] = 1.0 / world.inverse_mass[b]
                for y in range(3):
                    total = 0.0
                    for u in range(3):
                        for w in range(3):
                            total += work.matrix[b, x, u] * world.inertia[b, u, w] * work.matrix[b, y, w]
                    factors.diagonal[k, 3 + x, 3 + y] = total
    for k in range(first, last):
        if graph.node[k] >= 0:
            continue
        j = -1 - graph.node[k]
        for e in range(ROWS):
            factors.diagonal[k, e, e] = -1.0
            if lines.active[j, e] > 0:
                eased = _eased(world, work, rules, lines.line[j, e], each.body[j, 0], each.body[j, 1], lines.eased[0])
                factors.diagonal[k, e, e] = -lines.soft[j, e] - SOFTEN * eased
                if eased == 0.0:
                    factors.diagonal[k, e, e] = -1.0
        for s in range(2):
            p = graph.entry[j, s]
            if p < 0:
                continue
            lower = graph.row[p] == k
            for e in range(ROWS):
                if lines.active[j, e] == 0:
                    continue
                for x in range(6):
                    value = -lines.line[j, e, 6 * s + x] if x < 3 or rules.options.rotation else 0.0
                    if lower:
                        factors.block[p, e, x] = value
                    else:
                        factors.block[p, x, e] = value
    for k in range(first, last):
        _invert(factors.diagonal, factors.inverse, k)
        t = graph.start[k]
        for p in range(graph.below[k], graph.below[k + 1]):
            _multiply(factors.low, factors.block, factors.inverse, p, k)
            for q in range(graph.below[k], p + 1):
                target = graph.target[t]
                t += 1
                if target < 0:
                    _subtract(factors.diagonal, -1 - target, factors.low, p, factors.block, q)
                else:
                    _subtract(factors.block, target, factors.low, p, factors.block, q)


@njit(**BARE)
def _invert(diagonal, inverse, k):
    """Gauss-Jordan elimination without pivoting: the blocks are definite."""
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
def _substitute(graph, factors, c, first):
    """Solve for the right-hand side `x`, which is 0 before node `first`."""
    x, low, last = factors.x, factors.low, graph.comp[c + 1]
    for k in range(first, last):
        for p in range(graph.below[k], graph.below[k + 1]):
            _take_off(x, graph.row[p], low[p], k)
    for k in range(last - 1, graph.comp[c] - 1, -1):
        a, b, d, e, f, g = x[k, 0], x[k, 1], x[k, 2], x[k, 3], x[k, 4], x[k, 5]
        for i in range(6):
            m = factors.inverse[k, i]
            x[k, i] = m[0] * a + m[1] * b + m[2] * d + m[3] * e + m[4] * f + m[5] * g
        for p in range(graph.below[k], graph.below[k + 1]):
            _take_off(x, k, low[p].T, graph.row[p])


@njit(**BARE)
def _take_off(x, k, block, of):
    """Subtract from row k of x [K, 6] the product of a block [6, 6] with another row."""
    for i in range(6):
        total = 0.0
        for u in range(6):
            total += block[i, u] * x[of, u]
        x[k, i] -= total


@njit(**BARE)
def _project(world, work, motion, graph, factors, each, lines, c, change, whole):
    """Add to `change` so that the rows hold. `whole`: for the full velocities, with the values that the rows want; else
    for the change alone, which must be zero along the rows."""
    free = work.free
    for k in range(graph.comp[c], graph.comp[c + 1]):
        n = graph.node[k]
        for e in range(6):
            factors.x[k, e] = 0.0
        if n < 0:
            j = -1 - n
            a, b = each.body[j, 0], each.body[j, 1]
            for e in range(ROWS):
                if lines.active[j, e] == 0:
                    continue
                now = _reads_six(lines.line[j, e], change, a, b)
                if whole:
                    now += _reads(lines.line[j, e], motion, a, b)
                    now += _reads_six(lines.line[j, e], free, a, b)
                    now += lines.soft[j, e] * lines.impulse[j, e] - lines.wanted[j, e]
                factors.x[k, e] = now
    _substitute(graph, factors, c, graph.comp[c])
    for k in range(graph.comp[c], graph.comp[c + 1]):
        n = graph.node[k]
        if n >= 0:
            for x in range(6):
                change[n, x] += factors.x[k, x]
        elif whole:
            for e in range(ROWS):
                lines.impulse[-1 - n, e] += factors.x[k, e]


@njit(**BARE)
def _bend(world, work, motion, rules, graph, each, lines, trial, c):
    """Move the bodies on trial by the inner step, and correct the wanted values of the rows by their errors there.
    Returns the largest error."""
    h = rules.substep_dt
    for k in range(graph.comp[c], graph.comp[c + 1]):
        n = graph.node[k]
        if n >= 0:
            _tried(world, work, motion, rules, trial, n)
            continue
        for s in range(2):
            b = each.body[-1 - n, s]
            if b >= 0 and graph.of_body[b] < 0:
                _tried(world, work, motion, rules, trial, b)
    worst = 0.0
    for k in range(graph.comp[c], graph.comp[c + 1]):
        if graph.node[k] < 0:
            j = -1 - graph.node[k]
            if each.state[j, BROKEN] > 0.0:
                continue
            _errors(each, trial.position, trial.frame, j, lines.later)
            for e in range(ROWS):
                if lines.active[j, e] == 1:
                    error = lines.later[j, e] - lines.error[j, e]
                    lines.wanted[j, e] -= error / h
                    worst = max(worst, abs(error))
    return worst


@njit(**BARE)
def _tried(world, work, motion, rules, trial, b):
    """Where a body would be after the inner step."""
    h, change, free = rules.substep_dt, work.change, work.free
    v, w = get(motion.velocity, b), get(motion.angular, b)
    for x in range(4):
        trial.orientation[b, x] = motion.orientation[b, x]
    for x in range(3):
        for y in range(3):
            trial.frame[b, x, y] = work.matrix[b, x, y]
    if world.moves[b]:
        v = add(v, add((free[b, 0], free[b, 1], free[b, 2]), (change[b, 0], change[b, 1], change[b, 2])))
        w = add(w, add((free[b, 3], free[b, 4], free[b, 5]), (change[b, 3], change[b, 4], change[b, 5])))
    put(trial.position, b, along(get(motion.position, b), v, h))
    if not rules.options.rotation and world.moves[b]:
        return
    put(trial.angular, b, w)
    if world.moves[b] and not world.isotropic[b]:
        torque_free(world, trial.orientation, trial.angular, trial.frame, h, trial.turned, trial.tried, b)
    elif w[0] != 0.0 or w[1] != 0.0 or w[2] != 0.0:
        q = turned_by(scale(w, h), trial.orientation, b)
        for x in range(4):
            trial.orientation[b, x] = q[x]
        to_matrix(trial.orientation, b, trial.frame)


@njit(**BARE)
def _limited(world, work, motion, rules, graph, each, c, rows, count, steady):
    """Write the bounded rows of joints after `count` others. Returns the new number of rows. `steady`: only limits that
    hold, as after an inner step."""
    h, number, state = rules.substep_dt, each.number, each.state
    for k in range(graph.comp[c], graph.comp[c + 1]):
        if graph.node[k] >= 0:
            continue
        j = -1 - graph.node[k]
        if state[j, BROKEN] > 0.0:
            continue
        a, b, coord = each.body[j, 0], each.body[j, 1], state[j, COORD]
        before = _reads(each.axis[j, 0], motion, a, b)
        free = before + _reads_six(each.axis[j, 0], work.free, a, b)
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
                rows.row[count, x] = sign * each.axis[j, 0, x]
            _begin(world, work, motion, rules, each, rows, count, STOP_ROW, j, aim, then)
            rows.impulse[count] = 0.0 if steady else max(0.0, sign * state[j, STOP])
            rows.strong[count], rows.grip[count] = left, sign
            count += 1
        if steady or each.kind[j] > BALL:
            continue
        grip, most, motor = h * number[j, DRAG], h * number[j, MOST], number[j, MOTOR]
        if motor == 0.0:
            most = 0.0
        if each.kind[j] == BALL:
            for e in range(3 if grip > 0.0 else 0):
                for x in range(12):
                    rows.row[count, x] = 0.0
                rows.row[count, 3 + e], rows.row[count, 9 + e] = 1.0, -1.0
                now = 0.0
                if a >= 0:
                    now += motion.angular[a, e] + work.free[a, 3 + e]
                if b >= 0:
                    now -= motion.angular[b, e] + work.free[b, 3 + e]
                _begin(world, work, motion, rules, each, rows, count, GRIP_ROW, j, 0.0, now)
                rows.impulse[count], rows.grip[count] = state[j, DRIVE + e], grip
                count += 1
        elif grip > 0.0 or most > 0.0:
            aim, soft, gain = 0.0, 0.0, number[j, GAIN]
            if motor == 1.0:
                aim = state[j, TARGET]
            elif motor == 2.0:
                aim = (state[j, TARGET] - coord) / max(number[j, TIME], h)
            if motor > 0.0 and gain > 0.0:
                ease = _eased(world, work, rules, each.axis[j, 0], a, b, rows.row[count])
                aim, soft = _servo(motor, gain, number[j, TIME], state[j, TARGET], coord, before, h, ease)
            # A motor with a gain and friction are rows of their own.
            for part in range(2 if soft > 0.0 and grip > 0.0 else 1):
                for x in range(12):
                    rows.row[count, x] = each.axis[j, 0, x]
                _begin(world, work, motion, rules, each, rows, count, DRIVE_ROW, j, aim if part == 0 else 0.0, free)
                rows.impulse[count], rows.grip[count], rows.strong[count] = state[j, DRIVE], grip, most
                if soft > 0.0:
                    own = state[j, DRIVE + 1]
                    rows.impulse[count] = own if part == 0 else state[j, DRIVE] - own
                    rows.grip[count], rows.strong[count] = grip * part, most * (1 - part)
                    rows.soft[count] = soft * (1 - part)
                count += 1
    return count


@njit(**BARE)
def _servo(motor, gain, time, target, coord, before, h, ease):
    """The speed and the compliance of a motor with a gain, as a row; `ease` is the effect of a unit impulse on it. The
    force is the mean over the inner steps around (1/4, 1/2, 1/4), with damping where the inner step does not resolve
    the period."""
    if motor == 1.0:
        late = _late(gain * h * ease)
        return (target - (1.0 - late) * before) / late, 1.0 / (h * gain * late)
    damping = gain * time
    late = _late(damping * h * ease)
    coarse = max(0.0, 1.0 - RESOLVED / (gain * h * h * ease))
    stiff = gain * h * (0.25 + coarse) + damping * late
    push = gain * (target - coord) + (0.25 * gain * h - damping * (1.0 - late)) * before
    return push / stiff, 1.0 / (h * stiff)


@njit(**BARE)
def _begin(world, work, motion, rules, each, rows, r, kind, j, aim, base):
    rows.kind[r], rows.of[r] = kind, j
    rows.body[r, 0], rows.body[r, 1] = each.body[j, 0], each.body[j, 1]
    rows.base[r], rows.want[r] = base, aim - base
    rows.strong[r] = rows.grip[r] = rows.soft[r] = 0.0
    rows.give[r] = _eased(world, work, rules, rows.row[r], each.body[j, 0], each.body[j, 1], rows.row[r])


@njit(**BARE)
def _touched(inverse_mass, system, island, rows):
    """Write the rows of an island's contacts. Returns their number."""
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
                rows.row[count, 12 + x] = own[AXIS + x] * inverse_mass[a]
                rows.row[count, 18 + x] = -own[AXIS + x] * inverse_mass[b]
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


@njit(**BARE)
def _see(world, work, motion, graph, factors, reply, rows, count):
    """The effect of a unit impulse along each row on all rows, through the joints."""
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
            k = graph.of_body[b]
            if k < 0 or motion.island[b] >= 0:
                for x in range(6):
                    reply[b, x] += rows.row[r, 12 + 6 * s + x]
                continue
            c = graph.of_comp[b]
            if c != one and c != other:
                for i in range(graph.comp[c], graph.comp[c + 1]):
                    for x in range(6):
                        factors.x[i, x] = 0.0
                if one < 0:
                    one = c
                else:
                    other = c
            for x in range(6):
                factors.x[k, x] += rows.row[r, 6 * s + x]
        for c in (one, other):
            if c >= 0:
                _substitute(graph, factors, c, graph.comp[c])
                for i in range(graph.comp[c], graph.comp[c + 1]):
                    if graph.node[i] >= 0:
                        for x in range(6):
                            reply[graph.node[i], x] = factors.x[i, x]
        for q in range(count):
            rows.see[r, q] = _read(rows, q, reply)
        rows.give[r] = rows.see[r, r] if rows.see[r, r] > BLOCKED * rows.give[r] else 0.0
        for s in range(2):
            b = rows.body[r, s]
            if b >= 0:
                for x in range(6):
                    reply[b, x] = 0.0
        for c in (one, other):
            if c >= 0:
                for i in range(graph.comp[c], graph.comp[c + 1]):
                    if graph.node[i] >= 0:
                        for x in range(6):
                            reply[graph.node[i], x] = 0.0


@njit(**BARE)
def _step(moves, rows, count, r, total, change):
    """Give a row its impulse. Returns the change of the row's velocity."""
    step = total - rows.impulse[r]
    if step == 0.0:
        return 0.0
    rows.impulse[r] = total
    if len(rows.see):
        now, seen = rows.now, rows.see[r]  # names outside of the loop, so that it becomes vector code
        for q in range(count):
            now[q] += step * seen[q]
    else:
        _give(moves, rows, r, step, change)
    return abs(step) * rows.give[r]


@njit(**BARE)
def _short(rows, r, change):
    """What a row lacks of its wanted change."""
    return rows.want[r] - (rows.now[r] if len(rows.see) else _read(rows, r, change))


@njit(**BARE)
def _driven(now, aim, give, most, grip):
    """The impulse of a motor with friction; `now` is the speed without it."""
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
def _grip(moves, rows, count, r, change):
    """Relax the three rows of a ball joint's friction, which are bounded together. Returns the largest change."""
    known = rows.impulse[r], rows.impulse[r + 1], rows.impulse[r + 2]
    for q in range(r, r + 3):
        if rows.give[q] > 0.0:
            _step(moves, rows, count, q, rows.impulse[q] + _short(rows, q, change) / rows.give[q], change)
    length = math.sqrt(rows.impulse[r] ** 2 + rows.impulse[r + 1] ** 2 + rows.impulse[r + 2] ** 2)
    if length > rows.grip[r]:
        for q in range(r, r + 3):
            _step(moves, rows, count, q, rows.impulse[q] * rows.grip[r] / length, change)
    worst = 0.0
    for x in range(3):
        worst = max(worst, abs(rows.impulse[r + x] - known[x]) * rows.give[r + x])
    return worst


@njit(**BARE)
def _sweep(moves, rows, count, change):
    """Relax all bounded rows one after the other, friction of contacts last. Returns the largest change."""
    worst, last = 0.0, -1
    for r in range(count):
        kind = rows.kind[r]
        if kind == GRIP_ROW and r > last:
            worst, last = max(worst, _grip(moves, rows, count, r, change)), r + 2
        if kind == GRIP_ROW or kind == TANGENT_ROW:
            continue
        if rows.give[r] <= 0.0:
            _step(moves, rows, count, r, 0.0, change)
            continue
        total = rows.impulse[r] + _short(rows, r, change) / rows.give[r]
        if kind == NORMAL_ROW or kind == STOP_ROW:
            total = max(total, 0.0)
        elif kind == DRIVE_ROW:
            aim = rows.base[r] + rows.want[r]
            now = aim - _short(rows, r, change) - rows.impulse[r] * rows.give[r]
            if rows.soft[r] > 0.0:
                total = min(max((aim - now) / (rows.give[r] + rows.soft[r]), -rows.strong[r]), rows.strong[r])
            else:
                total = _driven(now, aim, rows.give[r], rows.strong[r], rows.grip[r])
        worst = max(worst, _step(moves, rows, count, r, total, change))
    r = 0
    while r < count:
        if rows.kind[r] != TANGENT_ROW:
            r += 1
            continue
        most = rows.grip[r] * rows.impulse[r - 1]
        give, one, other = max(rows.give[r], rows.give[r + 1]), 0.0, 0.0
        if rows.give[r] > 0.0:
            one = rows.impulse[r] + _short(rows, r, change) / give
        if rows.give[r + 1] > 0.0:
            other = rows.impulse[r + 1] + _short(rows, r + 1, change) / give
        share = _within(one, other, most)
        worst = max(worst, _step(moves, rows, count, r, share * one, change))
        worst = max(worst, _step(moves, rows, count, r + 1, share * other, change))
        r += 2
    return worst


@njit(**BARE)
def _all_rows(world, work, motion, rules, system, graph, each, comps, lo, hi, island, rows):
    """Write the bounded rows of an island, and apply their known impulses to the bodies."""
    count = _touched(world.inverse_mass, system, island, rows)
    for i in range(lo, hi):
        count = _limited(world, work, motion, rules, graph, each, comps[i], rows, count, False)
    for r in range(count):
        if rows.impulse[r] != 0.0:
            _give(world.moves, rows, r, rows.impulse[r], work.change)
    return count


@njit(**BARE)
def _hold(world, work, motion, rules, held, comps, lo, hi, rows, count, steady):
    """Solve for all impulses of an island so that its rows hold after the inner step."""
    graph, factors, each, lines = held.graph, held.factors, held.each, held.rows
    change, h = work.change, rules.substep_dt
    for i in range(lo, hi):
        for k in range(graph.comp[comps[i]], graph.comp[comps[i] + 1]):
            if graph.node[k] < 0:
                for e in range(ROWS):
                    lines.impulse[-1 - graph.node[k], e] = 0.0
        _project(world, work, motion, graph, factors, each, lines, comps[i], change, True)
    for _ in range(ROUNDS):
        if count:
            for r in range(count):
                rows.known[r] = rows.impulse[r]
                rows.now[r] = _read(rows, r, change)
            for _ in range(rules.rounds):
                worst = _sweep(world.moves, rows, count, change)
                if len(rows.see) == 0:
                    for i in range(lo, hi):
                        _project(world, work, motion, graph, factors, each, lines, comps[i], change, True)
                if worst <= EXACT * rules.exact:
                    break
            if len(rows.see):
                for r in range(count):
                    if rows.impulse[r] != rows.known[r]:
                        _give(world.moves, rows, r, rows.impulse[r] - rows.known[r], change)
                for i in range(lo, hi):
                    _project(world, work, motion, graph, factors, each, lines, comps[i], change, True)
        if steady:
            return
        worst = 0.0
        for i in range(lo, hi):
            worst = max(worst, _bend(world, work, motion, rules, graph, each, lines, held.trial, comps[i]))
        for r in range(count):
            if rows.kind[r] == STOP_ROW and rows.impulse[r] > 0.0 and rows.strong[r] < math.inf:
                j = rows.of[r]
                coord = each.state[j, COORD]
                _coordinate(each, held.trial.position, held.trial.frame, j)
                sign = rows.grip[r]
                gap = sign * (each.state[j, COORD] - each.number[j, LOW if sign > 0.0 else HIGH])
                each.state[j, COORD] = coord
                for x in range(12):
                    each.axis[j, 0, x] = sign * rows.row[r, x]
                rows.want[r] -= (gap - rows.strong[r]) / h
                worst = max(worst, abs(gap - rows.strong[r]))
        if worst <= HOLDS:
            return
        for i in range(lo, hi):
            _project(world, work, motion, graph, factors, each, lines, comps[i], change, True)


@njit(**BARE)
def _clear(graph, system, island, comps, lo, hi, change):
    for o in range(system.start[island], system.start[island + 1]):
        c = system.order[o]
        for x in range(6):
            change[system.where[c, 2], x] = change[system.where[c, 3], x] = 0.0
    for i in range(lo, hi):
        for k in range(graph.comp[comps[i]], graph.comp[comps[i] + 1]):
            if graph.node[k] >= 0:
                for x in range(6):
                    change[graph.node[k], x] = 0.0


@njit(**FAST)
def _room(count):
    return Bounded(
        np.empty(count, np.int64), np.empty(count, np.int64), np.empty((count, 2), np.int64), np.empty((count, 24)),
        np.empty(count), np.empty(count), np.empty(count), np.empty(count), np.empty(count), np.empty(count),
        np.empty(count), np.empty(count), np.empty(count), np.empty((0, 0)),
    )  # fmt: skip


@njit(**FAST)
def _solve_island(world, work, motion, rules, system, held, comps, lo, hi, island):
    """Solve an island with joints: as `impulses._solve`, through the joints."""
    graph, factors, each, lines = held.graph, held.factors, held.each, held.rows
    contacts = system.start[island + 1] - system.start[island]
    most = 3 * contacts
    for i in range(lo, hi):
        most += 4 * (graph.comp[comps[i] + 1] - graph.comp[comps[i]])
    lively = deep = False
    for o in range(system.start[island], system.start[island + 1]):
        c = system.order[o]
        deep = deep or system.wanted[c] > 0.0
        lively = lively or system.row[c, 0, WANTED] > system.calm[c, 0]
    if deep:
        _resolve_penetration(world.inverse_mass, rules, system, work.shift, island, rules.rounds)
        for i in range(lo, hi):
            _project(world, work, motion, graph, factors, each, lines, comps[i], work.shift, False)
    room = _room(most)
    count = _all_rows(world, work, motion, rules, system, graph, each, comps, lo, hi, island, reference(room))
    bounded = _seen(room, count if count <= DENSE else 0)
    _solve_rows(world, work, motion, rules, system, held, comps, lo, hi, island, bounded, count, lively, deep)


@njit(**BARE)
def _solve_rows(world, work, motion, rules, system, held, comps, lo, hi, island, bounded, count, lively, deep):
    graph, factors, each, lines, rows = held.graph, held.factors, held.each, held.rows, reference(bounded)
    if len(rows.see):
        _see(world, work, motion, graph, factors, held.reply, rows, count)
    for _ in range(BREAKS):
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
            _clear(graph, system, island, comps, lo, hi, work.change)
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
            _record_held(world, work, motion, rules, graph, each, lines, held.calm, comps[i], touched or deep)
        for r in range(count):
            if rows.kind[r] >= STOP_ROW:
                rows.known[r] = _record_bounded(world, work, motion, rules, each, rows, r)
        broke = False
        for i in range(lo, hi):
            if _broken(graph, each, lines, comps[i]):
                broke = True
                _factor(world, work, motion, rules, graph, factors, each, lines, comps[i])
        if not broke:
            for r in range(count):
                if rows.kind[r] >= STOP_ROW:
                    each.state[rows.of[r], GIVEN] += rows.known[r]
            break
        # Broken joints no longer hold: find all impulses again.
        _clear(graph, system, island, comps, lo, hi, work.change)
        if len(rows.see):
            _see(world, work, motion, graph, factors, held.reply, rows, count)
        for r in range(count):
            rows.impulse[r] = 0.0
            if rows.kind[r] >= STOP_ROW and each.state[rows.of[r], BROKEN] > 0.0:
                rows.give[r] = 0.0


@njit(**FAST)
def _seen(rows, count):
    return Bounded(
        rows.kind, rows.of, rows.body, rows.row, rows.want, rows.impulse, rows.base, rows.strong, rows.grip, rows.soft,
        rows.give, rows.now, rows.known, np.empty((count, count)),
    )  # fmt: skip


@njit(**BARE)
def _record_held(world, work, motion, rules, graph, each, lines, calm, c, touched):
    """Record the forces and torques of the rows that hold."""
    h, state = rules.substep_dt, each.state
    for k in range(graph.comp[c], graph.comp[c + 1]):
        n = graph.node[k]
        if n >= 0:
            calm[n] = not touched
            if touched:
                motion.touching[n] = True
            continue
        j = -1 - n
        a, b = each.body[j, 0], each.body[j, 1]
        speed = _reads(each.axis[j, 0], motion, a, b)
        state[j, SPEED] = speed + _reads_six(each.axis[j, 0], work.free, a, b)
        state[j, SPEED] += _reads_six(each.axis[j, 0], work.change, a, b)
        for x in range(3):
            state[j, PULL + x] = state[j, TWIST + x] = state[j, DRIVE + x] = state[j, SOFT + x] = 0.0
        state[j, STOP] = state[j, FRESH] = 0.0
        for e in range(ROWS):
            state[j, BEND + e] = lines.wanted[j, e] if lines.active[j, e] == 1 else 0.0
            if lines.active[j, e] == 0:
                continue
            if lines.active[j, e] == 2:
                state[j, SOFT + (e - 3 if each.kind[j] == BALL else 0)] = lines.impulse[j, e]
            _add_pull(work.matrix, each, j, lines.line[j, e], lines.impulse[j, e] / h)


@njit(**BARE)
def _add_pull(matrix, each, j, row, force):
    """Add the effect of a row [12] to the force and the torque on the first body, about its anchor."""
    arm, _ = _arms(each, matrix, j)
    pull = vector(row)
    twist = sub((row[3], row[4], row[5]), cross(arm, pull))
    for x in range(3):
        each.state[j, PULL + x] += force * pull[x]
        each.state[j, TWIST + x] += force * twist[x]


@njit(**BARE)
def _record_bounded(world, work, motion, rules, each, rows, r):
    """Record the impulse of a bounded row of a joint. Returns the work of its motor."""
    j, kind, impulse, h, state = rows.of[r], rows.kind[r], rows.impulse[r], rules.substep_dt, each.state
    _add_pull(work.matrix, each, j, rows.row[r], impulse / h)
    if kind == STOP_ROW:
        state[j, STOP] += rows.grip[r] * impulse
    elif kind == DRIVE_ROW:
        state[j, DRIVE] += impulse  # a motor with a gain and friction are two rows
        if rows.strong[r] > 0.0:
            before = _reads(each.axis[j, 0], motion, each.body[j, 0], each.body[j, 1])
            mean = 0.5 * (before + state[j, SPEED])
            own = impulse + (rows.grip[r] if mean > 0.0 else -rows.grip[r])
            state[j, DRIVE + 1] = min(max(own, -rows.strong[r]), rows.strong[r])
            return state[j, DRIVE + 1] * mean
    else:
        for e in range(3):
            if rows.row[r, 3 + e] != 0.0:
                state[j, DRIVE + e] = impulse
    return 0.0


@njit(**BARE)
def _broken(graph, each, lines, c):
    """Break the joints that bear more than they can. Returns whether any broke."""
    found = False
    for k in range(graph.comp[c], graph.comp[c + 1]):
        if graph.node[k] < 0:
            j = -1 - graph.node[k]
            own, number = each.state[j], each.number[j]
            pull = norm((own[PULL], own[PULL + 1], own[PULL + 2]))
            twist = norm((own[TWIST], own[TWIST + 1], own[TWIST + 2]))
            if own[BROKEN] == 0.0 and (pull > number[FORCE] or twist > number[TORQUE]):
                own[BROKEN] = 1.0
                found = True
                for e in range(ROWS):
                    lines.active[j, e] = 0
                    lines.soft[j, e] = 0.0
    return found


@njit(**FAST)
def _islands(world, work, motion, graph, where):
    """Contacts and connected joints ordered by island: dynamic bodies that either joins.

    Returns:
        start [I + 1] and order [C] of contacts, and the same for the components that joints connect; sleeping
        components are left out.
    """
    parent, number, connected = work.parent, work.number, len(graph.comp) - 1
    for k in range(len(graph.node)):
        if graph.node[k] >= 0:
            parent[graph.node[k]], number[graph.node[k]] = graph.node[k], -1
    for c in range(len(where)):
        for e in range(2, 4):
            parent[where[c, e]], number[where[c, e]] = where[c, e], -1
    own = np.empty(connected, np.int64)
    for c in range(connected):
        own[c] = -1
        for k in range(graph.comp[c], graph.comp[c + 1]):
            if graph.node[k] >= 0:
                if own[c] >= 0:
                    join(parent, own[c], graph.node[k])
                own[c] = graph.node[k]
        if asleep(motion.island, graph, c):
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
    """Where each label begins, and the indices of the entries that have it; -1 is no label."""
    start = np.zeros(count + 1, np.int64)
    for c in range(len(label)):
        if label[c] >= 0:
            start[label[c] + 1] += 1
    for i in range(count):
        start[i + 1] += start[i]
    fill, order = np.empty(count, np.int64), np.empty(len(label), np.int64)
    for i in range(count):
        fill[i] = start[i]
    for c in range(len(label)):
        if label[c] >= 0:
            order[fill[label[c]]] = c
            fill[label[c]] += 1
    return start, order


@njit(**FAST, inline="always")
def solve_with_joints(world, work, motion, rules, manifolds, held):
    """Solve for the impulses of all contacts and joints, in place of `impulses.solve_contacts`. Returns the same."""
    graph = held.graph
    found = _equations(world, work, motion, rules, manifolds)
    start, order, begin, comps = _islands(world, work, motion, graph, found.where)
    system = System(found.where, found.row, found.friction, found.wanted, found.pushed, found.calm, start, order)
    equations = reference(system)
    for i in range(len(start) - 1):
        if begin[i + 1] > begin[i]:
            _solve_island(world, work, motion, rules, equations, held, comps, begin[i], begin[i + 1], np.int64(i))
        else:
            _solve(world.inverse_mass, rules, equations, work.change, work.shift, np.int64(i))
    remembered(manifolds, equations)
    return system


@njit(**BARE)
def _ready(world, work, rules, graph, c, share):
    """Inverse inertias of bodies in world axes, and the effect of pulls on them in a share of an inner step."""
    for k in range(graph.comp[c], graph.comp[c + 1]):
        b = graph.node[k]
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
def _resting(touching, graph, c):
    """Whether contacts act on a component: its velocities are then those of a whole inner step."""
    for k in range(graph.comp[c], graph.comp[c + 1]):
        if graph.node[k] >= 0 and touching[graph.node[k]]:
            return True
    return False


@njit(**BARE)
def _work_at(motion, graph, each, c, share):
    """Add to the work of motors that of a share of their impulses in the last inner step at the present speeds."""
    for k in range(graph.comp[c], graph.comp[c + 1]):
        j = -1 - graph.node[k]
        if j >= 0 and each.kind[j] != BALL and each.state[j, DRIVE + 1] != 0.0:
            speed = _reads(each.axis[j, 0], motion, each.body[j, 0], each.body[j, 1])
            each.state[j, GIVEN] += share * each.state[j, DRIVE + 1] * speed


@njit(**BARE)
def _kick(world, work, motion, rules, graph, each, lines, c, share):
    """Add to velocities a share of the impulses of springs, damping, motors and friction in the last inner step.
    `_projected` completes it. Returns whether there were any."""
    state, found = each.state, False
    _work_at(motion, graph, each, c, 0.5 * share)
    for k in range(graph.comp[c], graph.comp[c + 1]):
        if graph.node[k] >= 0:
            continue
        j = -1 - graph.node[k]
        if state[j, BROKEN] > 0.0:
            continue
        a, b = each.body[j, 0], each.body[j, 1]
        for e in range(3 if each.kind[j] == BALL else 1):
            impulse = share * (state[j, SOFT + e] + state[j, DRIVE + e])
            if impulse == 0.0:
                continue
            found = True
            row = each.axis[j, 0]
            if each.kind[j] == BALL:
                row = lines.line[j, 3 + e]
                _write_turn(row, _unit(e))
            _eased(world, work, rules, row, a, b, lines.eased[0])
            for s in range(2):
                body = each.body[j, s]
                if body >= 0 and world.moves[body]:
                    for x in range(3):
                        motion.velocity[body, x] += impulse * lines.eased[0, 12 + 6 * s + x]
                        motion.angular[body, x] += impulse * lines.eased[0, 15 + 6 * s + x]
    return found


@njit(**BARE)
def _projected(world, work, motion, rules, held, one, share, limits):
    """Change the velocities of a component, after `_kick` by `share`, to those that its joints allow; with `limits`,
    also those limits that hold."""
    graph, each, c = held.graph, held.each, one[0]
    rows = _room(np.int64(2 * (graph.comp[c + 1] - graph.comp[c])))
    count = np.int64(0)
    if limits:
        count = _limited(world, work, motion, rules, graph, each, c, reference(rows), count, True)
    _hold_steady(world, work, motion, rules, held, one, _seen(rows, count if count <= DENSE else 0), count)
    for k in range(graph.comp[c], graph.comp[c + 1]):
        n = graph.node[k]
        if n >= 0:
            for x in range(3):
                motion.velocity[n, x] += work.change[n, x]
                if rules.options.rotation:
                    motion.angular[n, x] += work.change[n, 3 + x]
    _work_at(motion, graph, each, c, 0.5 * share)


@njit(**FAST, inline="always")
def begin_step(world, work, motion, rules, held):
    """Convert velocities at an instant to those of the inner step before it, see `advance._shifted`. Unknown impulses
    are found first."""
    graph, each, lines = held.graph, held.each, held.rows
    fresh = False
    for j in range(len(each.body)):
        each.state[j, GIVEN] = 0.0
        fresh = fresh or each.state[j, FRESH] > 0.0
    for c in range(len(graph.comp) - 1):
        if not asleep(motion.island, graph, c):
            _ready(world, work, rules, graph, c, 1.0)
    if fresh:
        _find_first(world, work, motion, rules, held)
    kicked = np.zeros(len(graph.comp) - 1, np.bool_)
    for c in range(len(graph.comp) - 1):
        if not asleep(motion.island, graph, c) and not _resting(motion.touching, graph, c):
            for k in range(graph.comp[c], graph.comp[c + 1]):
                if graph.node[k] < 0:
                    _coordinate(each, motion.position, work.matrix, -1 - graph.node[k])
            kicked[c] = _kick(world, work, motion, rules, graph, each, lines, c, -0.5)
    if not kicked.any():
        return
    one = np.empty(1, np.int64)
    for c in range(len(graph.comp) - 1):
        if kicked[c]:
            _ready(world, work, rules, graph, c, 0.0)
    assemble(world, work, motion, rules, held, False)
    for c in range(len(graph.comp) - 1):
        if kicked[c]:
            one[0] = c
            _projected(world, work, motion, rules, held, one, -0.5, False)


@njit(**FAST)
def _find_first(world, work, motion, rules, held):
    """Find the unknown impulses of joints that no contact acts on. Where contacts act, velocities are not converted,
    so that none are needed."""
    graph, each = held.graph, held.each
    from_contacts = System(
        np.empty((0, 4), np.int64), np.empty((0, 3, WIDTH)), np.empty(0), np.empty(0), np.empty(0), np.empty((0, 4)),
        np.zeros(2, np.int64), np.empty(0, np.int64),
    )  # fmt: skip
    assemble(world, work, motion, rules, held, True)
    one = np.empty(1, np.int64)
    for c in range(len(graph.comp) - 1):
        fresh = False
        for k in range(graph.comp[c], graph.comp[c + 1]):
            fresh = fresh or (graph.node[k] < 0 and each.state[-1 - graph.node[k], FRESH] > 0.0)
        if not fresh or asleep(motion.island, graph, c) or _resting(motion.touching, graph, c):
            continue
        one[0] = c
        _solve_island(
            world, work, motion, rules, reference(from_contacts), held, one, np.int64(0), np.int64(1), np.int64(0)
        )
        for k in range(graph.comp[c], graph.comp[c + 1]):
            if graph.node[k] >= 0:
                motion.touching[graph.node[k]] = False
            else:
                each.state[-1 - graph.node[k], GIVEN] = 0.0


@njit(**BARE)
def _hold_steady(world, work, motion, rules, held, one, bounded, count):
    rows = reference(bounded)
    if len(rows.see):
        _see(world, work, motion, held.graph, held.factors, held.reply, rows, count)
    _hold(world, work, motion, rules, held, one, np.int64(0), np.int64(1), rows, count, True)


@njit(**FAST, inline="always")
def end_step(world, work, motion, rules, held):
    """Convert velocities of the last inner step to those at its end, as joints allow."""
    graph, each, lines = held.graph, held.each, held.rows
    one = np.empty(1, np.int64)
    for c in range(len(graph.comp) - 1):
        if not asleep(motion.island, graph, c):
            _ready(world, work, rules, graph, c, 0.0)
    assemble(world, work, motion, rules, held, False)
    for c in range(len(graph.comp) - 1):
        if asleep(motion.island, graph, c) or _resting(motion.touching, graph, c):
            continue
        _kick(world, work, motion, rules, graph, each, lines, c, 0.5)
        one[0] = c
        _projected(world, work, motion, rules, held, one, 0.5, True)
    for j in range(len(each.body)):
        a, b = each.body[j, 0], each.body[j, 1]
        each.state[j, SPEED] = _reads(each.axis[j, 0], motion, a, b)


@njit(**BARE)
def kept_together(held, part):
    """Bodies that joints connect move by the same part of an inner step."""
    graph = held.graph
    for c in range(len(graph.comp) - 1):
        least = 1.0
        for k in range(graph.comp[c], graph.comp[c + 1]):
            if graph.node[k] >= 0:
                least = min(least, part[graph.node[k]])
        for k in range(graph.comp[c], graph.comp[c + 1]):
            if graph.node[k] >= 0:
                part[graph.node[k]] = least


@njit(**BARE)
def roused(world, motion, held):
    """Wake sleeping bodies that a joint holds to a scripted moving body. Returns whether there were any."""
    each = held.each
    found = False
    for j in range(len(each.body)):
        for s in range(2):
            a, b = each.body[j, s], each.body[j, 1 - s]
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
def rest_held(each):
    """A step in which all bodies with joints sleep."""
    for j in range(len(each.body)):
        each.state[j, GIVEN] = each.state[j, SPEED] = 0.0


@njit(**BARE)
def given(each):
    """The work of motors in a step."""
    total = 0.0
    for j in range(len(each.body)):
        total += each.state[j, GIVEN]
    return total


@njit(**BARE)
def stored(each):
    """The energy in springs."""
    total = 0.0
    for j in range(len(each.body)):
        if each.number[j, STIFFNESS] > 0.0 and not each.state[j, BROKEN] > 0.0:
            total += 0.5 * each.number[j, STIFFNESS] * (each.state[j, COORD] - each.number[j, REST]) ** 2
    return total
