"""A hand: it holds a body at a point, and pulls this point to where the pointer is."""

from dataclasses import dataclass

import numpy as np

from sdfsim.physics import pose
from sdfsim.simulate.simulator import Simulator

STIFF = 0.25  # rad in a step: frequency of the spring, low enough for a force that stays the same for the whole step
FASTEST = 30.0  # rad/s, at most
STRONGEST = 12.0  # weights of the body: the spring's largest force
CALM = 0.2  # part of the spring's frequency with which a dragged body's spin fades
FOLLOW = 0.5  # part of the way to the pointer in 1 / frequency, where velocities are set


@dataclass
class Hand:
    """Holds the body `name` at `grip` [3] m, a point about its centre of mass in its axes, and pulls this point to
    `target` [3] m, world. With a `turn` [4] xyzw it also turns the body to this orientation. `stays`: it goes on when
    the pointer lets go."""

    name: str
    grip: np.ndarray
    target: np.ndarray
    turn: np.ndarray | None = None
    stays: bool = False

    def act(self, simulator: Simulator) -> None:
        """Pull for the next step: a critically damped spring as heavy as the body feels at the grip, plus its weight.
        Where the model takes no forces, set the body's velocity."""
        body = simulator[self.name]
        rate = min(STIFF / simulator.dt, FASTEST)
        axes = pose.to_matrix(body.quat_xyzw)
        arm, spin = axes @ self.grip, body.angular_velocity
        off = np.zeros(3)
        if self.turn is not None:
            off = pose.to_rotvec(pose.multiply(self.turn, pose.conjugate(body.quat_xyzw)))
        if not simulator.stepper.forces:
            body.velocity = FOLLOW * rate * (self.target - body.centre - arm)
            body.angular_velocity = (1.0 - CALM) * spin if self.turn is None else FOLLOW * rate * off
            return
        mass, inertia = body.mass, axes @ body.inertia @ axes.T
        gravity = simulator.scene.gravity
        stretch = self.target - body.centre - arm
        if self.turn is None:
            cross = np.cross(np.eye(3), arm)  # cross @ x is arm x x
            gives = np.eye(3) / mass - cross @ np.linalg.solve(inertia, cross)
            speed = body.velocity + np.cross(spin, arm)
            force = np.linalg.solve(gives, rate**2 * stretch - 2.0 * rate * speed)
            swings = inertia - mass * cross @ cross  # about the grip
            torque, at = -CALM * rate * swings @ spin, body.centre + arm
        else:
            force = mass * (rate**2 * stretch - 2.0 * rate * body.velocity)
            torque, at = inertia @ (rate**2 * off - 2.0 * rate * spin), body.centre
        force -= mass * gravity
        most = STRONGEST * mass * max(float(np.linalg.norm(gravity)), 1.0)
        body.pull(force * min(1.0, most / max(float(np.linalg.norm(force)), 1e-300)), at=at, torque=torque)
