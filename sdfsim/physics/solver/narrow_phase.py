"""Where bodies that are near each other touch, compiled.

There are three ways, depending on the two shapes. Solids that are convex, or made of convex pieces, collide as such
(`convex`). Round ones use the distance at their core. All others use points on the surface of each in the distance of
the other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from sdfsim.physics.solver.broad_phase import carried, near_pairs, swept
from sdfsim.physics.solver.clipping import CHOSEN, touching_points
from sdfsim.physics.solver.convex import BALL, Pair, closest, farthest, rounding, separation
from sdfsim.physics.solver.distance import (
    BOX,
    CAPSULE,
    CONE,
    GRID,
    KIND,
    PLANE,
    SIZE,
    SPHERE,
    TORUS,
    distance_alone,
)
from sdfsim.physics.solver.manifold import (
    FOUND,
    merged,
    moved,
    renewed,
    scratch_room,
    thinned,
    write,
)
from sdfsim.physics.solver.references import call, reference
from sdfsim.physics.solver.surface_distance import (
    BEADS,
    KEYS,
    at_least,
    beyond,
    core_point,
    core_radius,
    has_core,
    is_round,
    looked_at,
    map_between,
    mapped,
    nodes_near,
    round_points,
    swallowed,
)
from sdfsim.physics.solver.tolerances import ARM_PROBES, FACE_ARM, FLAT, MANY_PAIRS
from sdfsim.physics.solver.vectors import (
    BARE,
    FAST,
    INLINED,
    add,
    along,
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
from sdfsim.physics.solver.world import COLUMNS, FIRST, GAP, KEY, NORMAL, NORMAL_IMPULSE, SECOND, TORSION

SHARES = 16  # groups of pairs, each with its own scratch, that threads take in turn
SOLIDS, ROUND, SURFACES = range(3)  # the ways in which a pair is tested


class Parts(NamedTuple):
    """The near parts of the bodies of P pairs, each pair's in the room that all of its parts would need."""

    pair: np.ndarray  # [P, 2] the two bodies
    start: np.ndarray  # [P, 2] index of the first of each body's, see `Near`
    count: np.ndarray  # [P, 2]
    leaf: np.ndarray  # [L] int32
    away: np.ndarray  # [L]


class Near(NamedTuple):
    """The parts of the bodies of P pairs that may touch, until the next search for near bodies."""

    # start, count: [P, 2] index of the first near part, and their number: for solids, pairs of pieces (side 0); for
    # surfaces, leaves of nodes of each body
    start: np.ndarray
    count: np.ndarray
    leaf: np.ndarray  # [L] which
    away: np.ndarray  # [L] lower bound of its distance, from which the motion of both bodies since then is subtracted
    axis: np.ndarray  # [L, 3] the normal of a pair of pieces, from the second to the first; 0 if it is not known
    looked: np.ndarray  # [P] motion of both bodies when new points were last searched; -inf for never
    away_all: np.ndarray  # [P] the least of `away`; -inf if it is not known
    # For leaves: the deepest node when they were last searched, -1 for never; likewise a lower bound of the distance of
    # each of their nodes; and the point on the surface to which the descent from there led.
    deepest: np.ndarray  # [L] int32
    node_away: np.ndarray  # [L * largest number of nodes of a leaf]
    placed: np.ndarray  # [L] bool, whether it is known
    place: np.ndarray  # [L, 3] on the body's own surface, in its frame
    held: np.ndarray  # [L] bool, whether a pair of pieces has the normal of a support, see `internal_edges`
    acts: np.ndarray  # [L] bool, whether it touched at the start of the inner step in which its way was last followed
    following: np.ndarray  # [2 P] int64 for finding the contacts of a body


@njit(**FAST)
def find_near(shapes, world, work, motion, rules, span, old, pieces):
    """Pairs of bodies that may touch within `span` of time, and which of their parts are near.

    Sets in `work` how far each body may move until the next search, and which bodies have others near.

    Returns:
        The manifolds of these pairs, with the points of `old`, and those of sleeping bodies; and `Near`.
    """
    swept(world, work, motion, rules, span)
    pairs = near_pairs(world, motion, work.low, work.high)
    manifolds = carried(world, motion, pairs, old)
    near = near_parts(shapes, world, work, motion, rules, pairs, pieces)
    for p in range(len(pairs)):
        if near.count[p, 0] + near.count[p, 1] > 0:
            work.beside[pairs[p, 0]] = work.beside[pairs[p, 1]] = True
    return manifolds, near


@njit(**BARE)
def pair_kind(shapes, s, t):
    """The way in which two shapes are tested."""
    table, start = shapes.table, shapes.solids.start
    one, other = has_core(table, s), has_core(table, t)
    first, second = start[s + 1] > start[s], start[t + 1] > start[t]
    if one or other:
        if table[s, KIND] != GRID and table[t, KIND] != GRID:
            long = table[s, KIND] == CAPSULE or table[t, KIND] == CAPSULE
            # A line may lie along a face; else points on a core are enough.
            return SOLIDS if long and (BOX <= table[s, KIND] <= CONE or BOX <= table[t, KIND] <= CONE) else ROUND
        return SOLIDS if first and second else SURFACES
    return SOLIDS if (first or table[s, KIND] == PLANE) and (second or table[t, KIND] == PLANE) else SURFACES


@njit(**FAST, inline="always")
def near_parts(shapes, world, work, motion, rules, pairs, pieces):
    """The parts of P pairs that are nearer than the bodies may move."""
    count = len(pairs)
    start = np.zeros((count, 2), np.int64)
    total = 0
    for p in range(count):
        s, t = world.shape[pairs[p, 0]], world.shape[pairs[p, 1]]
        way = pair_kind(shapes, s, t)
        for side in range(2):
            start[p, side] = total
            own = s if side == 0 else t
            if way == SURFACES and not is_round(shapes.table, own):
                total += shapes.clump_leaf[shapes.clump_start[own + 1]] - shapes.clump_leaf[shapes.clump_start[own]]
            elif way == SOLIDS and side == 0:
                solids = shapes.solids.start
                total += (solids[s + 1] - solids[s]) * max(1, solids[t + 1] - solids[t])
            elif way == ROUND and side == 0:
                total += 1  # the body itself
    found = Parts(pairs, start, np.zeros((count, 2), np.int64), np.empty(total, np.int32), np.empty(total))
    call(pieces.near, (shapes, world, work, motion, rules, reference(found)))
    return _gathered(shapes, found)


@njit(**FAST)
def find_parts(shapes, world, work, motion, rules, parts, surfaces, threads):
    """Fill in the parts that are near. Returns the number of pairs."""
    matrix, pairs, ways, reach = work.matrix, parts.pair, work.motion_bound, rules.contact_margin
    many = False
    if threads is not None:  # known at compile time
        many = len(pairs) >= MANY_PAIRS
        if many:
            _near_many(shapes, world, motion, matrix, pairs, ways, reach, parts, surfaces)
    if not many:
        for p in range(len(pairs)):
            _near(shapes, world, motion, matrix, pairs, ways, reach, parts, p, surfaces)
    return len(pairs)


@njit(**FAST)
def _gathered(shapes, found):
    """Room for what is kept of the parts that are near, without gaps: most parts of most bodies are far."""
    count, wide = len(found.start), 0
    start, total = np.zeros((count, 2), np.int64), 0
    for p in range(count):
        for side in range(2):
            start[p, side] = total
            total += found.count[p, side]
    for leaf in range(len(shapes.leaf_node) - 1):
        wide = max(wide, shapes.leaf_node[leaf + 1] - shapes.leaf_node[leaf])
    leaf, away = np.empty(total, np.int32), np.empty(total)
    for p in range(count):
        for side in range(2):
            for i in range(found.count[p, side]):
                here, there = start[p, side] + i, found.start[p, side] + i
                leaf[here], away[here] = found.leaf[there], found.away[there]
    return Near(
        start, found.count, leaf, away, np.zeros((total, 3)), np.full(count, -math.inf), np.full(count, -math.inf),
        np.full(total, -1, np.int32), np.empty(total * wide), np.zeros(total, np.bool_), np.empty((total, 3)),
        np.zeros(total, np.bool_), np.zeros(total, np.bool_), np.zeros(2 * count, np.int64),
    )  # fmt: skip


@njit(parallel=True, **FAST)
def _near_many(shapes, world, motion, matrix, pairs, ways, reach, near, surfaces):
    for i in prange(len(pairs)):
        p = np.int64(i)  # the index of a parallel loop is unsigned, for which everything would be compiled again
        _near(shapes, world, motion, matrix, pairs, ways, reach, near, p, surfaces)


@njit(**BARE)
def _near(shapes, world, motion, matrix, pairs, ways, reach, near, p, surfaces):
    a, b = pairs[p, 0], pairs[p, 1]
    most = ways[a] + ways[b] + reach
    way = pair_kind(shapes, world.shape[a], world.shape[b])
    if way == SOLIDS:
        _near_pieces(shapes, world, motion, matrix, a, b, most, near, p)
        return
    if way == ROUND:
        # One query says whether the ball around either may touch the other; 1 means yes.
        one = a if has_core(shapes.table, world.shape[a]) else b
        other = b if one == a else a
        w, c = map_between(motion.position, matrix, world.scale, world.com, one, other)
        k = world.scale[other]
        d = distance_alone(shapes.table, shapes.brick, shapes.sample, world.shape[other], mapped(w, c, (0.0, 0.0, 0.0)))
        s = world.shape[one]
        size = (shapes.table[s, SIZE] + shapes.table[s, SIZE + 1]) * world.scale[one]
        near.count[p, 0] = 1 if d * k - size <= most else 0
        return
    if surfaces is not None:
        _near_leaves(shapes, world, motion, matrix, pairs, most, near, p)


@njit(**BARE)
def _near_leaves(shapes, world, motion, matrix, pairs, most, near, p):
    """The leaves of each surface that are near the other body."""
    table, brick, sample = shapes.table, shapes.brick, shapes.sample
    for side in range(2):
        one, other = pairs[p, side], pairs[p, 1 - side]
        s, t = world.shape[one], world.shape[other]
        if is_round(table, s):
            continue  # the other body's own distance is exact, so points of this body are not needed
        w, c = map_between(motion.position, matrix, world.scale, world.com, one, other)
        k, own = world.scale[other], world.scale[one]
        at = near.start[p, side]
        for clump in range(shapes.clump_start[s], shapes.clump_start[s + 1]):
            d = distance_alone(table, brick, sample, t, mapped(w, c, get(shapes.clump_ball, clump)))
            if k * at_least(table, t, d) - own * shapes.clump_ball[clump, 3] > most:
                continue
            for i in range(shapes.clump_leaf[clump], shapes.clump_leaf[clump + 1]):
                away = beyond(shapes, t, w, c, k, own, i)
                if away <= most:
                    near.leaf[at], near.away[at] = i, away
                    at += 1
        near.count[p, side] = at - near.start[p, side]


@njit(**BARE)
def origin(position, matrix, coms, body):
    """The origin of a body's shape."""
    return sub(get(position, body), turn(matrix, body, get(coms, body)))


@njit(**BARE)
def _near_pieces(shapes, world, motion, matrix, a, b, most, near, p):
    """The pairs of convex pieces whose balls are near each other."""
    convex = shapes.solids
    s, t = world.shape[a], world.shape[b]
    offset = sub(origin(motion.position, matrix, world.com, a), origin(motion.position, matrix, world.com, b))
    plane, up = shapes.table[t, KIND] == PLANE, turn(matrix, b, (0.0, 0.0, 1.0))
    at, pieces = near.start[p, 0], convex.start[t + 1] - convex.start[t]
    whole = add(get(motion.position, b), turn(matrix, b, get(world.centre, b)))
    whole = sub(whole, origin(motion.position, matrix, world.com, b))
    for i in range(convex.start[s], convex.start[s + 1]):
        ball = (convex.table[i, BALL], convex.table[i, BALL + 1], convex.table[i, BALL + 2])
        middle = add(offset, turn(matrix, a, scale(ball, world.scale[a])))
        radius = world.scale[a] * convex.table[i, BALL + 3]
        first = i - convex.start[s]
        if plane:
            away = dot(up, middle) - radius
            if away <= most:
                near.leaf[at], near.away[at] = first, away
                at += 1
            continue
        if norm(sub(middle, whole)) - radius - norm(get(world.half, b)) > most:
            continue
        for j in range(convex.start[t], convex.start[t + 1]):
            ball = (convex.table[j, BALL], convex.table[j, BALL + 1], convex.table[j, BALL + 2])
            there = turn(matrix, b, scale(ball, world.scale[b]))
            away = norm(sub(middle, there)) - radius - world.scale[b] * convex.table[j, BALL + 3]
            if away <= most:
                near.leaf[at], near.away[at] = first * pieces + j - convex.start[t], away
                at += 1
    near.count[p, 0] = at - near.start[p, 0]


@njit(**BARE, inline="always")
def narrow_phase(shapes, world, work, motion, rules, manifolds, near, surfaces, threads):
    """Update all manifolds to the present poses: move or drop old points, and find new ones."""
    matrix, gone, scratch = work.matrix, work.moved, work.scratch
    if threads is not None:  # known at compile time
        if len(near.start) >= MANY_PAIRS:
            _collide_many(shapes, world, motion, matrix, rules, manifolds, near, gone, surfaces)
            return
    _collide_some(
        shapes, world, motion, matrix, rules, manifolds, near, gone, scratch, np.int64(0), np.int64(1), surfaces
    )


@njit(parallel=True, **FAST)
def _collide_many(shapes, world, motion, matrix, rules, manifolds, near, gone, surfaces):
    for i in prange(SHARES):
        _collide_share(
            shapes, world, motion, matrix, rules, manifolds, near, gone, scratch_room(), np.int64(i), surfaces
        )


@njit(**BARE)
def _collide_share(shapes, world, motion, matrix, rules, manifolds, near, gone, scratch, first, surfaces):
    room = reference(scratch)
    _collide_some(shapes, world, motion, matrix, rules, manifolds, near, gone, room, first, np.int64(SHARES), surfaces)


@njit(**BARE)
def _collide_some(shapes, world, motion, matrix, rules, manifolds, near, gone, scratch, first, step, surfaces):
    """Every `step`-th pair, starting with `first`."""
    for p in range(first, len(near.start), step):
        _collide_pair(shapes, world, motion, matrix, rules, manifolds, near, gone, scratch, p, surfaces)


@njit(**BARE, inline="always")
def _collide_pair(shapes, world, motion, matrix, rules, manifolds, near, gone, scratch, p, surfaces):
    a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
    if near.count[p, 0] + near.count[p, 1] == 0:
        manifolds.count[p] = 0
        return
    way = pair_kind(shapes, world.shape[a], world.shape[b])
    if way == ROUND:
        _collide_round(shapes, world, motion, matrix, rules, manifolds, scratch, p)
        return
    went = gone[a] + gone[b]
    if went - near.looked[p] < rules.still:
        manifolds.count[p] = moved(shapes, world, motion, matrix, rules, manifolds, p, manifolds.count[p])
        return
    since, first = went - near.looked[p], near.looked[p] == -math.inf
    near.looked[p], near.away_all[p] = went, math.inf
    if way == SOLIDS:
        known = manifolds.count[p]
        for at in range(near.start[p, 0], near.start[p, 0] + near.count[p, 0]):
            near.held[at] = False
        count = collide_solids(shapes, world, motion, matrix, rules, manifolds, near, went, scratch, p)
        manifolds.count[p] = renewed(rules, manifolds.point, p, known, scratch, count)
        return
    if surfaces is not None:
        _collide_surfaces(shapes, world, motion, matrix, rules, manifolds, near, went, since, first, scratch, p)


@njit(**BARE)
def _collide_surfaces(shapes, world, motion, matrix, rules, manifolds, near, went, since, first, scratch, p):
    """The manifold of a pair of which at least one is neither convex nor made of convex pieces."""
    a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
    known = moved(shapes, world, motion, matrix, rules, manifolds, p, manifolds.count[p])
    s, t = world.shape[a], world.shape[b]
    sharp = shapes.triangles.level[s] >= 0 or shapes.triangles.level[t] >= 0
    if sharp:
        known = looked_at(shapes, world, motion, matrix, rules, manifolds, p, known, False)
    manifolds.count[p] = known
    # Numbers of one type, or everything would be compiled again.
    none, one = np.int64(0), np.int64(1)
    count, look = none, rules.search_margin + _approach_margin(world, motion, rules, a, b)
    for side in range(2):
        if swallowed(shapes, world, motion, matrix, a, b, side, scratch.found):
            manifolds.count[p] = merged(rules, manifolds.point, p, none, scratch, one, none > one)
            near.away_all[p] = -math.inf
            return
    for side in range(2):
        count = nodes_near(shapes, world, motion, matrix, look, a, b, side, near, p, went, since, scratch, count)
    manifolds.count[p] = merged(rules, manifolds.point, p, known, scratch, count, none > one)
    if sharp:
        manifolds.count[p] = looked_at(shapes, world, motion, matrix, rules, manifolds, p, manifolds.count[p], True)
    _torsion_arms(shapes, world, motion, matrix, rules, manifolds, p, first)


@njit(**INLINED)
def _torsion_arms(shapes, world, motion, matrix, rules, manifolds, p, anew):
    """Where friction acts for the points that bound a flat manifold, as a part of the way from its middle to each
    point: the mean of the places that touch on this way. This distinguishes a full face, legs and a rim. Unless `anew`,
    only for new points."""
    a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
    point, count = manifolds.point[p], manifolds.count[p]
    middle, flat = (0.0, 0.0, 0.0), count >= 3
    for k in range(count):
        alike = 0.0
        for x in range(3):
            alike += point[k, NORMAL + x] * point[0, NORMAL + x]
        flat = flat and alike > FLAT and point[k, KEY] == point[0, KEY]
        middle = along(middle, _half_way(motion, matrix, point, a, b, k), 1.0 / count)
    known = flat and not anew
    for k in range(count):
        if not flat or anew:
            point[k, TORSION] = 1.0
        known = known and point[k, TORSION] < 1.0
    if not flat or known:
        return
    full = _both_touch(shapes, world, motion, matrix, rules, a, b, middle)
    for k in range(count):
        if point[k, TORSION] < 1.0:
            continue
        if full:
            point[k, TORSION] = FACE_ARM
            continue
        way = sub(_half_way(motion, matrix, point, a, b, k), middle)
        total = weights = 0.0
        for e in range(ARM_PROBES):
            t = (e + 0.5) / ARM_PROBES
            if _both_touch(shapes, world, motion, matrix, rules, a, b, along(middle, way, t)):
                total, weights = total + t * t, weights + t
        point[k, TORSION] = total / weights if weights > 0.0 else 1.0


@njit(**BARE)
def _half_way(motion, matrix, point, a, b, k):
    """The point half way between the two surfaces at a contact; it does not depend on the order of the bodies."""
    mine = add(get(motion.position, a), turn(matrix, a, (point[k, FIRST], point[k, FIRST + 1], point[k, FIRST + 2])))
    other = (point[k, SECOND], point[k, SECOND + 1], point[k, SECOND + 2])
    return scale(add(add(mine, get(motion.position, b)), turn(matrix, b, other)), 0.5)


@njit(**BARE)
def _both_touch(shapes, world, motion, matrix, rules, a, b, place):
    """Whether a point is on the surfaces of both bodies."""
    for body in (a, b):
        here = turn_back(matrix, body, sub(place, get(motion.position, body)))
        here = scale(add(here, get(world.com, body)), 1.0 / world.scale[body])
        d = distance_alone(shapes.table, shapes.brick, shapes.sample, world.shape[body], here)
        if abs(d) * world.scale[body] > rules.search_margin:
            return False
    return True


@njit(**BARE)
def _approach_margin(world, motion, rules, a, b):
    """How much farther than usual points of a pair are searched: as far as any of its points may come nearer."""
    if rules.ahead == 0.0:
        return 0.0
    speed = (
        norm(sub(get(motion.velocity, a), get(motion.velocity, b))) + norm(vector(rules.options.gravity)) * rules.ahead
    )
    for body in (a, b):
        if world.radius[body] < math.inf:
            speed += norm(get(motion.angular, body)) * world.radius[body]
    return speed * rules.ahead


@njit(**BARE)
def collide_solids(shapes, world, motion, matrix, rules, manifolds, near, went, scratch, p):
    """Find the points at which the convex pieces of two bodies touch or may soon touch. Returns their number."""
    convex, found, polygons = shapes.solids, scratch.found, scratch.polygons
    a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
    s, t = world.shape[a], world.shape[b]
    offset = sub(origin(motion.position, matrix, world.com, a), origin(motion.position, matrix, world.com, b))
    look = rules.contact_margin + _approach_margin(world, motion, rules, a, b)
    plane, pieces = shapes.table[t, KIND] == PLANE, max(1, convex.start[t + 1] - convex.start[t])
    up, count = turn(matrix, b, (0.0, 0.0, 1.0)), 0
    for at in range(near.start[p, 0], near.start[p, 0] + near.count[p, 0]):
        if near.away[at] - went <= look:
            i, j = near.leaf[at] // pieces, near.leaf[at] % pieces
            key = i * KEYS + j
            pair = Pair(convex.start[s] + i, convex.start[t] + j, a, b, world.scale[a], world.scale[b], offset)
            own = his = (0.0, 0.0, 0.0)
            if plane:
                gap, n = _above(convex, matrix, pair, up), up
            elif near.held[at]:
                n = get(near.axis, at)
                gap = separation(convex, matrix, pair, n)
                gap -= pair.size * rounding(convex, pair.first) + pair.other * rounding(convex, pair.second)
            else:
                known, n = _known_normal(near, at, manifolds, p, key)
                gap, n, own, his = closest(convex, matrix, pair, n, known, look, scratch.simplex)
                put(near.axis, at, n)
            near.away[at] = gap + went
            if gap <= look:
                if count + CHOSEN > FOUND:
                    count = thinned(rules, scratch, count)
                picked, arm = touching_points(
                    convex, matrix, pair, plane, near.held[at], gap, n, own, his, look, polygons
                )
                count = _write_points(world, matrix, pair, n, picked, arm, key, polygons, found, count)
        near.away_all[p] = min(near.away_all[p], near.away[at])
    return count


@njit(**BARE)
def _lowest_point(convex, matrix, pair, up):
    """The lowest point of a piece along the normal of a plane."""
    low = farthest(convex, pair.first, pair.size, matrix, pair.a, scale(up, -1.0))
    return along(add(pair.offset, low), up, -pair.size * rounding(convex, pair.first))


@njit(**BARE)
def _above(convex, matrix, pair, up):
    """Height of the lowest point of a piece above a plane."""
    return dot(up, _lowest_point(convex, matrix, pair, up))


@njit(**BARE)
def _known_normal(near, at, manifolds, p, key):
    """Whether a normal of a pair of pieces is known, and the normal: from the last test, or from a contact."""
    n = get(near.axis, at)
    if n[0] != 0.0 or n[1] != 0.0 or n[2] != 0.0:
        return True, n
    for k in range(manifolds.count[p]):
        if manifolds.point[p, k, KEY] == key:
            point = manifolds.point[p, k]
            return True, (point[NORMAL], point[NORMAL + 1], point[NORMAL + 2])
    return False, n


@njit(**BARE)
def _write_points(world, matrix, pair, n, picked, arm, key, polygons, found, count):
    """Write the picked corners of a contact as points of a manifold."""
    a, b = pair.a, pair.b
    for k in range(picked):
        corner = polygons.picked[k]
        mine = get(polygons.clipped, corner)
        theirs = along(mine, n, -polygons.gap[corner])
        first = sub(turn_back(matrix, a, sub(mine, pair.offset)), get(world.com, a))
        second = sub(turn_back(matrix, b, theirs), get(world.com, b))
        write(found, count, 0, first, second, n, polygons.gap[corner], key)
        found[count, TORSION] = arm
        count += 1
    return count


@njit(**INLINED)
def _collide_round(shapes, world, motion, matrix, rules, manifolds, scratch, p):
    """The manifold of a pair with a sphere, a capsule or a torus."""
    a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
    first, second = shapes.table[world.shape[a], KIND], shapes.table[world.shape[b], KIND]
    one, other = has_core(shapes.table, world.shape[a]), has_core(shapes.table, world.shape[b])
    known, found, point = manifolds.count[p], scratch.found, manifolds.point
    reach = rules.contact_margin + _approach_margin(world, motion, rules, a, b)
    if first == TORUS or second == TORUS:
        side = 0 if first == TORUS else 1
        count = round_points(shapes, world, motion, matrix, reach, a, b, side, found)
        manifolds.count[p] = renewed(rules, point, p, known, scratch, count)
        return
    count = round_points(shapes, world, motion, matrix, reach, a, b, 0 if one else 1, found)
    if count == 1 and first == SPHERE and second == SPHERE:
        if known == 0:
            _as_they_meet(world, motion, matrix, rules, a, b, found)
        for x in range(COLUMNS):
            if known == 0 or x < NORMAL_IMPULSE or x >= KEY:
                point[p, 0, x] = found[0, x]
        manifolds.count[p] = 1
        return
    if (one and other) or (first if one else second) != SPHERE:
        known = 0
    known = moved(shapes, world, motion, matrix, rules, manifolds, p, known)
    if count + known > 0:
        known = merged(rules, point, p, known, scratch, count, one or other)
    manifolds.count[p] = known


@njit(**BARE)
def _as_they_meet(world, motion, matrix, rules, a, b, found):
    """Turn the normal of two balls that hit each other to where they touch first, before or after the present poses:
    in an inner step they may move by a large part of their radius."""
    n, h = three(found[0], NORMAL), rules.substep_dt
    speed = sub(get(motion.velocity, a), get(motion.velocity, b))
    away, other = turn(matrix, a, three(found[0], FIRST)), turn(matrix, b, three(found[0], SECOND))
    centres = sub(along(other, n, found[0, GAP]), away)  # from the second to the first
    reach, square, closing = norm(centres) - found[0, GAP], dot(speed, speed), dot(centres, speed)
    root = closing * closing - square * (dot(centres, centres) - reach * reach)
    if -dot(speed, n) <= rules.slow or root <= 0.0:
        return
    span = (-closing - math.sqrt(root)) / square
    if abs(span) > h:
        return
    m = scale(along(centres, speed, span), 1.0 / reach)
    mine = add(get(world.com, a), three(found[0], FIRST))
    theirs = add(get(world.com, b), three(found[0], SECOND))
    mine = sub(turn_back(matrix, a, scale(m, -norm(mine))), get(world.com, a))
    theirs = sub(turn_back(matrix, b, scale(m, norm(theirs))), get(world.com, b))
    write(found, 0, 0, mine, theirs, m, dot(centres, m) - reach, found[0, KEY])


@njit(**BARE)
def nearest(shapes, shape, place, frame, scales, coms, pairs, near, p, went, least, enough, refresh, room, surfaces):
    """The least distance of pair p, over the parts that were near, with its two bodies at `place` and `frame`; `least`
    if all are farther, and possibly any distance below `enough`. Parts that touch at the start of an inner step are
    left out: their contacts act. `went` is how much nearer two points may have come since `near` was made. `refresh`:
    whether these are the poses at that start, so that distances may be stored in `near`."""
    table, brick, sample, convex = shapes.table, shapes.brick, shapes.sample, shapes.solids
    s, t = shape[pairs[p, 0]], shape[pairs[p, 1]]
    way = pair_kind(shapes, s, t)
    if way == SOLIDS:
        offset = sub(origin(place, frame, coms, 0), origin(place, frame, coms, 1))
        plane, pieces = table[t, KIND] == PLANE, max(1, convex.start[t + 1] - convex.start[t])
        for at in range(near.start[p, 0], near.start[p, 0] + near.count[p, 0]):
            if refresh:
                near.acts[at] = False
            if near.away[at] - went >= least or near.held[at] or near.acts[at]:
                continue
            i, j = near.leaf[at] // pieces, near.leaf[at] % pieces
            # Numbers of one type, or everything would be compiled again.
            one, other = np.int64(0), np.int64(1)
            pair = Pair(convex.start[s] + i, convex.start[t] + j, one, other, scales[0], scales[1], offset)
            if plane:
                gap = _above(convex, frame, pair, turn(frame, 1, (0.0, 0.0, 1.0)))
            else:
                n = get(near.axis, at)
                known = n[0] != 0.0 or n[1] != 0.0 or n[2] != 0.0
                gap, n, _, _ = closest(convex, frame, pair, n, known, least, room)
                put(near.axis, at, n)
            if refresh:
                near.away[at], near.acts[at] = gap + went, gap <= 0.0
                if near.acts[at]:
                    continue
            least = min(least, gap)
            if least < enough:
                return least
        return least
    for side in range(2):
        s, t = shape[pairs[p, side]], shape[pairs[p, 1 - side]]
        if has_core(table, s) and way == ROUND:
            w, c = map_between(place, frame, scales, coms, side, 1 - side)
            more = 0 if table[s, KIND] == SPHERE else (BEADS if table[s, KIND] == TORUS else 4)
            for e in range(more + 1):
                at = core_point(table, s, 2.0 * e / max(more, 1) - 1.0)
                d = distance_alone(table, brick, sample, t, mapped(w, c, at))
                least = min(least, scales[1 - side] * d - scales[side] * core_radius(table, s))
            if refresh and least <= 0.0:
                return math.inf
        elif surfaces is not None:
            if way == SURFACES and near.count[p, side] > 0 and not is_round(table, s):
                least = _nearest_node(
                    shapes, s, t, place, frame, scales, coms, side, near, p, went, least, enough, refresh
                )
                if least < enough:
                    return least
    return least


@njit(**BARE)
def _nearest_node(shapes, s, t, place, frame, scales, coms, side, near, p, went, least, enough, refresh):
    """`nearest` for the nodes of one body's near leaves and the other body."""
    table, brick, sample = shapes.table, shapes.brick, shapes.sample
    w, c = map_between(place, frame, scales, coms, side, 1 - side)
    k = scales[1 - side]
    first, last = near.start[p, side], near.start[p, side] + near.count[p, side]
    front = first
    if refresh:
        for i in range(first, last):
            if near.away[i] - went < least:
                near.acts[i] = False
                near.away[i] = went + beyond(shapes, t, w, c, k, scales[side], near.leaf[i])
                front = i if near.away[i] < near.away[front] else front
    # The nearest leaf first: the others are then seldom near enough to be searched.
    for n in range(first - 1, last):
        i = front if n < first else n
        if n == front or near.away[i] - went >= least or near.acts[i]:
            continue
        e = near.leaf[i]
        if refresh or beyond(shapes, t, w, c, k, scales[side], e) < least:
            there, d, nearest_here = get(shapes.node, shapes.leaf_node[e]), -math.inf, least
            for u in range(shapes.leaf_node[e], shapes.leaf_node[e + 1]):
                p_u = get(shapes.node, u)
                if d - scales[side] * norm(sub(p_u, there)) < nearest_here:  # else it is too near to a far node
                    d = distance_alone(table, brick, sample, t, mapped(w, c, p_u))
                    nearest_here, there, d = min(nearest_here, k * d), p_u, k * at_least(table, t, d)
            if refresh and nearest_here <= 0.0:
                near.acts[i] = True
                continue
            least = nearest_here
            if least < enough:
                return least
    return least
