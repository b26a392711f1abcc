"""What contacts did in a whole step, as input for networks: one edge for each place where bodies met."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from sdfsim.physics.solver.broad_phase import order_of
from sdfsim.physics.solver.impulses import IMPULSE, met_half_way
from sdfsim.physics.solver.manifold import points_of
from sdfsim.physics.solver.vectors import BARE, FAST, get, sub, turn
from sdfsim.physics.solver.world import GAP, NORMAL, NORMAL_IMPULSE, TANGENTIAL

# Columns of an edge: from the centres of mass of both bodies to the contact, the normal from the second body to the
# first, the impulse on the first body (all along world axes), the distance when it was first met, the part of the step
# that had passed by then, and the weight of its place.
ARM, OTHER, AXIS, GIVEN, APART, WHEN, WEIGHT, WIDTH = 0, 3, 6, 9, 12, 13, 14, 15
ALIKE = 0.9  # contacts of two bodies are merged if the cosine between their normals is above this,
CLOSE = 0.1  # and their distance, in model lengths, below this


class Edges(NamedTuple):
    """E places where bodies met or nearly met in a step: pair [E, 2] int64, the bodies; value [E, WIDTH], see above."""

    pair: np.ndarray
    value: np.ndarray


@njit(**FAST)
def no_edges():
    return Edges(np.empty((0, 2), np.int64), np.empty((0, WIDTH)))


@njit(**FAST)
def noted(motion, matrix, manifolds, system, when, edges):
    """Add the contacts of an inner step that acted to the edges; `when` is the part of the step that has passed."""
    acted = 0
    for c in range(len(system.where)):
        acted += system.row[c, 0, IMPULSE] > 0.0
    edges, e = _longer(edges, acted)
    for c in range(len(system.where)):
        if system.row[c, 0, IMPULSE] > 0.0:
            _put(motion, matrix, manifolds, system.where[c, 0], system.where[c, 1], when, edges, e)
            e += 1
    return edges


@njit(**FAST)
def gathered(world, motion, matrix, manifolds, pairs, when, edges):
    """One edge for each place: for contacts that acted in the inner steps of a step, and for near ones at its end that
    did not act.

    Args:
        pairs: the number of manifolds, counted from the first, whose bodies are near.
    """
    edges, e = _longer(edges, points_of(manifolds, pairs))
    for m in range(pairs):
        for k in range(manifolds.count[m]):
            if manifolds.point[m, k, NORMAL_IMPULSE] == 0.0:
                _put(motion, matrix, manifolds, m, k, when, edges, e)
                e += 1
    key = np.empty(e)
    for i in range(e):
        key[i] = edges.pair[i, 0] * len(world.shape) + edges.pair[i, 1]
    whole = Edges(np.empty((e, 2), np.int64), np.empty((e, WIDTH)))
    kept = first = last = 0
    for e in order_of(key):
        if key[e] != key[last]:
            first = kept
        last = e
        twin = _twin(whole.value, first, kept, edges.value, e)
        if twin < 0:
            _carry(edges, e, whole, kept)
            kept += 1
        elif edges.value[e, WEIGHT] > 0.0:
            _merge(whole.value, twin, edges.value, e)
    return Edges(whole.pair[:kept], whole.value[:kept])


@njit(**FAST)
def _longer(edges, more):
    """The edges with room for `more` after them, and their number before."""
    count = len(edges.pair)
    longer = Edges(np.empty((count + more, 2), np.int64), np.empty((count + more, WIDTH)))
    for e in range(count):
        _carry(edges, e, longer, e)
    return longer, count


@njit(**BARE)
def _carry(edges, e, to, k):
    to.pair[k, 0], to.pair[k, 1] = edges.pair[e, 0], edges.pair[e, 1]
    for x in range(WIDTH):
        to.value[k, x] = edges.value[e, x]


@njit(**BARE)
def _put(motion, matrix, manifolds, m, k, when, edges, e):
    a, b = manifolds.pair[m, 0], manifolds.pair[m, 1]
    point = manifolds.point
    arm = turn(matrix, a, (point[m, k, 0], point[m, k, 1], point[m, k, 2]))
    other = turn(matrix, b, (point[m, k, 3], point[m, k, 4], point[m, k, 5]))
    arm, other = met_half_way(sub(get(motion.position, a), get(motion.position, b)), arm, other)
    edges.pair[e, 0], edges.pair[e, 1] = a, b
    push = point[m, k, NORMAL_IMPULSE]
    for x in range(3):
        edges.value[e, ARM + x], edges.value[e, OTHER + x] = arm[x], other[x]
        edges.value[e, AXIS + x] = point[m, k, NORMAL + x]
        edges.value[e, GIVEN + x] = push * point[m, k, NORMAL + x] + point[m, k, TANGENTIAL + x]
    edges.value[e, APART], edges.value[e, WHEN], edges.value[e, WEIGHT] = point[m, k, GAP], when, push


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
    """Merge a later impulse with an earlier one: their sum acts at their mean place."""
    weight = value[k, WEIGHT] + other[e, WEIGHT]
    share = other[e, WEIGHT] / weight
    for x in range(6):
        value[k, ARM + x] += share * (other[e, ARM + x] - value[k, ARM + x])
    for x in range(3):
        value[k, GIVEN + x] += other[e, GIVEN + x]
    value[k, WEIGHT] = weight
