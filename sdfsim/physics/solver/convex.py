"""Convex solids, compiled: their support points, and the distance and normal between two of them.

Closest points by GJK (Gilbert, Johnson and Keerthi 1988). Overlapping solids are moved apart along the known normal,
and their closest points then give the next normal. Each round is a complete answer for its normal. Rounds end at the
nearest local minimum of the overlap, so a contact keeps the side that it came from.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable

from sdfsim.physics.solver.tolerances import (
    ALONG_FACE,
    AS_DEEP,
    FEW_VERTICES,
    GJK_EXACT,
    GJK_ROUNDS,
    NORMAL_ROUNDS,
    PUT_APART,
    TOO_NEAR,
)
from sdfsim.physics.solver.vectors import (
    BARE,
    INLINED,
    add,
    along,
    cross,
    dot,
    get,
    norm,
    put,
    scale,
    sub,
    turn,
    turn_back,
)

POINT, SEGMENT, BLOCK, DRUM, HULL, CONE = range(6)
# Columns of the table of convex pieces: kind; sizes (point: radius; segment: radius, half length; block: half extents;
# drum and cone: radius, half height); a ball around the piece; its thickness, the least distance of two parallel planes
# around it.
KIND, SIZE, BALL, THICKNESS, WIDTH = 0, 1, 4, 8, 9


class Convex(NamedTuple):
    """The convex pieces of S shapes; arrays end to end."""

    start: np.ndarray  # [S + 1] int64, shape s has pieces start[s] : start[s + 1]; none if it is not convex
    table: np.ndarray  # [P, WIDTH] float64
    vertex_start: np.ndarray  # [P + 1] int64
    vertex: np.ndarray  # [V, 3] float64, of hulls, in the shape's frame
    face_start: np.ndarray  # [P + 1] int64
    face: np.ndarray  # [F, 3] float64, outward unit normals
    loop_start: np.ndarray  # [F + 1] int64
    loop: np.ndarray  # [L] int64, the vertices around each face
    beside_start: np.ndarray  # [V + 1] int64
    beside: np.ndarray  # int64, the vertices at the other ends of a vertex's edges
    around_start: np.ndarray  # [V + 1] int64
    around: np.ndarray  # int64, the faces that meet at a vertex


class Simplex(NamedTuple):
    """Buffers for GJK: up to four corners of the difference of two solids, and the point of the first solid for
    each."""

    corner: np.ndarray  # [4, 3] point of the first minus point of the second
    own: np.ndarray  # [4, 3] point of the first
    weight: np.ndarray  # [4]
    trial: np.ndarray  # [4]


@register_jitable
def simplex_room():
    return Simplex(np.zeros((4, 3)), np.zeros((4, 3)), np.zeros(4), np.zeros(4))


@njit(**BARE)
def rounding(convex, p):
    """By how much a piece extends beyond its core on all sides."""
    return convex.table[p, SIZE] if convex.table[p, KIND] <= SEGMENT else 0.0


@njit(**INLINED)
def outermost(convex, p, d):
    """The vertex of a hull that is farthest along d: from the best of a few, climb to neighbours that are farther."""
    first, last = convex.vertex_start[p], convex.vertex_start[p + 1]
    best, most = first, -math.inf
    for v in range(first, last, 1 + (last - first - 1) // FEW_VERTICES):
        reach = convex.vertex[v, 0] * d[0] + convex.vertex[v, 1] * d[1] + convex.vertex[v, 2] * d[2]
        if reach > most:
            best, most = v, reach
    while last - first > FEW_VERTICES:
        start = best
        for e in range(convex.beside_start[start], convex.beside_start[start + 1]):
            v = convex.beside[e]
            reach = convex.vertex[v, 0] * d[0] + convex.vertex[v, 1] * d[1] + convex.vertex[v, 2] * d[2]
            if reach > most:
                best, most = v, reach
        if best == start:
            break
    return best


@njit(**INLINED)
def core(convex, p, d):
    """The point of the core of piece p, in its own frame, that is farthest along d."""
    kind = convex.table[p, KIND]
    if kind == HULL:
        return get(convex.vertex, outermost(convex, p, d))
    if kind == POINT:
        return 0.0, 0.0, 0.0
    a, b, c = convex.table[p, SIZE], convex.table[p, SIZE + 1], convex.table[p, SIZE + 2]
    if kind == SEGMENT:
        return 0.0, 0.0, math.copysign(b, d[2])
    if kind == BLOCK:
        return math.copysign(a, d[0]), math.copysign(b, d[1]), math.copysign(c, d[2])
    r = math.sqrt(d[0] * d[0] + d[1] * d[1])
    if kind == CONE and 2.0 * b * d[2] >= a * r:
        return 0.0, 0.0, b
    end = -b if kind == CONE else math.copysign(b, d[2])
    return (0.0, 0.0, end) if r < 1e-300 else (a * d[0] / r, a * d[1] / r, end)


@njit(**INLINED)
def farthest(convex, p, size, matrix, body, d):
    """The point of the core of a body's piece that is farthest along d; world axes, from the body's origin."""
    return turn(matrix, body, scale(core(convex, p, turn_back(matrix, body, d)), size))


class Pair(NamedTuple):
    """Two pieces in their present poses."""

    first: int  # the pieces
    second: int
    a: int | np.int64  # the bodies
    b: int | np.int64
    size: float  # the scales of the bodies
    other: float
    offset: tuple  # from the origin of the second body's shape to the first's, world axes


@njit(**BARE)
def separation(convex, matrix, pair, n):
    """Distance of two cores along the unit vector n, from the second to the first; below 0 if they overlap."""
    mine = farthest(convex, pair.first, pair.size, matrix, pair.a, scale(n, -1.0))
    theirs = farthest(convex, pair.second, pair.other, matrix, pair.b, n)
    return dot(n, sub(add(pair.offset, mine), theirs))


@njit(**BARE)
def closest(convex, matrix, pair, n, known, enough, room):
    """Distance of two solids, the unit normal from the second to the first, and the closest point of each (on its
    surface, from the second's origin). For overlapping solids this is the least depth near the normal n.

    Args:
        known: whether they last touched along n, or nearly. If not, n is ignored, and if they overlap the least depth
            is searched from several normals.
        enough: if they are farther apart than this, the distance may be too small, and no closest points are given.
    """
    thick = min(pair.size * convex.table[pair.first, THICKNESS], pair.other * convex.table[pair.second, THICKNESS])
    if known:
        return _least_deep(convex, matrix, pair, n, thick, enough, room)
    between = _middle_to_middle(convex, matrix, pair)
    v, there = _gjk(convex, matrix, pair, pair.offset, between, room)
    length = norm(v)
    if length > TOO_NEAR * thick:
        mine, theirs = pair.size * rounding(convex, pair.first), pair.other * rounding(convex, pair.second)
        n, length = _squared(convex, matrix, pair, scale(v, 1.0 / length), length, thick)
        return length - mine - theirs, n, along(there, n, -mine), along(sub(there, v), n, theirs)
    best = _least_deep(convex, matrix, pair, _along_face(convex, matrix, pair, between), thick, enough, room)
    for way in range(7):
        axis, sign = way // 2, 1.0 if way % 2 == 0 else -1.0
        start = (sign if axis == 0 else 0.0, sign if axis == 1 else 0.0, sign if axis == 2 else 0.0)
        if way == 6:
            if length == 0.0:
                continue
            start = scale(v, 1.0 / length)
        found = _least_deep(convex, matrix, pair, start, thick, enough, room)
        if found[0] > best[0] + AS_DEEP * thick:  # of two equally good normals take the one found in fewer rounds
            best = found
    return best


@njit(**BARE)
def _least_deep(convex, matrix, pair, n, thick, enough, room):
    """`closest`, starting from a normal."""
    mine, theirs = pair.size * rounding(convex, pair.first), pair.other * rounding(convex, pair.second)
    own, his = pair.offset, (0.0, 0.0, 0.0)
    s = separation(convex, matrix, pair, n)
    if s - mine - theirs > enough:
        return s - mine - theirs, n, own, his
    for _ in range(NORMAL_ROUNDS):
        shift = 0.0 if s > TOO_NEAR * thick else PUT_APART * thick - s
        v, there = _gjk(convex, matrix, pair, along(pair.offset, n, shift), n, room)
        length = norm(v)
        if length == 0.0:
            break
        m, was = scale(v, 1.0 / length), s
        own, his = along(there, n, -shift), sub(there, v)
        if shift == 0.0:
            n, s = m, length
            break
        found = separation(convex, matrix, pair, m)
        if found > s:
            n, s = m, found
        if found <= was + AS_DEEP * thick:
            break
    n, s = _squared(convex, matrix, pair, n, s, thick)
    return s - mine - theirs, n, along(own, n, -mine), along(his, n, theirs)


@njit(**BARE)
def _squared(convex, matrix, pair, n, s, thick):
    """A normal and the distance s of two cores along it; a normal that differs from that of a face only by rounding is
    replaced by the face's."""
    for side in range(2):
        p, body = (pair.first, pair.a) if side == 0 else (pair.second, pair.b)
        kind = convex.table[p, KIND]
        x, y, z = turn_back(matrix, body, n)
        if kind == HULL:
            out = (-x, -y, -z) if side == 0 else (x, y, z)
            top = outermost(convex, p, out)
            for e in range(convex.around_start[top], convex.around_start[top + 1]):
                face = get(convex.face, convex.around[e])
                if dot(face, out) > ALONG_FACE:
                    m = turn(matrix, body, scale(face, -1.0 if side == 0 else 1.0))
                    found = separation(convex, matrix, pair, m)
                    if found >= s - AS_DEEP * thick:
                        return m, found
        elif kind == BLOCK or kind == DRUM or kind == CONE:
            flat = abs(z) > ALONG_FACE or (kind == BLOCK and (abs(x) > ALONG_FACE or abs(y) > ALONG_FACE))
            if flat:
                m = turn(matrix, body, (float(round(x)), float(round(y)), float(round(z))))
                found = separation(convex, matrix, pair, m)
                if found >= s - AS_DEEP * thick:
                    return m, found
    return n, s


@njit(**BARE)
def _gjk(convex, matrix, pair, offset, v, room):
    """The shortest vector from the second solid's core to the first's, which is moved by `offset`, with its proven
    length, and its end on the first; v is a guess of its direction. Zero if the cores overlap."""
    corner, own, weight = room.corner, room.own, room.weight
    count, there, least = 0, (0.0, 0.0, 0.0), math.inf
    # Along a rim corners come so close to each other that rounding finally turns v: the v with the best proven bound
    # counts.
    surely, best = -math.inf, v
    for step in range(GJK_ROUNDS):
        a = add(offset, farthest(convex, pair.first, pair.size, matrix, pair.a, scale(v, -1.0)))
        w = sub(a, farthest(convex, pair.second, pair.other, matrix, pair.b, v))
        if step > 0:
            proved = dot(v, w)
            if proved > surely * math.sqrt(least):
                surely, best = proved / math.sqrt(least), v
            if least - proved <= GJK_EXACT * least:
                break
            known = False
            for i in range(count):
                known = known or (corner[i, 0] == w[0] and corner[i, 1] == w[1] and corner[i, 2] == w[2])
            if known:
                break
        put(corner, count, w)
        put(own, count, a)
        count = _nearest_part(corner, own, weight, room.trial, count + 1)
        if count == 0:
            return (0.0, 0.0, 0.0), a
        new, on = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        for i in range(count):
            new, on = along(new, get(corner, i), weight[i]), along(on, get(own, i), weight[i])
        length = dot(new, new)
        if length >= least:  # rounding errors dominate
            break
        v, there, least = new, on, length
    return scale(best, max(surely, 0.0) / norm(best)), there


@njit(**INLINED)
def _nearest_part(corner, own, weight, trial, count):
    """Reduce a simplex to the corners between which the point nearest to the origin lies, with their weights. Returns
    their number; 0 if the origin is inside."""
    if count == 1:
        weight[0] = 1.0
        return 1
    for i in range(4):
        weight[i] = 0.0
    if count == 2:
        _on_line(corner, 0, 1, weight)
    elif count == 3:
        _on_face(corner, 0, 1, 2, weight)
    elif _inside(corner):
        return 0
    else:
        least = math.inf
        for left_out in range(4):
            i, j, k = (left_out + 1) % 4, (left_out + 2) % 4, (left_out + 3) % 4
            for x in range(4):
                trial[x] = 0.0
            _on_face(corner, i, j, k, trial)
            at = (0.0, 0.0, 0.0)
            for x in range(4):
                at = along(at, get(corner, x), trial[x])
            if dot(at, at) < least:
                least = dot(at, at)
                for x in range(4):
                    weight[x] = trial[x]
    kept = 0
    for i in range(count):
        if weight[i] > 0.0:
            weight[kept] = weight[i]
            put(corner, kept, get(corner, i))
            put(own, kept, get(own, i))
            kept += 1
    return kept


@njit(**BARE)
def _inside(corner):
    """Whether the origin is inside a tetrahedron; a flat one has no inside."""
    a, b, c, d = get(corner, 0), get(corner, 1), get(corner, 2), get(corner, 3)
    volume = dot(cross(sub(b, a), sub(c, a)), sub(d, a))
    if volume == 0.0:
        return False
    sign = math.copysign(1.0, volume)
    return (
        sign * dot(cross(b, c), d) > 0.0
        and -sign * dot(cross(a, c), d) > 0.0
        and sign * dot(cross(a, b), d) > 0.0
        and -sign * dot(cross(a, b), c) > 0.0
    )


@njit(**BARE)
def _on_line(corner, i, j, weight):
    """Weights of two corners for the point between them that is nearest to the origin."""
    a, b = get(corner, i), get(corner, j)
    side = sub(b, a)
    way, square = -dot(a, side), dot(side, side)
    if way <= 0.0 or square == 0.0:
        weight[i], weight[j] = 1.0, 0.0
    elif way >= square:
        weight[i], weight[j] = 0.0, 1.0
    else:
        weight[i], weight[j] = 1.0 - way / square, way / square


@njit(**BARE)
def _on_face(corner, i, j, k, weight):
    """Weights of three corners for the point between them that is nearest to the origin."""
    a, b, c = get(corner, i), get(corner, j), get(corner, k)
    n = cross(sub(b, a), sub(c, a))
    square = dot(n, n)
    u, v, w = dot(n, cross(b, c)), dot(n, cross(c, a)), dot(n, cross(a, b))
    if square > 0.0 and u > 0.0 and v > 0.0 and w > 0.0:
        total = u + v + w
        weight[i], weight[j], weight[k] = u / total, v / total, w / total
        return
    # Beyond an edge: the nearest point is on one of the three.
    least, first, second, share = math.inf, i, j, 0.0
    for e in range(3):
        p, q = (i, j) if e == 0 else ((j, k) if e == 1 else (k, i))
        start = get(corner, p)
        side = sub(get(corner, q), start)
        way, long = -dot(start, side), dot(side, side)
        t = 0.0 if way <= 0.0 or long == 0.0 else min(way / long, 1.0)
        at = along(start, side, t)
        if dot(at, at) < least:
            least, first, second, share = dot(at, at), p, q, t
    weight[i] = weight[j] = weight[k] = 0.0
    weight[first], weight[second] = 1.0 - share, share


@njit(**BARE)
def _middle_to_middle(convex, matrix, pair):
    """The direction from the middle of the second piece to that of the first."""
    there = add(pair.offset, turn(matrix, pair.a, scale(get_ball(convex, pair.first), pair.size)))
    between = sub(there, turn(matrix, pair.b, scale(get_ball(convex, pair.second), pair.other)))
    length = norm(between)
    return (0.0, 0.0, 1.0) if length == 0.0 else scale(between, 1.0 / length)


@njit(**BARE)
def _along_face(convex, matrix, pair, n):
    """The normal along which the two overlap least, among n and the normals of the faces of both pieces."""
    best, most = n, separation(convex, matrix, pair, n)
    for side in range(2):
        p, body = (pair.first, pair.a) if side == 0 else (pair.second, pair.b)
        hull = convex.table[p, KIND] == HULL
        for e in range(_axes(convex, p)):
            axis = turn(matrix, body, _axis(convex, p, e))
            for way in range(2):
                out = way == side  # normals go from the second to the first: into the one, out of the other
                if hull and not out:
                    continue
                m = scale(axis, 1.0 if way == 1 else -1.0)
                found = separation(convex, matrix, pair, m)
                if found > most:
                    best, most = m, found
    return best


@njit(**BARE)
def get_ball(convex, p):
    """The centre of the ball around a piece, in the piece's frame."""
    return convex.table[p, BALL], convex.table[p, BALL + 1], convex.table[p, BALL + 2]


@njit(**BARE)
def _axes(convex, p):
    kind = convex.table[p, KIND]
    if kind == HULL:
        return min(convex.face_start[p + 1] - convex.face_start[p], 64)
    return 3 if kind == BLOCK or kind == DRUM or kind == CONE else 0


@njit(**BARE)
def _axis(convex, p, e):
    """The normal of a face; for a drum or cone also two directions across its axis."""
    if convex.table[p, KIND] == HULL:
        faces = convex.face_start[p + 1] - convex.face_start[p]
        return get(convex.face, convex.face_start[p] + e * max(1, faces // 64))
    return (1.0 if e == 0 else 0.0, 1.0 if e == 1 else 0.0, 1.0 if e == 2 else 0.0)
