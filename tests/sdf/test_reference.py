import numpy as np
import pytest

from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh
from sdfsim.sdf.closed_forms import BoxSdf
from sdfsim.sdf.reference import MeshDistance, PiecesDistance


def points_in(half: float, count: int = 4000) -> np.ndarray:
    return np.random.default_rng(5).uniform(-half, half, (count, 3))


def moved(mesh: Mesh, *shift: float) -> Mesh:
    return Mesh(mesh.vertices + np.array(shift), mesh.faces)


def test_a_plain_cube_is_exact_and_its_sign_is_right() -> None:
    # Few large faces, rays through edges and vertices: where a single parity ray goes wrong.
    points = np.concatenate(
        [points_in(1.0), np.stack(np.meshgrid(*[np.linspace(-0.9, 0.9, 7)] * 3), -1).reshape(-1, 3)]
    )
    truth, _ = BoxSdf((0.5, 0.5, 0.5))(points)
    got = MeshDistance(primitives.box())(points)
    np.testing.assert_allclose(got.distance, truth, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(points - got.closest, axis=1), np.abs(truth), atol=1e-6)


def test_torus_converges_to_its_closed_form() -> None:
    points = points_in(0.7)
    ring = np.hypot(points[:, 0], points[:, 1]) - 0.35
    truth = np.hypot(ring, points[:, 2]) - 0.15
    got = MeshDistance(primitives.torus(0.35, 0.15, 192, 96))(points)
    np.testing.assert_allclose(got.distance, truth, atol=4e-4)
    assert got.trusted.mean() > 0.999


def test_far_from_the_origin_nothing_changes() -> None:
    near = MeshDistance(primitives.cone())
    far = MeshDistance(moved(primitives.cone(), 1e5, -1e5, 3e4))
    points = points_in(1.0, 500)
    np.testing.assert_allclose(far(points + np.array([1e5, -1e5, 3e4])).distance, near(points).distance, atol=1e-6)


def test_the_sign_is_trusted_by_the_angle_to_the_normal() -> None:
    # Beside the edge of a flat sheet the offset is at right angles to the normal: neither side.
    sheet = Mesh(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    oracle = MeshDistance(sheet)
    assert not oracle.closed
    got = oracle(np.array([[1.5, 0.5, 0.0], [1.5, 0.5, 0.05], [0.5, 0.5, 0.4]]))
    assert got.trusted.tolist() == [False, False, True]
    assert got.distance[2] == pytest.approx(0.4)


def test_touching_pieces_have_no_surface_between_them() -> None:
    # Two half boxes make one box; the shared face must not appear as a surface inside.
    half = primitives.box((0.5, 1.0, 1.0))
    union = PiecesDistance([moved(half, -0.25, 0, 0), moved(half, 0.25, 0, 0)])
    points = points_in(0.8)
    points[:200, 0] = 0.0
    truth, _ = BoxSdf((0.5, 0.5, 0.5))(points)
    np.testing.assert_allclose(union(points).distance, truth, atol=1e-5)


def test_overlapping_pieces_are_their_union() -> None:
    a, b = moved(primitives.box(), -0.3, 0, 0), moved(primitives.box((0.5, 0.5, 2.0)), 0.2, 0.1, 0)
    union = PiecesDistance([a, b])
    points = points_in(1.2)
    first, _ = BoxSdf((0.5, 0.5, 0.5))(points + np.array([0.3, 0, 0]))
    second, _ = BoxSdf((0.25, 0.25, 1.0))(points - [0.2, 0.1, 0])
    got = union(points).distance
    truth = np.minimum(first, second)
    outside = truth > 0
    np.testing.assert_allclose(got[outside], truth[outside], atol=1e-6)
    # Inside, the minimum is only the depth in one piece: the union is at least as deep.
    assert (got[~outside] <= truth[~outside] + 0.01).all()
    assert (got[~outside] < 0).all()
