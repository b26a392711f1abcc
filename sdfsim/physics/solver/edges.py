"""The contact edges of networks, compiled: found in one query at the start of a step, from distances and free motion.

Networks on surface nodes take the nodes that come near another body. The network on bodies takes the points at which
two bodies are near each other, as `narrow_phase` finds them.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sdfsim.physics.solver.broad_phase import near_pairs, swept
from sdfsim.physics.solver.contacts import met_half_way
from sdfsim.physics.solver.distance import distance
from sdfsim.physics.solver.manifold import points_of
from sdfsim.physics.solver.narrow_phase import find_near
from sdfsim.physics.solver.references import call, reference
from sdfsim.physics.solver.surface_distance import map_between, mapped
from sdfsim.physics.solver.vectors import (
    ENTRY,
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
    vector,
)
from sdfsim.physics.solver.world import GAP, NORMAL, VOID


@njit(**ENTRY)
def nodes_within(shapes, world, work, motion, rules, node, start):
    """Nodes that are within `rules.contact_margin` of another body's surface, or will be by the end of the step at
    their present speed: the contact edges of the paper (section 3).

    Args:
        node: [M, 3] surface nodes about the centres of mass, in the bodies' axes.
        start: [N + 1] int64, body b owns nodes start[b] : start[b + 1].

    Returns:
        [E, 3] int64, the owner, its node and the other body; [E, 7], the distance, the other's outward normal there,
        and the node relative to the other's centre of mass (world axes).
    """
    span = rules.substep_dt * rules.options.substeps
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
            speed += (
                norm(vector(rules.options.gravity)) * span * abs(fall)
                + norm(get(motion.angular, one)) * world.radius[one]
            )
            if norm(get(motion.angular, other)) > 0.0:
                speed += norm(get(motion.angular, other)) * world.radius[other]
            most = rules.contact_margin + speed * span
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
                velocity = along(velocity, vector(rules.options.gravity), fall * span)
                if d + min(0.0, dot(velocity, normal)) * span > rules.contact_margin:
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


@njit(**ENTRY)
def points_within(shapes, world, work, motion, rules, manifolds, pieces, soon):
    """Points at which bodies are within `rules.contact_margin` of each other, or will be after the time `rules.ahead`
    in free motion.

    Args:
        manifolds: empty, of this type.
        pieces: the addresses of `Pieces` that fit the scene.
        soon: a shorter time.

    Returns:
        [E, 2] int64, the two bodies; [E, 11], the contact point about the centre of mass of each, the normal from the
        second to the first (all along world axes), the distance, and the distance after the time `soon`.
    """
    shapes, world, work = reference(shapes), reference(world), reference(work)
    motion, rules = reference(motion), reference(rules)
    matrix, span = work.matrix, rules.ahead
    for b in world.going:
        to_matrix(motion.orientation, b, matrix)
    manifolds, near = find_near(shapes, world, work, motion, rules, span, manifolds, pieces)
    call(pieces.collide, (shapes, world, work, motion, rules, reference(manifolds), reference(near)))
    most = points_of(manifolds, len(near.start))
    pair, value, count = np.empty((most, 2), np.int64), np.empty((most, 11)), 0
    for m in range(len(manifolds.count)):
        a, b = manifolds.pair[m, 0], manifolds.pair[m, 1]
        fall = (1.0 if world.moves[a] else 0.0) - (1.0 if world.moves[b] else 0.0)
        between = sub(get(motion.position, a), get(motion.position, b))
        for k in range(manifolds.count[m]):
            point = manifolds.point[m, k]
            n = (point[NORMAL], point[NORMAL + 1], point[NORMAL + 2])
            arm = turn(matrix, a, (point[0], point[1], point[2]))
            other = turn(matrix, b, (point[3], point[4], point[5]))
            arm, other = met_half_way(between, arm, other)
            w, u = get(motion.angular, a), get(motion.angular, b)
            speed = sub(add(get(motion.velocity, a), cross(w, arm)), add(get(motion.velocity, b), cross(u, other)))
            closing = -dot(along(speed, vector(rules.options.gravity), fall * span), n)
            bent = 0.5 * span * (dot(w, w) * norm(arm) + (dot(u, u) * norm(other) if dot(u, u) > 0.0 else 0.0))
            gap, approach = point[GAP], max(closing + bent, 0.0)
            if point[VOID] > 0.0 or gap - approach * span > rules.contact_margin:
                continue
            pair[count, 0], pair[count, 1], value[count, 9], value[count, 10] = a, b, gap, gap - approach * soon
            for x in range(3):
                value[count, x], value[count, 3 + x], value[count, 6 + x] = arm[x], other[x], n[x]
            count += 1
    return pair[:count], value[:count]
