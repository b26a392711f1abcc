"""One step, compiled: pairs that may meet once, then inner steps of contact, impulses and motion."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sdfsim.physics.solver.impulses import solve_contacts
from sdfsim.physics.solver.internal_edges import heed_supports
from sdfsim.physics.solver.manifold import scratch_room
from sdfsim.physics.solver.narrow_phase import broad_phase, narrow_phase
from sdfsim.physics.solver.record import gathered, no_edges, noted
from sdfsim.physics.solver.sleep import put_to_sleep, woken
from sdfsim.physics.solver.time_of_impact import time_of_impact
from sdfsim.physics.solver.vectors import (
    BARE,
    FAST,
    add,
    along,
    cross,
    get,
    norm,
    put,
    scale,
    to_matrix,
    turn,
    turn_back,
    turned_by,
    vector,
)

MOST_TURN = 0.1  # rad in one stage of torque-free rotation


@njit(**FAST, inline="always")  # where it is called, and not once more by itself
def advance(shapes, world, work, motion, rules, manifolds):
    """Advance `motion` by one step, in place; time is that of the bodies that go, however many others there are.

    Returns:
        The manifolds at its end; what contacts did, where it is to be noted; and counts: pairs looked at, contacts of
        the last inner step, bodies that contacts moved.
    """
    matrix, inverse, free, change, shift = work.matrix, work.inverse, work.free, work.change, work.shift
    span = rules.substep_dt * rules.substeps
    for b in world.going:
        to_matrix(motion.orientation, b, matrix)
        work.met[b] = False
    manifolds, near = broad_phase(shapes, world, work, motion, rules, span, manifolds)
    while rules.sleep and woken(world, motion, manifolds, near):
        manifolds, near = broad_phase(shapes, world, work, motion, rules, span, manifolds)
    trial, frame = np.empty((1, 4)), np.empty((1, 3, 3))
    scratch = scratch_room()
    contacts, edges = 0, no_edges()
    _shifted(world, work, motion, rules, -0.5)
    for k in range(rules.substeps):
        for b in world.going:
            if work.gone[b] > work.ways[b] and world.moves[b]:
                left = rules.substep_dt * (rules.substeps - k)
                manifolds, near = broad_phase(shapes, world, work, motion, rules, left, manifolds)
                break
        for b in world.going:
            for x in range(6):
                change[b, x] = shift[b, x] = 0.0
            for x in range(9):
                free[b, x] = 0.0
            motion.touching[b] = False
            if world.moves[b] and motion.island[b] < 0 and work.beside[b]:
                _prepare(world, motion, matrix, inverse, work.wrench, rules, free, b)
        narrow_phase(shapes, world, motion, matrix, rules, manifolds, near, work.gone, scratch)
        heed_supports(shapes, world, work, motion, rules, manifolds, near, scratch)
        system = solve_contacts(world, work, motion, rules, manifolds)
        contacts = len(system.where)
        if rules.note:
            edges = noted(motion, matrix, manifolds, system, k / rules.substeps, edges)
        time_of_impact(shapes, world, work, motion, rules, manifolds, near, scratch)
        for b in world.going:
            if motion.island[b] < 0 and (world.moves[b] or world.scripted[b]):
                moved = _move(world, motion, matrix, rules, work.wrench, change, shift, work.part[b], trial, frame, b)
                work.gone[b] += moved
                work.met[b] = work.met[b] or motion.touching[b]
    if rules.note:
        edges = gathered(
            world, motion, matrix, manifolds, len(near.start), (rules.substeps - 1) / rules.substeps, edges
        )
    _shifted(world, work, motion, rules, 0.5)
    if rules.sleep:
        put_to_sleep(world, motion, rules, manifolds)
    met = 0  # of those that are awake still
    for b in world.going:
        met += work.met[b] and motion.island[b] < 0
    return manifolds, edges, (len(near.start), contacts, met)


@njit(**BARE)
def _shifted(world, work, motion, rules, part):
    """Velocities at an instant become those of the inner step before it, which contacts are solved with (part -0.5),
    and back: bodies that nothing held in the last inner step then move exactly as in free flight."""
    for b in world.going:
        if world.moves[b] and motion.island[b] < 0 and not motion.touching[b]:
            v, w = _pulled(world, work.matrix, work.wrench, rules, part, b)
            put(motion.velocity, b, add(get(motion.velocity, b), v))
            if rules.rotation:
                put(motion.angular, b, add(get(motion.angular, b), w))


@njit(**BARE)
def _pulled(world, matrix, wrench, rules, part, b):
    """What gravity and what pulls at a body add to its velocities in a part of an inner step."""
    span = rules.substep_dt * part
    weight = scale(vector(rules.gravity), span)
    if not wrench[b].any():
        return weight, (0.0, 0.0, 0.0)
    force, torque = (wrench[b, 0], wrench[b, 1], wrench[b, 2]), (wrench[b, 3], wrench[b, 4], wrench[b, 5])
    turned = turn(matrix, b, turn(world.inverse_inertia, b, turn_back(matrix, b, torque)))
    return along(weight, force, world.inverse_mass[b] * span), scale(turned, span)


@njit(**BARE)
def _prepare(world, motion, matrix, inverse, wrench, rules, free, b):
    """Inverse inertia in world axes, and what gravity, pulls and the gyroscopic torque make of the velocities."""
    v, w = _pulled(world, matrix, wrench, rules, 1.0, b)
    for x in range(3):
        free[b, x], free[b, 3 + x] = v[x], w[x]
    for x in range(3):
        for y in range(3):
            total = 0.0
            for i in range(3):
                for j in range(3):
                    total += matrix[b, x, i] * world.inverse_inertia[b, i, j] * matrix[b, y, j]
            inverse[b, x, y] = total
    if world.isotropic[b]:
        return
    w = get(motion.angular, b)
    momentum = turn(matrix, b, turn(world.inertia, b, turn_back(matrix, b, w)))
    # Explicit at the middle of the inner step: keeps energy to third order.
    half = turn(inverse, b, cross(momentum, w))
    middle = along(w, half, 0.5 * rules.substep_dt)
    later = turn(matrix, b, turn(world.inertia, b, turn_back(matrix, b, middle)))
    change = scale(turn(inverse, b, cross(later, middle)), rules.substep_dt)
    for x in range(3):
        free[b, 6 + x] = change[x]


@njit(**BARE)
def _move(world, motion, matrix, rules, wrench, change, shift, part, trial, frame, b):
    """Move a body by one inner step; returns how far at most any of its points has gone."""
    span = rules.substep_dt * part
    v, w, turned = get(motion.velocity, b), get(motion.angular, b), (0.0, 0.0, 0.0)
    if world.moves[b]:
        for x in range(6):
            if change[b, x] != 0.0 or shift[b, x] != 0.0:
                motion.touching[b] = True
        pulled, spun = _pulled(world, matrix, wrench, rules, 1.0, b)
        v = add(add(v, pulled), (change[b, 0], change[b, 1], change[b, 2]))
        put(motion.velocity, b, v)
        v = add(v, (shift[b, 0], shift[b, 1], shift[b, 2]))
        if rules.rotation:
            # What the gyroscopic torque adds comes with the exact motion below, which keeps angular momentum.
            w = add(add(w, spun), (change[b, 3], change[b, 4], change[b, 5]))
            turned = (shift[b, 3], shift[b, 4], shift[b, 5])
        else:
            w = (0.0, 0.0, 0.0)
        put(motion.angular, b, w)
    put(motion.position, b, along(get(motion.position, b), v, span))
    if world.moves[b] and rules.rotation and not world.isotropic[b]:
        _torque_free(world, motion, matrix, span, trial, frame, b)
        way = norm(w) + norm(turned)
    else:
        turned = add(w, turned)
        way = norm(turned)
    _turn_on(motion, matrix, scale(turned, span), b)
    if way == 0.0:  # a plane reaches to infinity, and may be led along
        return norm(v) * rules.substep_dt
    return (norm(v) + way * world.radius[b]) * rules.substep_dt


@njit(**BARE)
def _turn_on(motion, matrix, r, b):
    """Turn a body by a rotation vector."""
    if r[0] != 0.0 or r[1] != 0.0 or r[2] != 0.0:
        q = turned_by(r, motion.orientation, b)
        for x in range(4):
            motion.orientation[b, x] = q[x]
        to_matrix(motion.orientation, b, matrix)


@njit(**BARE)
def _torque_free(world, motion, matrix, span, trial, frame, b):
    """Rotation without torque: angular momentum is kept exactly, the pose to fourth order (Runge-Kutta-Munthe-Kaas)."""
    w = get(motion.angular, b)
    speed = norm(w)
    if speed == 0.0:
        return
    momentum = turn(matrix, b, turn(world.inertia, b, turn_back(matrix, b, w)))
    stages = max(1, math.ceil(min(speed * span, 100.0) / MOST_TURN))
    h = span / stages
    for _ in range(stages):
        k1 = scale(w, h)
        k2 = _slope(world, motion.orientation, momentum, scale(k1, 0.5), h, b, trial, frame)
        k3 = _slope(world, motion.orientation, momentum, scale(k2, 0.5), h, b, trial, frame)
        k4 = _slope(world, motion.orientation, momentum, k3, h, b, trial, frame)
        total = scale(add(add(k1, k4), scale(add(k2, k3), 2.0)), 1.0 / 6.0)
        q = turned_by(total, motion.orientation, b)
        for x in range(4):
            motion.orientation[b, x] = q[x]
        to_matrix(motion.orientation, b, matrix)
        w = turn(matrix, b, turn(world.inverse_inertia, b, turn_back(matrix, b, momentum)))
    put(motion.angular, b, w)


@njit(**BARE)
def _slope(world, orientation, momentum, u, h, b, trial, frame):
    q = turned_by(u, orientation, b)
    for x in range(4):
        trial[0, x] = q[x]
    to_matrix(trial, 0, frame)
    w = turn(frame, 0, turn(world.inverse_inertia, b, turn_back(frame, 0, momentum)))
    one = cross(u, w)
    two = cross(u, one)
    return scale(add(along(w, one, -0.5), scale(two, 1.0 / 12.0)), h)
