"""Islands, compiled: dynamic bodies that contacts join. Each island is solved, and falls asleep, on its own."""

from __future__ import annotations

import numpy as np
from numba import njit

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
def islands_of(world, parent, number, where):
    """Contacts ordered by island: dynamic bodies that contacts join."""
    for c in range(len(where)):
        for e in range(2, 4):
            parent[where[c, e]], number[where[c, e]] = where[c, e], -1
    for c in range(len(where)):
        a, b = where[c, 2], where[c, 3]
        if world.moves[a] and world.moves[b]:
            join(parent, a, b)
    islands = 0
    label = np.empty(len(where), np.int64)
    for c in range(len(where)):
        a = root(parent, where[c, 2])
        if number[a] < 0:
            number[a] = islands
            islands += 1
        label[c] = number[a]
    start = np.zeros(islands + 1, np.int64)
    for c in range(len(where)):
        start[label[c] + 1] += 1
    for i in range(islands):
        start[i + 1] += start[i]
    fill, order = np.empty(islands, np.int64), np.empty(len(where), np.int64)
    for i in range(islands):
        fill[i] = start[i]
    for c in range(len(where)):
        order[fill[label[c]]] = c
        fill[label[c]] += 1
    return start, order
