import numpy as np
import pytest

from sdfsim.geometry.mass import mass_properties
from sdfsim.geometry.mesh import is_closed, signed_volume
from sdfsim.geometry.primitives import PRIMITIVES, convex_pieces, sphere
from sdfsim.sdf.reference import MeshDistance, PiecesDistance

# Handles of each solid (its genus): V - E + F = 2 - 2 * handles.
HANDLES = {
    "box": 0,
    "sphere": 0,
    "cylinder": 0,
    "cone": 0,
    "torus": 1,
    "gear": 1,
    "torus_knot": 1,
    "bowl": 0,
    "shoe": 0,
}


@pytest.mark.parametrize("kind", PRIMITIVES)
def test_every_primitive_is_a_closed_outward_solid_near_a_metre(kind: str) -> None:
    mesh = PRIMITIVES[kind]()
    assert is_closed(mesh)
    assert signed_volume(mesh) > 0
    assert 0.85 < np.ptp(mesh.vertices, axis=0).max() <= 1.0 + 1e-9
    if kind in HANDLES:
        euler = len(mesh.vertices) - len(mesh.faces) // 2
        assert euler == 2 - 2 * HANDLES[kind]


@pytest.mark.parametrize(
    ("kind", "empty"), [("torus", [0, 0, 0]), ("gear", [0, 0, 0]), ("bowl", [0, 0, -0.2]), ("shoe", [-0.2, 0, 0.05])]
)
def test_holes_are_open(kind: str, empty: list[float]) -> None:
    assert MeshDistance(PRIMITIVES[kind]())(np.array([empty], dtype=float)).distance[0] > 0.02


@pytest.mark.parametrize("kind", [kind for kind in PRIMITIVES if kind != "shoe"])
def test_convex_pieces_fill_the_solid(kind: str) -> None:
    mesh, pieces = PRIMITIVES[kind](), convex_pieces(kind)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    points = np.random.default_rng(0).uniform(low, high, (20_000, 3))
    inside = MeshDistance(mesh)(points).distance < 0
    filled = PiecesDistance(pieces).inside(points)
    # Facets of round walls are coarser in the pieces.
    assert (filled & inside).sum() > 0.88 * (filled | inside).sum()


def test_no_pieces_where_there_is_no_simple_way() -> None:
    assert convex_pieces("shoe") == []


def test_sphere_vertices_are_on_the_sphere() -> None:
    mesh = sphere(0.25, subdivisions=2)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.25)
    assert len(mesh.faces) == 320
    assert mass_properties(mesh)[0] < 4 / 3 * np.pi * 0.25**3
