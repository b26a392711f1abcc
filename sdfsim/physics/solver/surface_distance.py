"""Surfaces against distances, compiled: nodes of one body in the distance of another, refined along the first one's
surface."""

from __future__ import annotations

import math

from numba import njit

from sdfsim.physics.solver.clipping import across
from sdfsim.physics.solver.distance import (
    CAPSULE,
    CELL,
    ERROR,
    GRID,
    KIND,
    PLANE,
    SIZE,
    SPHERE,
    TORUS,
    distance,
    distance_alone,
    patch_of,
    true_distance,
)
from sdfsim.physics.solver.manifold import CANDIDATES, FOUND, SIDE, write
from sdfsim.physics.solver.tolerances import (
    ALIKE,
    BESIDE,
    CORE_ENDS,
    DESCENT_ROUNDS,
    FIRST_STRIDE,
    GRID_FARTHER,
    GRID_FINE,
    LAST_STRIDE,
    LEVEL_CIRCLE,
    LEVEL_FACE,
    LEVEL_SLOPE,
    LONGER,
    LOWER,
    MOVED_SINCE,
    ONTO,
    ONTO_IT,
    OUTWARD,
    PROBED,
    RESTART,
    SHARP_REACH,
    SHARP_ROUNDS,
    SHARP_SHORTER,
    SHARP_STRIDE,
    SHORTER,
    SHORTEST,
    TRACE_ROUNDS,
    TRACED_TO,
    WITHIN,
)
from sdfsim.physics.solver.triangles import closest, lowest_corner
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
    three,
    turn,
    turn_back,
    vector,
)
from sdfsim.physics.solver.world import COLUMNS, FIRST, GAP, NORMAL, NORMAL_IMPULSE, OWNER, SECOND

KEYS = 1024  # largest number of patches of a shape
WAYS = 8  # directions in which the outermost nodes of a face are searched
BEADS, FIXED = 32, 8  # points on a core at which distances are taken; and those of a whole circle that touch
GOLDEN = 0.6180339887498949


@njit(**BARE)
def map_between(position, matrix, scales, coms, a, b):
    """Rows of W and the vector c: a point p of shape a is the point W p + c of shape b (both at scale 1)."""
    ratio = scales[a] / scales[b]
    x = turn_back(matrix, b, (matrix[a, 0, 0], matrix[a, 1, 0], matrix[a, 2, 0]))
    y = turn_back(matrix, b, (matrix[a, 0, 1], matrix[a, 1, 1], matrix[a, 2, 1]))
    z = turn_back(matrix, b, (matrix[a, 0, 2], matrix[a, 1, 2], matrix[a, 2, 2]))
    w = (
        (x[0] * ratio, y[0] * ratio, z[0] * ratio),
        (x[1] * ratio, y[1] * ratio, z[1] * ratio),
        (x[2] * ratio, y[2] * ratio, z[2] * ratio),
    )
    shift = turn_back(matrix, b, sub(get(position, a), get(position, b)))
    com = get(coms, a)
    own = (
        x[0] * com[0] + y[0] * com[1] + z[0] * com[2],
        x[1] * com[0] + y[1] * com[1] + z[1] * com[2],
        x[2] * com[0] + y[2] * com[1] + z[2] * com[2],
    )
    return w, scale(sub(add(shift, get(coms, b)), own), 1.0 / scales[b])


@njit(**BARE)
def mapped(w, c, p):
    return dot(w[0], p) + c[0], dot(w[1], p) + c[1], dot(w[2], p) + c[2]


@njit(**BARE)
def is_round(table, s):
    """Whether a shape consists of all points within a radius of a line or point."""
    return table[s, KIND] == SPHERE or table[s, KIND] == CAPSULE


@njit(**BARE)
def has_core(table, s):
    """Whether a shape consists of all points within a radius of a point, a line or a circle."""
    return is_round(table, s) or table[s, KIND] == TORUS


@njit(**BARE)
def core_radius(table, s):
    return table[s, SIZE + 1] if table[s, KIND] == TORUS else table[s, SIZE]


@njit(**BARE)
def core_point(table, s, part):
    """A point of the core, from one end (-1) to the other (1), or around the circle."""
    if table[s, KIND] == TORUS:
        return table[s, SIZE] * math.cos(math.pi * part), table[s, SIZE] * math.sin(math.pi * part), 0.0
    return 0.0, 0.0, part * table[s, SIZE + 1]


@njit(**INLINED)
def nodes_near(shapes, world, motion, matrix, look, a, b, side, near, pair, went, way, scratch, count):
    """Find where the surface of one body is near another, by descent along the other's distance from the deepest nodes
    of its near leaves, and add these points. `way` is how much the two have moved since the last search."""
    if near.count[pair, side] == 0:
        return count
    one, other = (a, b) if side == 0 else (b, a)
    r, s = world.shape[one], world.shape[other]
    w, c = map_between(motion.position, matrix, world.scale, world.com, one, other)
    k, own = world.scale[other], world.scale[one]
    size = shapes.clump_ball[shapes.clump_start[r], 3]
    sharp = shapes.triangles.level[r] >= 0 or shapes.triangles.level[s] >= 0
    reach = look + k * shapes.table[s, ERROR]
    kept = _candidates(shapes, r, s, w, c, k, own, reach, side, near, pair, went, scratch)
    chosen = _chosen(scratch, kept, look)
    # A round body may be smaller than the space between two nodes, so the search also starts at the point below its own
    # centre.
    begun, apart = count, WITHIN * max(own * _cell(shapes, r), k * _cell(shapes, s))
    back, middle = map_between(motion.position, matrix, world.scale, world.com, other, one)
    half = shapes.table[s, SIZE + 1] if shapes.table[s, KIND] == CAPSULE else 0.0
    first = (-1 if half == 0.0 else -3) if is_round(shapes.table, s) else 0
    for e in range(first, chosen):
        if count == FOUND:
            break
        if e < 0:
            key, stride, at, around = 0, FIRST_STRIDE * size, -1, FIRST_STRIDE * size
            p = _foot(shapes, r, mapped(back, middle, (0.0, 0.0, half * (e + 2))))
            if abs(distance_alone(shapes.table, shapes.brick, shapes.sample, r, p)) > ONTO_IT * shapes.table[r, CELL]:
                continue  # too far to reach the surface
            d, n = distance(shapes.table, shapes.brick, shapes.sample, s, mapped(w, c, p))
        else:
            i, stride = scratch.pick[e], FIRST_STRIDE * size
            key, at, p = scratch.key[i], scratch.leaf[i], get(shapes.node, scratch.node[i])
            around = 2.0 * shapes.cover[scratch.node[i]]
            d, n = scratch.depth[i] / k, get(scratch.normal, i)
        found = False
        if at >= 0 and near.placed[at]:
            # Start where the last descent ended, with shorter steps, unless the node is deeper by now.
            q, short = get(near.place, at), min(stride, max(RESTART * LAST_STRIDE * size, MOVED_SINCE * way / own))
            if q[0] == p[0] and q[1] == p[1] and q[2] == p[2]:
                stride, found = short, True
            else:
                there, normal = distance(shapes.table, shapes.brick, shapes.sample, s, mapped(w, c, q))
                if there < d + shapes.table[s, ERROR]:
                    p, d, n, stride, found = q, there, normal, short, True
        # The last descent on triangles ended on the true surface: a grid would lead away from there.
        if not (sharp and found):
            p, d, n = _refined(
                shapes.table, shapes.brick, shapes.sample, stride, LAST_STRIDE * size, r, s, w, c, k, own, p, d, n
            )
        if found and not sharp and way > PROBED * own * _cell(shapes, r):
            p, d, n = _past_ripples(shapes, LAST_STRIDE * size, r, s, w, c, k, own, p, d, n)
        if sharp:
            here = sub(scale(p, own), get(world.com, one))
            if _is_found(scratch.found, begun, count, side, here, apart):
                continue
            if not found:
                p = _onto(shapes, r, p, 2.0 * shapes.table[r, ERROR])
                stride = apart / own
            p, d, n = _descended(shapes, r, s, w, c, k, own, p, stride, SHARP_STRIDE * size, around)
        if at >= 0:
            near.placed[at] = True
            put(near.place, at, p)
        if d > look:
            continue
        # p of shape `one`, relative to its centre of mass; and its foot on the other, likewise.
        mine = sub(scale(p, own), get(world.com, one))
        theirs = sub(along(scale(mapped(w, c, p), k), n, -d), get(world.com, other))
        write(scratch.found, count, side, mine, theirs, turn(matrix, other, n), d, key)
        count += 1
    return count


@njit(**BARE)
def _is_found(found, begun, count, side, place, apart):
    """Whether a point of this side is known that is nearer than `apart`."""
    column = FIRST if side == 0 else SECOND
    for e in range(begun, count):
        away = sub(three(found[e], column), place)
        if dot(away, away) < apart * apart:
            return True
    return False


@njit(**BARE)
def _foot(shapes, s, p):
    """A point on the surface of shape s, from p along the negative gradient of its distance."""
    for _ in range(ONTO):
        d, n = distance(shapes.table, shapes.brick, shapes.sample, s, p)
        p = along(p, n, -d)
    return p


@njit(**INLINED)
def _candidates(shapes, r, s, w, c, k, own, look, side, near, pair, went, scratch):
    """The deepest node of each near leaf around which the surface may touch. Returns their number.

    Lower bounds of the distances of leaves and nodes are kept until the next search for near bodies: nodes that cannot
    be near or deepest, given how far bodies have moved since, are not evaluated again.
    """
    table, brick, sample = shapes.table, shapes.brick, shapes.sample
    flat, kept = table[s, KIND] == PLANE, 0
    wide = len(near.node_away) // max(1, len(near.away))
    for at in range(near.start[pair, side], near.start[pair, side] + near.count[pair, side]):
        i, best = near.leaf[at], near.deepest[at]
        if near.away[at] - went <= look and best < 0:
            near.away[at] = beyond(shapes, s, w, c, k, own, i) + went
        if near.away[at] - went > look:
            near.away_all[pair] = min(near.away_all[pair], near.away[at])
            continue
        first, last = shapes.leaf_node[i], shapes.leaf_node[i + 1]
        outward = OUTWARD * own * (norm(get(shapes.leaf_ball, i)) + shapes.leaf_ball[i, 3])
        deepest, chosen, lowest, closest = 0.0, -1, math.inf, math.inf
        facing, d, bound, there = (0.0, 0.0, 0.0), 0.0, -math.inf, (0.0, 0.0, 0.0)
        # The former deepest node comes first: few others can then be deeper.
        for e in range(first - 1 if best >= 0 else first, last):
            if e == best:
                continue
            u = best if e < first else e
            around, known = own * shapes.cover[u], at * wide + u - first
            low = near.node_away[known] - went if best >= 0 else -math.inf
            if low - around > look or low - outward > lowest:
                closest = min(closest, low - around)
                continue
            p = get(shapes.node, u)
            if flat:
                d, n = k * (dot(w[2], p) + c[2]), (0.0, 0.0, 1.0)
                low = d
            else:
                low = max(low, bound - own * norm(sub(p, there)))  # near to a far node
                if low - around > look or low - outward > lowest:
                    near.node_away[known], closest = low + went, min(closest, low - around)
                    continue
                d, n = distance(table, brick, sample, s, mapped(w, c, p))
                low = bound = k * at_least(table, s, d)
                d, there = k * d, p
            near.node_away[known], closest = low + went, min(closest, low - around)
            score = d - OUTWARD * own * norm(p)
            if d - around <= look and (score < lowest or (score == lowest and u < chosen)):
                deepest, chosen, lowest, facing = d, u, score, n
        near.away[at], near.deepest[at] = closest + went, chosen if chosen >= 0 else first
        near.away_all[pair] = min(near.away_all[pair], near.away[at])
        if chosen < 0:
            continue
        if kept == CANDIDATES:
            worst = 0
            for e in range(kept):
                worst = e if scratch.depth[e] > scratch.depth[worst] else worst
            if scratch.depth[worst] <= deepest:
                continue
        else:
            worst = kept
            kept += 1
        place = mapped(w, c, get(shapes.node, chosen))
        patch, there = shapes.leaf_patch[i], patch_of(table, shapes.label, s, place)
        scratch.depth[worst], scratch.node[worst], scratch.leaf[worst] = deepest, chosen, at
        scratch.key[worst] = patch * KEYS + there if side == 0 else there * KEYS + patch
        put(scratch.normal, worst, facing)
        put(scratch.place, worst, scale(place, k))
    return kept


@njit(**INLINED)
def _chosen(scratch, kept, level):
    """Pick, to scratch.pick, the deepest of the candidates that face the same way, and of those about as deep the
    outermost to all sides: the corners of a face, whatever the order of its leaves. Returns their number."""
    depth, key, normal, place, pick, used = (
        scratch.depth, scratch.key, scratch.normal, scratch.place, scratch.pick, scratch.used,
    )  # fmt: skip
    for e in range(kept):
        used[e] = 0
    chosen = 0
    while chosen < SIDE:
        first = -1
        for e in range(kept):
            if used[e] == 0 and (first < 0 or depth[e] < depth[first]):
                first = e
        if first < 0:
            break
        n = get(normal, first)
        u, v = across(n)
        start = chosen
        pick[chosen] = first
        chosen += 1
        for way in range(WAYS):
            angle = 2.0 * math.pi * way / WAYS
            d = add(scale(u, math.cos(angle)), scale(v, math.sin(angle)))
            outer, most = -1, -math.inf
            for e in range(kept):
                if used[e] != 1 and key[e] == key[first] and dot(n, get(normal, e)) > ALIKE:
                    used[e] = 2
                    if depth[e] <= depth[first] + level and dot(d, get(place, e)) > most:
                        outer, most = e, dot(d, get(place, e))
            known = outer < 0
            for e in range(start, chosen):
                known = known or pick[e] == outer
            if not known and chosen < SIDE:
                pick[chosen] = outer
                chosen += 1
        for e in range(kept):
            used[e] = 1 if used[e] == 2 else used[e]
        used[first] = 1
    return chosen


@njit(**INLINED)
def _refined(table, brick, sample, stride, least, s, t, w, c, k, own, p, d, n):
    """Descend along the surface of s to lower distances of t, from a point p on s with distance d and normal n (in t's
    axes), in steps from `stride` down to `least`. Returns the point, the distance at the scale of t, and the normal."""
    ratio = k / own
    _, m = distance(table, brick, sample, s, p)
    way, was = (0.0, 0.0, 0.0), 0.0  # the last step's direction, and the slope of the distance along it
    for _ in range(DESCENT_ROUNDS):
        # The other's normal in own axes (w is a rotation times own / k), minus its component normal to the own surface.
        g = (
            (w[0][0] * n[0] + w[1][0] * n[1] + w[2][0] * n[2]) * ratio,
            (w[0][1] * n[0] + w[1][1] * n[1] + w[2][1] * n[2]) * ratio,
            (w[0][2] * n[0] + w[1][2] * n[1] + w[2][2] * n[2]) * ratio,
        )
        g = along(g, m, -dot(g, m))
        slope = norm(g)
        if slope < LEVEL_SLOPE:
            break
        # Step length: to where the slope vanishes if it continues to change as in the last step (secant), and a short
        # step at first; in powers of two, or rounding errors would grow tenfold in each step.
        change = was + dot(way, g)
        if was > 0.0:
            longer = min(slope / change, LONGER) if change > 0.0 else LONGER
            stride *= 2.0 ** math.floor(math.log2(longer) + 0.5)
        way, was, better = scale(g, -1.0 / slope), slope, False
        while stride > least:
            q, share = along(p, way, stride), SHORTER
            # Back onto the own surface. Beyond an edge one step is not enough, and a point beside the surface is not
            # accepted.
            own_d, across_own = distance(table, brick, sample, s, q)
            for _ in range(ONTO):
                if abs(own_d) <= BESIDE * stride:
                    break
                q = along(q, across_own, -own_d)
                own_d, across_own = distance(table, brick, sample, s, q)
            if abs(own_d) <= BESIDE * stride:
                q = along(q, across_own, -own_d)
                there, normal = distance(table, brick, sample, t, mapped(w, c, q))
                if there < d - LOWER:
                    better = True
                    p, d, n, m = q, there, normal, across_own
                    break
                # The minimum of the parabola through the slope here and the distance there.
                fall = slope * stride / ratio
                share = min(SHORTER, max(SHORTEST, 0.5 * fall / (there - d + fall)))
            stride *= share
        if not better:
            break
    return p, k * d, n


@njit(**INLINED)
def _past_ripples(shapes, least, s, t, w, c, k, own, p, d, n):
    """A lower point of a grid's surface than p, where `_refined` ended, if there is one a cell away: the surface of a
    grid ripples with its cells. A push behind the lowest point of a body that rolls would drive it."""
    table, brick, sample = shapes.table, shapes.brick, shapes.sample
    cell, d = table[s, CELL], d / k
    for _ in range(2):
        _, m = distance(table, brick, sample, s, p)
        u, v = across(m)
        low, place = d, p
        for way in range(WAYS):
            angle = 2.0 * math.pi * way / WAYS
            q = add(p, scale(add(scale(u, math.cos(angle)), scale(v, math.sin(angle))), cell))
            for _ in range(2):
                off, m = distance(table, brick, sample, s, q)
                q = along(q, m, -off)
            there = distance_alone(table, brick, sample, t, mapped(w, c, q))
            if there < low - LOWER:
                low, place = there, q
        there, m = distance(table, brick, sample, t, mapped(w, c, place))
        if low == d or dot(m, n) <= ALIKE:
            break
        p, d, n = _refined(table, brick, sample, 0.5 * cell, least, s, t, w, c, k, own, place, there, m)
        d = d / k
    return p, k * d, n


@njit(**INLINED)
def _descended(shapes, s, t, w, c, k, own, p, step, least, around):
    """Descend along the true surface of s, from a point on it, to lower distances of the true one of t, by steps along
    the other's normal and back onto the surface, on nearly level faces to the lowest corner `around`. Returns the
    point, the distance at the scale of t, and the normal."""
    ratio = k / own
    d, n = true_distance(shapes, t, mapped(w, c, p))
    for _ in range(SHARP_ROUNDS):
        if step <= least:
            break
        g = (
            (w[0][0] * n[0] + w[1][0] * n[1] + w[2][0] * n[2]) * ratio,
            (w[0][1] * n[0] + w[1][1] * n[1] + w[2][1] * n[2]) * ratio,
            (w[0][2] * n[0] + w[1][2] * n[1] + w[2][2] * n[2]) * ratio,
        )
        q = _onto(shapes, s, along(p, g, -step), SHARP_REACH * step)
        level = norm(sub(q, p)) <= LEVEL_FACE * step
        if level:
            q = lowest_corner(shapes.triangles, s, p, g, around, LEVEL_FACE)
        if norm(sub(q, p)) <= least:
            break
        there, normal = true_distance(shapes, t, mapped(w, c, q))
        if there < d - LOWER and (not level or dot(normal, n) > ALIKE):
            p, d, n = q, there, normal
        else:
            # A step by the distance itself leads to where two lines cross.
            step = d * ratio if least < d * ratio < 0.5 * step else SHARP_SHORTER * step
    return p, k * d, n


@njit(**BARE)
def _cell(shapes, s):
    return shapes.table[s, CELL] if shapes.table[s, KIND] == GRID else 0.0


@njit(**BARE)
def _onto(shapes, s, p, most):
    """A point on the surface of s near p: with triangles the closest, if it is nearer than `most`."""
    if shapes.triangles.level[s] >= 0:
        _, q, _ = closest(shapes.triangles, s, p, most)
        return q
    return _foot(shapes, s, p)


@njit(**BARE)
def looked_at(shapes, world, motion, matrix, rules, manifolds, p, count, ahead):
    """Find the normals and distances of the points of a pair again, on true surfaces; or, looking `ahead`, where points
    that are apart will touch in this inner step: what only passes an edge is no contact. Returns the number of points
    that are left."""
    kept = 0
    for k in range(count):
        point = manifolds.point[p, k]
        side = int(point[OWNER])
        one, other = manifolds.pair[p, side], manifolds.pair[p, 1 - side]
        mine, theirs = (FIRST, SECOND) if side == 0 else (SECOND, FIRST)
        t, size = world.shape[other], world.scale[other]
        w, c = map_between(motion.position, matrix, world.scale, world.com, one, other)
        own = scale(add(three(point, mine), get(world.com, one)), 1.0 / world.scale[one])
        x, gap = mapped(w, c, own), point[GAP]
        d, n = gap / size, (0.0, 0.0, 0.0)
        if not ahead:
            if point[NORMAL_IMPULSE] == 0.0:
                continue  # it is found again if it matters
            d, n = true_distance(shapes, t, x)
            gap = size * d
            if gap > rules.contact_margin:
                continue
        elif gap > TRACED_TO:
            r = _travel(world, motion, matrix, rules, point, one, other, mine, theirs)
            way, gone = norm(r) / size, 0.0
            r = scale(turn_back(matrix, other, r), 1.0 / size)
            if way > d:
                for _ in range(TRACE_ROUNDS):
                    gone += d / way
                    if gone >= 1.0 or d * size <= TRACED_TO:
                        break
                    d, n = true_distance(shapes, t, along(x, r, gone))
                gap = -gone * dot(r, n) * size
                if gone >= 1.0 or gap <= 0.0:
                    continue
        if not ahead or gap != point[GAP]:
            foot = sub(scale(along(x, n, -d), size), get(world.com, other))
            normal = turn(matrix, other, n)
            for e in range(3):
                point[NORMAL + e] = normal[e] if side == 0 else -normal[e]
                if not ahead:
                    point[theirs + e] = foot[e]
            point[GAP] = gap
        for e in range(COLUMNS):
            manifolds.point[p, kept, e] = point[e]
        kept += 1
    return kept


@njit(**BARE)
def _travel(world, motion, matrix, rules, point, one, other, mine, theirs):
    """How far a point of the first body moves relative to the second in an inner step."""
    arm, lever = turn(matrix, one, three(point, mine)), turn(matrix, other, three(point, theirs))
    v = add(get(motion.velocity, one), cross(get(motion.angular, one), arm))
    if world.moves[other] or world.scripted[other]:
        v = sub(v, add(get(motion.velocity, other), cross(get(motion.angular, other), lever)))
    fall = (1.0 if world.moves[one] else 0.0) - (1.0 if world.moves[other] else 0.0)
    v = along(v, vector(rules.options.gravity), fall * rules.substep_dt)
    return scale(v, rules.substep_dt)


@njit(**BARE)
def round_points(shapes, world, motion, matrix, reach, a, b, side, found):
    """A sphere, capsule or torus against anything: the distance at points of its core, less its radius."""
    table, brick, sample = shapes.table, shapes.brick, shapes.sample
    one, other = (a, b) if side == 0 else (b, a)
    s, t = world.shape[one], world.shape[other]
    w, c = map_between(motion.position, matrix, world.scale, world.com, one, other)
    if table[s, KIND] == TORUS:
        return _ring_points(shapes, world, matrix, reach, one, other, w, c, side, found)
    count = _core_point(shapes, world, matrix, reach, one, other, w, c, side, found, 0, -1.0)
    if table[s, KIND] == CAPSULE:
        count = _core_point(shapes, world, matrix, reach, one, other, w, c, side, found, count, 1.0)
        between = 1.0 if table[t, KIND] == PLANE else _lowest(table, brick, sample, s, t, w, c, -1.0, 1.0)
        if abs(between) <= CORE_ENDS:
            count = _core_point(shapes, world, matrix, reach, one, other, w, c, side, found, count, between)
    return count


@njit(**BARE)
def _ring_points(shapes, world, matrix, reach, one, other, w, c, side, found):
    """`round_points` for a torus: the points of its circle at which the distance is least, and if all of the circle is
    near, as of a ring that lies on a table, also some that do not change."""
    table, brick, sample = shapes.table, shapes.brick, shapes.sample
    s, t, count, kept = world.shape[one], world.shape[other], 0, FOUND - BEADS
    low, high = math.inf, -math.inf
    for e in range(BEADS):
        d = distance_alone(table, brick, sample, t, mapped(w, c, core_point(table, s, 2.0 * e / BEADS - 1.0)))
        found[kept + e, GAP], low, high = d, min(low, d), max(high, d)
    near = (reach + world.scale[one] * core_radius(table, s)) / world.scale[other]
    level, near_all = high - low <= LEVEL_CIRCLE * table[s, SIZE], high <= near
    step = math.pi * table[s, SIZE] * world.scale[one] / world.scale[other] * 2.0 / BEADS
    for e in range(BEADS):
        d, part = found[kept + e, GAP], 2.0 * e / BEADS - 1.0
        if near_all and e % (BEADS // FIXED) == 0:
            count = _core_point(shapes, world, matrix, reach, one, other, w, c, side, found, count, part)
        before, after = found[kept + (e - 1) % BEADS, GAP], found[kept + (e + 1) % BEADS, GAP]
        if not level and d <= near + step and d <= before and d < after:
            least = _lowest(table, brick, sample, s, t, w, c, part - 2.0 / BEADS, part + 2.0 / BEADS)
            count = _core_point(shapes, world, matrix, reach, one, other, w, c, side, found, count, least)
    return count


@njit(**BARE)
def _core_point(shapes, world, matrix, reach, one, other, w, c, side, found, count, part):
    """Write the point that belongs to one of the core, if it is near. Returns the number of points."""
    s, t, k, own = world.shape[one], world.shape[other], world.scale[other], world.scale[one]
    core, radius = core_point(shapes.table, s, part), own * core_radius(shapes.table, s)
    d, n = distance(shapes.table, shapes.brick, shapes.sample, t, mapped(w, c, core))
    gap = k * d - radius
    if gap > reach:
        return count
    mine = turn_back(matrix, one, turn(matrix, other, scale(n, -radius)))
    mine = sub(add(scale(core, own), mine), get(world.com, one))
    theirs = sub(along(scale(mapped(w, c, core), k), n, -k * d), get(world.com, other))
    write(found, count, side, mine, theirs, turn(matrix, other, n), gap, 0)
    return count + 1


@njit(**BARE)
def at_least(table, t, d):
    """A lower bound of a point's distance to shape t, from the distance that was read: between the corners of a grid's
    bricks that may be too large."""
    if table[t, KIND] != GRID or d <= GRID_FINE * table[t, CELL]:
        return d - table[t, ERROR]
    return max(GRID_FINE, d / table[t, CELL] - GRID_FARTHER) * table[t, CELL]


@njit(**BARE)
def beyond(shapes, t, w, c, k, own, e):
    """A lower bound of a leaf's distance to shape t."""
    d = distance_alone(shapes.table, shapes.brick, shapes.sample, t, mapped(w, c, get(shapes.leaf_ball, e)))
    return k * at_least(shapes.table, t, d) - own * shapes.leaf_ball[e, 3]


@njit(**BARE)
def _lowest(table, brick, sample, s, t, w, c, low, high):
    """The part of a core, between two, that is nearest to shape t, by golden section search."""
    one, other = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    f = distance_alone(table, brick, sample, t, mapped(w, c, core_point(table, s, one)))
    g = distance_alone(table, brick, sample, t, mapped(w, c, core_point(table, s, other)))
    for _ in range(30):
        if f <= g:
            high, other, g = other, one, f
            one = high - GOLDEN * (high - low)
            f = distance_alone(table, brick, sample, t, mapped(w, c, core_point(table, s, one)))
        else:
            low, one, f = one, other, g
            other = low + GOLDEN * (high - low)
            g = distance_alone(table, brick, sample, t, mapped(w, c, core_point(table, s, other)))
    return 0.5 * (low + high)


@njit(**BARE)
def swallowed(shapes, world, motion, matrix, a, b, side, found):
    """Whether the centre of one body is inside both solids (that of a ring on a peg is not inside the ring).

    For nodes beyond the other's middle the nearest surface is then on the wrong side. The pair gets one contact
    instead, at this centre, along the other's normal there.
    """
    one, other = (a, b) if side == 0 else (b, a)
    away = norm(sub(get(motion.position, one), get(motion.position, other)))
    if not world.moves[one] or not away < world.radius[other] < math.inf:
        return False
    table, brick, sample = shapes.table, shapes.brick, shapes.sample
    k, centre = world.scale[other], scale(get(world.com, one), 1.0 / world.scale[one])
    own = distance_alone(table, brick, sample, world.shape[one], centre)
    if own >= 0.0:
        return False
    w, c = map_between(motion.position, matrix, world.scale, world.com, one, other)
    there = mapped(w, c, centre)
    d, n = distance(table, brick, sample, world.shape[other], there)
    if d >= 0.0:
        return False
    theirs = sub(along(scale(there, k), n, -k * d), get(world.com, other))
    write(found, 0, side, (0.0, 0.0, 0.0), theirs, turn(matrix, other, n), k * d, 0)
    return True
