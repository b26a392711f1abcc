"""One step, compiled: first the pairs that may meet, then inner steps of contacts, impulses and motion."""

from __future__ import annotations

import numpy as np
from numba import njit

from sdfsim.physics.solver.flight import drift, pull_of
from sdfsim.physics.solver.joints import begin_step, kept_together
from sdfsim.physics.solver.narrow_phase import find_near
from sdfsim.physics.solver.references import call, reference
from sdfsim.physics.solver.sleep import put_to_sleep, roused, woken
from sdfsim.physics.solver.vectors import (
    BARE,
    FAST,
    add,
    along,
    cross,
    get,
    norm,
    put,
    rotated_matrix,
    scale,
    to_matrix,
    turn,
    turn_back,
    vector,
)
from sdfsim.physics.solver.world import BETWEEN, END, START, kick_of


@njit(**FAST, inline="always")
def advance(shapes, world, work, motion, rules, manifolds, joints, pieces, script, step):
    """Advance `motion`, and the state of joints, by one step of a script, in place. The time depends on the bodies that
    are awake, however many others there are. All structures except `manifolds` are references.

    Returns:
        The manifolds at the end of the step; and counts: pairs tested, contacts of the last inner step, bodies that
        contacts or joints moved.
    """
    substeps, jointed = rules.options.substeps, len(joints.each.body) > 0
    for b in world.going:
        to_matrix(motion.orientation, b, work.matrix)
        work.met[b] = False
    span = rules.substep_dt * substeps
    manifolds, near = find_near(shapes, world, work, motion, rules, span, manifolds, pieces)
    stirred = rules.options.sleep
    while stirred:
        stirred = woken(world, motion, rules, reference(manifolds), reference(near))
        stirred = stirred or roused(world, motion, joints.each.body)
        if stirred:
            manifolds, near = find_near(shapes, world, work, motion, rules, span, manifolds, pieces)
    begin_step(joints.each, False)
    contacts = np.int64(0)
    for k in range(substeps + 1):
        phase = np.int64(START if k == 0 else (END if k == substeps else BETWEEN))
        if phase != END:
            for b in world.going:
                if work.moved[b] > work.motion_bound[b] and (world.moves[b] or world.scripted[b]):
                    left = rules.substep_dt * (substeps - k)
                    manifolds, near = find_near(shapes, world, work, motion, rules, left, manifolds, pieces)
                    break
        for s in range(len(script.body)):
            for x in range(3):
                motion.velocity[script.body[s], x] = script.velocity[step, k, s, x]
                motion.angular[script.body[s], x] = script.velocity[step, k, s, 3 + x]
        # Both are used again at the end of the step, so that the references hold.
        points, parts = reference(manifolds), reference(near)
        for b in world.going:
            _prepare(world, work, motion, rules, phase, b, work.beside[b] or joints.graph.of_body[b] >= 0)
        if jointed:
            call(pieces.assemble, (world, work, motion, rules, joints, phase))
        if phase != END:
            call(pieces.collide, (shapes, world, work, motion, rules, points, parts))
        count = call(pieces.solve, (world, work, motion, rules, points, joints, phase))
        if phase != END:
            contacts = count
            call(pieces.impact, (shapes, world, work, motion, rules, points, parts))
            kept_together(joints, work.part)
        for b in world.going:
            if motion.island[b] < 0 and (world.moves[b] or world.scripted[b]):
                _move(world, work, motion, rules, phase, b)
    if rules.options.sleep:
        put_to_sleep(world, work, motion, rules, reference(manifolds), joints)
    met = 0  # number of bodies that contacts or joints moved and that are still awake
    for b in world.going:
        met += work.met[b] and motion.island[b] < 0
    return manifolds, (len(near.start), contacts, met)


@njit(**BARE)
def _prepare(world, work, motion, rules, phase, b, acts):
    """The velocities of a body before a kick, and, if something `acts` on it, its inverse inertia in world axes and the
    change of its velocities by gravity, pulls and the gyroscopic torque."""
    matrix, inverse, free = work.matrix, work.inverse, work.free
    work.acted[b] = False
    for x in range(3):
        work.twist[b, x], work.twist[b, 3 + x] = motion.velocity[b, x], motion.angular[b, x]
    for x in range(6):
        work.change[b, x] = work.shift[b, x] = 0.0
    for x in range(9):
        free[b, x] = 0.0
    if not acts:
        return
    if phase != END:
        for x in range(3):
            work.position_before[b, x] = motion.position[b, x]
            for y in range(3):
                work.matrix_before[b, x, y] = matrix[b, x, y]
    if not world.moves[b] or motion.island[b] >= 0:
        return
    v, w = pull_of(world, matrix, work.wrench, rules, kick_of(phase), b)
    for x in range(3):
        free[b, x], free[b, 3 + x] = v[x], w[x]
    rotated_matrix(matrix, world.inverse_inertia, b, inverse[b])
    if world.isotropic[b] or phase == END:
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
def _move(world, work, motion, rules, phase, b):
    """Give a body its new velocities, and move it by one inner step unless it is the end of the step."""
    v, w, change, shift = get(motion.velocity, b), get(motion.angular, b), work.change[b], work.shift[b]
    shifted, turned = vector(shift), (shift[3], shift[4], shift[5])
    if world.moves[b]:
        for x in range(6):
            work.acted[b] = work.acted[b] or change[x] != 0.0 or shift[x] != 0.0
        work.met[b] = work.met[b] or work.acted[b]
        pulled, spun = pull_of(world, work.matrix, work.wrench, rules, kick_of(phase), b)
        v = add(add(v, pulled), vector(change))
        # The gyroscopic torque is part of the exact motion, which conserves angular momentum.
        w = add(add(w, spun), (change[3], change[4], change[5]))
        put(motion.velocity, b, v)
        if rules.options.rotation:
            put(motion.angular, b, w)
    if phase == END:
        return
    way = drift(
        world, work, rules, motion.position, motion.orientation, motion.angular, work.matrix, v, w, shifted, turned,
        rules.substep_dt * work.part[b], b,
    )  # fmt: skip
    far = norm(v) + norm(shifted)
    if way > 0.0:  # a plane reaches to infinity, and may be scripted
        far += way * world.radius[b]
    work.moved[b] += far * rules.substep_dt
