"""Contacts, compiled: broad phase, nodes of one body in the distances of the other, manifolds that persist."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from sdfsim.dynamics.kernels.distance import CAPSULE, KIND, PLANE, SIZE, SPHERE, distance, patch_of
from sdfsim.dynamics.kernels.vectors import (
    BARE,
    FAST,
    add,
    along,
    dot,
    get,
    norm,
    put,
    scale,
    sub,
    turn,
    turn_back,
    vector,
)
from sdfsim.dynamics.kernels.world import COLUMNS, DRAG, FIRST, GAP, KEY, NORMAL, NOTE, POINTS, PUSH, SECOND, Manifolds

FOUND = 48  # contact points that a pair may find in one look
SIDE = 24  # of these from the nodes of either body
EACH = 4  # points of a manifold that are of the same two patches
KEYS = 1024  # patches of a shape at most
ALIKE = 0.9  # cosine between normals that are taken for one
ROUNDS = 12  # of refinement
OUTWARD = 1e-3  # how much deeper another node must be to be preferred to one that is farther out by a length
STRIDE = 0.02  # of a body's size, the first step of the refinement
MANY = 48  # pairs from which on threads are worth their while


@njit(**FAST)
def look_around(shapes, world, motion, matrix, rules, span, old):
    """Pairs of bodies that may touch within `span` of time, which of their nodes are near, and their manifolds.

    Returns:
        The pairs with the points of `old`; how far each body may go until it must be looked at again; for either side
        of each pair the place of its first leaf [P, 2], how many are near [P, 2], and these leaves.
    """
    ways, low, high = _swept(world, motion, matrix, rules, span)
    pairs = _pairs(world, motion, low, high)
    manifolds = _carried(world, motion, pairs, old)
    start, count, leaf = _near_leaves(shapes, world, motion, matrix, manifolds.pair, ways, rules.reach)
    return manifolds, ways, start, count, leaf


@njit(**FAST)
def _swept(world, motion, matrix, rules, span):
    """How far [N] any point of a body may go, and the boxes around all that they may reach."""
    n = len(world.shape)
    ways, low, high = np.zeros(n), np.empty((n, 3)), np.empty((n, 3))
    fall = norm(vector(rules.gravity)) * span
    for b in range(n):
        if world.shape[b] < 0 or not math.isfinite(world.radius[b]):
            continue
        if motion.island[b] < 0 and (world.moves[b] or world.scripted[b]):
            speed = norm(get(motion.velocity, b)) + norm(get(motion.angular, b)) * world.radius[b]
            if world.moves[b]:
                speed += fall
            ways[b] = speed * span + 0.5 * rules.reach
        middle = add(get(motion.position, b), turn(matrix, b, get(world.centre, b)))
        for a in range(3):
            wide = ways[b] + 0.5 * rules.reach
            for c in range(3):
                wide += abs(matrix[b, a, c]) * world.half[b, c]
            low[b, a] = middle[a] - wide
            high[b, a] = middle[a] + wide
    return ways, low, high


@njit(**BARE)
def _may_meet(world, a, b):
    one, other = world.realm[a], world.realm[b]
    return (one == other or one < 0 or other < 0) and world.allowed[world.group[a], world.group[b]]


@njit(**BARE)
def _overlap(low, high, a, other_low, other_high, b):
    for k in range(3):
        if low[a, k] > other_high[b, k] or high[a, k] < other_low[b, k]:
            return False
    return True


@njit(**FAST)
def _pairs(world, motion, low, high):
    """[P, 2] bodies whose boxes overlap, in a fixed order: sweep and prune along the axis on which they spread most."""
    n = len(world.shape)
    going = np.empty(n, np.int64)
    count = 0
    for b in range(n):
        if world.shape[b] >= 0 and (world.moves[b] or world.scripted[b]):
            going[count] = b
            count += 1
    going = going[:count]
    found = np.empty((max(64, 4 * count), 2), np.int64)
    pairs = 0
    axis, widest = 0, -1.0
    for k in range(3):
        least, most = math.inf, -math.inf
        for i in range(count):
            least, most = min(least, low[going[i], k]), max(most, low[going[i], k])
        if most - least > widest:
            axis, widest = k, most - least
    along_axis = np.empty(count)
    for i in range(count):
        along_axis[i] = low[going[i], axis]
    rank = _sorted(along_axis)
    order = np.empty(count, np.int64)
    for i in range(count):
        order[i] = going[rank[i]]
    for i in range(count):
        a = order[i]
        awake = world.moves[a] and motion.island[a] < 0
        for j in range(i + 1, count):
            b = order[j]
            if low[b, axis] > high[a, axis]:
                break
            if not (awake or (world.moves[b] and motion.island[b] < 0)):
                continue
            if _overlap(low, high, a, low, high, b) and _may_meet(world, a, b):
                swap = (b < a and world.moves[b]) or not world.moves[a]
                found, pairs = _append(found, pairs, b if swap else a, a if swap else b)
        if not awake:
            continue
        for k in range(len(world.plane)):
            if _may_meet(world, a, world.plane[k]):
                found, pairs = _append(found, pairs, a, world.plane[k])
        last, beyond = 0, len(world.still)
        while last < beyond:
            k = (last + beyond) // 2
            if world.low[k, world.axis] <= high[a, world.axis]:
                last = k + 1
            else:
                beyond = k
        for k in range(last - 1, -1, -1):
            if world.reach[k] < low[a, world.axis]:
                break
            if _overlap(low, high, a, world.low, world.high, k) and _may_meet(world, a, world.still[k]):
                found, pairs = _append(found, pairs, a, world.still[k])
    key = np.empty(pairs)
    for p in range(pairs):
        key[p] = found[p, 0] * n + found[p, 1]
    rank = _sorted(key)
    ordered = np.empty((pairs, 2), np.int64)
    for p in range(pairs):
        ordered[p, 0], ordered[p, 1] = found[rank[p], 0], found[rank[p], 1]
    return ordered


@njit(**FAST)
def _sorted(values):
    """The order that sorts `values`, equal ones as they come: a merge sort; numpy's takes seconds to compile."""
    n = len(values)
    order, other = np.arange(n), np.empty(n, np.int64)
    width = 1
    while width < n:
        for first in range(0, n, 2 * width):
            i, middle, j, last = first, min(first + width, n), min(first + width, n), min(first + 2 * width, n)
            for k in range(first, last):
                if j >= last or (i < middle and values[order[i]] <= values[order[j]]):
                    other[k] = order[i]
                    i += 1
                else:
                    other[k] = order[j]
                    j += 1
        order, other = other, order
        width *= 2
    return order


@njit(**FAST)
def _append(found, count, a, b):
    if count == len(found):
        more = np.empty((2 * count, 2), np.int64)
        more[:count] = found
        found = more
    found[count, 0], found[count, 1] = a, b
    return found, count + 1


@njit(**FAST)
def _carried(world, motion, pairs, old):
    """The manifolds of `pairs` with what is known of them, and those of bodies that sleep."""
    n = len(world.shape)
    kept = np.zeros(len(old.count), np.bool_)
    for k in range(len(old.count)):
        a, b = old.pair[k, 0], old.pair[k, 1]
        kept[k] = motion.island[a] >= 0 and (motion.island[b] >= 0 or not world.moves[b])
    here = len(pairs)
    total = here + kept.sum()
    pair = np.empty((total, 2), np.int64)
    count = np.zeros(total, np.int64)
    point = np.empty((total, POINTS, COLUMNS))
    pair[:here] = pairs
    at = 0
    for k in range(here):
        key = pairs[k, 0] * n + pairs[k, 1]
        while at < len(old.count) and old.pair[at, 0] * n + old.pair[at, 1] < key:
            at += 1
        if at < len(old.count) and old.pair[at, 0] * n + old.pair[at, 1] == key:
            count[k] = old.count[at]
            point[k, : count[k]] = old.point[at, : count[k]]
            kept[at] = False
    end = here
    for k in range(len(old.count)):
        if kept[k]:
            pair[end] = old.pair[k]
            count[end] = old.count[k]
            point[end, : count[end]] = old.point[k, : count[end]]
            end += 1
    return Manifolds(pair[:end], count[:end], point[:end])


@njit(**BARE)
def _map(position, matrix, scales, coms, a, b):
    """Rows of W and the vector c: a point p of shape a is at W p + c of shape b (both at scale 1)."""
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
def _mapped(w, c, p):
    return dot(w[0], p) + c[0], dot(w[1], p) + c[1], dot(w[2], p) + c[2]


@njit(**BARE)
def is_round(table, s):
    """Whether a shape is all within a radius of a line."""
    return table[s, KIND] == SPHERE or table[s, KIND] == CAPSULE


@njit(**FAST)
def _near_leaves(shapes, world, motion, matrix, pairs, ways, reach):
    """For either side of each pair the leaves of nodes that the other may touch: first place, number, and which."""
    count = len(pairs)
    start = np.zeros((count, 2), np.int64)
    total = 0
    for p in range(count):
        for side in range(2):
            start[p, side] = total
            s, other = world.shape[pairs[p, side]], world.shape[pairs[p, 1 - side]]
            if not (is_round(shapes.table, s) or is_round(shapes.table, other)):
                total += shapes.clump_leaf[shapes.clump_start[s + 1]] - shapes.clump_leaf[shapes.clump_start[s]]
    near = np.zeros((count, 2), np.int64)
    leaf = np.empty(total, np.int32)
    if count >= MANY:
        _near_many(shapes, world, motion, matrix, pairs, ways, reach, start, near, leaf)
    else:
        for p in range(count):
            _near(shapes, world, motion, matrix, pairs, ways, reach, start, near, leaf, p)
    return start, near, leaf


@njit(parallel=True, **FAST)
def _near_many(shapes, world, motion, matrix, pairs, ways, reach, start, near, leaf):
    for p in prange(len(pairs)):
        _near(shapes, world, motion, matrix, pairs, ways, reach, start, near, leaf, p)


@njit(**BARE)
def _near(shapes, world, motion, matrix, pairs, ways, reach, start, near, leaf, p):
    table, brick, sample = shapes.table, shapes.brick, shapes.sample
    a, b = pairs[p, 0], pairs[p, 1]
    most = ways[a] + ways[b] + reach
    if is_round(shapes.table, world.shape[a]) or is_round(shapes.table, world.shape[b]):
        # One query tells whether the ball around either may touch the other; 1 stands for yes.
        one = a if is_round(shapes.table, world.shape[a]) else b
        other = b if one == a else a
        w, c = _map(motion.position, matrix, world.scale, world.com, one, other)
        k = world.scale[other]
        d, _ = distance(table, brick, sample, world.shape[other], _mapped(w, c, (0.0, 0.0, 0.0)))
        s = world.shape[one]
        size = (
            shapes.table[s, SIZE] + (shapes.table[s, SIZE + 1] if shapes.table[s, KIND] == CAPSULE else 0.0)
        ) * world.scale[one]
        near[p, 0] = 1 if d * k - size <= most else 0
        return
    for side in range(2):
        one, other = pairs[p, side], pairs[p, 1 - side]
        s, t = world.shape[one], world.shape[other]
        w, c = _map(motion.position, matrix, world.scale, world.com, one, other)
        k, own = world.scale[other], world.scale[one]
        found = 0
        for clump in range(shapes.clump_start[s], shapes.clump_start[s + 1]):
            d, _ = distance(table, brick, sample, t, _mapped(w, c, get(shapes.clump_ball, clump)))
            if k * d - own * shapes.clump_ball[clump, 3] > most:
                continue
            for i in range(shapes.clump_leaf[clump], shapes.clump_leaf[clump + 1]):
                d, _ = distance(table, brick, sample, t, _mapped(w, c, get(shapes.leaf_ball, i)))
                if k * d - own * shapes.leaf_ball[i, 3] <= most:
                    leaf[start[p, side] + found] = i
                    found += 1
        near[p, side] = found


@njit(**FAST)
def collide(shapes, world, motion, matrix, rules, manifolds, start, near, leaf):
    """Bring all manifolds up to the present poses: old points moved along or dropped, new ones found and merged."""
    count = len(start)
    if count >= MANY:
        _collide_many(shapes, world, motion, matrix, rules, manifolds, start, near, leaf)
    else:
        for p in range(count):
            _collide_pair(shapes, world, motion, matrix, rules, manifolds, start, near, leaf, p)


@njit(parallel=True, **FAST)
def _collide_many(shapes, world, motion, matrix, rules, manifolds, start, near, leaf):
    for p in prange(len(start)):
        _collide_pair(shapes, world, motion, matrix, rules, manifolds, start, near, leaf, p)


@njit(**FAST)
def _collide_pair(shapes, world, motion, matrix, rules, manifolds, start, near, leaf, p):
    a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
    point = manifolds.point[p]
    if near[p, 0] + near[p, 1] == 0:
        manifolds.count[p] = 0
        return
    s, t = world.shape[a], world.shape[b]
    found = np.empty((FOUND, COLUMNS))
    count = 0
    if is_round(shapes.table, s) or is_round(shapes.table, t):
        one = 0 if is_round(shapes.table, s) else 1
        count = _round(shapes, world, motion, matrix, rules, a, b, one, found)
        known = manifolds.count[p] if shapes.table[world.shape[manifolds.pair[p, one]], KIND] == SPHERE else 0
        known = 0 if is_round(shapes.table, s) and is_round(shapes.table, t) else known
        known = _moved(shapes, world, motion, matrix, rules, a, b, point, known)
        manifolds.count[p] = _merged(rules, point, known, found, count, True)
        return
    known = _moved(shapes, world, motion, matrix, rules, a, b, point, manifolds.count[p])
    for side in range(2):
        first = start[p, side]
        some = leaf[first : first + near[p, side]]
        count = _nodes(shapes, world, motion, matrix, rules, a, b, side, some, found, count)
    count = _first_to_touch(rules, found, count)
    manifolds.count[p] = _merged(rules, point, known, found, count, False)


@njit(**BARE)
def _moved(shapes, world, motion, matrix, rules, a, b, point, count):
    """Old points at the present poses; those that have parted or slid too far are dropped."""
    kept = 0
    for k in range(count):
        n = (point[k, NORMAL], point[k, NORMAL + 1], point[k, NORMAL + 2])
        for side in range(2):
            # The point of a ball that is touched is where the normal says, however it has rolled.
            body = a if side == 0 else b
            if shapes.table[world.shape[body], KIND] == SPHERE:
                radius = shapes.table[world.shape[body], SIZE] * world.scale[body] * (-1.0 if side == 0 else 1.0)
                here = turn_back(matrix, body, scale(n, radius))
                for c in range(3):
                    point[k, 3 * side + c] = here[c] - world.com[body, c]
        first = turn(matrix, a, (point[k, 0], point[k, 1], point[k, 2]))
        second = turn(matrix, b, (point[k, 3], point[k, 4], point[k, 5]))
        offset = add(sub(get(motion.position, a), get(motion.position, b)), sub(first, second))
        gap = dot(offset, n)
        slid = along(offset, n, -gap)
        if gap > rules.reach or dot(slid, slid) > rules.reach * rules.reach:
            continue
        for c in range(COLUMNS):
            point[kept, c] = point[k, c]
        point[kept, GAP] = gap
        kept += 1
    return kept


@njit(**FAST)
def _nodes(shapes, world, motion, matrix, rules, a, b, side, leaves, found, count):
    """The deepest node of each near leaf of one body in the other's distances, refined; added to `found`."""
    table, brick, sample = shapes.table, shapes.brick, shapes.sample
    one, other = (a, b) if side == 0 else (b, a)
    s, t = world.shape[one], world.shape[other]
    w, c = _map(motion.position, matrix, world.scale, world.com, one, other)
    k, own = world.scale[other], world.scale[one]
    best, which, keys = np.empty(SIDE), np.empty(SIDE, np.int64), np.empty(SIDE, np.int64)
    normals = np.empty((SIDE, 3))
    stride = STRIDE * shapes.clump_ball[shapes.clump_start[s], 3]
    kept = 0
    for i in leaves:
        d, _ = distance(table, brick, sample, t, _mapped(w, c, get(shapes.leaf_ball, i)))
        if k * d - own * shapes.leaf_ball[i, 3] > rules.look:
            continue
        deepest, chosen, lowest = 0.0, -1, 1e300
        facing = (0.0, 0.0, 0.0)
        for u in range(shapes.leaf_node[i], shapes.leaf_node[i + 1]):
            p = get(shapes.node, u)
            d, n = _gap(table, brick, sample, t, w, c, p, get(shapes.inward, u))
            d *= k
            score = d - OUTWARD * own * norm(p)
            if d <= rules.look and score < lowest:
                deepest, chosen, lowest, facing = d, u, score, n
        if chosen < 0:
            continue
        patch, there = shapes.leaf_patch[i], patch_of(table, shapes.label, t, _mapped(w, c, get(shapes.node, chosen)))
        key = patch * KEYS + there if side == 0 else there * KEYS + patch
        # Of those that are of the same two patches and face the same way the deepest, and of all.
        alike, place, worst = 0, -1, -1
        for e in range(kept):
            if keys[e] == key and dot(facing, get(normals, e)) > ALIKE:
                alike += 1
                if place < 0 or best[e] > best[place]:
                    place = e
            if worst < 0 or best[e] > best[worst]:
                worst = e
        if alike < EACH:
            place = kept if kept < SIDE else worst
        if place < kept and best[place] <= deepest:
            continue
        kept = max(kept, place + 1)
        best[place], which[place], keys[place] = deepest, chosen, key
        put(normals, place, facing)
    for e in range(kept):
        if count == FOUND:
            break
        u = which[e]
        p, d, n = _refined(table, brick, sample, stride, s, t, w, c, k, own, get(shapes.node, u), get(shapes.inward, u))
        if d > rules.look:
            continue
        # p of shape `one` -> about its centre of mass; its foot on the other, likewise.
        mine = sub(scale(p, own), get(world.com, one))
        q = _mapped(w, c, p)
        theirs = sub(along(scale(q, k), n, -d), get(world.com, other))
        normal = turn(matrix, other, n)
        if side == 1:
            normal = scale(normal, -1.0)
        for x in range(3):
            found[count, (FIRST if side == 0 else SECOND) + x] = mine[x]
            found[count, (SECOND if side == 0 else FIRST) + x] = theirs[x]
            found[count, NORMAL + x] = normal[x]
            found[count, PUSH + x] = 0.0
        found[count, DRAG + 2] = 0.0
        found[count, GAP] = d
        found[count, KEY] = keys[e]
        count += 1
    return count


@njit(**BARE)
def _gap(table, brick, sample, t, w, c, p, inward):
    """Distance of a node from shape t, and the normal there, as seen from a little within its own solid.

    On an edge of t its own distance has two normals, and the one that parts two stacked boxes is not always the
    nearer. From within, only the face that is met is near.
    """
    q = _mapped(w, c, add(p, inward))
    d, n = distance(table, brick, sample, t, q)
    back = sub(q, _mapped(w, c, p))
    return d - dot(back, n), n


@njit(**BARE)
def _refined(table, brick, sample, stride, s, t, w, c, k, own, p, inward):
    """From node p of shape s down the distance of t along the surface of s: place, distance, normal in t's axes."""
    d, n = _gap(table, brick, sample, t, w, c, p, inward)
    ratio = k / own
    least = 1e-3 * stride
    for _ in range(ROUNDS):
        # The other's normal in own axes (w is a rotation times own / k), less its part across the own surface.
        g = (
            (w[0][0] * n[0] + w[1][0] * n[1] + w[2][0] * n[2]) * ratio,
            (w[0][1] * n[0] + w[1][1] * n[1] + w[2][1] * n[2]) * ratio,
            (w[0][2] * n[0] + w[1][2] * n[1] + w[2][2] * n[2]) * ratio,
        )
        _, m = distance(table, brick, sample, s, p)
        g = along(g, m, -dot(g, m))
        slope = norm(g)
        if slope < 0.02:
            break
        better = False
        while stride > least:
            q = along(p, g, -stride / slope)
            own_d, m = distance(table, brick, sample, s, q)
            q = along(q, m, -own_d)
            there, normal = distance(table, brick, sample, t, _mapped(w, c, q))
            if there < d - 1e-9:
                better = True
                p, d, n = q, there, normal
                stride *= 1.3
                break
            stride *= 0.4
        if not better:
            break
    return p, k * d, n


@njit(**BARE)
def _round(shapes, world, motion, matrix, rules, a, b, side, found):
    """A sphere or capsule against anything: the distance at its core, less its radius."""
    table, brick, sample = shapes.table, shapes.brick, shapes.sample
    one, other = (a, b) if side == 0 else (b, a)
    s, t = world.shape[one], world.shape[other]
    w, c = _map(motion.position, matrix, world.scale, world.com, one, other)
    k, own = world.scale[other], world.scale[one]
    radius = shapes.table[s, SIZE]
    tried = 1
    half = 0.0
    at = (0.0, 0.0, 0.0)
    if shapes.table[s, KIND] == CAPSULE:
        half = shapes.table[s, SIZE + 1]
        tried = 3
        at = (-half, half, _lowest(table, brick, sample, t, w, c, half) if shapes.table[t, KIND] != PLANE else half)
    count = 0
    for e in range(tried):
        if e == 2 and half - abs(at[2]) < 0.05 * half:
            continue
        core = (0.0, 0.0, at[e])
        d, n = distance(table, brick, sample, t, _mapped(w, c, core))
        gap = k * d - own * radius
        if gap > rules.reach:
            continue
        mine = turn_back(matrix, one, turn(matrix, other, scale(n, -own * radius)))
        mine = sub(add(scale(core, own), mine), get(world.com, one))
        theirs = sub(along(scale(_mapped(w, c, core), k), n, -k * d), get(world.com, other))
        normal = turn(matrix, other, n)
        if side == 1:
            normal = scale(normal, -1.0)
        for x in range(3):
            found[count, (FIRST if side == 0 else SECOND) + x] = mine[x]
            found[count, (SECOND if side == 0 else FIRST) + x] = theirs[x]
            found[count, NORMAL + x] = normal[x]
            found[count, PUSH + x] = 0.0
        found[count, DRAG + 2] = 0.0
        found[count, KEY] = 0.0
        found[count, GAP] = gap
        count += 1
    return count


@njit(**BARE)
def nearest(shapes, shape, place, frame, scales, coms, pairs, start, near, leaf, p):
    """The least distance of pair p with its two bodies at `place` and `frame`, of the nodes that were near."""
    table, brick, sample = shapes.table, shapes.brick, shapes.sample
    least = math.inf
    for side in range(2):
        s, t = shape[pairs[p, side]], shape[pairs[p, 1 - side]]
        w, c = _map(place, frame, scales, coms, side, 1 - side)
        k = scales[1 - side]
        if is_round(table, s):
            half = table[s, SIZE + 1] if table[s, KIND] == CAPSULE else 0.0
            for e in range(-2, 3):
                d, _ = distance(table, brick, sample, t, _mapped(w, c, (0.0, 0.0, 0.5 * e * half)))
                least = min(least, k * d - scales[side] * table[s, SIZE])
        elif not is_round(table, t):
            for i in range(start[p, side], start[p, side] + near[p, side]):
                e = leaf[i]
                d, _ = distance(table, brick, sample, t, _mapped(w, c, get(shapes.leaf_ball, e)))
                if k * d - scales[side] * shapes.leaf_ball[e, 3] < least:
                    for u in range(shapes.leaf_node[e], shapes.leaf_node[e + 1]):
                        d, _ = distance(table, brick, sample, t, _mapped(w, c, get(shapes.node, u)))
                        least = min(least, k * d)
    return least


@njit(**BARE)
def _lowest(table, brick, sample, t, w, c, half):
    """Where between -half and half of its axis a capsule is nearest to shape t: golden section."""
    low, high = -half, half
    one, other = high - 0.6180339887498949 * (high - low), low + 0.6180339887498949 * (high - low)
    f, _ = distance(table, brick, sample, t, _mapped(w, c, (0.0, 0.0, one)))
    g, _ = distance(table, brick, sample, t, _mapped(w, c, (0.0, 0.0, other)))
    for _ in range(30):
        if f <= g:
            high, other, g = other, one, f
            one = high - 0.6180339887498949 * (high - low)
            f, _ = distance(table, brick, sample, t, _mapped(w, c, (0.0, 0.0, one)))
        else:
            low, one, f = one, other, g
            other = low + 0.6180339887498949 * (high - low)
            g, _ = distance(table, brick, sample, t, _mapped(w, c, (0.0, 0.0, other)))
    return 0.5 * (low + high)


@njit(**BARE)
def _first_to_touch(rules, found, count):
    """Of points with one normal only the deepest are kept, and those that are as deep: what an impact meets first.

    The others follow in the next inner steps, when the impact has been answered.
    """
    for e in range(count):
        found[e, NOTE] = 0.0
        for f in range(count):
            alike = 0.0
            for x in range(3):
                alike += found[e, NORMAL + x] * found[f, NORMAL + x]
            if alike > ALIKE and found[e, KEY] == found[f, KEY] and found[f, GAP] < found[e, GAP] - rules.together:
                found[e, NOTE] = 1.0
    kept = 0
    for e in range(count):
        if found[e, NOTE] == 0.0:
            for x in range(COLUMNS):
                found[kept, x] = found[e, x]
            kept += 1
    return kept


@njit(**FAST)
def _merged(rules, point, known, found, count, rounded):
    """Old and new points of a pair in one manifold, spread far; of points that nearly coincide the new ones.

    Returns how many there are.
    """
    every = np.empty((FOUND + POINTS, COLUMNS))
    total = 0
    for k in range(count):
        every[total] = found[k]
        total += 1
    same = rules.reach * rules.reach
    for k in range(known):
        twin = -1
        for e in range(count):
            turned = 0.0
            away = 0.0
            for x in range(3):
                turned += point[k, NORMAL + x] * found[e, NORMAL + x]
                away += (point[k, x] - found[e, x]) ** 2
            if (away < same and turned > 0.8) or (rounded and turned > 0.99):
                twin = e
                break
        if twin < 0:
            every[total] = point[k]
            total += 1
        elif every[twin, PUSH] == 0.0:
            for x in range(PUSH, KEY):
                every[twin, x] = point[k, x]
    # The deepest first, then always the one that is farthest from those chosen.
    away = np.full(total, 1e300)
    kept = 0
    alike = np.zeros(total, np.int64)
    chosen, lowest = -1, 1e300
    for e in range(total):
        score = every[e, GAP] - OUTWARD * norm((every[e, 0], every[e, 1], every[e, 2]))
        if score < lowest:
            chosen, lowest = e, score
    while chosen >= 0 and kept < POINTS:
        point[kept] = every[chosen]
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
            if away[e] > farthest and alike[e] < EACH:
                farthest, following = away[e], e
        chosen = following
    return kept
