"""Sleep, compiled: islands at rest and in balance are frozen, and woken by bodies that move beside them."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sdfsim.physics.solver.broad_phase import stirs
from sdfsim.physics.solver.islands import join, root
from sdfsim.physics.solver.vectors import BARE, FAST, get, norm, put, sub


@njit(**BARE)
def rests(world, motion):
    """Whether all dynamic bodies sleep, and no scripted body moves."""
    for b in world.going:
        if stirs(world, motion, b):
            return False
    return True


@njit(**BARE)
def _wake(motion, island):
    for c in range(len(motion.island)):
        if motion.island[c] == island:
            motion.island[c] = -1
            motion.quiet[c] = 0


@njit(**BARE)
def _drift(world, motion, rules, b):
    """How far a body moves in the time after which bodies at rest fall asleep; infinite for planes that turn."""
    turns = norm(get(motion.angular, b))
    speed = norm(get(motion.velocity, b)) + (turns * world.radius[b] if turns > 0.0 else 0.0)
    return speed * rules.rest * rules.substep_dt * rules.options.substeps


@njit(**BARE)
def woken(world, motion, rules, manifolds, near):
    """Wake the islands that something awake touches, or may touch in this step. Returns whether there were any.

    What is beside an island, but hardly moves, does not wake it, or two such would keep each other awake.
    """
    found = False
    for p in range(len(near.start)):
        a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
        if near.count[p, 0] + near.count[p, 1] == 0:
            continue
        for sleeper, other in ((a, b), (b, a)):
            if motion.island[sleeper] < 0 or not stirs(world, motion, other):
                continue
            beside = world.moves[other] and manifolds.count[p] == 0
            if _drift(world, motion, rules, other) > (rules.drift if beside else 0.0):
                found = True
                _wake(motion, motion.island[sleeper])
    return found


@njit(**BARE)
def roused(world, motion, body):
    """Wake sleeping bodies that a joint holds to a scripted moving body. Returns whether there were any."""
    found = False
    for j in range(len(body)):
        a = _driven_by_path(world, motion, body, j)
        if a >= 0 and motion.island[a] >= 0:
            found = True
            _wake(motion, motion.island[a])
    return found


@njit(**FAST)
def put_to_sleep(world, work, motion, rules, manifolds, joints):
    """Freeze the islands whose bodies have all stayed in place for long enough; joints join bodies as contacts do."""
    n, rests = len(world.shape), False
    for b in world.going:
        if not world.moves[b] or motion.island[b] >= 0:
            continue
        stays = work.acted[b]
        stays = stays or joints.graph.of_body[b] >= 0
        if stays and _strayed(world, motion, b, 0) < rules.stray:
            motion.quiet[b] += 1
        else:
            motion.quiet[b] = 0
        if motion.quiet[b] == rules.rest // 2:
            _drop_anchor(motion, b, 7)
        if motion.quiet[b] == 0 or (motion.quiet[b] >= rules.rest and not _balanced(world, motion, rules, b)):
            motion.quiet[b] = 0
            _drop_anchor(motion, b, 0)
        rests = rests or motion.quiet[b] >= rules.rest
    if not rests:
        return
    parent = np.arange(n)
    for m in range(len(manifolds.count)):
        a, b = manifolds.pair[m, 0], manifolds.pair[m, 1]
        if manifolds.count[m] and world.moves[a] and world.moves[b]:
            join(parent, a, b)
    restless = np.zeros(n, np.bool_)
    _join_held(joints.graph, parent)
    _mark_gliding(world, motion, rules, manifolds, joints, parent, restless)
    for j in range(len(joints.each.body)):
        a = _driven_by_path(world, motion, joints.each.body, j)
        if a >= 0:
            restless[root(parent, a)] = True
    for b in range(n):
        if world.moves[b] and motion.island[b] < 0 and motion.quiet[b] < rules.rest:
            restless[root(parent, b)] = True
    for m in range(len(manifolds.count)):
        a, b = manifolds.pair[m, 0], manifolds.pair[m, 1]
        if manifolds.count[m] and world.scripted[b]:
            if norm(get(motion.velocity, b)) + norm(get(motion.angular, b)) > 0.0:
                restless[root(parent, a)] = True
    number = 0
    for b in range(n):
        number = max(number, motion.island[b] + 1)
    for b in range(n):
        if world.moves[b] and motion.island[b] < 0 and not restless[root(parent, b)]:
            motion.island[b] = number + root(parent, b)
            put(motion.velocity, b, (0.0, 0.0, 0.0))
            put(motion.angular, b, (0.0, 0.0, 0.0))


@njit(**FAST)
def _mark_gliding(world, motion, rules, manifolds, joints, parent, restless):
    """Mark the islands of bodies that move steadily while no friction acts on them: they never come to rest."""
    braked = np.zeros(len(world.shape), np.bool_)
    for m in range(len(manifolds.count)):
        a, b = manifolds.pair[m, 0], manifolds.pair[m, 1]
        if manifolds.count[m] and rules.options.friction and world.friction[a] * world.friction[b] > 0.0:
            braked[a] = braked[b] = True
    for b in world.going:
        if world.moves[b] and motion.island[b] < 0 and not braked[b] and joints.graph.of_body[b] < 0:
            if _drift(world, motion, rules, b) > rules.drift:
                restless[root(parent, b)] = True


@njit(**BARE)
def _join_held(graph, parent):
    """Join the bodies that joints and couplings connect."""
    for c in range(len(graph.comp) - 1):
        last = -1
        for k in range(graph.comp[c], graph.comp[c + 1]):
            if graph.node[k] >= 0:
                if last >= 0:
                    join(parent, last, graph.node[k])
                last = graph.node[k]


@njit(**BARE)
def _driven_by_path(world, motion, body, j):
    """The dynamic body that joint j holds to a scripted body that moves, or -1."""
    for s in range(2):
        a, b = body[j, s], body[j, 1 - s]
        if a >= 0 and b >= 0 and world.moves[a] and world.scripted[b]:
            if norm(get(motion.velocity, b)) + norm(get(motion.angular, b)) > 0.0:
                return a
    return -1


@njit(**BARE)
def _drop_anchor(motion, b, column):
    for x in range(3):
        motion.anchor[b, column + x] = motion.position[b, x]
    for x in range(4):
        motion.anchor[b, column + 3 + x] = motion.orientation[b, x]


@njit(**BARE)
def _strayed(world, motion, b, column):
    """A bound of how far any point of a body is from its place in an anchor pose."""
    anchor, cosine = motion.anchor[b], 0.0
    for x in range(4):
        cosine += anchor[column + 3 + x] * motion.orientation[b, x]
    away = sub(get(motion.position, b), (anchor[column], anchor[column + 1], anchor[column + 2]))
    return norm(away) + 2.0 * math.sqrt(max(0.0, 1.0 - cosine * cosine)) * world.radius[b]


@njit(**BARE)
def _balanced(world, motion, rules, b):
    """Whether the forces at a body are in balance: if the motion changes as it did from the first half of its quiet
    time to the second, the body stays near in the time that follows.

    With the poses q0, q1, q2 at the start, the middle and the end, this change is q2 - 2 q1 + q0. For a constant force
    it is a quarter of how far the force would move a body from rest in the next quiet time.
    """
    half, whole = rules.rest - rules.rest // 2, rules.rest
    anchor = motion.anchor[b]
    most = 0.0
    for x in range(3):
        later = (motion.position[b, x] - anchor[7 + x]) / half
        before = (anchor[7 + x] - anchor[x]) / (whole - half)
        most += (later - before) ** 2
    turned, sign, halfway = 0.0, 1.0, 1.0
    dots = 0.0
    mids = 0.0
    for x in range(4):
        dots += anchor[3 + x] * anchor[10 + x]
        mids += anchor[10 + x] * motion.orientation[b, x]
    sign, halfway = (1.0 if dots >= 0.0 else -1.0), (1.0 if mids >= 0.0 else -1.0)
    for x in range(4):
        later = (halfway * motion.orientation[b, x] - anchor[10 + x]) / half
        before = (anchor[10 + x] - sign * anchor[3 + x]) / (whole - half)
        turned += (later - before) ** 2
    # The two halves give the acceleration per step, and from it the motion of a body at rest in `whole` more steps.
    gain = (math.sqrt(most) + 2.0 * math.sqrt(turned) * world.radius[b]) / half
    return 0.5 * gain * whole * whole < rules.drift
