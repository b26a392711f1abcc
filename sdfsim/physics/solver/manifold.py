"""Contacts that persist, compiled: points carried along, and new ones that take their place."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable

from sdfsim.physics.solver.clipping import Polygons, polygons_room
from sdfsim.physics.solver.convex import Simplex, simplex_room
from sdfsim.physics.solver.distance import KIND, SIZE, SPHERE
from sdfsim.physics.solver.vectors import BARE, add, along, dot, get, scale, sub, turn, turn_back
from sdfsim.physics.solver.world import (
    COLUMNS,
    FIRST,
    GAP,
    KEY,
    NORMAL,
    NORMAL_IMPULSE,
    POINTS,
    SECOND,
    TANGENTIAL,
    TORSION,
    VOID,
)

FOUND = 128  # contact points that a pair may find in one look
CANDIDATES = 256  # leaves of nodes that may touch, of which
SIDE = 40  # at most become points
EACH = 4  # points of a manifold that are of the same two patches
ALIKE = 0.9  # cosine between normals that are taken for one
EVEN = 1e-9  # by how much two lengths or their squares differ at least, for one to come before the other
TOUCHES = 1e6  # more than any squared distance between points of a pair
OUTWARD = 1e-3  # how much deeper another point must be to be preferred to one that is farther out by a length


class Scratch(NamedTuple):
    """Room for what is found of one pair: compiled code allocates slowly."""

    found: np.ndarray  # [FOUND, COLUMNS] new points
    every: np.ndarray  # [FOUND + POINTS, COLUMNS] with those that were known
    # depth, node, leaf, key, normal, place, used: [CANDIDATES] and [CANDIDATES, 3] of nodes that may become points
    depth: np.ndarray
    node: np.ndarray
    leaf: np.ndarray
    key: np.ndarray
    normal: np.ndarray
    place: np.ndarray
    used: np.ndarray
    pick: np.ndarray  # [SIDE] int64, which of them do
    # away, alike: [FOUND + POINTS] how far from those chosen a point is, and how many of these are of its kind
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
    """How many points the manifolds of the first so many pairs have."""
    total = 0
    for m in range(pairs):
        total += manifolds.count[m]
    return total


@njit(**BARE)
def moved(shapes, world, motion, matrix, rules, manifolds, p, count):
    """Old points at the present poses; those that have parted or slid too far are dropped."""
    a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
    point = manifolds.point
    kept = 0
    for k in range(count):
        n = (point[p, k, NORMAL], point[p, k, NORMAL + 1], point[p, k, NORMAL + 2])
        for side in range(2):
            # The point of a ball that is touched is where the normal says, however it has rolled.
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
    """A new point, as found by the body that is first (0) or second (1) of its pair."""
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


@njit(**BARE)
def merged(rules, point, p, known, scratch, count, rounded):
    """Old and new points of a pair in one manifold, spread far; of points that nearly coincide the new ones.

    Returns how many there are.
    """
    found, every, away, alike = scratch.found, scratch.every, scratch.away, scratch.alike
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
            if (gone < same and turned > 0.8) or (rounded and turned > 0.99):
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
    # The deepest first, then always the one that is farthest from those chosen, of what touches before all others.
    chosen, lowest = -1, 1e300
    for e in range(total):
        away[e], alike[e] = 1e300, 0
        if every[e, GAP] < lowest - EVEN:
            chosen, lowest = e, every[e, GAP]
    kept = 0
    while chosen >= 0 and kept < POINTS:
        for x in range(COLUMNS):
            point[p, kept, x] = every[chosen, x]
        kept += 1
        farthest, following = rules.apart * rules.apart, -1
        for e in range(total):
            gone = 0.0
            turned = 0.0
            for x in range(3):
                gone += (every[e, x] - every[chosen, x]) ** 2
                turned += (every[e, NORMAL + x] - every[chosen, NORMAL + x]) ** 2
            if turned < 0.02 and every[e, KEY] == every[chosen, KEY]:
                alike[e] += 1
            away[e] = min(away[e], gone + 0.01 * turned)
            # What touches, or is about to, comes first: a corner that is far out and above would take the place of what
            # bears. What rolls on would sink in if the node that comes next had to wait until it touches.
            if away[e] > rules.apart * rules.apart and alike[e] < EACH:
                far = away[e] + (TOUCHES if every[e, GAP] <= rules.slop else 0.0)
                if far > farthest + EVEN:
                    farthest, following = far, e
        chosen = following
    return kept


@njit(**BARE)
def renewed(rules, point, p, known, scratch, count):
    """New points in place of all that were known of a pair; one that lies where one was goes on with its impulses.
    Returns how many there are."""
    found, every = scratch.found, scratch.every
    for k in range(known):
        for x in range(COLUMNS):
            every[k, x] = point[p, k, x]
    same = rules.contact_margin * rules.contact_margin
    if count > POINTS:
        count = thinned(scratch, count)
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
            if turned > 0.8 and away < least:
                twin, least = k, away
        for x in range(COLUMNS):
            point[p, e, x] = found[e, x]
        if twin >= 0:
            for x in range(NORMAL_IMPULSE, KEY):
                point[p, e, x] = every[twin, x]
            every[twin, KEY] = -1.0  # each goes on once
    return count


@njit(**BARE)
def thinned(scratch, count):
    """Of many points as many as a manifold holds: the deepest, then always the one that is farthest from those chosen.
    They come first in `found`."""
    found, away = scratch.found, scratch.away
    for e in range(count):
        away[e] = 1e300
    kept, chosen = 0, 0
    for e in range(count):
        if found[e, GAP] < found[chosen, GAP] - EVEN:
            chosen = e
    while kept < POINTS:
        away[chosen], away[kept] = away[kept], away[chosen]
        for x in range(COLUMNS):
            found[chosen, x], found[kept, x] = found[kept, x], found[chosen, x]
        last = kept
        kept += 1
        chosen = kept
        for e in range(kept, count):
            gone = 0.0
            for x in range(3):
                gone += (found[e, FIRST + x] - found[last, FIRST + x]) ** 2
                gone += 0.01 * (found[e, NORMAL + x] - found[last, NORMAL + x]) ** 2
            away[e] = min(away[e], gone)
            if away[e] > away[chosen] + EVEN:
                chosen = e
    return kept
