"""Internal edges of a surface that consists of several bodies or pieces, compiled: bodies must not catch on them.

A body that slides over a floor of tiles may hit the side of the next tile if it has sunk in slightly, or if its gap to
the next edge closes, however far that edge is. But what is completely below the plane on which a body stands is no wall
for what is above that plane: it can only support along the plane's normal, so such contacts get this normal. (Jolt and
Box3D remove such edges by their position in a mesh; here tiles may be separate bodies.)
"""

from __future__ import annotations

from numba import njit

from sdfsim.physics.solver.convex import farthest, rounding
from sdfsim.physics.solver.distance import KIND, PLANE
from sdfsim.physics.solver.manifold import renewed
from sdfsim.physics.solver.narrow_phase import SOLIDS, collide_solids, origin, pair_kind
from sdfsim.physics.solver.surface_distance import KEYS
from sdfsim.physics.solver.tolerances import AROUND, ASLANT, FACING, LEVEL
from sdfsim.physics.solver.triangles import highest
from sdfsim.physics.solver.vectors import BARE, add, dot, get, put, scale, three, turn, turn_back
from sdfsim.physics.solver.world import FIRST, GAP, KEY, NORMAL, SECOND, VOID

OPEN = -1.0  # in place of 0 or 1: whether a contact is void is not known yet


@njit(**BARE, inline="always")
def heed_supports(shapes, world, work, motion, rules, manifolds, near, scratch):
    """Give contacts with bodies that are below the plane of a support the support's normal, or void them."""
    latest, following = work.latest, near.following
    pairs = len(near.start)
    several = False
    for p in range(pairs):
        for side in range(2):
            latest[manifolds.pair[p, side]] = -1
    for p in range(pairs):
        if manifolds.count[p] > 0:
            for side in range(2):
                body = manifolds.pair[p, side]
                following[2 * p + side] = latest[body]
                if not world.moves[body]:
                    continue  # a body that does not move needs no support
                several = several or latest[body] >= 0
                other = world.shape[manifolds.pair[p, 1 - side]]
                sharp = shapes.triangles.level[other] >= 0
                for k in range(1, manifolds.count[p]):
                    several = several or sharp or manifolds.point[p, k, KEY] != manifolds.point[p, 0, KEY]
                latest[body] = 2 * p + side
    if not several:
        return
    for p in range(pairs):
        if manifolds.count[p] > 0:
            _heed(shapes, world, work, motion, rules, manifolds, near, scratch, p)


@njit(**BARE, inline="always")
def _heed(shapes, world, work, motion, rules, manifolds, near, scratch, p):
    a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
    s, t = world.shape[a], world.shape[b]
    pieces = max(1, shapes.solids.start[t + 1] - shapes.solids.start[t])
    if pair_kind(shapes, s, t) != SOLIDS:
        for k in range(manifolds.count[p]):
            manifolds.point[p, k, VOID] = OPEN
        # The deepest contact last: of two that would void each other it stays.
        for _ in range(manifolds.count[p]):
            last = -1
            for k in range(manifolds.count[p]):
                if manifolds.point[p, k, VOID] == OPEN and (
                    last < 0 or manifolds.point[p, k, GAP] > manifolds.point[p, last, GAP]
                ):
                    last = k
            manifolds.point[p, last, VOID] = 0.0
            for side in range(2):
                if not world.moves[manifolds.pair[p, side]] or manifolds.point[p, last, GAP] < -LEVEL * rules.slop:
                    continue
                found, _ = _support(shapes, world, work, motion, rules, manifolds, near, p, last, side)
                if found:
                    manifolds.point[p, last, VOID] = 1.0
        return
    if shapes.table[t, KIND] == PLANE:
        return
    again = False
    for at in range(near.start[p, 0], near.start[p, 0] + near.count[p, 0]):
        if near.held[at]:
            continue
        i, j = near.leaf[at] // pieces, near.leaf[at] % pieces
        for k in range(manifolds.count[p]):
            if manifolds.point[p, k, KEY] == i * KEYS + j:
                for side in range(2):
                    if not world.moves[manifolds.pair[p, side]]:
                        continue
                    found, n = _support(shapes, world, work, motion, rules, manifolds, near, p, k, side)
                    if found:
                        near.held[at] = again = True
                        put(near.axis, at, n if side == 0 else scale(n, -1.0))
                        break
                break
    if again:
        went = work.moved[a] + work.moved[b]
        count = collide_solids(shapes, world, motion, work.matrix, rules, manifolds, near, went, scratch, p)
        manifolds.count[p] = renewed(rules, manifolds.point, p, manifolds.count[p], scratch, count)


@njit(**BARE)
def _support(shapes, world, work, motion, rules, manifolds, near, p, k, side):
    """Whether the first (side 0) or second (1) body of pair p stands on something with another normal, its part at
    point k is above that plane, and everything that it meets there is below it; and this normal, towards the body."""
    body, other = manifolds.pair[p, side], manifolds.pair[p, 1 - side]
    n = _normal(manifolds, p, k, side)
    s, t = world.shape[body], world.shape[other]
    solids = pair_kind(shapes, s, t) == SOLIDS
    if shapes.solids.start[t + 1] == shapes.solids.start[t] and shapes.triangles.level[t] < 0:
        return False, n  # its extent is not known
    key = manifolds.point[p, k, KEY]
    link = work.latest[body]
    while link >= 0:
        q, own = link // 2, link % 2
        link = near.following[link]
        for e in range(manifolds.count[q]):
            if q == p and solids and manifolds.point[q, e, KEY] == key:
                continue
            m = _normal(manifolds, q, e, own)
            facing = dot(n, m)
            # What supports nothing itself is no support: else contacts void each other, and bodies fall through.
            void = manifolds.point[q, e, VOID] > 0.0
            if void or facing > ASLANT or facing < FACING or manifolds.point[q, e, GAP] > rules.slop:
                continue
            # The plane of the support, and how far the other body's piece extends above it.
            ground = manifolds.pair[q, 1 - own]
            column = SECOND if own == 0 else FIRST
            foot = turn(
                work.matrix, ground,
                (
                    manifolds.point[q, e, column], manifolds.point[q, e, column + 1],
                    manifolds.point[q, e, column + 2],
                ),
            )  # fmt: skip
            foot = add(get(motion.position, ground), foot)
            height = dot(m, foot) + LEVEL * rules.slop
            bottom = _lowest(shapes, world, work, motion, manifolds, p, k, side, m)
            if dot(m, foot) + min(manifolds.point[q, e, GAP], 0.0) - bottom > LEVEL * rules.slop:
                continue  # for what is below the plane as well, it is a wall
            if shapes.triangles.level[t] < 0:
                if _reach(shapes, world, work, motion, other, key, side, m) > height:
                    continue
            elif _over(shapes, world, work, motion, rules, manifolds, p, k, side, m, height):
                continue
            return True, m
    return False, n


@njit(**BARE)
def _normal(manifolds, p, k, side):
    """The normal of a contact towards the first (side 0) or second (1) of its bodies."""
    sign, point = 1.0 if side == 0 else -1.0, manifolds.point[p, k]
    return sign * point[NORMAL], sign * point[NORMAL + 1], sign * point[NORMAL + 2]


@njit(**BARE)
def _lowest(shapes, world, work, motion, manifolds, p, k, side, m):
    """The least height along m of what touches at a contact of the first (side 0) or second (1) body: its piece, or
    the point itself if bodies are not tested by their pieces."""
    body, other, point = manifolds.pair[p, side], manifolds.pair[p, 1 - side], manifolds.point[p, k]
    if pair_kind(shapes, world.shape[body], world.shape[other]) == SOLIDS:
        return -_reach(shapes, world, work, motion, body, point[KEY], 1 - side, scale(m, -1.0))
    column = FIRST if side == 0 else SECOND
    place = turn(work.matrix, body, (point[column], point[column + 1], point[column + 2]))
    return dot(m, add(get(motion.position, body), place))


@njit(**BARE)
def _over(shapes, world, work, motion, rules, manifolds, p, k, side, m, height):
    """Whether triangles of the other body around a contact extend along m beyond a height."""
    other, column = manifolds.pair[p, 1 - side], SECOND if side == 0 else FIRST
    size, place = world.scale[other], three(manifolds.point[p, k], column)
    up = turn_back(work.matrix, other, m)
    height -= dot(m, origin(motion.position, work.matrix, world.com, other))
    place = add(place, get(world.com, other))
    if dot(up, place) > height:  # the contact itself is on the surface
        return True
    around = AROUND * rules.slop / size
    return size * highest(shapes.triangles, world.shape[other], scale(place, 1.0 / size), up, around) > height


@njit(**BARE)
def _reach(shapes, world, work, motion, body, key, side, m):
    """How far the piece of a body to which a contact belongs extends along m."""
    s, convex = world.shape[body], shapes.solids
    pieces = convex.start[s + 1] - convex.start[s]
    number = int(key) % KEYS if side == 0 else int(key) // KEYS
    piece = convex.start[s] + min(number, pieces - 1)
    place = add(
        origin(motion.position, work.matrix, world.com, body),
        farthest(convex, piece, world.scale[body], work.matrix, body, m),
    )
    return dot(m, place) + world.scale[body] * rounding(convex, piece)
