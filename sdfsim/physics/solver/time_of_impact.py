"""Time of impact, compiled: conservative advancement of bodies that move farther in an inner step than walls are
thick."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sdfsim.physics.solver.distance import SIZE, THICKNESS
from sdfsim.physics.solver.narrow_phase import SOLIDS, nearest, pair_kind
from sdfsim.physics.solver.surface_distance import is_round
from sdfsim.physics.solver.tolerances import ON_ITS_WAY, THIN_FAR, THIN_IN
from sdfsim.physics.solver.vectors import BARE, FAST, along, get, norm, put, scale, sub, to_matrix, turned_by


@njit(**BARE, inline="always")
def time_of_impact(shapes, world, work, motion, rules, manifolds, near, scratch, surfaces):
    """The part of the inner step by which each body may move, so that none passes through anything thinner than its
    motion."""
    free, change, part = work.free, work.change, work.part
    for b in world.going:
        part[b] = 1.0
    for p in range(len(near.start)):
        if near.count[p, 0] + near.count[p, 1] == 0:
            continue
        a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
        v, w = _after(motion.velocity, free, change, 0, a), _after(motion.angular, free, change, 3, a)
        speed = norm(sub(v, _after(motion.velocity, free, change, 0, b))) + norm(w) * world.radius[a]
        if world.moves[b] or world.scripted[b]:
            speed += norm(_after(motion.angular, free, change, 3, b)) * world.radius[b]
        depth = _harmless(shapes, world, a, b)
        away = near.away_all[p] - work.moved[a] - work.moved[b]
        if speed * rules.substep_dt > depth and not away > speed * rules.substep_dt:
            free_part = _until_near(
                shapes, world, motion, work, rules, manifolds, near, scratch, p, speed, depth, surfaces
            )
            part[a], part[b] = min(part[a], free_part), min(part[b], free_part)


@njit(**BARE)
def _harmless(shapes, world, a, b):
    """How deep two bodies may overlap before a distance points to the wrong side of a wall."""
    depth = math.inf
    if pair_kind(shapes, world.shape[a], world.shape[b]) == SOLIDS:
        for body in (a, b):
            depth = min(depth, THIN_FAR * shapes.table[world.shape[body], THICKNESS] * world.scale[body])
        return depth if world.radius[b] < math.inf else math.inf
    for side in range(2):
        one, other = (a, b) if side == 0 else (b, a)
        s, t = world.shape[one], world.shape[other]
        within = THIN_FAR * shapes.table[t, THICKNESS] * world.scale[other]
        if is_round(shapes.table, s):
            return within + shapes.table[s, SIZE] * world.scale[one]
        if shapes.clump_start[s + 1] > shapes.clump_start[s] and not is_round(shapes.table, t):
            depth = min(depth, within)
    return depth


@njit(**FAST)
def _until_near(shapes, world, motion, work, rules, manifolds, near, scratch, p, speed, depth, surfaces):
    """The part of the inner step by which a pair may move until it overlaps slightly, by conservative advancement."""
    free, change = work.free, work.change
    gone = work.moved[manifolds.pair[p, 0]] + work.moved[manifolds.pair[p, 1]]
    place, frame, turned = np.empty((2, 3)), np.empty((2, 3, 3)), np.empty((2, 4))
    scales, coms = np.empty(2), np.empty((2, 3))
    for side in range(2):
        body = manifolds.pair[p, side]
        scales[side] = world.scale[body]
        put(coms, side, get(world.com, body))
    deep, way = THIN_IN * depth, speed * rules.substep_dt
    t = 0.0
    for _ in range(ON_ITS_WAY):
        for side in range(2):
            body = manifolds.pair[p, side]
            span = rules.substep_dt * t
            put(place, side, along(get(motion.position, body), _after(motion.velocity, free, change, 0, body), span))
            q = turned_by(scale(_after(motion.angular, free, change, 3, body), span), motion.orientation, body)
            for x in range(4):
                turned[side, x] = q[x]
            to_matrix(turned, side, frame)
        rest = max((1.0 - t) * way - deep, -0.5 * deep)  # bodies farther apart do not meet before the end
        gap = nearest(
            shapes, world.shape, place, frame, scales, coms, manifolds.pair, near, p, gone + t * way, rest,
            -0.5 * deep, t == 0.0, scratch.simplex, surfaces,
        )  # fmt: skip
        if gap >= rest:
            return 1.0
        if gap <= -0.5 * deep:
            return t
        t += (gap + deep) / way
    return t


@njit(**BARE)
def _after(velocity, free, change, column, b):
    return (
        velocity[b, 0] + free[b, column] + change[b, column],
        velocity[b, 1] + free[b, column + 1] + change[b, column + 1],
        velocity[b, 2] + free[b, column + 2] + change[b, column + 2],
    )
