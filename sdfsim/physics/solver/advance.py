"""One step, compiled: first the pairs that may meet, then inner steps of contacts, impulses and motion."""

from __future__ import annotations

import numpy as np
from numba import njit

from sdfsim.physics.solver.flight import pull_of, torque_free
from sdfsim.physics.solver.impulses import solve_contacts
from sdfsim.physics.solver.internal_edges import heed_supports
from sdfsim.physics.solver.joints import (
    assemble,
    begin_step,
    end_step,
    kept_together,
    roused,
    solve_with_joints,
)
from sdfsim.physics.solver.narrow_phase import find_near, narrow_phase
from sdfsim.physics.solver.references import reference
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
)


@njit(**FAST, inline="always")
def advance(shapes, world, work, motion, rules, manifolds, held, surfaces, threads, script, step):
    """Advance `motion`, and the state of joints in `held`, by one step of a script, in place. The time depends on the
    bodies that are awake, however many others there are.

    All structures except `manifolds` and `held` are references. `run_steps` says which arguments may be None.

    Returns:
        The manifolds at the end of the step; and counts: pairs tested, contacts of the last inner step, bodies that
        contacts moved.
    """
    joints = reference(held)
    matrix, inverse, free, change, shift = work.matrix, work.inverse, work.free, work.change, work.shift
    span = rules.substep_dt * rules.options.substeps
    for b in world.going:
        to_matrix(motion.orientation, b, matrix)
        work.met[b] = False
    manifolds, near = find_near(shapes, world, work, motion, rules, span, manifolds, surfaces, threads)
    stirred = rules.options.sleep
    while stirred:
        stirred = woken(world, motion, reference(manifolds), reference(near))
        if held is not None:
            stirred = stirred or roused(world, motion, joints)
        if stirred:
            manifolds, near = find_near(shapes, world, work, motion, rules, span, manifolds, surfaces, threads)
    trial, frame = np.empty((1, 4)), np.empty((1, 3, 3))
    contacts = 0
    _shifted(world, work, motion, rules, -0.5)
    if held is not None:
        begin_step(world, work, motion, rules, joints)
    for k in range(rules.options.substeps):
        for b in world.going:
            if work.gone[b] > work.ways[b] and (world.moves[b] or world.scripted[b]):
                left = rules.substep_dt * (rules.options.substeps - k)
                manifolds, near = find_near(shapes, world, work, motion, rules, left, manifolds, surfaces, threads)
                break
        for s in range(len(script.body)):
            for x in range(3):
                motion.velocity[script.body[s], x] = script.velocity[step, k, s, x]
                motion.angular[script.body[s], x] = script.velocity[step, k, s, 3 + x]
        # Both are used again at the end of the step, so that the references hold.
        points, parts = reference(manifolds), reference(near)
        for b in world.going:
            for x in range(6):
                change[b, x] = shift[b, x] = 0.0
            for x in range(9):
                free[b, x] = 0.0
            motion.touching[b] = False
            beside = work.beside[b]
            if held is not None:
                beside = beside or joints.graph.of_body[b] >= 0
            if beside and world.moves[b] and motion.island[b] < 0:
                _prepare(world, motion, matrix, inverse, work.wrench, rules, free, b)
        if held is not None:
            assemble(world, work, motion, rules, joints, True)
        narrow_phase(shapes, world, motion, matrix, rules, points, parts, work.gone, work.scratch, surfaces, threads)
        heed_supports(shapes, world, work, motion, rules, points, parts, work.scratch)
        if held is not None:
            system = solve_with_joints(world, work, motion, rules, points, joints)
        else:
            system = solve_contacts(world, work, motion, rules, points, threads)
        contacts = len(system.where)
        time_of_impact(shapes, world, work, motion, rules, points, parts, work.scratch, surfaces)
        if held is not None:
            kept_together(joints, work.part)
        for b in world.going:
            if motion.island[b] < 0 and (world.moves[b] or world.scripted[b]):
                moved = _move(world, motion, matrix, rules, work.wrench, change, shift, work.part[b], trial, frame, b)
                work.gone[b] += moved
                if held is not None:
                    if joints.calm[b]:  # for bodies that only joints hold
                        motion.touching[b] = False
                work.met[b] = work.met[b] or motion.touching[b]
    _shifted(world, work, motion, rules, 0.5)
    if held is not None:
        end_step(world, work, motion, rules, joints)
    if rules.options.sleep:
        put_to_sleep(world, motion, rules, reference(manifolds), joints)
    met = 0  # number of bodies that contacts moved and that are still awake
    for b in world.going:
        met += work.met[b] and motion.island[b] < 0
    return manifolds, (len(near.start), contacts, met)


@njit(**BARE)
def _shifted(world, work, motion, rules, part):
    """Convert velocities at an instant to those of the inner step before it, with which contacts are solved (part
    -0.5), or back (part 0.5). So bodies without contact in the last inner step move exactly as in free flight."""
    for b in world.going:
        if world.moves[b] and motion.island[b] < 0 and not motion.touching[b]:
            v, w = pull_of(world, work.matrix, work.wrench, rules, part, b)
            put(motion.velocity, b, add(get(motion.velocity, b), v))
            if rules.options.rotation:
                put(motion.angular, b, add(get(motion.angular, b), w))


@njit(**BARE)
def _prepare(world, motion, matrix, inverse, wrench, rules, free, b):
    """Inverse inertia in world axes, and the change of velocities by gravity, pulls and the gyroscopic torque."""
    v, w = pull_of(world, matrix, wrench, rules, 1.0, b)
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
    # Explicit at the middle of the inner step: conserves energy to third order.
    half = turn(inverse, b, cross(momentum, w))
    middle = along(w, half, 0.5 * rules.substep_dt)
    later = turn(matrix, b, turn(world.inertia, b, turn_back(matrix, b, middle)))
    change = scale(turn(inverse, b, cross(later, middle)), rules.substep_dt)
    for x in range(3):
        free[b, 6 + x] = change[x]


@njit(**BARE)
def _move(world, motion, matrix, rules, wrench, change, shift, part, trial, frame, b):
    """Move a body by one inner step. Returns a bound of how far any of its points has moved."""
    span = rules.substep_dt * part
    v, w, turned = get(motion.velocity, b), get(motion.angular, b), (0.0, 0.0, 0.0)
    if world.moves[b]:
        for x in range(6):
            if change[b, x] != 0.0 or shift[b, x] != 0.0:
                motion.touching[b] = True
        pulled, spun = pull_of(world, matrix, wrench, rules, 1.0, b)
        v = add(add(v, pulled), (change[b, 0], change[b, 1], change[b, 2]))
        put(motion.velocity, b, v)
        v = add(v, (shift[b, 0], shift[b, 1], shift[b, 2]))
        if rules.options.rotation:
            # The gyroscopic torque is part of the exact motion below, which conserves angular momentum.
            w = add(add(w, spun), (change[b, 3], change[b, 4], change[b, 5]))
            turned = (shift[b, 3], shift[b, 4], shift[b, 5])
        else:
            w = (0.0, 0.0, 0.0)
        put(motion.angular, b, w)
    put(motion.position, b, along(get(motion.position, b), v, span))
    if world.moves[b] and rules.options.rotation and not world.isotropic[b]:
        torque_free(world, motion.orientation, motion.angular, matrix, span, trial, frame, b)
        way = norm(w) + norm(turned)
    else:
        turned = add(w, turned)
        way = norm(turned)
    _turn_on(motion, matrix, scale(turned, span), b)
    if way == 0.0:  # a plane reaches to infinity, and may be scripted
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
