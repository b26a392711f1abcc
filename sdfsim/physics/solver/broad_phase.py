"""Which bodies are near each other, compiled: sweep and prune, and the contacts that are known of them."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sdfsim.physics.solver.vectors import BARE, FAST, add, get, norm, turn, vector
from sdfsim.physics.solver.world import COLUMNS, POINTS, Manifolds


@njit(**BARE)
def swept(world, work, motion, rules, span):
    """How far any point of a body may go, and the box around all that it may reach."""
    ways, low, high, matrix = work.ways, work.low, work.high, work.matrix
    fall = norm(vector(rules.gravity)) * span
    for b in world.going:
        ways[b], work.gone[b], work.beside[b] = 0.0, 0.0, False
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
def _stirs(world, motion, b):
    """Whether a body is awake, or led along."""
    if world.scripted[b]:
        return norm(get(motion.velocity, b)) + norm(get(motion.angular, b)) > 0.0
    return world.moves[b] and motion.island[b] < 0


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
    """[P, 2] bodies whose boxes overlap, in a fixed order: sweep and prune along the axis on which they spread most."""
    going = world.going[(world.shape[world.going] >= 0) & np.isfinite(world.radius[world.going])]
    count = len(going)
    found = np.empty((max(64, 4 * count), 2), np.int64)
    pairs = 0
    axis, widest = 0, -1.0
    for k in range(3):
        least, most = math.inf, -math.inf
        for i in range(count):
            least, most = min(least, low[going[i], k]), max(most, low[going[i], k])
        if most - least > widest:
            axis, widest = k, most - least
    order = going[np.argsort(low[:, axis][going], kind="mergesort")]
    for i in range(count):
        a = order[i]
        awake = _stirs(world, motion, a)
        for j in range(i + 1, count):
            b = order[j]
            if low[b, axis] > high[a, axis]:
                break
            if not (awake or _stirs(world, motion, b)) or not (world.moves[a] or world.moves[b]):
                continue
            if _overlap(low, high, a, low, high, b) and _may_meet(world, a, b):
                swap = (b < a and world.moves[b]) or not world.moves[a]
                found, pairs = _append(found, pairs, b if swap else a, a if swap else b)
        if not world.moves[a]:
            continue
        for k in range(len(world.plane)):
            if (awake or _stirs(world, motion, world.plane[k])) and _may_meet(world, a, world.plane[k]):
                found, pairs = _append(found, pairs, a, world.plane[k])
        if not awake:
            continue
        last = np.searchsorted(world.low[:, world.axis], high[a, world.axis], side="right")
        for k in range(last - 1, -1, -1):
            if world.reach[k] < low[a, world.axis]:
                break
            if _overlap(low, high, a, world.low, world.high, k) and _may_meet(world, a, world.still[k]):
                found, pairs = _append(found, pairs, a, world.still[k])
    found = found[:pairs]
    # Floats, for which sorting is compiled already.
    return found[np.argsort((found[:, 0] * len(world.shape) + found[:, 1]) * 1.0, kind="mergesort")]


@njit(**FAST)
def _append(found, count, a, b):
    if count == len(found):
        more = np.empty((2 * count, 2), np.int64)
        more[:count] = found
        found = more
    found[count, 0], found[count, 1] = a, b
    return found, count + 1


@njit(**FAST)
def carried(world, motion, pairs, old):
    """The manifolds of `pairs` with what is known of them, and those of bodies that sleep."""
    n = len(world.shape)
    key, asleep = np.empty(len(old.count)), np.zeros(len(old.count), np.bool_)
    for k in range(len(old.count)):
        a, b = old.pair[k, 0], old.pair[k, 1]
        key[k] = a * n + b
        asleep[k] = motion.island[a] >= 0 and (motion.island[b] >= 0 or not world.moves[b])
    order = np.argsort(key, kind="mergesort")
    here = len(pairs)
    total = here + asleep.sum()
    pair = np.empty((total, 2), np.int64)
    count = np.zeros(total, np.int64)
    point = np.empty((total, POINTS, COLUMNS))
    pair[:here] = pairs
    at = 0
    for k in range(here):
        wanted = pairs[k, 0] * n + pairs[k, 1]
        while at < len(order) and key[order[at]] < wanted:
            at += 1
        if at < len(order) and key[order[at]] == wanted:
            known = order[at]
            count[k] = old.count[known]
            point[k, : count[k]] = old.point[known, : count[k]]
            asleep[known] = False
    end = here
    for k in range(len(old.count)):
        if asleep[k]:
            pair[end] = old.pair[k]
            count[end] = old.count[k]
            point[end, : count[end]] = old.point[k, : count[end]]
            end += 1
    return Manifolds(pair[:end], count[:end], point[:end])
