"""Free flight, compiled: forces that pull at bodies, and rotation without torque."""

from __future__ import annotations

import math

from numba import njit

from sdfsim.physics.solver.tolerances import MOST_TURN, MOST_TURNS
from sdfsim.physics.solver.vectors import (
    BARE,
    add,
    along,
    cross,
    get,
    norm,
    put,
    scale,
    to_matrix,
    turn,
    turn_back,
    turned_by,
    vector,
)


@njit(**BARE)
def pull_of(world, matrix, wrench, rules, part, b):
    """Change of a body's velocities by gravity and pulls in a part of an inner step."""
    span = rules.substep_dt * part
    weight = scale(vector(rules.options.gravity), span)
    pulled = False
    for x in range(6):
        pulled = pulled or wrench[b, x] != 0.0
    if not pulled:
        return weight, (0.0, 0.0, 0.0)
    force, torque = (wrench[b, 0], wrench[b, 1], wrench[b, 2]), (wrench[b, 3], wrench[b, 4], wrench[b, 5])
    turned = turn(matrix, b, turn(world.inverse_inertia, b, turn_back(matrix, b, torque)))
    return along(weight, force, world.inverse_mass[b] * span), scale(turned, span)


@njit(**BARE)
def drift(world, work, rules, position, orientation, angular, matrix, v, w, shifted, turned, span, b):
    """Move a body for a time at its velocities v and w, and at those that do not last; only w changes on the way.
    Returns a bound of its turning speed."""
    put(position, b, along(get(position, b), add(v, shifted), span))
    if world.moves[b] and not rules.options.rotation:
        put(angular, b, (0.0, 0.0, 0.0))
        return 0.0
    put(angular, b, w)
    speed = norm(w) + norm(turned)
    if world.moves[b] and not world.isotropic[b]:
        torque_free(world, orientation, angular, matrix, span, work.turned, work.frame, b)
    else:
        turned = add(w, turned)
    r = scale(turned, span)
    if r[0] != 0.0 or r[1] != 0.0 or r[2] != 0.0:
        q = turned_by(r, orientation, b)
        for x in range(4):
            orientation[b, x] = q[x]
        to_matrix(orientation, b, matrix)
    return speed


@njit(**BARE)
def torque_free(world, orientation, angular, matrix, span, trial, frame, b):
    """Rotation without torque: angular momentum is conserved exactly, the pose is exact to fourth order
    (Runge-Kutta-Munthe-Kaas)."""
    w = get(angular, b)
    speed = norm(w)
    if speed == 0.0:
        return
    momentum = turn(matrix, b, turn(world.inertia, b, turn_back(matrix, b, w)))
    stages = max(1, math.ceil(min(speed * span / MOST_TURN, MOST_TURNS)))
    h = span / stages
    for _ in range(stages):
        k1 = scale(w, h)
        k2 = _slope(world, orientation, momentum, scale(k1, 0.5), h, b, trial, frame)
        k3 = _slope(world, orientation, momentum, scale(k2, 0.5), h, b, trial, frame)
        k4 = _slope(world, orientation, momentum, k3, h, b, trial, frame)
        total = scale(add(add(k1, k4), scale(add(k2, k3), 2.0)), 1.0 / 6.0)
        q = turned_by(total, orientation, b)
        for x in range(4):
            orientation[b, x] = q[x]
        to_matrix(orientation, b, matrix)
        w = turn(matrix, b, turn(world.inverse_inertia, b, turn_back(matrix, b, momentum)))
    put(angular, b, w)


@njit(**BARE)
def _slope(world, orientation, momentum, u, h, b, trial, frame):
    q = turned_by(u, orientation, b)
    for x in range(4):
        trial[0, x] = q[x]
    to_matrix(trial, 0, frame)
    w = turn(frame, 0, turn(world.inverse_inertia, b, turn_back(frame, 0, momentum)))
    one = cross(u, w)
    two = cross(u, one)
    return scale(add(along(w, one, -0.5), scale(two, 1.0 / 12.0)), h)
