"""Free flight: ballistic motion in closed form, and torque-free rotation that conserves angular momentum; also for
whole states."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sdfsim.physics.bodies import Bodies, State, awake
from sdfsim.physics.motion import MOTION
from sdfsim.physics.options import Options
from sdfsim.physics.pose import cross, from_rotvec, multiply, normalise, to_matrix

MAX_TURN = 0.1  # rad of rotation per inner step of the torque-free rotation
MOST_TURN = 100.0  # rad of rotation in a step, beyond which it is not exact


def ballistic(
    position: np.ndarray, velocity: np.ndarray, gravity: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Position [N, 3] m and velocity [N, 3] m/s after `dt` s under constant `gravity` [3] m/s^2 (exact)."""
    return position + velocity * dt + 0.5 * gravity * dt**2, velocity + gravity * dt


def torque_free(
    orientation: np.ndarray, angular_velocity: np.ndarray, inertia: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation without torque: orientation [N, 4] and angular velocity [N, 3] rad/s, world, after `dt` s, for inertias
    [N, 3, 3] kg m^2 in body axes.

    The angular momentum in world axes is conserved exactly; the orientation follows dR/dt = [R I^-1 R^T L] R by a
    Runge-Kutta-Munthe-Kaas method of order 4, each inner step turning at most `MAX_TURN`. If the total is beyond
    `MOST_TURN`, the result is no longer exact.
    """
    turning = np.flatnonzero((angular_velocity != 0).any(-1))
    if len(turning) < len(orientation):  # bodies that do not turn stay as they are
        after = orientation.copy(), angular_velocity.copy()
        if len(turning):
            some = torque_free(orientation[turning], angular_velocity[turning], inertia[turning], dt)
            after[0][turning], after[1][turning] = some
        return after
    if len(orientation) == 0:
        return orientation, angular_velocity
    inverse = np.linalg.inv(inertia)
    rotation = to_matrix(orientation)
    momentum = _times(rotation, _times(inertia, _times(rotation.mT, angular_velocity)))
    fastest = float(np.linalg.norm(angular_velocity, axis=-1).max())
    steps = max(1, math.ceil(min(MOST_TURN, fastest * abs(dt)) / MAX_TURN))
    h = dt / steps

    def spin(q: np.ndarray) -> np.ndarray:
        r = to_matrix(q)
        return _times(r, _times(inverse, _times(r.mT, momentum)))

    for _ in range(steps):
        orientation = normalise(_rkmk4(orientation, angular_velocity, spin, h))
        angular_velocity = spin(orientation)
    return orientation, angular_velocity


def _times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """[N, 3] products of matrices [N, 3, 3] and vectors [N, 3]."""
    return (matrix @ vector[..., None])[..., 0]


def _rkmk4(q: np.ndarray, start: np.ndarray, spin: Callable[[np.ndarray], np.ndarray], h: float) -> np.ndarray:
    """One Runge-Kutta-Munthe-Kaas step of order 4 for q' = spin(q) (world axes), where spin(q) = `start`; it never
    leaves the unit sphere."""

    def slope(u: np.ndarray) -> np.ndarray:
        w = spin(multiply(from_rotvec(u), q))
        uw = cross(u, w)
        return h * (w - 0.5 * uw + cross(u, uw) / 12.0)  # dexp^-1, to the order needed

    k1 = h * start
    k2 = slope(0.5 * k1)
    k3 = slope(0.5 * k2)
    k4 = slope(k3)
    return multiply(from_rotvec((k1 + 2 * k2 + 2 * k3 + k4) / 6.0), q)


def driven(bodies: Bodies, state: State, dt: float) -> State:
    """Give scripted bodies the velocities that lead them along their paths in the coming step."""
    if bodies.tracks is None:
        return state
    velocity, angular = bodies.tracks.velocity(state.time, dt)
    return state.with_rows(bodies.tracks.body, {"velocity": velocity, "angular_velocity": angular})


def fly(bodies: Bodies, state: State, options: Options) -> State:
    """Free flight of every dynamic body: exact, whatever the step. Scripted bodies continue along their paths."""
    rows, after = awake(bodies, state), state
    if len(rows):
        pull = options.gravity
        if state.load is not None:
            pull = pull + bodies.inverse_mass[rows, None] * state.load[rows, :3]
        place, velocity = (state.rows_of(name, rows) for name in ("position", "velocity"))
        place, velocity = ballistic(place, velocity, pull, options.dt)
        if options.rotation:
            turned = _turned(bodies, state, rows, options.dt)
        else:
            turned = (state.rows_of("orientation", rows), np.zeros_like(velocity))
        after = after.with_rows(rows, dict(zip(MOTION, (place, turned[0], velocity, turned[1]), strict=True)))
    if bodies.tracks is not None:
        place, orientation = bodies.tracks.at(state.time + options.dt)
        after = after.with_rows(bodies.tracks.body, {"position": place, "orientation": orientation})
    earlier: dict[str, np.ndarray] = {}
    if state.earlier_position is not None and state.earlier_orientation is not None:
        earlier["earlier_position"] = np.stack([state.earlier_position[1], state.position])
        earlier["earlier_orientation"] = np.stack([state.earlier_orientation[1], state.orientation])
    return after.with_rows(rows[:0], {}, time=state.time + options.dt, **earlier)


def with_history(state: State, bodies: Bodies, options: Options, changed: np.ndarray | None = None) -> State:
    """The state with the two earlier poses that free flight would give: for the `changed` [N] bool bodies, or for all
    bodies if the state has no earlier poses or `changed` is None."""
    back = options._replace(dt=-options.dt)
    one = fly(bodies, replace(state, earlier_position=None, earlier_orientation=None), back)
    two = fly(bodies, one, back)
    position, orientation = (np.stack([getattr(s, name) for s in (two, one)]) for name in MOTION[:2])
    if changed is not None and state.earlier_position is not None and state.earlier_orientation is not None:
        position = np.where(changed[:, None], position, state.earlier_position)
        orientation = np.where(changed[:, None], orientation, state.earlier_orientation)
    return replace(state, earlier_position=position, earlier_orientation=orientation)


def _turned(bodies: Bodies, state: State, rows: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Orientation and angular velocity after free flight; half of a torque's effect comes before it and half after."""
    orientation, angular = (state.rows_of(name, rows) for name in ("orientation", "angular_velocity"))
    inertia = bodies.inertia[rows]
    if state.load is None:
        return torque_free(orientation, angular, inertia, dt)
    half = 0.5 * dt * state.load[rows, 3:, None]

    def twisted(orientation: np.ndarray) -> np.ndarray:
        axes = to_matrix(orientation)
        return (axes @ np.linalg.solve(inertia, axes.mT @ half))[..., 0]

    orientation, angular = torque_free(orientation, angular + twisted(orientation), inertia, dt)
    return orientation, angular + twisted(orientation)
