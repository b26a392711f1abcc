import numpy as np
import pytest
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.primitives import box, sphere, torus
from sdfsim.sdf.closed_forms import BoxSdf
from sdfsim.sdf.mesh_sdf import MeshSdf
from sdfsim.sdf.sdf import Sdf

SIZE = (1.0, 0.6, 0.8)
HALF = np.array(SIZE) / 2


@pytest.fixture(scope="module")
def crate() -> MeshSdf:
    return MeshSdf(box(SIZE))


def around(count: int, reach: float, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-reach, reach, (count, 3))


def test_a_box_has_its_closed_form(crate: MeshSdf) -> None:
    assert isinstance(crate, Sdf)
    truth = BoxSdf((0.5, 0.3, 0.4))
    np.testing.assert_allclose(crate.bounds, truth.bounds)
    points = around(3000, 1.2)
    distance, gradient = crate(points)
    exact = truth(points)
    np.testing.assert_allclose(distance, exact[0], atol=1e-6)
    # Inside, the nearest face is only as sure as the lead it has over the next.
    gap = np.sort(np.abs(HALF - np.abs(points)), axis=1)
    sure = (exact[0] > 1e-3) | ((gap[:, 1] - gap[:, 0] > 1e-3) & (exact[0] < -1e-3))
    np.testing.assert_allclose(gradient[sure], exact[1][sure], atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-12)


def test_the_gradient_is_that_of_the_distance() -> None:
    sdf = MeshSdf(torus())
    points = around(500, 0.6)
    distance, gradient = sdf(points)
    step = 1e-3
    difference = np.stack([sdf(points + step * axis)[0] - sdf(points - step * axis)[0] for axis in np.eye(3)], axis=1)
    off = np.linalg.norm(difference / (2 * step) - gradient, axis=1)
    # Not on the medial axis, and not where the closest point goes over an edge within the step.
    assert np.median(off) < 1e-3
    assert (off < 0.05).mean() > 0.97
    np.testing.assert_allclose(sdf(points - distance[:, None] * gradient)[0], 0, atol=1e-5)


@pytest.mark.parametrize("height", [0.0, 1e-12, -1e-12, 1e-8, -1e-8, 3e-6, -3e-6, 2e-5, -2e-5])
def test_on_the_surface_the_gradient_is_the_normal(crate: MeshSdf, height: float) -> None:
    points = around(50, 0.25)
    for axis in range(3):
        for side in (-1.0, 1.0):
            normal = side * np.eye(3)[axis]
            on_face = np.where(np.arange(3) == axis, side * (HALF[axis] + height), points)
            distance, gradient = crate(on_face)
            np.testing.assert_allclose(distance, height, atol=2e-7)
            np.testing.assert_allclose(gradient, np.tile(normal, (50, 1)), atol=0.02)


def test_corners_and_edges_have_a_gradient_that_points_away(crate: MeshSdf) -> None:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * HALF
    edges = corners * [0.0, 1.0, 1.0]
    for points in (corners, edges):
        gradient = crate(points)[1]
        np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-9)
        assert ((gradient * np.sign(points))[points != 0] > 0.3).all()


def test_never_nan(crate: MeshSdf) -> None:
    sheet = MeshSdf(Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])))
    hostile = np.array([[0.0, 0, 0], [0.2, 0.2, 0], [1e9, 0, -1e9], [1e25, 0, 0], [-1e100] * 3, [0.25, 0.25, 1e-9]])
    for sdf in (crate, MeshSdf(sphere(0.5)), sheet):
        distance, gradient = sdf(hostile)
        assert np.isfinite(distance).all()
        np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-9)
    assert crate(np.zeros((1, 3)))[0] == pytest.approx(-0.3)
    # What is not a number has no distance, and spoils no other point's.
    distance, _ = crate(np.array([[np.nan, 0, 0], [0, 0, 1.0]]))
    assert np.isnan(distance[0]) and distance[1] == pytest.approx(0.6)


def test_far_away_the_distance_is_that_to_the_closest_point(crate: MeshSdf) -> None:
    direction = around(50, 1.0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    for reach in (5.0, 900.0, 5e3, 1e8):
        distance, gradient = crate(reach * direction)
        np.testing.assert_allclose(distance, BoxSdf((0.5, 0.3, 0.4))(reach * direction)[0], rtol=1e-4)
        np.testing.assert_allclose((gradient * direction).sum(1), 1.0, atol=0.03)


def test_metres_far_from_the_origin() -> None:
    here, offset = box(SIZE), np.array([1e5, -1e5, 1e5])
    there = MeshSdf(Mesh(here.vertices + offset, here.faces))
    points = around(300, 1.0)
    np.testing.assert_allclose(there(points + offset)[0], BoxSdf((0.5, 0.3, 0.4))(points)[0], atol=1e-6)


def test_tensors_arrays_and_empty_questions(crate: MeshSdf) -> None:
    points = torch.rand(20, 3)
    distance, gradient = crate(points)
    assert distance.dtype == gradient.dtype == torch.float32
    assert crate(points.double().numpy())[1].dtype == np.float64
    assert crate(torch.zeros(0, 3))[1].shape == (0, 3)
    assert crate.to("cpu") is crate
    with pytest.raises(SdfsimError, match="no faces"):
        MeshSdf(Mesh(np.zeros((3, 3)), np.zeros((0, 3), dtype=np.int64)))


@pytest.mark.gpu
def test_points_on_cuda_are_brought_over_and_back(crate: MeshSdf) -> None:
    points = torch.rand(100, 3)
    here, there = crate(points), crate(points.cuda())
    assert there[0].is_cuda and there[1].is_cuda
    torch.testing.assert_close(here[0], there[0].cpu())
