"""Where two convex solids touch, compiled: the faces that face each other, clipped against each other."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable

from sdfsim.physics.solver.convex import (
    BLOCK,
    CONE,
    HULL,
    KIND,
    POINT,
    SEGMENT,
    SIZE,
    THICKNESS,
    outermost,
    rounding,
)
from sdfsim.physics.solver.tolerances import (
    BETWEEN_CORNERS,
    BETWEEN_GAPS,
    BULGE,
    EDGES_ASIDE,
    EDGES_LEVEL,
    EQUALLY_DEEP,
    IN_FACE,
    LEVEL_END,
    NO_AREA,
    ONE_POINT,
    SAME_LENGTH,
    STEEP,
)
from sdfsim.physics.solver.vectors import BARE, INLINED, add, along, cross, dot, get, put, scale, sub, turn, turn_back

RIM = 24  # points on the circle of the end of a drum or cone that bound its contact
MOST = 160  # largest number of corners of a clipped face
CHOSEN = 4  # largest number of them that carry the contact


class Polygons(NamedTuple):
    """Buffers for the faces of one pair, [MOST, 3]: two coordinates across the normal and the height along it."""

    first: np.ndarray
    second: np.ndarray
    clipped: np.ndarray
    spare: np.ndarray
    gap: np.ndarray  # [MOST] of the clipped corners
    picked: np.ndarray  # [CHOSEN] int64


@register_jitable
def polygons_room():
    return Polygons(
        np.zeros((MOST, 3)), np.zeros((MOST, 3)), np.zeros((MOST, 3)), np.zeros((MOST, 3)), np.zeros(MOST),
        np.zeros(CHOSEN, np.int64),
    )  # fmt: skip


@njit(**BARE)
def feature(convex, p, size, matrix, body, d, out):
    """Write the corners of the face, edge or corner of a piece's core that faces along d to `out` [MOST, 3] (world
    axes, from the body's origin). Returns their number, and the outward normal of a face."""
    kind, local = convex.table[p, KIND], turn_back(matrix, body, d)
    a, b, c = convex.table[p, SIZE], convex.table[p, SIZE + 1], convex.table[p, SIZE + 2]
    if kind == HULL:
        top = outermost(convex, p, local)
        best, most = convex.face_start[p], -math.inf
        for e in range(convex.around_start[top], convex.around_start[top + 1]):
            f = convex.around[e]
            facing = dot(get(convex.face, f), local)
            if facing > most:
                best, most = f, facing
        first, count = convex.loop_start[best], convex.loop_start[best + 1] - convex.loop_start[best]
        for i in range(count):
            put(out, i, turn(matrix, body, scale(get(convex.vertex, convex.loop[first + i]), size)))
        return count, turn(matrix, body, get(convex.face, best))
    if kind == BLOCK:
        x, y, z = abs(local[0]), abs(local[1]), abs(local[2])
        axis = 0 if x >= y and x >= z else (1 if y >= z else 2)
        for i in range(4):
            one = 1.0 if i == 0 or i == 3 else -1.0
            two = 1.0 if i < 2 else -1.0
            if axis == 0:
                corner = (math.copysign(a, local[0]), one * b, two * c)
            elif axis == 1:
                corner = (one * a, math.copysign(b, local[1]), two * c)
            else:
                corner = (one * a, two * b, math.copysign(c, local[2]))
            put(out, i, turn(matrix, body, scale(corner, size)))
        normal = (
            math.copysign(1.0, local[0]) if axis == 0 else 0.0,
            math.copysign(1.0, local[1]) if axis == 1 else 0.0,
            math.copysign(1.0, local[2]) if axis == 2 else 0.0,
        )
        return 4, turn(matrix, body, normal)
    if kind == POINT:
        put(out, 0, (0.0, 0.0, 0.0))
        return 1, d
    across = math.sqrt(local[0] * local[0] + local[1] * local[1])
    if kind == SEGMENT:
        if abs(local[2]) > across:
            put(out, 0, turn(matrix, body, (0.0, 0.0, size * math.copysign(b, local[2]))))
            return 1, d
        put(out, 0, turn(matrix, body, (0.0, 0.0, -size * b)))
        put(out, 1, turn(matrix, body, (0.0, 0.0, size * b)))
        return 2, d
    x, y = (1.0, 0.0) if across == 0.0 else (local[0] / across, local[1] / across)
    top = 0.0 if kind == CONE else a
    aside = abs(local[2]) <= across
    if kind == CONE:  # whether its side faces along d, rather than its disc
        aside = 2.0 * b * across + a * local[2] >= -local[2] * math.sqrt(a * a + 4.0 * b * b)
    if aside:
        put(out, 0, turn(matrix, body, (size * a * x, size * a * y, -size * b)))
        put(out, 1, turn(matrix, body, (size * top * x, size * top * y, size * b)))
        return 2, d
    if across < LEVEL_END:
        x, y = 1.0, 0.0
    end = math.copysign(1.0, local[2])
    for i in range(RIM):
        angle = 2.0 * math.pi * i / RIM
        u, v = math.cos(angle), math.sin(angle)
        put(out, i, turn(matrix, body, (size * a * (u * x - v * y), size * a * (u * y + v * x), size * b * end)))
    return RIM, turn(matrix, body, (0.0, 0.0, end))


@njit(**BARE)
def across(n):
    """Two unit vectors across n, the same for -n: the order of the two bodies must not matter."""
    if n[0] < 0.0 or (n[0] == 0.0 and (n[1] < 0.0 or (n[1] == 0.0 and n[2] < 0.0))):
        n = scale(n, -1.0)
    axis = (1.0, 0.0, 0.0) if abs(n[0]) < 0.6 else (0.0, 1.0, 0.0)
    u = cross(axis, n)
    u = scale(u, 1.0 / math.sqrt(dot(u, u)))
    return u, cross(n, u)


@njit(**INLINED)
def touching_points(convex, matrix, pair, plane, held, gap, n, own, his, reach, room):
    """Find the points at which two pieces touch or may soon touch, and pick up to CHOSEN that bound the contact. Writes
    room.clipped (points on the first piece, world axes from the second's origin) and room.gap.

    Args:
        plane: whether the second body is the half space below its origin, with normal n.
        held: whether n is given and not that of least distance, so that there may be no point.
        gap, n, own, his: what `closest` found; for a plane, or if n is held, only the gap counts.

    Returns:
        The number of picked points, and the factor by which friction acts nearer to their middle than the points are: a
            face that presses evenly resists turning with the mean distance from its middle as lever arm.
    """
    u, w = across(n)
    mine = pair.size * rounding(convex, pair.first)
    theirs, thick = 0.0, pair.size * convex.table[pair.first, THICKNESS]
    if not plane:
        theirs = pair.other * rounding(convex, pair.second)
        thick = min(thick, pair.other * convex.table[pair.second, THICKNESS])
    first, m = feature(convex, pair.first, pair.size, matrix, pair.a, scale(n, -1.0), room.first)
    _project(room.first, first, pair.offset, n, u, w)
    if first > 2 and abs(dot(m, n)) < STEEP:
        first = 1
    count = 0
    if plane:
        count = first
        for i in range(first):
            put(room.clipped, i, get(room.first, i))
            room.gap[i] = room.first[i, 2] - mine
    else:
        second, k = feature(convex, pair.second, pair.other, matrix, pair.b, n, room.second)
        _project(room.second, second, (0.0, 0.0, 0.0), n, u, w)
        if second > 2 and abs(dot(k, n)) < STEEP:
            second = 1
        if first > 2 and second > 2:
            if first == RIM and convex.table[pair.first, KIND] != HULL:
                _sharpen(room.first, room.second, second)
            if second == RIM and convex.table[pair.second, KIND] != HULL:
                _sharpen(room.second, room.first, first)
        if first > 1 and second > 2:
            count = _clip(room, room.first, first, room.second, second)
            for i in range(count):
                x, y, h = get(room.clipped, i)
                room.gap[i] = h - mine - theirs - _height(room.second, k, n, u, w, x, y)
        elif first > 2 and second == 2:
            count = _clip(room, room.second, second, room.first, first)
            for i in range(count):
                x, y, h = get(room.clipped, i)
                room.clipped[i, 2] = _height(room.first, m, n, u, w, x, y)
                room.gap[i] = room.clipped[i, 2] - mine - theirs - h
        elif first == 2 and second == 2:
            count = _common(room, mine + theirs, EDGES_ASIDE * thick)
    least, kept = math.inf, 0
    for i in range(count):
        if room.gap[i] <= reach:
            put(room.clipped, kept, get(room.clipped, i))
            room.gap[kept] = room.gap[i]
            least = min(least, room.gap[i])
            kept += 1
    count = kept
    extent = _extent(room, count)
    if not plane and not held and least > gap + BETWEEN_CORNERS * extent + BETWEEN_GAPS * abs(gap):
        # Corners or edges meet between the corners of the clipped polygon.
        at = along(own, n, mine)
        put(room.clipped, count, (dot(at, u), dot(at, w), dot(at, n)))
        room.gap[count] = least = gap
        count += 1
        extent = _extent(room, count)
    arm = _arm(room, count, least, extent)
    picked = _pick(room, count, extent, least + EQUALLY_DEEP * thick)
    if picked > 1 and arm > 0.0:
        arm = _shrink(room, picked, arm)
    for i in range(count):
        x, y, h = get(room.clipped, i)
        put(room.clipped, i, along(along(scale(n, h - mine), u, x), w, y))
    return picked, (arm if arm > 0.0 else 1.0)


@njit(**BARE)
def _project(points, count, offset, n, u, w):
    for i in range(count):
        p = add(get(points, i), offset)
        put(points, i, (dot(p, u), dot(p, w), dot(p, n)))


@njit(**BARE)
def _sharpen(rim, face, count):
    """Move the points on the circle of a drum's end closer together beside a face that is small and crosses it."""
    x = y = cx = cy = far = 0.0
    for i in range(count):
        x, y = x + face[i, 0] / count, y + face[i, 1] / count
    for i in range(count):
        far = max(far, (face[i, 0] - x) ** 2 + (face[i, 1] - y) ** 2)
    for i in range(RIM):
        cx, cy = cx + rim[i, 0] / RIM, cy + rim[i, 1] / RIM
    middle = scale(add(get(rim, 0), get(rim, RIM // 2)), 0.5)
    one, two = sub(get(rim, 0), middle), sub(get(rim, RIM // 4), middle)
    x, y, far = x - cx, y - cy, math.sqrt(far)
    radius, off = math.sqrt(dot(one, one)), math.sqrt(x * x + y * y)
    step = math.sqrt(BULGE * far / radius)
    if step >= 2.0 * math.pi / RIM or off + far < (1.0 - BULGE) * radius:
        return
    area = one[0] * two[1] - one[1] * two[0]
    towards = math.atan2((one[0] * y - one[1] * x) / area, (x * two[1] - y * two[0]) / area)
    for i in range(RIM):
        k = i - RIM // 2
        angle = k * step
        if abs(k) > RIM // 4:  # the rest of the circle
            start = RIM // 4 * step
            angle = math.copysign(start + (math.pi - start) * (abs(k) - RIM // 4) / (RIM // 4), k)
        put(rim, i, along(along(middle, one, math.cos(towards + angle)), two, math.sin(towards + angle)))


@njit(**BARE)
def _height(points, normal, n, u, w, x, y):
    """Height of the plane of a face at (x, y)."""
    slope = dot(normal, n)
    return points[0, 2] - ((x - points[0, 0]) * dot(normal, u) + (y - points[0, 1]) * dot(normal, w)) / slope


@njit(**BARE)
def _clip(room, subject, count, bounds, sides):
    """Write the part of a face or edge that lies over another face to room.clipped (Sutherland and Hodgman 1974)."""
    area = 0.0
    for i in range(sides):
        j = (i + 1) % sides
        area += bounds[i, 0] * bounds[j, 1] - bounds[j, 0] * bounds[i, 1]
    sign = 1.0 if area >= 0.0 else -1.0
    for i in range(count):
        put(room.clipped, i, get(subject, i))
    open_line = count == 2
    for i in range(sides):
        j = (i + 1) % sides
        px, py = bounds[i, 0], bounds[i, 1]
        dx, dy = sign * (bounds[j, 0] - px), sign * (bounds[j, 1] - py)
        kept = 0
        for k in range(count):
            if open_line and k == count - 1 and count > 1:
                # An edge is not closed: no side leads from its end back to its start.
                d = dx * (room.clipped[k, 1] - py) - dy * (room.clipped[k, 0] - px)
                if d >= 0.0 and kept < MOST:
                    put(room.spare, kept, get(room.clipped, k))
                    kept += 1
                continue
            following = (k + 1) % count
            d = dx * (room.clipped[k, 1] - py) - dy * (room.clipped[k, 0] - px)
            e = dx * (room.clipped[following, 1] - py) - dy * (room.clipped[following, 0] - px)
            if d >= 0.0 and kept < MOST:
                put(room.spare, kept, get(room.clipped, k))
                kept += 1
            if (d > 0.0 and e < 0.0) or (d < 0.0 and e > 0.0):
                share = d / (d - e)
                if kept < MOST:
                    for x in range(3):
                        start = room.clipped[k, x]
                        room.spare[kept, x] = start + share * (room.clipped[following, x] - start)
                    kept += 1
        count = kept
        for k in range(count):
            put(room.clipped, k, get(room.spare, k))
        if count == 0:
            return 0
    return count


@njit(**BARE)
def _common(room, round_off, aside):
    """The two ends of the common part of two edges, if they are no farther than `aside` from each other across the
    normal; none if they only cross."""
    first, second = room.first, room.second
    dx, dy = first[1, 0] - first[0, 0], first[1, 1] - first[0, 1]
    ex, ey = second[1, 0] - second[0, 0], second[1, 1] - second[0, 1]
    long, other = math.sqrt(dx * dx + dy * dy), math.sqrt(ex * ex + ey * ey)
    if long == 0.0 or other == 0.0:
        return 0
    # Parameter along the first edge, from 0 to 1.
    start = ((second[0, 0] - first[0, 0]) * dx + (second[0, 1] - first[0, 1]) * dy) / (long * long)
    end = ((second[1, 0] - first[0, 0]) * dx + (second[1, 1] - first[0, 1]) * dy) / (long * long)
    if start == end:
        return 0
    low, high = max(0.0, min(start, end)), min(1.0, max(start, end))
    # The distance aside of the second edge changes linearly along the first.
    px, py = second[0, 0] - first[0, 0], second[0, 1] - first[0, 1]
    off = (dx * py - dy * px) / long
    slope = (dx * ey - dy * ex) / long / (end - start)
    if abs(slope) * (high - low) > EDGES_LEVEL * long:
        one, two = start + (-aside - off) / slope, start + (aside - off) / slope
        low, high = max(low, min(one, two)), min(high, max(one, two))
    elif abs(off) > aside:
        return 0
    # Across the second edge its surface is level, so heights above it are taken at the first edge's points.
    foot, share = -(px * ex + py * ey) / (other * other), (dx * ex + dy * ey) / (other * other)
    if share != 0.0:
        one, two = -foot / share, (1.0 - foot) / share
        low, high = max(low, min(one, two)), min(high, max(one, two))
    if low >= high:
        return 0
    for i in range(2):
        t = low if i == 0 else high
        s = foot + t * share
        for x in range(3):
            room.clipped[i, x] = first[0, x] + t * (first[1, x] - first[0, x])
        room.gap[i] = room.clipped[i, 2] - round_off - (second[0, 2] + s * (second[1, 2] - second[0, 2]))
    return 2


@njit(**BARE)
def _extent(room, count):
    low_x = low_y = math.inf
    high_x = high_y = -math.inf
    for i in range(count):
        low_x, high_x = min(low_x, room.clipped[i, 0]), max(high_x, room.clipped[i, 0])
        low_y, high_y = min(low_y, room.clipped[i, 1]), max(high_y, room.clipped[i, 1])
    return max(high_x - low_x, high_y - low_y) if count else 0.0


@njit(**BARE)
def _pick(room, count, extent, deep):
    """Pick the deepest point, the farthest from it, and the farthest to either side of their line; ties are broken by
    position."""
    if count == 0:
        return 0
    best, outer = 0, -math.inf
    for i in range(count):
        place = 0.8 * room.clipped[i, 0] + 0.6 * room.clipped[i, 1]
        if room.gap[i] <= deep and place > outer:
            best, outer = i, place
    room.picked[0] = best
    ax, ay = room.clipped[best, 0], room.clipped[best, 1]
    far, most = -1, (ONE_POINT * extent) ** 2
    for i in range(count):
        away = (room.clipped[i, 0] - ax) ** 2 + (room.clipped[i, 1] - ay) ** 2
        if away > most * (1.0 + SAME_LENGTH):
            far, most = i, away
    if far < 0:
        return 1
    room.picked[1] = far
    dx, dy = room.clipped[far, 0] - ax, room.clipped[far, 1] - ay
    long = math.sqrt(dx * dx + dy * dy)
    left = right = -1
    over = under = ONE_POINT * extent
    for i in range(count):
        side = (dx * (room.clipped[i, 1] - ay) - dy * (room.clipped[i, 0] - ax)) / long
        if side > over * (1.0 + SAME_LENGTH):
            left, over = i, side
        if -side > under * (1.0 + SAME_LENGTH):
            right, under = i, -side
    kept = 2
    for i in (left, right):
        if i >= 0:
            room.picked[kept] = i
            kept += 1
    return kept


@njit(**BARE)
def _arm(room, count, least, extent):
    """The mean distance of the points of a face or an edge from its middle; 0 for a single point."""
    within = least + IN_FACE * extent
    kept = 0
    for i in range(count):
        if room.gap[i] <= within:
            room.spare[kept, 0], room.spare[kept, 1] = room.clipped[i, 0], room.clipped[i, 1]
            kept += 1
    if kept < 2:
        return 0.0
    mx = my = area = 0.0
    for i in range(kept):
        j = (i + 1) % kept
        x, y = room.spare[i, 0] - room.spare[0, 0], room.spare[i, 1] - room.spare[0, 1]
        p, q = room.spare[j, 0] - room.spare[0, 0], room.spare[j, 1] - room.spare[0, 1]
        part = x * q - y * p
        area += part
        mx += part * (x + p) / 3.0
        my += part * (y + q) / 3.0
    if abs(area) < NO_AREA * extent * extent:
        long = 0.0
        for i in range(1, kept):
            gone = (room.spare[i, 0] - room.spare[0, 0]) ** 2 + (room.spare[i, 1] - room.spare[0, 1]) ** 2
            long = max(long, gone)
        return 0.25 * math.sqrt(long)
    mx, my = room.spare[0, 0] + mx / area, room.spare[0, 1] + my / area
    total = 0.0
    for i in range(kept):
        j = (i + 1) % kept
        x, y = room.spare[i, 0] - mx, room.spare[i, 1] - my
        p, q = room.spare[j, 0] - mx, room.spare[j, 1] - my
        long = math.sqrt((p - x) ** 2 + (q - y) ** 2)
        if long > 0.0:
            high = abs(x * q - y * p) / long
            one, two = (x * (p - x) + y * (q - y)) / long, (p * (p - x) + q * (q - y)) / long
            if high > 0.0:
                total += high / 6.0 * (_root_sum(two, high) - _root_sum(one, high))
    return total / (0.5 * abs(area))


@njit(**BARE)
def _root_sum(s, h):
    """Twice the integral of sqrt(h^2 + s^2)."""
    return s * math.sqrt(h * h + s * s) + h * h * math.asinh(s / h)


@njit(**BARE)
def _shrink(room, picked, arm):
    """The factor by which to move the picked points towards their middle, so that their mean distance from it is
    `arm`."""
    x = y = 0.0
    for i in range(picked):
        x, y = x + room.clipped[room.picked[i], 0], y + room.clipped[room.picked[i], 1]
    x, y, total = x / picked, y / picked, 0.0
    for i in range(picked):
        total += math.sqrt((room.clipped[room.picked[i], 0] - x) ** 2 + (room.clipped[room.picked[i], 1] - y) ** 2)
    return 1.0 if total == 0.0 else min(1.0, arm * picked / total)
