"""Winding numbers of surfaces that cross, touch and cover each other, beside boxes in closed form."""

import numpy as np
import pytest

from sdfsim.geometry.bvh import Around
from sdfsim.geometry.mesh import Mesh, joined
from tests.helpers.surfaces import cube

# Side, middle of each box, by case: the last two are one box in the same place.
CASES = {
    "crossing": ((1.0, (0, 0, 0)), (0.6, (0.4, 0.3, 0.2))),
    "flush": ((1.0, (0, 0, 0)), (0.5, (0.75, 0.1, 0.0)), (0.5, (0.0, 0.25, 0.75))),
    "one inside the other": ((1.0, (0, 0, 0)), (0.5, (0.1, 0.0, 0.0))),
    "twice in one place": ((1.0, (0, 0, 0)), (1.0, (0, 0, 0))),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("middle", [(0.0, 0.0, 0.0), (300.0, -200.0, 50.0)])
def test_winding_numbers_count_the_boxes_around_a_point(case, middle):
    boxes = [(side, np.add(at, middle)) for side, at in CASES[case]]
    mesh = joined([Mesh(cube(side).vertices + at, cube(side).faces) for side, at in boxes])
    points = np.random.default_rng(0).uniform(-1, 1.2, (20_000, 3)) + middle
    off = np.array([np.abs(points - at).max(1) - side / 2 for side, at in boxes])  # signed, but beyond edges
    clear = np.abs(off).min(0) > 1e-4
    np.testing.assert_allclose(Around(mesh)(points[clear]), (off[:, clear] < 0).sum(0), atol=0.05)
