"""The joints of a scene as a graph, compiled: the rows that hold are solved exactly, by a block factorisation of the
matrix of masses and rows. Bodies and joints are eliminated in an order that is found once; trees have no fill-in, and
loops, which have redundant rows, are softened."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from sdfsim.physics.solver.rows import ANGULAR, LINEAR, MASS, OTHER, velocity_of
from sdfsim.physics.solver.tolerances import REDUNDANT
from sdfsim.physics.solver.vectors import BARE, rotated_matrix

EQUATIONS = 6  # largest number of rows that a joint holds


class Graph(NamedTuple):
    """The dynamic bodies and the joints as K nodes of a graph, in the order in which they are eliminated. The nodes
    from comp[c] to comp[c + 1] are connected."""

    comp: np.ndarray  # [C + 1] int64
    node: np.ndarray  # [K] int64: a body, or -1 - j for joint j
    of_body: np.ndarray  # [N] int64, the node of a body; -1 if no joint holds it or it does not move
    of_comp: np.ndarray  # [N] int64, likewise the number of its connected component
    entry: np.ndarray  # [J, 2] int64, the block of a joint and its body; -1 if the body does not move
    below: np.ndarray  # [K + 1] int64, the blocks below the diagonal of a column
    row: np.ndarray  # [F] int64, the node of a block's row
    start: np.ndarray  # [K + 1] int64, the targets of a column
    target: np.ndarray  # [U] int64, the block to which a pair of a column's blocks adds; -1 - k: diagonal of node k


class Factors(NamedTuple):
    """The matrix of masses and rows: diagonal, inverse [K, 6, 6]; block, low [F, 6, 6]; and the right-hand side x [K,
    6]."""

    diagonal: np.ndarray
    inverse: np.ndarray
    block: np.ndarray
    low: np.ndarray
    x: np.ndarray


class Held(NamedTuple):
    """The rows that joints hold, in an inner step. Body -1 is the world."""

    body: np.ndarray  # [J, 2] int64
    row: np.ndarray  # [J, EQUATIONS, WIDTH] as those of `Rows`
    active: np.ndarray  # [J, EQUATIONS] int64: 0 unused, 1 for a row that holds, 2 for a spring
    # [J, EQUATIONS]: compliance; wanted velocity; impulse; error before and after the inner step
    soft: np.ndarray
    wanted: np.ndarray
    impulse: np.ndarray
    error: np.ndarray
    later: np.ndarray


@njit(**BARE)
def factor(world, work, graph, factors, held, c):
    """Factor the matrix of component c, block by block."""
    first, last = graph.comp[c], graph.comp[c + 1]
    factors.diagonal[first:last] = 0.0
    for k in range(first, last):
        for p in range(graph.below[k], graph.below[k + 1]):
            factors.block[p] = 0.0
        b = graph.node[k]
        if b >= 0:
            for x in range(3):
                factors.diagonal[k, x, x] = 1.0 / world.inverse_mass[b]
            rotated_matrix(work.matrix, world.inertia, b, factors.diagonal[k, 3:, 3:])
    for k in range(first, last):
        if graph.node[k] >= 0:
            continue
        j = -1 - graph.node[k]
        for e in range(EQUATIONS):
            row = held.row[j, e]
            used = held.active[j, e] > 0
            factors.diagonal[k, e, e] = -1.0
            if used and row[MASS] > 0.0:
                factors.diagonal[k, e, e] = -held.soft[j, e] - REDUNDANT / row[MASS]
            for s in range(2):
                p = graph.entry[j, s]
                if p < 0 or not used:
                    continue
                lower = graph.row[p] == k
                for x in range(6):
                    if x < 3:
                        value = -row[LINEAR + x] if s == 0 else row[LINEAR + x]
                    else:
                        value = -row[(ANGULAR if s == 0 else OTHER) + x - 3]
                    if lower:
                        factors.block[p, e, x] = value
                    else:
                        factors.block[p, x, e] = value
    for k in range(first, last):
        _invert(factors.diagonal, factors.inverse, k)
        t = graph.start[k]
        for p in range(graph.below[k], graph.below[k + 1]):
            _multiply(factors.low, factors.block, factors.inverse, p, k)
            for q in range(graph.below[k], p + 1):
                target = graph.target[t]
                t += 1
                if target < 0:
                    _subtract(factors.diagonal, -1 - target, factors.low, p, factors.block, q)
                else:
                    _subtract(factors.block, target, factors.low, p, factors.block, q)


@njit(**BARE)
def _invert(diagonal, inverse, k):
    """Gauss-Jordan elimination without pivoting: the blocks are definite."""
    a = inverse[k]
    for x in range(6):
        for y in range(6):
            a[x, y] = diagonal[k, x, y]
    for i in range(6):
        pivot = 1.0 / a[i, i]
        a[i, i] = 1.0
        for y in range(6):
            a[i, y] *= pivot
        for x in range(6):
            if x != i:
                share = a[x, i]
                a[x, i] = 0.0
                for y in range(6):
                    a[x, y] -= share * a[i, y]


@njit(**BARE)
def _multiply(out, block, inverse, p, k):
    for x in range(6):
        for y in range(6):
            total = 0.0
            for u in range(6):
                total += block[p, x, u] * inverse[k, u, y]
            out[p, x, y] = total


@njit(**BARE)
def _subtract(out, t, low, p, block, q):
    for x in range(6):
        for y in range(6):
            total = 0.0
            for u in range(6):
                total += low[p, x, u] * block[q, y, u]
            out[t, x, y] -= total


@njit(**BARE)
def substitute(graph, factors, c):
    """Solve for the right-hand side `x` of component c, in place."""
    x, low, last = factors.x, factors.low, graph.comp[c + 1]
    for k in range(graph.comp[c], last):
        for p in range(graph.below[k], graph.below[k + 1]):
            _take_off(x, graph.row[p], low[p], k)
    for k in range(last - 1, graph.comp[c] - 1, -1):
        a, b, d, e, f, g = x[k, 0], x[k, 1], x[k, 2], x[k, 3], x[k, 4], x[k, 5]
        for i in range(6):
            m = factors.inverse[k, i]
            x[k, i] = m[0] * a + m[1] * b + m[2] * d + m[3] * e + m[4] * f + m[5] * g
        for p in range(graph.below[k], graph.below[k + 1]):
            _take_off(x, k, low[p].T, graph.row[p])


@njit(**BARE)
def _take_off(x, k, block, of):
    """Subtract from row k of x [K, 6] the product of a block [6, 6] with another row."""
    for i in range(6):
        total = 0.0
        for u in range(6):
            total += block[i, u] * x[of, u]
        x[k, i] -= total


@njit(**BARE)
def project(work, graph, factors, held, c, change, whole):
    """Add to velocities `change` [N + 1, 6] the smallest change, in the metric of masses, with which the rows hold.
    `whole`: for the full velocities, with the values that the rows want; else for the change alone, which must be zero
    along the rows."""
    for k in range(graph.comp[c], graph.comp[c + 1]):
        j = -1 - graph.node[k]
        for e in range(6):
            factors.x[k, e] = 0.0
            if j >= 0 and held.active[j, e] > 0:
                row, a, b = held.row[j, e], held.body[j, 0], held.body[j, 1]
                now = velocity_of(row, change, a, b)
                if whole:
                    now += velocity_of(row, work.twist, a, b) + velocity_of(row, work.free, a, b)
                    now += held.soft[j, e] * held.impulse[j, e] - held.wanted[j, e]
                factors.x[k, e] = now
    substitute(graph, factors, c)
    for k in range(graph.comp[c], graph.comp[c + 1]):
        n = graph.node[k]
        for e in range(6):
            if n >= 0:
                change[n, e] += factors.x[k, e]
            elif whole:
                held.impulse[-1 - n, e] += factors.x[k, e]


@njit(**BARE)
def respond_through(graph, factors, reply, row, a, b, own):
    """Write the effect of a unit impulse along a row on the velocities `reply` [N + 1, 6] through the joints that hold
    its bodies; `own` is whether each of the two is held. All other entries of `reply` must be 0."""
    for s in range(2):
        n = a if s == 0 else b
        if not own[s]:
            continue
        c = graph.of_comp[n]
        if s == 1 and own[0] and graph.of_comp[a] == c:
            continue
        factors.x[graph.comp[c] : graph.comp[c + 1]] = 0.0
        for t in range(2):
            m = a if t == 0 else b
            if own[t] and graph.of_comp[m] == c:
                k, sign = graph.of_body[m], 1.0 - 2.0 * t
                for x in range(3):
                    factors.x[k, x] += sign * row[LINEAR + x]
                    factors.x[k, 3 + x] += row[(ANGULAR if t == 0 else OTHER) + x]
        substitute(graph, factors, c)
        for i in range(graph.comp[c], graph.comp[c + 1]):
            if graph.node[i] >= 0:
                for x in range(6):
                    reply[graph.node[i], x] = factors.x[i, x]


@njit(**BARE)
def forget_through(graph, reply, a, b, own):
    """Set to 0 what `respond_through` has written."""
    for s in range(2):
        if own[s]:
            c = graph.of_comp[a if s == 0 else b]
            for i in range(graph.comp[c], graph.comp[c + 1]):
                if graph.node[i] >= 0:
                    reply[graph.node[i]] = 0.0


@njit(**BARE)
def asleep(island, graph, c):
    """Whether the bodies of component c sleep; components without a body do nothing."""
    for k in range(graph.comp[c], graph.comp[c + 1]):
        if graph.node[k] >= 0:
            return island[graph.node[k]] >= 0
    return True
