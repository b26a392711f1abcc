"""The compiled tree of triangles against trimesh and closed forms."""

import numpy as np
import pytest

from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh
from sdfsim.physics.solver.prepare import _planted
from sdfsim.physics.solver.triangles import signed_distances
from sdfsim.shape.triangle_tree import triangle_tree


def distances(mesh: Mesh, points: np.ndarray, most: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
    return signed_distances(_planted([triangle_tree(mesh)]), 0, points, most)


def test_a_box_has_its_closed_form_also_at_edges_and_corners() -> None:
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (3000, 3))
    half = np.array([0.5, 0.7, 0.2])
    over = np.abs(points) - half
    wanted = np.linalg.norm(np.maximum(over, 0.0), axis=1) + np.minimum(over.max(1), 0.0)
    found, normal = distances(primitives.box(tuple(2.0 * half)), points)
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    ahead, _ = distances(primitives.box(tuple(2.0 * half)), points + 1e-6 * normal)
    np.testing.assert_allclose((ahead - found)[np.abs(found) > 1e-5], 1e-6, rtol=1e-3)


@pytest.mark.parametrize("name", ["torus", "gear", "bowl", "torus_knot", "cone"])
def test_the_nearest_point_is_that_of_another_library_and_so_is_the_side(name: str) -> None:
    import trimesh

    mesh = primitives.PRIMITIVES[name]()
    other = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    rng = np.random.default_rng(1)
    points = other.sample(400, seed=1) + rng.normal(size=(400, 3)) * 0.03
    _, wanted, _ = trimesh.proximity.closest_point_naive(other, points)
    found, _ = distances(mesh, points)
    np.testing.assert_allclose(np.abs(found), wanted, atol=1e-12)
    around = (points[:, None, None] - other.triangles[None]).reshape(len(points), -1, 3, 3) * -1.0
    a, b, c = around[:, :, 0], around[:, :, 1], around[:, :, 2]
    na, nb, nc = (np.linalg.norm(side, axis=2) for side in (a, b, c))
    volume = np.einsum("pti,pti->pt", a, np.cross(b, c))
    dots = [np.einsum("pti,pti->pt", one, two) for one, two in ((a, b), (b, c), (c, a))]
    solid_angle = 2.0 * np.arctan2(volume, na * nb * nc + dots[0] * nc + dots[1] * na + dots[2] * nb)
    inside = solid_angle.sum(1) > 2.0 * np.pi
    clear = np.abs(found) > 1e-9
    assert ((found < 0.0) == inside)[clear].all()


def test_what_is_farther_than_asked_is_not_found() -> None:
    mesh = primitives.PRIMITIVES["torus"]()
    points = np.random.default_rng(2).uniform(-1.0, 1.0, (2000, 3))
    everything, limited = distances(mesh, points)[0], distances(mesh, points, 0.1)[0]
    near = np.abs(everything) < 0.1
    assert near.any()
    np.testing.assert_array_equal(limited[near], everything[near])
    assert np.isinf(limited[~near]).all()


def test_a_repeated_seam_of_vertices_is_one_edge() -> None:
    """Files for rendering repeat vertices where textures are cut: signs at such edges stay right."""
    box = primitives.box()
    apart = Mesh(box.vertices[box.faces].reshape(-1, 3), np.arange(3 * len(box.faces)).reshape(-1, 3))
    points = np.random.default_rng(3).uniform(-0.8, 0.8, (2000, 3))
    np.testing.assert_allclose(distances(apart, points)[0], distances(box, points)[0], atol=1e-12)
