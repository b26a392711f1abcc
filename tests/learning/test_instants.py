"""Recorded velocities become those at the instants of positions, where bodies fly."""

from dataclasses import replace

import numpy as np

from sdfsim.learning.instants import at_instants
from tests.learning.conftest import balls

SUBSTEP, DT, GRAVITY = 0.004, 0.02, np.array([0.0, 0.0, -10.0])


def symplectic(frames: int, speed: float):
    """A ball that an engine throws by symplectic Euler and that lies still from frame 6 on."""
    position, velocity = np.zeros((frames, 1, 3)), np.zeros((frames, 1, 3))
    velocity[0, 0, 2] = speed
    for k in range(1, frames):
        v, x = velocity[k - 1].copy(), position[k - 1].copy()
        for _ in range(5):
            v = v + SUBSTEP * GRAVITY
            x = x + SUBSTEP * v
        velocity[k], position[k] = v, x
    position[6:], velocity[6:] = position[6], 0.0
    return replace(balls(position), velocity=velocity)


def test_flights_are_parabolas_of_the_velocities_at_instants():
    motion = at_instants(symplectic(12, 3.0), SUBSTEP)
    for k in range(5):
        fallen = motion.position[k] + motion.velocity[k] * DT + 0.5 * GRAVITY * DT**2
        np.testing.assert_allclose(motion.position[k + 1], fallen, atol=1e-12)


def test_what_lies_keeps_its_velocity():
    recorded = symplectic(12, 3.0)
    motion = at_instants(recorded, SUBSTEP)
    np.testing.assert_array_equal(motion.velocity[7:], 0.0)
    assert (motion.velocity[:5, 0, 2] < recorded.velocity[:5, 0, 2]).all()


def test_static_bodies_do_not_fall():
    motion = at_instants(replace(symplectic(12, 3.0), static=np.array([True])), SUBSTEP)
    np.testing.assert_array_equal(motion.velocity, symplectic(12, 3.0).velocity)
