"""The contact edges of networks on surface nodes, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit

from sdfsim.physics.solver.broad_phase import near_pairs, swept
from sdfsim.physics.solver.distance import distance
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
