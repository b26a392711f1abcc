"""Islands, compiled: dynamic bodies that contacts and joints connect. Each is solved, and falls asleep, on its own."""

from __future__ import annotations

import numpy as np
from numba import njit

from sdfsim.physics.solver.tree import asleep
from sdfsim.physics.solver.vectors import BARE, FAST


@njit(**BARE)
def root(parent, b):
    while parent[b] != b:
        parent[b] = parent[parent[b]]
        b = parent[b]
    return b


@njit(**BARE)
def join(parent, a, b):
    """Join the sets of bodies a and b."""
    one, other = root(parent, a), root(parent, b)
    parent[max(one, other)] = min(one, other)


@njit(**FAST)
def islands_of(world, work, motion, where, graph):
    """Blocks of rows, and the components of joints in `graph` (None if there are none), ordered by island. Sleeping
    components are left out.

    Returns:
        start [I + 1] and order [C] of the blocks, and the same of the components.
    """
    parent, number, components = work.parent, work.number, np.int64(0)
    if graph is not None:
        components = len(graph.comp) - 1
        for k in range(len(graph.node)):
            if graph.node[k] >= 0:
                parent[graph.node[k]], number[graph.node[k]] = graph.node[k], -1
    for c in range(len(where)):
        for e in range(2, 4):
            if where[c, e] >= 0:
                parent[where[c, e]], number[where[c, e]] = where[c, e], -1
    member = np.full(components, -1)
    if graph is not None:
        for c in range(components):
            if asleep(motion.island, graph, c):
                continue
            for k in range(graph.comp[c], graph.comp[c + 1]):
                if graph.node[k] >= 0:
                    if member[c] >= 0:
                        join(parent, member[c], graph.node[k])
                    member[c] = graph.node[k]
    for c in range(len(where)):
        a, b = where[c, 2], where[c, 3]
        if a >= 0 and b >= 0 and world.moves[a] and world.moves[b]:
            join(parent, a, b)
    islands = 0
    label, group = np.empty(len(where), np.int64), np.full(components, -1)
    for c in range(len(where) + components):
        if c < len(where):
            b = where[c, 2]
            b = b if b >= 0 and (world.moves[b] or where[c, 3] < 0) else where[c, 3]
        else:
            b = member[c - len(where)]
        if b < 0:
            continue
        a = root(parent, b)
        if number[a] < 0:
            number[a] = islands
            islands += 1
        if c < len(where):
            label[c] = number[a]
        else:
            group[c - len(where)] = number[a]
    start, order = _sorted(label, islands)
    first, component = _sorted(group, islands)
    return start, order, first, component


@njit(**FAST)
def _sorted(label, count):
    """Where each label begins, and the indices of the entries that have it; -1 is no label."""
    start = np.zeros(count + 1, np.int64)
    for c in range(len(label)):
        if label[c] >= 0:
            start[label[c] + 1] += 1
    for i in range(count):
        start[i + 1] += start[i]
    fill, order = start[:count].copy(), np.empty(len(label), np.int64)
    for c in range(len(label)):
        if label[c] >= 0:
            order[fill[label[c]]] = c
            fill[label[c]] += 1
    return start, order
