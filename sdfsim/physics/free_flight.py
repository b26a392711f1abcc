"""Free flight in closed form: ballistic motion, and torque-free rotation that keeps its angular momentum; of states."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from sdfsim.physics.bodies import Bodies, State, awake
from sdfsim.physics.options import Options
from sdfsim.physics.pose import apply, from_rotvec, multiply, normalise, to_matrix

MAX_TURN = 0.1  # rad of rotation per inner step of the torque-free rotation
MOST_TURN = 100.0  # rad of rotation that a step can follow
MOTION = ("position", "orientation", "velocity", "angular_velocity")


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


def driven(bodies: Bodies, state: State, dt: float) -> State:
    """Scripted bodies take the velocities that lead them along their paths in the coming step."""
    if bodies.tracks is None:
        return state
    velocity, angular = bodies.tracks.velocity(state.time, dt)
    rows = bodies.tracks.body
    return replace(
        state,
        velocity=state.velocity.index_copy(0, rows, velocity),
        angular_velocity=state.angular_velocity.index_copy(0, rows, angular),
    )


def fly(bodies: Bodies, state: State, options: Options) -> State:
    """Free flight of every body that moves: exact, whatever the step. Scripted bodies go on along their paths."""
    rows = awake(bodies, state)
    now = {name: getattr(state, name) for name in MOTION}
    if len(rows):
        pull = options.gravity
        if state.load is not None:
            pull = pull + bodies.inverse_mass[rows, None] * state.load[rows, :3]
        place, velocity = ballistic(state.position[rows], state.velocity[rows], pull, options.dt)
        if options.rotation:
            turned = _turned(bodies, state, rows, options.dt)
        else:
            turned = (state.orientation[rows], torch.zeros_like(velocity))
        now = with_rows(now, rows, (place, turned[0], velocity, turned[1]))
    if bodies.tracks is not None:
        place, orientation = bodies.tracks.at(state.time + options.dt)
        at = bodies.tracks.body
        now = with_rows(now, at, (place, orientation, state.velocity[at], state.angular_velocity[at]))
    return replace(
        state,
        **now,
        earlier_position=_shift(state.earlier_position, state.position),
        earlier_orientation=_shift(state.earlier_orientation, state.orientation),
        time=state.time + options.dt,
    )


def _turned(bodies: Bodies, state: State, rows: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Orientation and angular velocity after free flight; a torque acts half before and half after it."""
    orientation, angular, inertia = state.orientation[rows], state.angular_velocity[rows], bodies.inertia[rows]
    if state.load is None:
        return torque_free(orientation, angular, inertia, dt)
    half = 0.5 * dt * state.load[rows, 3:, None]

    def twisted(orientation: Tensor) -> Tensor:
        axes = to_matrix(orientation)
        return (axes @ torch.linalg.solve(inertia, axes.mT @ half))[..., 0]

    orientation, angular = torque_free(orientation, angular + twisted(orientation), inertia, dt)
    return orientation, angular + twisted(orientation)


def with_rows(now: dict[str, Tensor], rows: Tensor, values: tuple[Tensor, ...]) -> dict[str, Tensor]:
    """The tensors of `now` with the given rows replaced."""
    return {name: now[name].index_copy(0, rows, value) for name, value in zip(MOTION, values, strict=True)}


def _shift(earlier: Tensor | None, now: Tensor) -> Tensor | None:
    return None if earlier is None else torch.stack([earlier[1], now])
