"""Impulses that keep surfaces from sinking into each other, compiled: sequential impulses along the normals of a
contact graph (projected Gauss-Seidel)."""

import numpy as np
from numba import njit

ROUNDS = 100  # sweeps at most, forth and back by turns
ENOUGH = 1e-14  # relative to the fastest approach: sweeps end when no contact's velocity changes by more


@njit(cache=True)
def separated(twist, inverse_mass, inverse_inertia, first, second, normal, arm_first, arm_second, least):
    """Change `twist` [N, 6] (velocities and angular velocities) by the smallest impulses along the normals that leave
    every contact a relative normal velocity of at least `least` [E]; the other arguments are those of a `ContactGraph`.
    Returns the impulses [E], none below 0."""
    count = len(first)
    total, mass = np.zeros(count), np.zeros(count)
    turn = np.zeros((2, count, 3))
    push = np.zeros((2, count, 3))
    jacobian = np.zeros((2, count, 3))
    most = 0.0
    for e in range(count):
        inverse = 0.0
        for side in range(2):
            body = first[e] if side == 0 else second[e]
            arm = arm_first[e] if side == 0 else arm_second[e]
            n = normal[e] if side == 0 else -normal[e]
            jacobian[side, e] = np.cross(arm, n)
            push[side, e] = n * inverse_mass[body]
            for x in range(3):
                for y in range(3):
                    turn[side, e, x] += inverse_inertia[body, x, y] * jacobian[side, e, y]
                inverse += n[x] * push[side, e, x]
            for x in range(3):
                inverse += jacobian[side, e, x] * turn[side, e, x]
        mass[e] = 1.0 / inverse if inverse > 0.0 else 0.0
        most = max(most, least[e] - _approach(twist, e, first, second, normal, jacobian))
    for sweep in range(ROUNDS):
        changed = 0.0
        for k in range(count):
            e = k if sweep % 2 == 0 else count - 1 - k
            short = least[e] - _approach(twist, e, first, second, normal, jacobian)
            given = max(-total[e], mass[e] * short)
            if given == 0.0:
                continue
            total[e] += given
            changed = max(changed, abs(given) / mass[e])
            for side in range(2):
                body = first[e] if side == 0 else second[e]
                for x in range(3):
                    twist[body, x] += given * push[side, e, x]
                    twist[body, 3 + x] += given * turn[side, e, x]
        if changed <= ENOUGH * most:
            break
    return total


@njit(cache=True)
def _approach(twist, e, first, second, normal, jacobian):
    """The relative velocity of contact e along its normal, below 0 if it closes."""
    speed = 0.0
    for x in range(3):
        speed += normal[e, x] * (twist[first[e], x] - twist[second[e], x])
        speed += jacobian[0, e, x] * twist[first[e], 3 + x] + jacobian[1, e, x] * twist[second[e], 3 + x]
    return speed
