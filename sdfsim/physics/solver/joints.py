"""Joints, compiled: the rows that they hold, their limits, motors and springs, and what they bear."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from sdfsim.physics.joint_columns import (
    ARMATURE,
    BALL,
    BOUNCE,
    BROKEN,
    COORD,
    CURVE,
    DAMPING,
    DISTANCE,
    DRIVE,
    FORCE,
    FRICTION,
    GAIN,
    GIVEN,
    HIGH,
    HINGE,
    LENGTH,
    LOW,
    MAX_FORCE,
    MOTOR,
    PULL,
    REST,
    SLIDER,
    SPEED,
    STIFFNESS,
    STOP,
    TARGET,
    TIE,
    TIME,
    TO_PLACE,
    TO_SPEED,
    TORQUE,
    TWIST,
)
from sdfsim.physics.solver.flight import drift
from sdfsim.physics.solver.rows import (
    AIM,
    ANGULAR,
    DRAG,
    FOLLOWER,
    GRIP,
    IMPULSE,
    LEADER,
    LEFT,
    LIMIT,
    LINEAR,
    MASS,
    OTHER,
    SIDE,
    STRONGEST,
    WANTED,
    later,
    respond,
    soften,
    softness,
    velocity_of,
    write_point,
    write_turn,
)
from sdfsim.physics.solver.rows import (
    MOTOR as MOTOR_ROW,
)
from sdfsim.physics.solver.tolerances import (
    LIMIT_AHEAD,
    LIMIT_GIVES,
    NO_LENGTH,
    NO_SWING,
    REPAIR,
    RESOLVED,
    STRETCH,
)
from sdfsim.physics.solver.tree import EQUATIONS, Factors, Graph, Held, asleep, factor, substitute
from sdfsim.physics.solver.vectors import (
    BARE,
    add,
    along,
    cross,
    dot,
    get,
    norm,
    put,
    scale,
    sub,
    three,
    to_matrix,
    turn,
    turned_by,
    vector,
)
from sdfsim.physics.solver.world import END, kick_of


class Each(NamedTuple):
    """The constants and the state of J joints."""

    body: np.ndarray  # [J, 2] int64, -1 for the world
    kind: np.ndarray  # [J] int64
    anchor: np.ndarray  # [J, 2, 3] from the centres of mass, in the bodies' axes
    axes: np.ndarray  # [J, 2, 3, 3] the joint's three axes in body axes
    number: np.ndarray  # [J, NUMBERS]
    state: np.ndarray  # [J, STATE]
    axis: np.ndarray  # [J, WIDTH] the row along which it moves
    # Couplings: coupled [C, 2] int64, the first joint follows the second; coupling [C, 2] ratio and offset
    coupled: np.ndarray
    coupling: np.ndarray


class Trial(NamedTuple):
    """Trial poses of bodies: position [N, 3], orientation [N, 4], angular velocity [N, 3], matrix [N, 3, 3]."""

    position: np.ndarray
    orientation: np.ndarray
    angular: np.ndarray
    matrix: np.ndarray


class Joints(NamedTuple):
    """All joints of a scene, with buffers for an inner step."""

    graph: Graph
    factors: Factors
    each: Each
    held: Held
    trial: Trial
    reply: np.ndarray  # [N + 1, 6] effect of an impulse on velocities through the joints


@njit(**BARE)
def _in_world(matrix, b, v):
    """A vector [3] from the axes of body b (below 0: the world) to those of the world."""
    return vector(v) if b < 0 else turn(matrix, b, vector(v))


@njit(**BARE)
def _axis(each, matrix, j, s, k):
    """Axis k of a joint on its body s, world axes."""
    return _in_world(matrix, each.body[j, s], each.axes[j, s, k])


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
    """The errors of the rows that a joint holds."""
    kind = each.kind[j]
    arm, other = _arms(each, matrix, j)
    way = _between(position, each.body, j, arm, other)
    for e in range(EQUATIONS):
        out[j, e] = 0.0
    if kind == DISTANCE:
        if each.number[j, LENGTH] >= 0.0:
            out[j, 0] = norm(way) - each.number[j, LENGTH]
        return
    first = 3
    if kind == SLIDER:
        out[j, 0] = dot(_axis(each, matrix, j, 1, 1), way)
        out[j, 1] = dot(_axis(each, matrix, j, 1, 2), way)
        first = 2
    else:
        out[j, 0], out[j, 1], out[j, 2] = way[0], way[1], way[2]
    if kind == HINGE:
        for k in range(2):
            out[j, 3 + k] = dot(_axis(each, matrix, j, 0, 0), _axis(each, matrix, j, 1, 1 + k))
    elif kind != BALL:
        for k in range(3):
            out[j, first + k] = dot(_axis(each, matrix, j, 0, (k + 1) % 3), _axis(each, matrix, j, 1, (k + 2) % 3))


@njit(**BARE)
def coordinate(each, position, matrix, j):
    """Find the angle, position or length of a joint, and the row along which it changes."""
    kind, state, row = each.kind[j], each.state, each.axis[j]
    arm, other = _arms(each, matrix, j)
    way = _between(position, each.body, j, arm, other)
    if kind == HINGE:
        b = _axis(each, matrix, j, 0, 1)
        angle = math.atan2(dot(b, _axis(each, matrix, j, 1, 2)), dot(b, _axis(each, matrix, j, 1, 1)))
        turns = math.floor((state[j, COORD] - angle) / (2.0 * math.pi) + 0.5)
        state[j, COORD] = angle + 2.0 * math.pi * turns
        write_turn(row, _axis(each, matrix, j, 0, 0))
    elif kind == SLIDER:
        a = _axis(each, matrix, j, 1, 0)
        state[j, COORD] = dot(a, way)
        write_point(row, a, arm, add(other, way))
    elif kind == BALL:
        a, b = _axis(each, matrix, j, 0, 0), _axis(each, matrix, j, 1, 0)
        n = cross(a, b)
        s = norm(n)
        state[j, COORD] = math.atan2(s, dot(a, b))
        write_turn(row, scale(n, -1.0 / s) if s > NO_SWING else (0.0, 0.0, 0.0))
    elif kind == DISTANCE:
        length = norm(way)
        state[j, COORD] = length
        write_point(row, scale(way, 1.0 / length) if length > NO_LENGTH else (0.0, 0.0, 1.0), arm, other)


@njit(**BARE)
def _copy(row, out):
    for x in range(MASS + 1):
        out[x] = row[x]


@njit(**BARE)
def _write_held(each, held, position, matrix, j):
    """Write the Jacobians of the rows that hold, at the present poses."""
    kind, row, active = each.kind[j], held.row, held.active
    arm, other = _arms(each, matrix, j)
    for e in range(EQUATIONS):
        active[j, e], held.soft[j, e] = 0, 0.0
    if kind == DISTANCE:
        if each.number[j, LENGTH] >= 0.0:
            _copy(each.axis[j], row[j, 0])
            active[j, 0] = 1
        return
    first = 3
    if kind == SLIDER:
        far = add(other, _between(position, each.body, j, arm, other))
        write_point(row[j, 0], _axis(each, matrix, j, 1, 1), arm, far)
        write_point(row[j, 1], _axis(each, matrix, j, 1, 2), arm, far)
        first = 2
    else:
        for k in range(3):
            write_point(row[j, k], _unit(k), arm, other)
    last = first
    if kind == HINGE:
        for k in range(2):
            write_turn(row[j, 3 + k], cross(_axis(each, matrix, j, 0, 0), _axis(each, matrix, j, 1, 1 + k)))
        last = 5
    elif kind != BALL:
        for k in range(3):
            one, two = _axis(each, matrix, j, 0, (k + 1) % 3), _axis(each, matrix, j, 1, (k + 2) % 3)
            write_turn(row[j, first + k], cross(one, two))
        last = first + 3
    for e in range(last):
        active[j, e] = 1


@njit(**BARE)
def _write_springs(work, rules, each, held, j, phase):
    """Springs and damping of a joint as soft rows beside those that hold."""
    number, kind = each.number[j], each.kind[j]
    if number[STIFFNESS] <= 0.0 and number[DAMPING] <= 0.0 and number[ARMATURE] <= 0.0:
        return
    a, b = each.body[j, 0], each.body[j, 1]
    for k in range(3 if kind == BALL else 1):
        e = 3 + k if kind == BALL else (5 if kind != DISTANCE else 1)
        row = held.row[j, e]
        if kind == BALL:
            write_turn(row, _unit(k))
            respond(work, rules, row, a, b)
        else:
            _copy(each.axis[j], row)
        if row[MASS] <= 0.0:
            continue
        before = velocity_of(row, work.twist, a, b)
        away = number[REST] - each.state[j, COORD] if number[STIFFNESS] > 0.0 else 0.0
        held.active[j, e] = 2
        held.wanted[j, e], held.soft[j, e] = softness(
            number[STIFFNESS], number[DAMPING], 0.0, away, before, row[MASS], rules.substep_dt, phase
        )
        if number[ARMATURE] > 0.0:  # the impulse of a rotor is -armature x the change of the row's velocity
            rate = 1.0 / held.soft[j, e]
            whole = rate + number[ARMATURE]
            held.wanted[j, e] = (rate * held.wanted[j, e] + number[ARMATURE] * before) / whole
            held.soft[j, e] = 1.0 / whole


@njit(**BARE)
def assemble(world, work, motion, rules, joints, phase):
    """Write the rows of all joints that are awake, and factor their matrix. Bodies are moved if rows do not hold."""
    graph, factors, each, held = joints.graph, joints.factors, joints.each, joints.held
    for c in range(len(graph.comp) - 1):
        if asleep(motion.island, graph, c):
            continue
        for attempt in range(3):
            worst = 0.0
            for k in range(graph.comp[c], graph.comp[c + 1]):
                j = -1 - graph.node[k]
                if j < 0:
                    continue
                a, b = each.body[j, 0], each.body[j, 1]
                coordinate(each, motion.position, work.matrix, j)
                respond(work, rules, each.axis[j], a, b)
                if each.state[j, BROKEN] > 0.0:
                    _release(held, j)
                    continue
                _write_held(each, held, motion.position, work.matrix, j)
                _errors(each, motion.position, work.matrix, j, held.error)
                for e in range(EQUATIONS):
                    held.wanted[j, e] = 0.0 if phase == END else each.state[j, CURVE + e]
                    worst = max(worst, abs(held.error[j, e]))
                    if held.active[j, e]:
                        respond(work, rules, held.row[j, e], a, b)
                _write_springs(work, rules, each, held, j, phase)
            factor(world, work, graph, factors, held, c)
            if worst <= STRETCH or attempt == 2:
                break
            _project_positions(world, work, motion, rules, graph, factors, held, c)


@njit(**BARE)
def _release(held, j):
    for e in range(EQUATIONS):
        held.active[j, e] = 0
        held.error[j, e] = held.soft[j, e] = 0.0


@njit(**BARE)
def _project_positions(world, work, motion, rules, graph, factors, held, c):
    """Move bodies so that rows hold, by the smallest change in the metric of their masses."""
    for k in range(graph.comp[c], graph.comp[c + 1]):
        j = -1 - graph.node[k]
        for e in range(EQUATIONS):
            factors.x[k, e] = held.error[j, e] if j >= 0 and held.active[j, e] == 1 else 0.0
    substitute(graph, factors, c)
    most = 0.0
    for k in range(graph.comp[c], graph.comp[c + 1]):
        if graph.node[k] >= 0:
            most = max(most, norm(get(factors.x, k)), norm(three(factors.x[k], 3)))
    share = 1.0 if most <= REPAIR else REPAIR / most
    for k in range(graph.comp[c], graph.comp[c + 1]):
        b = graph.node[k]
        if b >= 0:
            moved, turned = get(factors.x, k), three(factors.x[k], 3)
            put(motion.position, b, along(get(motion.position, b), moved, share))
            if rules.options.rotation:
                q = turned_by(scale(turned, share), motion.orientation, b)
                for x in range(4):
                    motion.orientation[b, x] = q[x]
                to_matrix(motion.orientation, b, work.matrix)
            if world.radius[b] < math.inf:
                work.moved[b] += share * (norm(moved) + norm(turned) * world.radius[b])


@njit(**BARE)
def curve(world, work, motion, rules, joints, c):
    """Move the bodies of component c on trial by the inner step, and correct the wanted velocities of the rows by their
    errors there (SHAKE). Returns the largest error."""
    graph, each, held, trial = joints.graph, joints.each, joints.held, joints.trial
    for k in range(graph.comp[c], graph.comp[c + 1]):
        n = graph.node[k]
        for s in range(1 if n >= 0 else 2):
            b = n if n >= 0 else each.body[-1 - n, s]
            if n >= 0 or (b >= 0 and graph.of_body[b] < 0):
                _try(world, work, motion, rules, trial, b)
    worst = 0.0
    for k in range(graph.comp[c], graph.comp[c + 1]):
        j = -1 - graph.node[k]
        if j < 0 or each.state[j, BROKEN] > 0.0:
            continue
        _errors(each, trial.position, trial.matrix, j, held.later)
        for e in range(EQUATIONS):
            if held.active[j, e] == 1:
                error = held.later[j, e] - held.error[j, e]
                held.wanted[j, e] -= error / rules.substep_dt
                worst = max(worst, abs(error))
    return worst


@njit(**BARE)
def _try(world, work, motion, rules, trial, b):
    """Where a body would be after the inner step."""
    for x in range(3):
        trial.position[b, x] = motion.position[b, x]
        for y in range(3):
            trial.matrix[b, x, y] = work.matrix[b, x, y]
    for x in range(4):
        trial.orientation[b, x] = motion.orientation[b, x]
    twist, free, change = work.twist[b], work.free[b], work.change[b]
    v = add(vector(twist), add(vector(free), vector(change)))
    w = add(three(twist, 3), add(three(free, 3), three(change, 3)))
    nothing = (0.0, 0.0, 0.0)
    drift(
        world, work, rules, trial.position, trial.orientation, trial.angular, trial.matrix, v, w, nothing, nothing,
        rules.substep_dt, b,
    )  # fmt: skip


@njit(**BARE)
def past_limits(rules, joints, rows, lo, hi):
    """Correct the wanted velocities of limits by how far the trial poses are from them. Returns the largest error."""
    each, worst = joints.each, 0.0
    for i in range(lo, hi):
        c = rows.order[i]
        own = rows.own[c]
        if rows.kind[c] != LIMIT or rows.row[c, 0, IMPULSE] <= 0.0 or own[LEFT] == math.inf:
            continue
        j = rows.where[c, 0]
        here = each.state[j, COORD]
        coordinate(each, joints.trial.position, joints.trial.matrix, j)
        gap = own[SIDE] * (each.state[j, COORD] - each.number[j, LOW if own[SIDE] > 0.0 else HIGH])
        each.state[j, COORD] = here
        for x in range(LINEAR, OTHER + 3):
            each.axis[j, x] = own[SIDE] * rows.row[c, 0, x]
        rows.row[c, 0, WANTED] -= (gap - own[LEFT]) / rules.substep_dt
        worst = max(worst, abs(gap - own[LEFT]))
    return worst


@njit(**BARE)
def bounded_rows(work, motion, rules, joints, rows, count, phase):
    """Write the rows of limits, motors and friction after `count` others. Returns the new number of blocks."""
    each, graph = joints.each, joints.graph
    for c in range(len(graph.comp) - 1):
        if asleep(motion.island, graph, c):
            continue
        for k in range(graph.comp[c], graph.comp[c + 1]):
            j = -1 - graph.node[k]
            if j >= 0 and each.state[j, BROKEN] == 0.0:
                count = _limits(work, rules, each, rows, count, j, phase)
                if each.kind[j] == BALL:
                    count = _ball_friction(work, rules, each, rows, count, j, phase)
                elif each.kind[j] < BALL:
                    count = _motor(work, rules, each, rows, count, j, phase)
    for k in range(len(each.coupled)):
        count = _coupling(work, motion, rules, joints, rows, count, k, phase)
    return count


@njit(**BARE)
def _coupling(work, motion, rules, joints, rows, count, k, phase):
    each, wrong = joints.each, -joints.each.coupling[k, 1]
    for side in range(2):
        j = each.coupled[k, side]
        going = each.state[j, BROKEN] == 0.0
        for s in range(2):
            b = each.body[j, s]
            going = going and (b < 0 or motion.island[b] < 0)
        if not going:
            return count
    for side in range(2):
        j, factor = each.coupled[k, side], 1.0 if side == 0 else -each.coupling[k, 0]
        row, own = each.axis[j], rows.row[count + side, 0]
        a, b = each.body[j, 0], each.body[j, 1]
        _begin(each, rows, count + side, FOLLOWER if side == 0 else LEADER, j)
        rows.where[count + side, 1] = k
        for x in range(MASS):
            own[x] = factor * row[x]
        own[MASS] = row[MASS] / (factor * factor) if factor != 0.0 else 0.0
        own[WANTED] = -velocity_of(own, work.twist, a, b) - velocity_of(own, work.free, a, b)
        own[IMPULSE] = kick_of(phase) * each.state[each.coupled[k, 0], TIE]
        wrong += factor * each.state[j, COORD]
    if phase != END:
        rows.row[count, 0, WANTED] -= wrong / rules.substep_dt
    return count + 2


@njit(**BARE)
def _begin(each, rows, count, kind, j):
    rows.kind[count], rows.where[count, 0] = kind, j
    rows.where[count, 2], rows.where[count, 3] = each.body[j, 0], each.body[j, 1]


@njit(**BARE)
def _limits(work, rules, each, rows, count, j, phase):
    h, number, state, row = rules.substep_dt, each.number[j], each.state[j], each.axis[j]
    a, b = each.body[j, 0], each.body[j, 1]
    before = velocity_of(row, work.twist, a, b)
    free = before + velocity_of(row, work.free, a, b)
    for side in range(2):
        sign = 1.0 - 2.0 * side
        gap = sign * (state[COORD] - number[LOW + side])
        if not gap < math.inf or (phase == END and state[STOP] * sign <= 0.0):
            continue
        then = sign * free
        if gap + h * then > LIMIT_AHEAD and gap > LIMIT_AHEAD:
            continue
        left = 0.0 if gap >= 0.0 else (1.0 - LIMIT_GIVES) * gap
        aim = 0.0 if phase == END else (left - gap) / h
        approach = -sign * before
        if phase != END and number[BOUNCE] > 0.0 and approach > rules.slow and gap <= h * approach:
            aim, left = number[BOUNCE] * approach, math.inf
        _begin(each, rows, count, LIMIT, j)
        own = rows.row[count, 0]
        for x in range(MASS):
            own[x] = sign * row[x]
        own[MASS], own[WANTED] = row[MASS], aim - then
        own[IMPULSE] = max(0.0, kick_of(phase) * sign * state[STOP])
        rows.own[count, LEFT], rows.own[count, SIDE] = left, sign
        count += 1
    return count


@njit(**BARE)
def _ball_friction(work, rules, each, rows, count, j, phase):
    span, a, b = kick_of(phase) * rules.substep_dt, each.body[j, 0], each.body[j, 1]
    if each.number[j, FRICTION] <= 0.0:
        return count
    _begin(each, rows, count, GRIP, j)
    rows.own[count, DRAG] = span * each.number[j, FRICTION]
    for e in range(3):
        row = rows.row[count, e]
        write_turn(row, _unit(e))
        respond(work, rules, row, a, b)
        row[WANTED] = -velocity_of(row, work.twist, a, b) - velocity_of(row, work.free, a, b)
        row[IMPULSE] = kick_of(phase) * each.state[j, DRIVE + e]
    return count + 1


@njit(**BARE)
def _motor(work, rules, each, rows, count, j, phase):
    """A motor with friction. A motor with a gain and friction are rows of their own."""
    h, number, state, row = rules.substep_dt, each.number[j], each.state[j], each.axis[j]
    kick, motor, gain = kick_of(phase), number[MOTOR], number[GAIN]
    grip, most = kick * h * number[FRICTION], kick * h * number[MAX_FORCE] if motor > 0.0 else 0.0
    if grip <= 0.0 and most <= 0.0:
        return count
    a, b = each.body[j, 0], each.body[j, 1]
    before = velocity_of(row, work.twist, a, b)
    free = before + velocity_of(row, work.free, a, b)
    aim, soft = 0.0, 0.0
    if motor > 0.0 and gain > 0.0 and row[MASS] > 0.0:
        aim, soft = _servo(motor, gain, number[TIME], state[TARGET], state[COORD], before, row[MASS], h, phase)
    elif motor == TO_SPEED:
        aim = state[TARGET]
    elif motor == TO_PLACE:
        aim = (state[TARGET] - state[COORD]) / max(number[TIME], h)
    for part in range(2 if soft > 0.0 and grip > 0.0 else 1):
        _begin(each, rows, count, MOTOR_ROW, j)
        own, mine = rows.row[count, 0], rows.own[count]
        _copy(row, own)
        goal = aim if part == 0 else 0.0
        own[WANTED], own[IMPULSE] = goal - free, kick * state[DRIVE]
        mine[AIM], mine[STRONGEST], mine[DRAG] = goal, most, grip
        if soft > 0.0:
            own[IMPULSE] = kick * (state[DRIVE + 1] if part == 0 else state[DRIVE] - state[DRIVE + 1])
            mine[STRONGEST], mine[DRAG] = most * (1 - part), grip * part
            soften(own, soft * (1 - part))
        count += 1
    return count


@njit(**BARE)
def _servo(motor, gain, time, target, coord, before, mass, h, phase):
    """The wanted speed and the compliance of a motor with a gain: damping towards a speed, or a spring with damping,
    with more damping where the inner step does not resolve its period."""
    if motor == TO_SPEED:
        late = later(gain * kick_of(phase) * h / mass)
        return (target - (1.0 - late) * before) / late, 1.0 / (kick_of(phase) * h * gain * late)
    coarse = max(0.0, 1.0 - RESOLVED * mass / (gain * h * h))
    return softness(gain, gain * time, coarse, target - coord, before, mass, h, phase)


@njit(**BARE)
def record_held(work, rules, joints, c, phase):
    """Record the forces and torques of the rows that hold, and forget those of bounded rows."""
    graph, each, held = joints.graph, joints.each, joints.held
    span = kick_of(phase) * rules.substep_dt
    for k in range(graph.comp[c], graph.comp[c + 1]):
        n = graph.node[k]
        if n >= 0:
            continue
        j = -1 - n
        a, b, state = each.body[j, 0], each.body[j, 1], each.state[j]
        state[SPEED] = velocity_of(each.axis[j], work.twist, a, b) + velocity_of(each.axis[j], work.free, a, b)
        state[SPEED] += velocity_of(each.axis[j], work.change, a, b)
        for x in range(3):
            state[PULL + x] = state[TWIST + x] = state[DRIVE + x] = 0.0
        state[STOP] = state[TIE] = 0.0
        for e in range(EQUATIONS):
            if phase != END:
                state[CURVE + e] = held.wanted[j, e] if held.active[j, e] == 1 else 0.0
            if held.active[j, e]:
                _add_pull(work.matrix, each, j, held.row[j, e], held.impulse[j, e] / span)


@njit(**BARE)
def _add_pull(matrix, each, j, row, force):
    """Add the effect of a row to the force and the torque on the first body, about its anchor."""
    arm, _ = _arms(each, matrix, j)
    pull = three(row, LINEAR)
    twist = sub(three(row, ANGULAR), cross(arm, pull))
    for x in range(3):
        each.state[j, PULL + x] += force * pull[x]
        each.state[j, TWIST + x] += force * twist[x]


@njit(**BARE)
def record_bounded(work, rules, each, rows, c, phase):
    """Record the impulses of a block of a joint, as those of a whole inner step. Returns the work of its motor."""
    j, kind, kick, own = rows.where[c, 0], rows.kind[c], kick_of(phase), rows.own[c]
    state = each.state[j]
    for e in range(3 if kind == GRIP else 1):
        row = rows.row[c, e]
        _add_pull(work.matrix, each, j, row, row[IMPULSE] / (kick * rules.substep_dt))
        if kind == FOLLOWER:
            state[TIE] = row[IMPULSE] / kick
        elif kind == LIMIT:
            state[STOP] += own[SIDE] * row[IMPULSE] / kick
        elif kind != LEADER:
            state[DRIVE + e] += row[IMPULSE] / kick  # a motor with a gain and friction are two rows
    if kind != MOTOR_ROW or own[STRONGEST] <= 0.0:
        return 0.0
    mean = 0.5 * (velocity_of(each.axis[j], work.twist, each.body[j, 0], each.body[j, 1]) + state[SPEED])
    push = rows.row[c, 0, IMPULSE] + (own[DRAG] if mean > 0.0 else -own[DRAG])
    push = min(max(push, -own[STRONGEST]), own[STRONGEST])
    state[DRIVE + 1] = push / kick
    return push * mean


@njit(**BARE)
def breaks(joints, c):
    """Break the joints that bear more than they can. Returns whether any broke."""
    graph, each, found = joints.graph, joints.each, False
    for k in range(graph.comp[c], graph.comp[c + 1]):
        j = -1 - graph.node[k]
        if j < 0:
            continue
        own, number = each.state[j], each.number[j]
        pull, twist = norm(three(own, PULL)), norm(three(own, TWIST))
        if own[BROKEN] == 0.0 and (pull > number[FORCE] or twist > number[TORQUE]):
            own[BROKEN] = 1.0
            found = True
            _release(joints.held, j)
    return found


@njit(**BARE)
def kept_together(joints, part):
    """Bodies that joints connect move by the same part of an inner step."""
    graph = joints.graph
    for c in range(len(graph.comp) - 1):
        least = 1.0
        for k in range(graph.comp[c], graph.comp[c + 1]):
            if graph.node[k] >= 0:
                least = min(least, part[graph.node[k]])
        for k in range(graph.comp[c], graph.comp[c + 1]):
            if graph.node[k] >= 0:
                part[graph.node[k]] = least


@njit(**BARE)
def begin_step(each, asleep_too):
    """Forget the work of motors in the step before; and the speeds, if all bodies with joints sleep."""
    for j in range(len(each.body)):
        each.state[j, GIVEN] = 0.0
        if asleep_too:
            each.state[j, SPEED] = 0.0


@njit(**BARE)
def given(each):
    """The work of motors in a step."""
    total = 0.0
    for j in range(len(each.body)):
        total += each.state[j, GIVEN]
    return total


@njit(**BARE)
def stored(each):
    """The energy in springs and rotors."""
    total = 0.0
    for j in range(len(each.body)):
        total += 0.5 * each.number[j, ARMATURE] * each.state[j, SPEED] ** 2
        if each.number[j, STIFFNESS] > 0.0 and not each.state[j, BROKEN] > 0.0:
            total += 0.5 * each.number[j, STIFFNESS] * (each.state[j, COORD] - each.number[j, REST]) ** 2
    return total
