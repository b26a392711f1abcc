"""Which bodies are near each other, compiled: sweep and prune, and their known contacts."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sdfsim.physics.solver.vectors import BARE, FAST, add, get, norm, turn, vector
from sdfsim.physics.solver.world import COLUMNS, POINTS, Manifolds


@njit(**BARE)
def swept(world, work, motion, rules, span):
    """For each body, how far any of its points may move, and the box around everything that it may reach."""
    ways, low, high, matrix = work.motion_bound, work.low, work.high, work.matrix
    fall = norm(vector(rules.options.gravity)) * span
    for b in world.going:
        ways[b], work.moved[b], work.beside[b] = 0.0, 0.0, False
        if world.shape[b] < 0 or not math.isfinite(world.radius[b]):
            continue
        if motion.island[b] < 0 and (world.moves[b] or world.scripted[b]):
            speed = norm(get(motion.velocity, b)) + norm(get(motion.angular, b)) * world.radius[b]
            if world.moves[b]:
                speed += fall
            ways[b] = speed * span + 0.5 * rules.contact_margin
        middle = add(get(motion.position, b), turn(matrix, b, get(world.centre, b)))
        for a in range(3):
            wide = ways[b] + 0.5 * rules.contact_margin
            for c in range(3):
                wide += abs(matrix[b, a, c]) * world.half[b, c]
            low[b, a] = middle[a] - wide
            high[b, a] = middle[a] + wide


@njit(**BARE)
def stirs(world, motion, b):
    """Whether a body is awake, or scripted and moving."""
    if world.scripted[b]:
        return norm(get(motion.velocity, b)) + norm(get(motion.angular, b)) > 0.0
    return world.moves[b] and motion.island[b] < 0


@njit(**BARE)
def frozen(world, motion, a, b):
    """Whether two bodies, the first of which is dynamic, do not interact until one of them wakes."""
    return motion.island[a] >= 0 and (motion.island[b] >= 0 or not world.moves[b])


@njit(**BARE)
def _may_meet(world, a, b):
    if len(world.apart):
        for k in range(world.apart[a], world.apart[a + 1]):
            if world.apart[k] == b:
                return False
    one, other = world.world[a], world.world[b]
    return (one == other or one < 0 or other < 0) and world.allowed[world.group[a], world.group[b]]


@njit(**BARE)
def _overlap(low, high, a, other_low, other_high, b):
    for k in range(3):
        if low[a, k] > other_high[b, k] or high[a, k] < other_low[b, k]:
            return False
    return True


@njit(**FAST)
def near_pairs(world, motion, low, high):
    """[P, 2] pairs of bodies whose boxes overlap, in a fixed order: sweep and prune along the axis of largest
    spread."""
    going, count = np.empty(len(world.going), np.int64), 0
    for b in world.going:
        if world.shape[b] >= 0 and math.isfinite(world.radius[b]):
            going[count] = b
            count += 1
    found = np.empty((max(64, 4 * count), 2), np.int64)
    pairs = np.int64(0)  # a literal has a type of its own, for which everything would be compiled again
    axis, widest = 0, -1.0
    for k in range(3):
        least, most = math.inf, -math.inf
        for i in range(count):
            least, most = min(least, low[going[i], k]), max(most, low[going[i], k])
        if most - least > widest:
            axis, widest = k, most - least
    lowest = np.empty(count)
    for i in range(count):
        lowest[i] = low[going[i], axis]
    order = order_of(lowest)
    for i in range(count):
        a = going[order[i]]
        awake = stirs(world, motion, a)
        for j in range(i + 1, count):
            b = going[order[j]]
            if low[b, axis] > high[a, axis]:
                break
            if not (awake or stirs(world, motion, b)) or not (world.moves[a] or world.moves[b]):
                continue
            if _overlap(low, high, a, low, high, b) and _may_meet(world, a, b):
                swap = (b < a and world.moves[b]) or not world.moves[a]
                found, pairs = _append(found, pairs, b if swap else a, a if swap else b)
        if not world.moves[a]:
            continue
        for k in range(len(world.plane)):
            if (awake or stirs(world, motion, world.plane[k])) and _may_meet(world, a, world.plane[k]):
                found, pairs = _append(found, pairs, a, world.plane[k])
        if not awake:
            continue
        for k in range(_first_above(world, high[a, world.axis]) - 1, -1, -1):
            if world.reach[k] < low[a, world.axis]:
                break
            if _overlap(low, high, a, world.low, world.high, k) and _may_meet(world, a, world.still[k]):
                found, pairs = _append(found, pairs, a, world.still[k])
    key, ordered = np.empty(pairs), np.empty((pairs, 2), np.int64)
    for p in range(pairs):
        key[p] = found[p, 0] * len(world.shape) + found[p, 1]
    order = order_of(key)
    for p in range(pairs):
        ordered[p, 0], ordered[p, 1] = found[order[p], 0], found[order[p], 1]
    return ordered


@njit(**FAST)
def order_of(key):
    """Stable argsort of an array [N] of floats."""
    return np.argsort(key, kind="mergesort")


@njit(**BARE)
def _first_above(world, top):
    """The first static body, in their order, that begins above `top` along `axis`."""
    first, last = 0, len(world.still)
    while first < last:
        middle = (first + last) // 2
        if world.low[middle, world.axis] <= top:
            first = middle + 1
        else:
            last = middle
    return first


@njit(**FAST)
def _append(found, count, a, b):
    if count == len(found):
        more = np.empty((2 * count, 2), np.int64)
        for p in range(count):
            more[p, 0], more[p, 1] = found[p, 0], found[p, 1]
        found = more
    found[count, 0], found[count, 1] = a, b
    return found, count + 1


@njit(**FAST)
def carried(world, motion, pairs, old):
    """The manifolds of `pairs`, with the contact points that are known, and those of sleeping bodies."""
    n = len(world.shape)
    key, asleep = np.empty(len(old.count)), np.zeros(len(old.count), np.bool_)
    for k in range(len(old.count)):
        a, b = old.pair[k, 0], old.pair[k, 1]
        key[k] = a * n + b
        asleep[k] = frozen(world, motion, a, b)
    order = order_of(key)
    here = total = len(pairs)
    for k in range(len(asleep)):
        total += asleep[k]
    pair = np.empty((total, 2), np.int64)
    count = np.zeros(total, np.int64)
    point = np.empty((total, POINTS, COLUMNS))
    at = 0
    for k in range(here):
        pair[k, 0], pair[k, 1] = pairs[k, 0], pairs[k, 1]
        wanted = pairs[k, 0] * n + pairs[k, 1]
        while at < len(order) and key[order[at]] < wanted:
            at += 1
        if at < len(order) and key[order[at]] == wanted:
            known = order[at]
            _carry_points(old, known, count, point, k)
            asleep[known] = False
    end = here
    for k in range(len(old.count)):
        if asleep[k]:
            pair[end, 0], pair[end, 1] = old.pair[k, 0], old.pair[k, 1]
            _carry_points(old, k, count, point, end)
            end += 1
    return Manifolds(pair[:end], count[:end], point[:end])


@njit(**BARE)
def _carry_points(old, known, count, point, k):
    count[k] = old.count[known]
    for e in range(count[k]):
        for x in range(COLUMNS):
            point[k, e, x] = old.point[known, e, x]
