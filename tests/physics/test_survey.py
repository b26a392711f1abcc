"""What is looked at after every step, beside the same in NumPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim.physics.solver.survey import energies, first_fault, touching
from sdfsim.physics.solver.world import COLUMNS, GAP, NORMAL, NORMAL_IMPULSE, POINTS, TANGENTIAL, Manifolds

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


def test_contacts_are_told_where_the_first_body_has_them(state):
    position, orientation, _, _ = state
    rng = np.random.default_rng(2)
    pair, count = np.array([[4, 1], [0, 6], [3, 2]]), np.array([5, 0, POINTS])
    known = Manifolds(pair, count, rng.normal(size=(3, POINTS, COLUMNS)))
    told = list(zip(*touching(known, position, orientation, 0.1), strict=True))
    wanted = [(m, known.point[m, k]) for m in range(3) for k in range(count[m]) if known.point[m, k, GAP] <= 0.1]
    assert len(told) == len(wanted) > 5
    for (bodies, place, normal, impulse, gap), (m, point) in zip(told, wanted, strict=True):
        first, axis = pair[m, 0], point[NORMAL : NORMAL + 3]
        assert (bodies == pair[m]).all() and gap == point[GAP]
        np.testing.assert_allclose(place, position[first] + Rotation.from_quat(orientation[first]).apply(point[:3]))
        np.testing.assert_allclose(normal, axis)
        np.testing.assert_allclose(impulse, axis * point[NORMAL_IMPULSE] + point[TANGENTIAL : TANGENTIAL + 3])


@pytest.mark.parametrize("value", [1e3, np.nan, np.inf])
@pytest.mark.parametrize("which", [0, 1, 2, 3])
def test_the_first_body_that_cannot_be_is_found(state, which, value):
    position, orientation, velocity, angular = state
    told = (position, orientation, velocity, angular)
    seen, most = np.ones(BODIES, bool), np.array([1e-6, 50.0, 60.0, 70.0, 1e9])

    def found():
        return first_fault(seen, position, orientation, velocity, angular, position, 0.1, most)

    assert found() == (-1, 0)
    told[which][5, 2] = told[which][3, 1] = value
    assert found() == (3, [1, 0, 2, 3][which])
    seen[3] = False  # sleeps
    assert found() == (5, [1, 0, 2, 3][which])


def test_a_way_that_is_too_long_for_a_step_is_found(state):
    position, orientation, velocity, angular = state
    before = position.copy()
    before[4, 0] += 0.5
    most, seen = np.array([1e-6, 1e9, 1e9, 1e9, 4.9]), np.ones(BODIES, bool)
    assert first_fault(seen, position, orientation, velocity, angular, before, 0.1, most) == (4, 4)
