import numpy as np
import pytest
import torch

from sdfsim.sdf.closed_forms import BoxSdf, PlaneSdf, SphereSdf
from sdfsim.sdf.sdf import Sdf

ALL = [PlaneSdf(), SphereSdf(0.4), BoxSdf((0.3, 0.5, 0.2))]


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
