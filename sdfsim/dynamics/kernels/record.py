"""What contacts did in a whole step, for networks that go on from there: one edge for each place where bodies met."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from sdfsim.dynamics.kernels.collide import sorted_order
from sdfsim.dynamics.kernels.solve import IMPULSE, met_half_way
from sdfsim.dynamics.kernels.vectors import BARE, FAST, get, sub, turn
from sdfsim.dynamics.kernels.world import DRAG, GAP, NORMAL, PUSH

# Columns of an edge: from the centres of mass of both bodies to the contact, the normal from the second body to the
# first, the impulse on the first body (all along world axes), the distance when it was first met, the inner step in
# which it was, and the weight of its place.
ARM, OTHER, AXIS, GIVEN, APART, WHEN, WEIGHT, WIDTH = 0, 3, 6, 9, 12, 13, 14, 15
ALIKE = 0.9  # cosine between normals, and
CLOSE = 0.1  # model lengths between contacts of two bodies, that are taken for one


class Edges(NamedTuple):
    """E places where bodies met or nearly met in a step.

    Attributes:
        pair: [E, 2] int64, the bodies.
        value: [E, WIDTH], the columns above.
        count: [1] int64, how many there are; there may be room for more.
    """

    pair: np.ndarray
    value: np.ndarray
    count: np.ndarray


@njit(**FAST)
def no_edges(room):
    return Edges(np.empty((room, 2), np.int64), np.empty((room, WIDTH)), np.zeros(1, np.int64))


@njit(**FAST)
def noted(motion, matrix, manifolds, system, when, edges):
    """The edges with those contacts of an inner step that acted."""
    for c in range(len(system.where)):
        if system.row[c, 0, IMPULSE] > 0.0:
            edges = _with_room(edges)
            _put(motion, matrix, manifolds, system.where[c, 0], system.where[c, 1], when, edges)
    return edges


@njit(**FAST)
def gathered(world, motion, matrix, manifolds, pairs, steps, edges):
    """One edge a place: what acted there in the inner steps of a step, and what is near at its end but did not act.

    Args:
        pairs: of how many manifolds, the first ones, bodies are near.
    """
    for m in range(pairs):
        for k in range(manifolds.count[m]):
            if manifolds.point[m, k, PUSH] == 0.0:
                edges = _with_room(edges)
                _put(motion, matrix, manifolds, m, k, steps - 1, edges)
    n, total = len(world.shape), edges.count[0]
    key = np.empty(total)
    for e in range(total):
        key[e] = edges.pair[e, 0] * n + edges.pair[e, 1]
    order = sorted_order(key)
    whole = no_edges(max(1, total))
    kept = first = 0
    for i in range(total):
        e = order[i]
        if i == 0 or key[e] != key[order[i - 1]]:
            first = kept
        twin = _twin(whole.value, first, kept, edges.value, e)
        if twin < 0:
            whole.pair[kept] = edges.pair[e]
            whole.value[kept] = edges.value[e]
            kept += 1
        elif edges.value[e, WEIGHT] > 0.0:
            _merge(whole.value, twin, edges.value, e)
    whole.count[0] = kept
    return whole


@njit(**FAST)
def _with_room(edges):
    count = edges.count[0]
    if count < len(edges.pair):
        return edges
    more = no_edges(max(64, 2 * count))
    more.pair[:count], more.value[:count], more.count[0] = edges.pair, edges.value, count
    return more


@njit(**BARE)
def _put(motion, matrix, manifolds, m, k, when, edges):
    a, b = manifolds.pair[m, 0], manifolds.pair[m, 1]
    point, e = manifolds.point, edges.count[0]
    arm = turn(matrix, a, (point[m, k, 0], point[m, k, 1], point[m, k, 2]))
    other = turn(matrix, b, (point[m, k, 3], point[m, k, 4], point[m, k, 5]))
    arm, other = met_half_way(sub(get(motion.position, a), get(motion.position, b)), arm, other)
    edges.pair[e, 0], edges.pair[e, 1] = a, b
    push = point[m, k, PUSH]
    for x in range(3):
        edges.value[e, ARM + x], edges.value[e, OTHER + x] = arm[x], other[x]
        edges.value[e, AXIS + x] = point[m, k, NORMAL + x]
        edges.value[e, GIVEN + x] = push * point[m, k, NORMAL + x] + point[m, k, DRAG + x]
    edges.value[e, APART], edges.value[e, WHEN], edges.value[e, WEIGHT] = point[m, k, GAP], when, push
    edges.count[0] = e + 1


@njit(**BARE)
def _twin(value, first, last, other, e):
    for k in range(first, last):
        alike = gone = 0.0
        for x in range(3):
            alike += value[k, AXIS + x] * other[e, AXIS + x]
            gone += (value[k, ARM + x] - other[e, ARM + x]) ** 2
        if alike > ALIKE and gone < CLOSE * CLOSE:
            return k
    return -1


@njit(**BARE)
def _merge(value, k, other, e):
    """A later impulse joins an earlier one: their sum acts at their mean place."""
    weight = value[k, WEIGHT] + other[e, WEIGHT]
    share = other[e, WEIGHT] / weight
    for x in range(6):
        value[k, ARM + x] += share * (other[e, ARM + x] - value[k, ARM + x])
    for x in range(3):
        value[k, GIVEN + x] += other[e, GIVEN + x]
    value[k, WEIGHT] = weight
