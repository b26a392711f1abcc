"""The triangles of shapes, compiled: distances of the true surface, where a grid would round its edges off.

Boxes of triangles form a complete binary tree, numbered like a heap from 1, so that a search needs no stack. Searches
are for points whose distance is roughly known from a grid: they look at what is within it only. The sign is that of
the pseudonormal of the nearest feature (Baerentzen and Aanaes 2005), a face, an edge or a corner.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from sdfsim.physics.solver.tolerances import ON_FEATURE
from sdfsim.physics.solver.vectors import BARE, ENTRY, add, along, dot, get, norm, put, scale, sub

FEATURES = 7  # of a triangle: its face, its three edges, its three corners


class Triangles(NamedTuple):
    """The closed surfaces of S shapes, those of each in the order of its tree."""

    level: np.ndarray  # [S] int64, levels of a tree below its root; -1 for a shape without triangles
    # first, box: [S + 1] int64, the first triangle and the first box of each shape
    first: np.ndarray
    root: np.ndarray
    size: np.ndarray  # [S] largest extent
    box: np.ndarray  # [B, 6] lower and upper ends
    corner: np.ndarray  # [T, 3, 3]
    normal: np.ndarray  # [T, FEATURES, 3] pseudonormals, not of unit length


@njit(**BARE)
def closest(triangles, s, p, most):
    """The point of the surface of shape s that is closest to p, if it is nearer than `most`.

    Returns:
        The distance, inf if there is none; the point; and the pseudonormal of the feature on which it is.
    """
    level, first, root = triangles.level[s], triangles.first[s], triangles.root[s] - 1
    count, leaves = triangles.first[s + 1] - first, 1 << level
    least, found, feature, place = most * most, -1, 0, p
    # One bit for each level above the present box: whether its sibling must still be looked at.
    i, waiting, down = 1, 0, _off(triangles, root + 1, p) < least
    while True:
        while down and i < leaves:
            one, other = _off(triangles, root + 2 * i, p), _off(triangles, root + 2 * i + 1, p)
            nearer = 0 if one <= other else 1
            down = min(one, other) < least
            if down:
                i, waiting = 2 * i + nearer, 2 * waiting + (1 if max(one, other) < least else 0)
        if down:
            leaf = i - leaves
            for t in range(first + (count * leaf >> level), first + (count * (leaf + 1) >> level)):
                q, which = _on_triangle(triangles.corner[t], p)
                away = sub(p, q)
                square = dot(away, away)
                if square < least:
                    least, found, feature, place = square, t, which, q
        down = False
        while i > 1 and not down:
            if waiting & 1 == 1 and _off(triangles, root + (i ^ 1), p) < least:
                i, waiting, down = i ^ 1, waiting - 1, True
            else:
                i, waiting = i >> 1, waiting >> 1
        if not down:
            break
    if found < 0:
        return math.inf, place, (0.0, 0.0, 1.0)
    return math.sqrt(least), place, get(triangles.normal[found], feature)


@njit(**BARE)
def signed(triangles, s, p, most):
    """The signed distance, the unit gradient (on the surface a normal), and the closest point, nearer than `most`; inf
    if it is farther."""
    away, q, m = closest(triangles, s, p, most)
    offset = sub(p, q)
    length = norm(m)
    unit = scale(m, 1.0 / length) if length > 0.0 else (0.0, 0.0, 1.0)
    if away == math.inf:
        return away, unit, q
    side = -1.0 if dot(offset, m) < 0.0 else 1.0
    if away > ON_FEATURE * triangles.size[s]:
        unit = scale(offset, side / away)
    return side * away, unit, q


@njit(**ENTRY)
def signed_distances(triangles, s, points, most):
    """Signed distances [P] and unit gradients [P, 3] at points [P, 3] of shape s."""
    d, n = np.empty(len(points)), np.empty((len(points), 3))
    for i in range(len(points)):
        d[i], normal, _ = signed(triangles, s, get(points, i), most)
        put(n, i, normal)
    return d, n


@njit(**BARE)
def highest(triangles, s, p, up, radius):
    """How far the surface of shape s extends along `up` within a distance of p: an upper bound, at most that of the
    ball."""
    level, first, root = triangles.level[s], triangles.first[s], triangles.root[s]
    count, leaves = triangles.first[s + 1] - first, 1 << level
    top, ball = -math.inf, dot(up, p) + radius
    i = 1
    while True:
        if _off(triangles, root + i - 1, p) < radius * radius:
            if i < leaves:
                i *= 2
                continue
            leaf = i - leaves
            for t in range(first + (count * leaf >> level), first + (count * (leaf + 1) >> level)):
                q, _ = _on_triangle(triangles.corner[t], p)
                if norm(sub(p, q)) < radius:
                    for k in range(3):
                        top = max(top, min(dot(up, get(triangles.corner[t], k)), ball))
        i += 1
        while i & 1 == 0:
            i >>= 1
        if i == 1:
            return top


@njit(**BARE)
def lowest_corner(triangles, s, p, up, radius, slope):
    """The corner of shape s that is lowest along `up`, of those within a distance of p that lie no steeper below it
    than a slope; p if none is lower."""
    if triangles.level[s] < 0:
        return p
    level, first, root = triangles.level[s], triangles.first[s], triangles.root[s]
    count, leaves = triangles.first[s + 1] - first, 1 << level
    low, place, i = dot(up, p), p, 1
    while True:
        b, least = root + i - 1, 0.0
        for x in range(3):
            least += up[x] * triangles.box[b, x if up[x] > 0.0 else 3 + x]
        if least < low and _off(triangles, b, p) < radius * radius:
            if i < leaves:
                i *= 2
                continue
            leaf = i - leaves
            for t in range(first + (count * leaf >> level), first + (count * (leaf + 1) >> level)):
                for k in range(3):
                    corner = get(triangles.corner[t], k)
                    away = norm(sub(corner, p))
                    if dot(up, corner) < low and away < radius and dot(up, sub(p, corner)) <= slope * away:
                        low, place = dot(up, corner), corner
        i += 1
        while i & 1 == 0:
            i >>= 1
        if i == 1:
            return place


@njit(**BARE)
def _off(triangles, b, p):
    """The squared distance of p from a box."""
    total = 0.0
    for x in range(3):
        out = max(triangles.box[b, x] - p[x], p[x] - triangles.box[b, 3 + x], 0.0)
        total += out * out
    return total


@njit(**BARE)
def _on_triangle(corner, p):
    """The point of a triangle closest to p, and its feature (Ericson, Real-Time Collision Detection, 5.1.5)."""
    a, b, c = get(corner, 0), get(corner, 1), get(corner, 2)
    ab, ac, ap = sub(b, a), sub(c, a), sub(p, a)
    d1, d2 = dot(ab, ap), dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return a, 4
    bp = sub(p, b)
    d3, d4 = dot(ab, bp), dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return b, 5
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return along(a, ab, d1 / (d1 - d3)), 1
    cp = sub(p, c)
    d5, d6 = dot(ab, cp), dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return c, 6
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return along(a, ac, d2 / (d2 - d6)), 3
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        return along(b, sub(c, b), (d4 - d3) / ((d4 - d3) + (d5 - d6))), 2
    total = va + vb + vc
    return add(a, add(scale(ab, vb / total), scale(ac, vc / total))), 0
