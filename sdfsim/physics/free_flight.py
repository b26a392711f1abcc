"""Free flight in closed form: ballistic motion, and torque-free rotation that keeps its angular momentum."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from sdfsim.physics.pose import apply, from_rotvec, multiply, normalise, to_matrix

MAX_TURN = 0.1  # rad of rotation per inner step of the torque-free rotation
MOST_TURN = 100.0  # rad of rotation that a step can follow


def ballistic(position: Tensor, velocity: Tensor, gravity: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Position [N, 3] m and velocity [N, 3] m/s after `dt` s under constant `gravity` [3] m/s^2 (exact)."""
    return position + velocity * dt + 0.5 * gravity * dt**2, velocity + gravity * dt


def torque_free(orientation: Tensor, angular_velocity: Tensor, inertia: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Rotation of bodies on which no torque acts: orientation [N, 4] and angular velocity [N, 3] rad/s, world, after
    `dt` s, by inertias [N, 3, 3] kg m^2 in body axes.

    The world angular momentum is held exactly; the orientation follows dR/dt = [R I^-1 R^T L] R by a
    Runge-Kutta-Munthe-Kaas method of order 4, each inner step turning at most `MAX_TURN`. Beyond `MOST_TURN` in all it
    is no longer exact.
    """
    turning = (angular_velocity != 0).any(-1).nonzero()[:, 0]
    if len(turning) < len(orientation):  # what does not turn stays as it is
        some = orientation[turning], angular_velocity[turning]
        if len(turning):
            some = torque_free(*some, inertia[turning], dt)
        return orientation.index_copy(0, turning, some[0]), angular_velocity.index_copy(0, turning, some[1])
    if len(orientation) == 0:
        return orientation, angular_velocity
    inverse = torch.linalg.inv(inertia)
    rotation = to_matrix(orientation)
    momentum = apply(rotation, apply(inertia, apply(rotation.mT, angular_velocity)))
    fastest = float(angular_velocity.norm(dim=-1).max())
    steps = max(1, math.ceil(min(MOST_TURN, fastest * abs(dt)) / MAX_TURN))
    h = dt / steps

    def spin(q: Tensor) -> Tensor:
        r = to_matrix(q)
        return apply(r, apply(inverse, apply(r.mT, momentum)))

    for _ in range(steps):
        orientation = normalise(_rkmk4(orientation, angular_velocity, spin, h))
        angular_velocity = spin(orientation)
    return orientation, angular_velocity


def _rkmk4(q: Tensor, start: Tensor, spin: Callable[[Tensor], Tensor], h: float) -> Tensor:
    """One Runge-Kutta-Munthe-Kaas step of order 4 for q' = spin(q) (world axes), where spin(q) = `start`; it never
    leaves the unit sphere."""

    def slope(u: Tensor) -> Tensor:
        w = spin(multiply(from_rotvec(u), q))
        uw = torch.linalg.cross(u, w)
        return h * (w - 0.5 * uw + torch.linalg.cross(u, uw) / 12.0)  # dexp^-1, to the order needed

    k1 = h * start
    k2 = slope(0.5 * k1)
    k3 = slope(0.5 * k2)
    k4 = slope(k3)
    return multiply(from_rotvec((k1 + 2 * k2 + 2 * k3 + k4) / 6.0), q)
