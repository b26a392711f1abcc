"""Contacts, compiled: broad phase, nodes of one body in the distances of the other, manifolds that persist."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from sdfsim.dynamics.kernels.distance import (
    CAPSULE,
    CELL,
    GRID,
    KIND,
    PLANE,
    SIZE,
    SPHERE,
    distance,
    distance_alone,
    patch_of,
)
from sdfsim.dynamics.kernels.vectors import (
    BARE,
    FAST,
    add,
    along,
    cross,
    dot,
    get,
    norm,
    scale,
    sub,
    to_matrix,
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
NEAR = 3.0  # cells: so near to its surface a grid is fine
FARTHER = 2.0  # cells: by so much it is too far elsewhere, at a tip
OUTWARD = 1e-3  # how much deeper another node must be to be preferred to one that is farther out by a length
STRIDE, FINEST = 0.02, 5e-4  # of a body's size, the first step of the refinement and the last
MANY = 192  # pairs from which on threads are worth their while, also beside other programs
SHARES = 16  # of the pairs, each with its own scratch, that threads take in turn


class Near(NamedTuple):
    """The leaves of nodes of either body that the other of P pairs may touch, until bodies are looked for again."""

    # start, count: [P, 2] for either side the place of its first leaf and how many are near
    start: np.ndarray
    count: np.ndarray
    leaf: np.ndarray  # [L] which
    away: np.ndarray  # [L] how far each is at least, once the ways of both bodies since then are taken off
    looked: np.ndarray  # [P] the ways of both bodies when new points were last looked for; -inf for never
    away_all: np.ndarray  # [P] the least of `away`; -inf where it is not known


@njit(**FAST)
def look_around(shapes, world, work, motion, rules, span, old):
    """Pairs of bodies that may touch within `span` of time, and which of their nodes are near.

    Of `work` it sets how far each body may go until it must be looked around again, and who has somebody near.

    Returns:
        The manifolds of these pairs, with the points of `old`, and those of bodies that sleep; what is near.
    """
    swept(world, work, motion, rules, span)
    pairs = near_pairs(world, motion, work.low, work.high)
    manifolds = _carried(world, motion, pairs, old)
    near = _near_leaves(shapes, world, motion, work.matrix, pairs, work.ways, rules.reach)
    for p in range(len(pairs)):
        if near.count[p, 0] + near.count[p, 1] > 0:
            work.beside[pairs[p, 0]] = work.beside[pairs[p, 1]] = True
    return manifolds, near


@njit(**BARE)
def swept(world, work, motion, rules, span):
    """How far any point of a body may go, and the box around all that it may reach."""
    ways, low, high, matrix = work.ways, work.low, work.high, work.matrix
    fall = norm(vector(rules.gravity)) * span
    for b in world.going:
        ways[b], work.gone[b], work.beside[b] = 0.0, 0.0, False
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


@njit(**BARE)
def _stirs(world, motion, b):
    """Whether a body is awake, or led along."""
    if world.scripted[b]:
        return norm(get(motion.velocity, b)) + norm(get(motion.angular, b)) > 0.0
    return world.moves[b] and motion.island[b] < 0


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
def near_pairs(world, motion, low, high):
    """[P, 2] bodies whose boxes overlap, in a fixed order: sweep and prune along the axis on which they spread most."""
    going = world.going[(world.shape[world.going] >= 0) & np.isfinite(world.radius[world.going])]
    count = len(going)
    found = np.empty((max(64, 4 * count), 2), np.int64)
    pairs = 0
    axis, widest = 0, -1.0
    for k in range(3):
        least, most = math.inf, -math.inf
        for i in range(count):
            least, most = min(least, low[going[i], k]), max(most, low[going[i], k])
        if most - least > widest:
            axis, widest = k, most - least
    order = going[np.argsort(low[:, axis][going], kind="mergesort")]
    for i in range(count):
        a = order[i]
        awake = _stirs(world, motion, a)
        for j in range(i + 1, count):
            b = order[j]
            if low[b, axis] > high[a, axis]:
                break
            if not (awake or _stirs(world, motion, b)) or not (world.moves[a] or world.moves[b]):
                continue
            if _overlap(low, high, a, low, high, b) and _may_meet(world, a, b):
                swap = (b < a and world.moves[b]) or not world.moves[a]
                found, pairs = _append(found, pairs, b if swap else a, a if swap else b)
        if not world.moves[a]:
            continue
        for k in range(len(world.plane)):
            if (awake or _stirs(world, motion, world.plane[k])) and _may_meet(world, a, world.plane[k]):
                found, pairs = _append(found, pairs, a, world.plane[k])
        if not awake:
            continue
        last = np.searchsorted(world.low[:, world.axis], high[a, world.axis], side="right")
        for k in range(last - 1, -1, -1):
            if world.reach[k] < low[a, world.axis]:
                break
            if _overlap(low, high, a, world.low, world.high, k) and _may_meet(world, a, world.still[k]):
                found, pairs = _append(found, pairs, a, world.still[k])
    found = found[:pairs]
    return found[np.argsort(found[:, 0] * len(world.shape) + found[:, 1], kind="mergesort")]


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
    key, asleep = np.empty(len(old.count)), np.zeros(len(old.count), np.bool_)
    for k in range(len(old.count)):
        a, b = old.pair[k, 0], old.pair[k, 1]
        key[k] = a * n + b
        asleep[k] = motion.island[a] >= 0 and (motion.island[b] >= 0 or not world.moves[b])
    order = np.argsort(key, kind="mergesort")
    here = len(pairs)
    total = here + asleep.sum()
    pair = np.empty((total, 2), np.int64)
    count = np.zeros(total, np.int64)
    point = np.empty((total, POINTS, COLUMNS))
    pair[:here] = pairs
    at = 0
    for k in range(here):
        wanted = pairs[k, 0] * n + pairs[k, 1]
        while at < len(order) and key[order[at]] < wanted:
            at += 1
        if at < len(order) and key[order[at]] == wanted:
            known = order[at]
            count[k] = old.count[known]
            point[k, : count[k]] = old.point[known, : count[k]]
            asleep[known] = False
    end = here
    for k in range(len(old.count)):
        if asleep[k]:
            pair[end] = old.pair[k]
            count[end] = old.count[k]
            point[end, : count[end]] = old.point[k, : count[end]]
            end += 1
    return Manifolds(pair[:end], count[:end], point[:end])


@njit(**BARE)
def map_between(position, matrix, scales, coms, a, b):
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
def mapped(w, c, p):
    return dot(w[0], p) + c[0], dot(w[1], p) + c[1], dot(w[2], p) + c[2]


@njit(**BARE)
def is_round(table, s):
    """Whether a shape is all within a radius of a line."""
    return table[s, KIND] == SPHERE or table[s, KIND] == CAPSULE


@njit(**FAST)
def _near_leaves(shapes, world, motion, matrix, pairs, ways, reach):
    count = len(pairs)
    start = np.zeros((count, 2), np.int64)
    total = 0
    for p in range(count):
        for side in range(2):
            start[p, side] = total
            s, other = world.shape[pairs[p, side]], world.shape[pairs[p, 1 - side]]
            if not (is_round(shapes.table, s) or is_round(shapes.table, other)):
                total += shapes.clump_leaf[shapes.clump_start[s + 1]] - shapes.clump_leaf[shapes.clump_start[s]]
    near = Near(
        start, np.zeros((count, 2), np.int64), np.empty(total, np.int32), np.empty(total),
        np.full(count, -math.inf), np.full(count, -math.inf),
    )  # fmt: skip
    if count >= MANY:
        _near_many(shapes, world, motion, matrix, pairs, ways, reach, near)
    else:
        for p in range(count):
            _near(shapes, world, motion, matrix, pairs, ways, reach, near, p)
    return near


@njit(parallel=True, **FAST)
def _near_many(shapes, world, motion, matrix, pairs, ways, reach, near):
    for p in prange(len(pairs)):
        _near(shapes, world, motion, matrix, pairs, ways, reach, near, p)


@njit(**BARE)
def _near(shapes, world, motion, matrix, pairs, ways, reach, near, p):
    table, brick, sample = shapes.table, shapes.brick, shapes.sample
    a, b = pairs[p, 0], pairs[p, 1]
    most = ways[a] + ways[b] + reach
    if is_round(shapes.table, world.shape[a]) or is_round(shapes.table, world.shape[b]):
        # One query tells whether the ball around either may touch the other; 1 stands for yes.
        one = a if is_round(shapes.table, world.shape[a]) else b
        other = b if one == a else a
        w, c = map_between(motion.position, matrix, world.scale, world.com, one, other)
        k = world.scale[other]
        d = distance_alone(table, brick, sample, world.shape[other], mapped(w, c, (0.0, 0.0, 0.0)))
        s = world.shape[one]
        size = (shapes.table[s, SIZE] + shapes.table[s, SIZE + 1]) * world.scale[one]
        near.count[p, 0] = 1 if d * k - size <= most else 0
        return
    for side in range(2):
        one, other = pairs[p, side], pairs[p, 1 - side]
        s, t = world.shape[one], world.shape[other]
        w, c = map_between(motion.position, matrix, world.scale, world.com, one, other)
        k, own = world.scale[other], world.scale[one]
        at = near.start[p, side]
        for clump in range(shapes.clump_start[s], shapes.clump_start[s + 1]):
            d = distance_alone(table, brick, sample, t, mapped(w, c, get(shapes.clump_ball, clump)))
            if k * d - own * shapes.clump_ball[clump, 3] > most:
                continue
            for i in range(shapes.clump_leaf[clump], shapes.clump_leaf[clump + 1]):
                away = _beyond(shapes, t, w, c, k, own, i)
                if away <= most:
                    near.leaf[at], near.away[at] = i, away
                    at += 1
        near.count[p, side] = at - near.start[p, side]


class Scratch(NamedTuple):
    """Room for what is found of one pair, once for each of S shares: compiled code allocates slowly."""

    found: np.ndarray  # [S, FOUND, COLUMNS] new points
    every: np.ndarray  # [S, FOUND + POINTS, COLUMNS] with those that were known
    # depth, node, key, normal: [S, SIDE] and [S, SIDE, 3] of the nodes that are to become points
    depth: np.ndarray
    node: np.ndarray
    key: np.ndarray
    normal: np.ndarray
    # away, alike: [S, FOUND + POINTS] how far from those chosen a point is, and how many of these are of its kind
    away: np.ndarray
    alike: np.ndarray


@njit(**FAST)
def scratch_room():
    most = FOUND + POINTS
    return Scratch(
        np.empty((SHARES, FOUND, COLUMNS)), np.empty((SHARES, most, COLUMNS)), np.empty((SHARES, SIDE)),
        np.empty((SHARES, SIDE), np.int64), np.empty((SHARES, SIDE), np.int64), np.empty((SHARES, SIDE, 3)),
        np.empty((SHARES, most)), np.empty((SHARES, most), np.int64),
    )  # fmt: skip


@njit(**FAST)
def collide(shapes, world, motion, matrix, rules, manifolds, near, gone, scratch):
    """Bring all manifolds up to the present poses: old points moved along or dropped, new ones found and merged.

    `gone` [N] is how far any point of a body may have moved since `near` was made.
    """
    if len(near.start) >= MANY:
        _collide_many(shapes, world, motion, matrix, rules, manifolds, near, gone, scratch)
    else:
        for p in range(len(near.start)):
            _collide_pair(shapes, world, motion, matrix, rules, manifolds, near, gone, scratch, 0, p)


@njit(parallel=True, **FAST)
def _collide_many(shapes, world, motion, matrix, rules, manifolds, near, gone, scratch):
    for t in prange(SHARES):
        for p in range(t, len(near.start), SHARES):
            _collide_pair(shapes, world, motion, matrix, rules, manifolds, near, gone, scratch, t, p)


@njit(**BARE)
def _collide_pair(shapes, world, motion, matrix, rules, manifolds, near, gone, scratch, t, p):
    a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
    if near.count[p, 0] + near.count[p, 1] == 0:
        manifolds.count[p] = 0
        return
    if is_round(shapes.table, world.shape[a]) or is_round(shapes.table, world.shape[b]):
        _collide_round(shapes, world, motion, matrix, rules, manifolds, scratch, t, p)
        return
    known = _moved(shapes, world, motion, matrix, rules, manifolds, p, manifolds.count[p])
    manifolds.count[p] = known
    went = gone[a] + gone[b]
    if went - near.looked[p] < rules.still:
        return
    near.looked[p], near.away_all[p] = went, math.inf
    count, look = 0, rules.look + 2.0 * rules.margin + _nearer(world, motion, rules, a, b)
    for side in range(2):
        if _swallowed(shapes, world, motion, matrix, a, b, side, scratch.found, t):
            manifolds.count[p] = _merged(rules, manifolds.point, p, 0, scratch, t, 1, False)
            near.away_all[p] = -math.inf
            return
    for side in range(2):
        count = _nodes(shapes, world, motion, matrix, look, a, b, side, near, p, went, scratch, t, count)
    count = _first_to_touch(rules, scratch.found, t, count)
    manifolds.count[p] = _merged(rules, manifolds.point, p, known, scratch, t, count, False)


@njit(**BARE)
def _nearer(world, motion, rules, a, b):
    """How much farther than usual a pair looks for points: as far as any of its points may come nearer."""
    if rules.ahead == 0.0:
        return 0.0
    speed = norm(sub(get(motion.velocity, a), get(motion.velocity, b))) + norm(vector(rules.gravity)) * rules.ahead
    for body in (a, b):
        if world.radius[body] < math.inf:
            speed += norm(get(motion.angular, body)) * world.radius[body]
    return speed * rules.ahead


@njit(**BARE)
def _collide_round(shapes, world, motion, matrix, rules, manifolds, scratch, t, p):
    """The manifold of a pair with a sphere or a capsule."""
    a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
    first, second = shapes.table[world.shape[a], KIND], shapes.table[world.shape[b], KIND]
    one, other = is_round(shapes.table, world.shape[a]), is_round(shapes.table, world.shape[b])
    known, found, point = manifolds.count[p], scratch.found, manifolds.point
    reach = rules.reach + _nearer(world, motion, rules, a, b)
    count = _round(shapes, world, motion, matrix, reach, a, b, 0 if one else 1, found, t)
    if count == 1 and first == SPHERE and second == SPHERE:
        for x in range(COLUMNS):
            if known == 0 or x < PUSH or x >= KEY:
                point[p, 0, x] = found[t, 0, x]
        manifolds.count[p] = 1
        return
    if (one and other) or (first if one else second) != SPHERE:
        known = 0
    known = _moved(shapes, world, motion, matrix, rules, manifolds, p, known)
    if count + known > 0:
        known = _merged(rules, point, p, known, scratch, t, count, True)
    manifolds.count[p] = known


@njit(**BARE)
def _swallowed(shapes, world, motion, matrix, a, b, side, found, t):
    """Whether the centre of one body is inside both solids (that of a ring on a peg is not inside the ring).

    The nearest surface is then the wrong way out for the nodes beyond the other's middle. The pair has one contact
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
    _write(found, t, 0, side, (0.0, 0.0, 0.0), theirs, turn(matrix, other, n), k * d, 0)
    return True


@njit(**BARE)
def _moved(shapes, world, motion, matrix, rules, manifolds, p, count):
    """Old points at the present poses; those that have parted or slid too far are dropped."""
    a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
    point = manifolds.point
    kept = 0
    for k in range(count):
        n = (point[p, k, NORMAL], point[p, k, NORMAL + 1], point[p, k, NORMAL + 2])
        for side in range(2):
            # The point of a ball that is touched is where the normal says, however it has rolled.
            body = a if side == 0 else b
            if shapes.table[world.shape[body], KIND] == SPHERE:
                radius = shapes.table[world.shape[body], SIZE] * world.scale[body] * (-1.0 if side == 0 else 1.0)
                here = turn_back(matrix, body, scale(n, radius))
                for c in range(3):
                    point[p, k, 3 * side + c] = here[c] - world.com[body, c]
        first = turn(matrix, a, (point[p, k, 0], point[p, k, 1], point[p, k, 2]))
        second = turn(matrix, b, (point[p, k, 3], point[p, k, 4], point[p, k, 5]))
        offset = add(sub(get(motion.position, a), get(motion.position, b)), sub(first, second))
        gap = dot(offset, n)
        slid = along(offset, n, -gap)
        if gap > rules.reach or dot(slid, slid) > rules.reach * rules.reach:
            continue
        for c in range(COLUMNS):
            point[p, kept, c] = point[p, k, c]
        point[p, kept, GAP] = gap
        kept += 1
    return kept


@njit(**BARE)
def _nodes(shapes, world, motion, matrix, look, a, b, side, near, pair, went, scratch, t, count):
    """The deepest node of each near leaf of one body in the other's distances, refined; added to what is found."""
    if near.count[pair, side] == 0:
        return count
    table, brick, sample = shapes.table, shapes.brick, shapes.sample
    depth, node, keys, normal = scratch.depth, scratch.node, scratch.key, scratch.normal
    one, other = (a, b) if side == 0 else (b, a)
    r, s = world.shape[one], world.shape[other]
    w, c = map_between(motion.position, matrix, world.scale, world.com, one, other)
    k, own = world.scale[other], world.scale[one]
    stride = STRIDE * shapes.clump_ball[shapes.clump_start[r], 3]
    flat = table[s, KIND] == PLANE  # whose distance has one normal: no look from within
    slack = k * _too_far(table, s)
    kept = 0
    for at in range(near.start[pair, side], near.start[pair, side] + near.count[pair, side]):
        i = near.leaf[at]
        if near.away[at] - went <= look:
            near.away[at] = _beyond(shapes, s, w, c, k, own, i) + went
        near.away_all[pair] = min(near.away_all[pair], near.away[at])
        if near.away[at] - went > look:
            continue
        deepest, chosen, lowest = 0.0, -1, 1e300
        facing, d, off, there = (0.0, 0.0, 0.0), -math.inf, 0.0, get(shapes.node, shapes.leaf_node[i])
        for u in range(shapes.leaf_node[i], shapes.leaf_node[i + 1]):
            p, within = get(shapes.node, u), get(shapes.inward, u)
            if flat:
                d, n = k * (dot(w[2], p) + c[2]), (0.0, 0.0, 1.0)
            elif d - own * (norm(sub(p, there)) + 2.0 * (norm(within) + off)) > look + slack:
                continue  # too near to one that is far; a look from within is off by twice the way inwards at most
            else:
                d, n = _gap(table, brick, sample, s, w, c, p, within)
                there, off, d = p, norm(within), d * k
            score = d - OUTWARD * own * norm(p)
            if d <= look and score < lowest:
                deepest, chosen, lowest, facing = d, u, score, n
        if chosen < 0:
            continue
        patch, there = shapes.leaf_patch[i], patch_of(table, shapes.label, s, mapped(w, c, get(shapes.node, chosen)))
        key = patch * KEYS + there if side == 0 else there * KEYS + patch
        # Of those that are of the same two patches and face the same way the deepest, and of all.
        alike, place, worst = 0, -1, -1
        for e in range(kept):
            if keys[t, e] == key and dot(facing, (normal[t, e, 0], normal[t, e, 1], normal[t, e, 2])) > ALIKE:
                alike += 1
                if place < 0 or depth[t, e] > depth[t, place]:
                    place = e
            if worst < 0 or depth[t, e] > depth[t, worst]:
                worst = e
        if alike < EACH:
            place = kept if kept < SIDE else worst
        if place < kept and depth[t, place] <= deepest:
            continue
        kept = max(kept, place + 1)
        depth[t, place], node[t, place], keys[t, place] = deepest, chosen, key
        for x in range(3):
            normal[t, place, x] = facing[x]
    for e in range(kept):
        if count == FOUND:
            break
        u = node[t, e]
        p, d, n = _refined(table, brick, sample, stride, r, s, w, c, k, own, get(shapes.node, u), get(shapes.inward, u))
        if d > look:
            continue
        # p of shape `one` -> about its centre of mass; its foot on the other, likewise.
        mine = sub(scale(p, own), get(world.com, one))
        theirs = sub(along(scale(mapped(w, c, p), k), n, -d), get(world.com, other))
        _write(scratch.found, t, count, side, mine, theirs, turn(matrix, other, n), d, keys[t, e])
        count += 1
    return count


@njit(**BARE)
def _write(found, t, count, side, mine, theirs, normal, gap, key):
    """A new point, as found by the body that is first (0) or second (1) of its pair."""
    for x in range(3):
        found[t, count, (FIRST if side == 0 else SECOND) + x] = mine[x]
        found[t, count, (SECOND if side == 0 else FIRST) + x] = theirs[x]
        found[t, count, NORMAL + x] = normal[x] if side == 0 else -normal[x]
        found[t, count, DRAG + x] = 0.0
    found[t, count, PUSH] = 0.0
    found[t, count, GAP] = gap
    found[t, count, KEY] = key
    found[t, count, NOTE] = 0.0


@njit(**BARE)
def _gap(table, brick, sample, t, w, c, p, inward):
    """Distance of a node from shape t, and the normal there, as seen from a little within its own solid.

    On an edge of t its own distance has two normals, and the one that parts two stacked boxes is not always the
    nearer. From within, only the face that is met is near.
    """
    at, back = mapped(w, c, p), (dot(w[0], inward), dot(w[1], inward), dot(w[2], inward))
    if table[t, KIND] == GRID:
        most, long = NEAR * table[t, CELL], dot(back, back)
        if long > most * most:
            back = scale(back, most / math.sqrt(long))  # of a much larger body
    d, n = distance(table, brick, sample, t, add(at, back))
    return d - dot(back, n), n


@njit(**BARE)
def _refined(table, brick, sample, stride, s, t, w, c, k, own, p, inward):
    """From node p of shape s down the distance of t along the surface of s: place, distance, normal in t's axes."""
    d, n = _gap(table, brick, sample, t, w, c, p, inward)
    ratio = k / own
    least = stride * (FINEST / STRIDE)
    _, m = distance(table, brick, sample, s, p)
    for _ in range(ROUNDS):
        # The other's normal in own axes (w is a rotation times own / k), less its part across the own surface.
        g = (
            (w[0][0] * n[0] + w[1][0] * n[1] + w[2][0] * n[2]) * ratio,
            (w[0][1] * n[0] + w[1][1] * n[1] + w[2][1] * n[2]) * ratio,
            (w[0][2] * n[0] + w[1][2] * n[1] + w[2][2] * n[2]) * ratio,
        )
        g = along(g, m, -dot(g, m))
        slope = norm(g)
        if slope < 0.02:
            break
        better = False
        while stride > least:
            q = along(p, g, -stride / slope)
            own_d, m = distance(table, brick, sample, s, q)
            q = along(q, m, -own_d)
            there, normal = distance(table, brick, sample, t, mapped(w, c, q))
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
def _round(shapes, world, motion, matrix, reach, a, b, side, found, at):
    """A sphere or capsule against anything: the distance at its core, less its radius."""
    table, brick, sample = shapes.table, shapes.brick, shapes.sample
    one, other = (a, b) if side == 0 else (b, a)
    s, t = world.shape[one], world.shape[other]
    w, c = map_between(motion.position, matrix, world.scale, world.com, one, other)
    k, own = world.scale[other], world.scale[one]
    radius = shapes.table[s, SIZE]
    tried = 1
    half = 0.0
    heights = (0.0, 0.0, 0.0)
    if shapes.table[s, KIND] == CAPSULE:
        half = shapes.table[s, SIZE + 1]
        tried = 3
        between = half if shapes.table[t, KIND] == PLANE else _lowest(table, brick, sample, t, w, c, half)
        heights = (-half, half, between)
    count = 0
    for e in range(tried):
        if e == 2 and half - abs(heights[2]) < 0.05 * half:
            continue
        core = (0.0, 0.0, heights[e])
        d, n = distance(table, brick, sample, t, mapped(w, c, core))
        gap = k * d - own * radius
        if gap > reach:
            continue
        mine = turn_back(matrix, one, turn(matrix, other, scale(n, -own * radius)))
        mine = sub(add(scale(core, own), mine), get(world.com, one))
        theirs = sub(along(scale(mapped(w, c, core), k), n, -k * d), get(world.com, other))
        _write(found, at, count, side, mine, theirs, turn(matrix, other, n), gap, 0)
        count += 1
    return count


@njit(**BARE)
def nearest(shapes, shape, place, frame, scales, coms, pairs, near, p, went, least, enough, refresh):
    """The least distance of pair p with its two bodies at `place` and `frame`, of the nodes that were near; `least`
    where all are farther, and any that is less than `enough`. `went` is how much nearer two points may have come since
    `near` was made; whether the poses are those of the bodies, so that `near` may take up how far leaves are
    (`refresh`)."""
    table, brick, sample = shapes.table, shapes.brick, shapes.sample
    for side in range(2):
        s, t = shape[pairs[p, side]], shape[pairs[p, 1 - side]]
        w, c = map_between(place, frame, scales, coms, side, 1 - side)
        k = scales[1 - side]
        if is_round(table, s):
            half = table[s, SIZE + 1] if table[s, KIND] == CAPSULE else 0.0
            for e in range(-2, 3):
                d = distance_alone(table, brick, sample, t, mapped(w, c, (0.0, 0.0, 0.5 * e * half)))
                least = min(least, k * d - scales[side] * table[s, SIZE])
        elif near.count[p, side] > 0 and not is_round(table, t):
            first, last = near.start[p, side], near.start[p, side] + near.count[p, side]
            front = first
            if refresh:
                for i in range(first, last):
                    if near.away[i] - went < least:
                        near.away[i] = went + _beyond(shapes, t, w, c, k, scales[side], near.leaf[i])
                        front = i if near.away[i] < near.away[front] else front
            # The nearest leaf first: the others are then seldom near enough to be looked into.
            for n in range(first - 1, last):
                i = front if n < first else n
                if n == front or near.away[i] - went >= least:
                    continue
                e = near.leaf[i]
                if refresh or _beyond(shapes, t, w, c, k, scales[side], e) < least:
                    there, d, slack = get(shapes.node, shapes.leaf_node[e]), -math.inf, k * _too_far(table, t)
                    for u in range(shapes.leaf_node[e], shapes.leaf_node[e + 1]):
                        p_u = get(shapes.node, u)
                        if d - scales[side] * norm(sub(p_u, there)) - slack < least:  # else too near to one that is far
                            there, d = p_u, k * distance_alone(table, brick, sample, t, mapped(w, c, p_u))
                            least = min(least, d)
                    if least < enough:
                        return least
    return least


@njit(**BARE)
def _too_far(table, t):
    """By how much the distance of shape t may be more than the true one: between the corners of a grid's bricks."""
    return FARTHER * table[t, CELL] if table[t, KIND] == GRID else 0.0


@njit(**BARE)
def _beyond(shapes, t, w, c, k, own, e):
    """How far a leaf is from shape t at least."""
    d = distance_alone(shapes.table, shapes.brick, shapes.sample, t, mapped(w, c, get(shapes.leaf_ball, e)))
    return k * d - own * shapes.leaf_ball[e, 3]


@njit(**BARE)
def _lowest(table, brick, sample, t, w, c, half):
    """Where between -half and half of its axis a capsule is nearest to shape t: golden section."""
    low, high = -half, half
    one, other = high - 0.6180339887498949 * (high - low), low + 0.6180339887498949 * (high - low)
    f = distance_alone(table, brick, sample, t, mapped(w, c, (0.0, 0.0, one)))
    g = distance_alone(table, brick, sample, t, mapped(w, c, (0.0, 0.0, other)))
    for _ in range(30):
        if f <= g:
            high, other, g = other, one, f
            one = high - 0.6180339887498949 * (high - low)
            f = distance_alone(table, brick, sample, t, mapped(w, c, (0.0, 0.0, one)))
        else:
            low, one, f = one, other, g
            other = low + 0.6180339887498949 * (high - low)
            g = distance_alone(table, brick, sample, t, mapped(w, c, (0.0, 0.0, other)))
    return 0.5 * (low + high)


@njit(**BARE)
def _first_to_touch(rules, found, t, count):
    """Of points with one normal only the deepest are kept, and those that are as deep: what an impact meets first.

    The others follow in the next inner steps, when the impact has been answered.
    """
    for e in range(count):
        found[t, e, NOTE] = 0.0
        for f in range(count):
            alike = 0.0
            for x in range(3):
                alike += found[t, e, NORMAL + x] * found[t, f, NORMAL + x]
            deeper = found[t, f, GAP] < found[t, e, GAP] - rules.together
            if alike > ALIKE and deeper and found[t, e, KEY] == found[t, f, KEY]:
                found[t, e, NOTE] = 1.0
    kept = 0
    for e in range(count):
        if found[t, e, NOTE] == 0.0:
            for x in range(COLUMNS):
                found[t, kept, x] = found[t, e, x]
            kept += 1
    return kept


@njit(**BARE)
def _merged(rules, point, p, known, scratch, t, count, rounded):
    """Old and new points of a pair in one manifold, spread far; of points that nearly coincide the new ones.

    Returns how many there are.
    """
    found, every, away, alike = scratch.found, scratch.every, scratch.away, scratch.alike
    for e in range(count):
        for x in range(COLUMNS):
            every[t, e, x] = found[t, e, x]
    total = count
    same = rules.reach * rules.reach
    for k in range(known):
        twin = -1
        for e in range(count):
            turned = 0.0
            gone = 0.0
            for x in range(3):
                turned += point[p, k, NORMAL + x] * found[t, e, NORMAL + x]
                gone += (point[p, k, x] - found[t, e, x]) ** 2
            if (gone < same and turned > 0.8) or (rounded and turned > 0.99):
                twin = e
                break
        if twin < 0:
            for x in range(COLUMNS):
                every[t, total, x] = point[p, k, x]
            total += 1
        elif every[t, twin, PUSH] == 0.0:
            for x in range(PUSH, KEY):
                every[t, twin, x] = point[p, k, x]
    # The deepest first, then always the one that is farthest from those chosen.
    chosen, lowest = -1, 1e300
    for e in range(total):
        away[t, e], alike[t, e] = 1e300, 0
        score = every[t, e, GAP] - OUTWARD * norm((every[t, e, 0], every[t, e, 1], every[t, e, 2]))
        if score < lowest:
            chosen, lowest = e, score
    kept = 0
    while chosen >= 0 and kept < POINTS:
        for x in range(COLUMNS):
            point[p, kept, x] = every[t, chosen, x]
        kept += 1
        farthest, following = rules.apart * rules.apart, -1
        for e in range(total):
            gone = 0.0
            turned = 0.0
            for x in range(3):
                gone += (every[t, e, x] - every[t, chosen, x]) ** 2
                turned += (every[t, e, NORMAL + x] - every[t, chosen, NORMAL + x]) ** 2
            if turned < 0.02 and every[t, e, KEY] == every[t, chosen, KEY]:
                alike[t, e] += 1
            away[t, e] = min(away[t, e], gone + 0.01 * turned)
            if away[t, e] > farthest and alike[t, e] < EACH:
                farthest, following = away[t, e], e
        chosen = following
    return kept


@njit(**FAST)
def nodes_within(shapes, world, work, motion, rules, node, start):
    """Nodes that are within `rules.reach` of another body's surface, or will be by the end of the step as they go: the
    contact edges of the paper (section 3).

    Args:
        node: [M, 3] surface nodes about the centres of mass, in the bodies' axes.
        start: [N + 1] int64, body b owns nodes start[b] : start[b + 1].

    Returns:
        [E, 3] int64 the owner, its node and the other body; [E, 7] the distance, the other's outward normal there and
        the node seen from the other's centre of mass (world axes).
    """
    span = rules.inner * rules.steps
    for b in world.going:
        to_matrix(motion.orientation, b, work.matrix)
    swept(world, work, motion, rules, span)
    pairs = near_pairs(world, motion, work.low, work.high)
    index, value = np.empty((256, 3), np.int64), np.empty((256, 7))
    count = 0
    for p in range(len(pairs)):
        for side in range(2):
            one, other = pairs[p, side], pairs[p, 1 - side]
            fall = (1.0 if world.moves[one] else 0.0) - (1.0 if world.moves[other] else 0.0)
            w, c = map_between(motion.position, work.matrix, world.scale, world.com, one, other)
            own, k = 1.0 / world.scale[one], world.scale[other]
            apart = sub(get(motion.position, one), get(motion.position, other))
            speed = norm(sub(get(motion.velocity, one), get(motion.velocity, other)))
            speed += norm(vector(rules.gravity)) * span * abs(fall) + norm(get(motion.angular, one)) * world.radius[one]
            if norm(get(motion.angular, other)) > 0.0:
                speed += norm(get(motion.angular, other)) * world.radius[other]
            most = rules.reach + speed * span
            for u in range(start[one], start[one + 1]):
                place = mapped(w, c, scale(add(get(node, u), get(world.com, one)), own))
                seen = sub(scale(place, k), get(world.com, other))
                outside = False
                for x in range(3):
                    outside = outside or abs(seen[x] - world.centre[other, x]) > world.half[other, x] + most
                if outside and world.radius[other] < np.inf:
                    continue
                d, n = distance(shapes.table, shapes.brick, shapes.sample, world.shape[other], place)
                d *= k
                if d > most:
                    continue
                normal, arm = turn(work.matrix, other, n), turn(work.matrix, one, get(node, u))
                offset = add(apart, arm)
                velocity = add(get(motion.velocity, one), cross(get(motion.angular, one), arm))
                back = cross(get(motion.angular, other), along(offset, normal, -d))
                velocity = sub(velocity, add(get(motion.velocity, other), back))
                velocity = along(velocity, vector(rules.gravity), fall * span)
                if d + min(0.0, dot(velocity, normal)) * span > rules.reach:
                    continue
                if count == len(index):
                    more, room = np.empty((2 * count, 3), np.int64), np.empty((2 * count, 7))
                    more[:count], room[:count] = index, value
                    index, value = more, room
                index[count, 0], index[count, 1], index[count, 2] = one, u, other
                value[count, 0] = d
                for x in range(3):
                    value[count, 1 + x], value[count, 4 + x] = normal[x], offset[x]
                count += 1
    return index[:count], value[:count]
