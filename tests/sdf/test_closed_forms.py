import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from sdfsim.sdf.closed_forms import BoxSdf, ConeSdf, PlaneSdf, SphereSdf, TorusSdf
from sdfsim.sdf.sdf import Sdf
from sdfsim.shape.make import analytic_shape

ALL = [PlaneSdf(), SphereSdf(0.4), BoxSdf((0.3, 0.5, 0.2)), ConeSdf(0.3, 0.5), ConeSdf(0.8, 0.1), TorusSdf(0.5, 0.2)]


@pytest.mark.parametrize("sdf", ALL)
def test_gradient_is_the_derivative_and_has_unit_length(sdf: Sdf) -> None:
    assert isinstance(sdf, Sdf)
    points = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (2000, 3)))
    distance, gradient = sdf(points)
    torch.testing.assert_close(gradient.norm(dim=1), torch.ones(2000, dtype=torch.float64))
    step = 1e-6
    for axis in range(3):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[axis] = step
        slope = (sdf(points + shift)[0] - sdf(points - shift)[0]) / (2 * step)
        # Points within a step of the medial axis have two sides.
        assert (slope - gradient[:, axis]).abs().quantile(0.99) < 1e-5
    # Walking down the gradient by the distance ends on the surface.
    foot = points - distance[:, None] * gradient
    assert sdf(foot)[0].abs().max() < 1e-12


def test_distances_are_the_closed_forms() -> None:
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.3, 1.5, 0.1], [0.1, 0.0, 0.0]])
    assert PlaneSdf()(points)[0].tolist() == points[:, 2].tolist()
    np.testing.assert_allclose(SphereSdf(0.4)(points)[0], np.linalg.norm(points, axis=1) - 0.4)
    np.testing.assert_allclose(BoxSdf((0.3, 0.5, 0.2))(points)[0], [-0.2, 0.7, np.sqrt(2.0), -0.2])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("sdf", ALL)
def test_the_answer_has_the_type_of_the_question(sdf: Sdf, dtype: torch.dtype) -> None:
    points = torch.rand(7, 3, dtype=dtype)
    distance, gradient = sdf(points)
    assert distance.dtype == gradient.dtype == dtype
    assert distance.shape == (7,)
    array, slope = sdf(points.numpy())
    assert isinstance(array, np.ndarray)
    np.testing.assert_array_equal(array, distance.numpy())
    np.testing.assert_array_equal(slope, gradient.numpy())
    assert sdf(np.zeros((0, 3)))[1].shape == (0, 3)
    with pytest.raises(ValueError, match=r"\[P, 3\]"):
        sdf(np.zeros(3))


@pytest.mark.parametrize("sdf", [ConeSdf(0.3, 0.5), ConeSdf(0.8, 0.1), TorusSdf(0.5, 0.2)])
def test_cones_and_rings_are_as_far_as_dense_samples_of_their_surface(sdf: Sdf) -> None:
    """And the compiled kernel says the same, also on the axis, the rim and the tip."""
    from sdfsim.physics.solver.distance import distances
    from sdfsim.physics.solver.prepare import compiled_shapes
    from sdfsim.shape.contact_geometry import ContactGeometry

    turns, steps = 2 * np.pi * np.arange(600) / 600, np.linspace(0, 1, 600)
    if isinstance(sdf, TorusSdf):
        outline = np.stack([sdf.radius + sdf.tube * np.cos(turns), sdf.tube * np.sin(turns)], 1)
    else:
        assert isinstance(sdf, ConeSdf)
        side = np.stack([sdf.radius * (1 - steps), sdf.half * (2 * steps - 1)], 1)
        outline = np.concatenate([side, np.stack([sdf.radius * steps, np.full(600, -sdf.half)], 1)])
    around = np.stack([np.cos(turns), np.sin(turns)], 1)
    surface = np.concatenate([np.column_stack([r * around, np.full(600, z)]) for r, z in outline])
    points = np.random.default_rng(1).uniform(-1, 1, (2000, 3))
    away, _ = KDTree(surface).query(points)
    inside = sdf(points)[0] < 0
    np.testing.assert_allclose(np.abs(sdf(points)[0]), away, atol=4e-3)
    assert 10 < inside.sum() < 1000
    low, high = sdf.bounds
    np.testing.assert_allclose(surface.min(0), low, atol=1e-4)
    np.testing.assert_allclose(surface.max(0), high, atol=1e-4)
    special = np.array([[0, 0, 0], [0, 0, 2], [0, 0, -2], [0, 0, high[2]], [high[0], 0, 0], [high[0], 0, low[2]]])
    every = np.concatenate([points, surface[::997], special])
    shapes = compiled_shapes([ContactGeometry(sdf, np.zeros((1, 3)), (), analytic_shape("sphere", radius=1).mesh)])
    d, n = distances(shapes.table, shapes.brick, shapes.sample, 0, every)
    known, slope = sdf(every)
    np.testing.assert_allclose(d, known, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(n[:2000], slope[:2000], atol=1e-9)
