"""Persistent contacts, compiled: old points are carried along, and new ones replace them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable

from sdfsim.physics.solver.clipping import Polygons, polygons_room
from sdfsim.physics.solver.convex import Simplex, simplex_room
from sdfsim.physics.solver.distance import KIND, SIZE, SPHERE
from sdfsim.physics.solver.tolerances import EQUAL, ONE_FACE, SAME_CORE, SAME_NORMAL, TURN_COUNTS
from sdfsim.physics.solver.vectors import BARE, add, along, dot, get, scale, sub, turn, turn_back
from sdfsim.physics.solver.world import (
    COLUMNS,
    FIRST,
    GAP,
    KEY,
    NORMAL,
    NORMAL_IMPULSE,
    OWNER,
    POINTS,
    SECOND,
    TANGENTIAL,
    TORSION,
    VOID,
)

FOUND = 128  # contact points that may be found for a pair at once
CANDIDATES = 256  # largest number of leaves of nodes that may touch
SIDE = 40  # largest number of them that become points
EACH = 4  # points of a manifold for the same two patches
TOUCHES = 1e6  # more than any squared distance between points of a pair


class Scratch(NamedTuple):
    """Buffers for the points of one pair: compiled code allocates slowly."""

    found: np.ndarray  # [FOUND, COLUMNS] new points
    every: np.ndarray  # [FOUND + POINTS, COLUMNS] new and known points
    # depth, node, leaf, key, normal, place, used: [CANDIDATES] or [CANDIDATES, 3], nodes that may become points
    depth: np.ndarray
    node: np.ndarray
    leaf: np.ndarray
    key: np.ndarray
    normal: np.ndarray
    place: np.ndarray
    used: np.ndarray
    pick: np.ndarray  # [SIDE] int64, the ones that do
    # away, alike: [FOUND + POINTS] distance of a point from the chosen ones, and the number of these of its kind
    away: np.ndarray
    alike: np.ndarray
    simplex: Simplex
    polygons: Polygons


@register_jitable
def scratch_room():
    most = FOUND + POINTS
    return Scratch(
        np.empty((FOUND, COLUMNS)), np.empty((most, COLUMNS)), np.empty(CANDIDATES), np.empty(CANDIDATES, np.int64),
        np.empty(CANDIDATES, np.int64), np.empty(CANDIDATES, np.int64), np.empty((CANDIDATES, 3)),
        np.empty((CANDIDATES, 3)), np.empty(CANDIDATES, np.int64), np.empty(SIDE, np.int64), np.empty(most),
        np.empty(most, np.int64),
        simplex_room(), polygons_room(),
    )  # fmt: skip


@njit(**BARE)
def points_of(manifolds, pairs):
    """Number of points in the manifolds of the first `pairs` pairs."""
    total = 0
    for m in range(pairs):
        total += manifolds.count[m]
    return total


@njit(**BARE)
def moved(shapes, world, motion, matrix, rules, manifolds, p, count):
    """Move old points to the present poses, and drop those that have parted or slid too far."""
    a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
    point = manifolds.point
    kept = 0
    for k in range(count):
        n = (point[p, k, NORMAL], point[p, k, NORMAL + 1], point[p, k, NORMAL + 2])
        for side in range(2):
            # The contact point of a ball follows from the normal, however the ball has rolled.
            body = a if side == 0 else b
            if shapes.table[world.shape[body], KIND] == SPHERE:
                radius = shapes.table[world.shape[body], SIZE] * world.scale[body] * (-1.0 if side == 0 else 1.0)
                here = turn_back(matrix, body, scale(n, radius))
                for c in range(3):
                    point[p, k, 3 * side + c] = here[c] - world.com[body, c]
        first = turn(matrix, a, (point[p, k, 0], point[p, k, 1], point[p, k, 2]))
        second = turn(matrix, b, (point[p, k, 3], point[p, k, 4], point[p, k, 5]))
        offset = add(sub(get(motion.position, a), get(motion.position, b)), sub(first, second))
        gap = dot(offset, n)
        slid = along(offset, n, -gap)
        if gap > rules.contact_margin or dot(slid, slid) > rules.contact_margin * rules.contact_margin:
            continue
        for c in range(COLUMNS):
            point[p, kept, c] = point[p, k, c]
        point[p, kept, GAP] = gap
        kept += 1
    return kept


@njit(**BARE)
def write(found, count, side, mine, theirs, normal, gap, key):
    """Write a new point, found from the first (side 0) or second (1) body of its pair."""
    for x in range(3):
        found[count, (FIRST if side == 0 else SECOND) + x] = mine[x]
        found[count, (SECOND if side == 0 else FIRST) + x] = theirs[x]
        found[count, NORMAL + x] = normal[x] if side == 0 else -normal[x]
        found[count, TANGENTIAL + x] = 0.0
    found[count, NORMAL_IMPULSE] = 0.0
    found[count, GAP] = gap
    found[count, KEY] = key
    found[count, TORSION] = 1.0
    found[count, VOID] = 0.0
    found[count, OWNER] = side


@njit(**BARE)
def merged(rules, point, p, known, scratch, count, rounded):
    """Merge old and new points of a pair into one manifold of points far apart; of nearly coincident points the new
    ones are kept.

    Returns their number.
    """
    found, every = scratch.found, scratch.every
    for e in range(count):
        for x in range(COLUMNS):
            every[e, x] = found[e, x]
    total = count
    same = rules.contact_margin * rules.contact_margin
    for k in range(known):
        twin = -1
        for e in range(count):
            turned = 0.0
            gone = 0.0
            for x in range(3):
                turned += point[p, k, NORMAL + x] * found[e, NORMAL + x]
                gone += (point[p, k, x] - found[e, x]) ** 2
            if (gone < same and turned > SAME_NORMAL) or (rounded and turned > SAME_CORE):
                twin = e
                break
        if twin < 0:
            for x in range(COLUMNS):
                every[total, x] = point[p, k, x]
            total += 1
        elif every[twin, NORMAL_IMPULSE] == 0.0:
            for x in range(NORMAL_IMPULSE, KEY):
                every[twin, x] = point[p, k, x]
            every[twin, TORSION] = point[p, k, TORSION]
    return spread(rules, scratch, total, point[p])


@njit(**BARE)
def renewed(rules, point, p, known, scratch, count):
    """Replace all known points of a pair by the new ones; a new point at the place of an old one takes over its
    impulses. Returns their number."""
    found, every, same = scratch.found, scratch.every, rules.contact_margin * rules.contact_margin
    if count > POINTS:
        count = thinned(rules, scratch, count)
    for k in range(known):
        for x in range(COLUMNS):
            every[k, x] = point[p, k, x]
    for e in range(count):
        twin, least = -1, same
        for k in range(known):
            if every[k, KEY] != found[e, KEY]:
                continue
            turned = on_first = on_second = 0.0
            for x in range(3):
                turned += every[k, NORMAL + x] * found[e, NORMAL + x]
                on_first += (every[k, FIRST + x] - found[e, FIRST + x]) ** 2
                on_second += (every[k, SECOND + x] - found[e, SECOND + x]) ** 2
            away = min(on_first, on_second)
            if turned > SAME_NORMAL and away < least:
                twin, least = k, away
        for x in range(COLUMNS):
            point[p, e, x] = found[e, x]
        if twin >= 0:
            for x in range(NORMAL_IMPULSE, KEY):
                point[p, e, x] = every[twin, x]
            every[twin, KEY] = -1.0  # each is taken over once
    return count


@njit(**BARE)
def thinned(rules, scratch, count):
    """Choose as many of the new points as a manifold holds. They are moved to the front of `found`."""
    for e in range(count):
        for x in range(COLUMNS):
            scratch.every[e, x] = scratch.found[e, x]
    return spread(rules, scratch, count, scratch.found)


@njit(**BARE)
def spread(rules, scratch, total, chosen):
    """Write to `chosen` the deepest of the first points of `scratch.every`, then always the one farthest from those
    chosen; points that touch come before all others. Returns their number, at most that of a manifold."""
    every, away, alike = scratch.every, scratch.away, scratch.alike
    best, lowest = -1, math.inf
    for e in range(total):
        away[e], alike[e] = math.inf, 0
        if every[e, GAP] < lowest - EQUAL:
            best, lowest = e, every[e, GAP]
    kept, apart = 0, rules.apart * rules.apart
    while best >= 0 and kept < POINTS:
        for x in range(COLUMNS):
            chosen[kept, x] = every[best, x]
        kept += 1
        farthest, following = apart, -1
        for e in range(total):
            gone = turned = 0.0
            for x in range(3):
                gone += (every[e, x] - every[best, x]) ** 2
                turned += (every[e, NORMAL + x] - every[best, NORMAL + x]) ** 2
            if turned < ONE_FACE and every[e, KEY] == every[best, KEY]:
                alike[e] += 1
            away[e] = min(away[e], gone + TURN_COUNTS * turned)
            # Points that carry load come first, else a body at rest would change its points when all are equally deep;
            # then those that touch, or are about to: a corner that is far out but above is no help, and a rolling body
            # would sink in if its next node had to wait until it touches.
            if away[e] > apart and alike[e] < EACH:
                bears = every[e, NORMAL_IMPULSE] > 0.0
                far = away[e] + (2.0 * TOUCHES if bears else TOUCHES if every[e, GAP] <= rules.slop else 0.0)
                if far > farthest + EQUAL:
                    farthest, following = far, e
        best = following
    return kept
