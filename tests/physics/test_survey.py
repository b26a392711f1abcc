"""What is looked at after every step, beside the same in NumPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim.physics.solver.survey import energies

BODIES = 7


@pytest.fixture
def state():
    rng = np.random.default_rng(0)
    position, velocity, angular = rng.normal(size=(3, BODIES, 3))
    return position, Rotation.random(BODIES, rng=rng).as_quat(), velocity, angular


def test_energies_are_those_of_the_closed_form(state):
    position, orientation, velocity, angular = state
    rng = np.random.default_rng(1)
    mass, root = rng.uniform(0.5, 2.0, BODIES), rng.normal(size=(BODIES, 3, 3))
    mass[2] = 0.0  # does not move by itself: it has no energy
    inertia, gravity = root @ root.transpose(0, 2, 1), np.array([0.3, -1.0, -9.0])
    axes = Rotation.from_quat(orientation).as_matrix()
    turning = np.einsum("ni,nij,njk,nlk,nl->n", angular, axes, inertia, axes, angular)
    kinetic = 0.5 * (mass * np.square(velocity).sum(1) + np.where(mass > 0, turning, 0.0)).sum()
    found = energies(mass, inertia, gravity, position, orientation, velocity, angular)
    np.testing.assert_allclose(found, (kinetic, -(mass * (position @ gravity)).sum()), rtol=1e-13)
