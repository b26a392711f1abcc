"""Certificates of fits, and the distances to meshes and pieces that they are held to."""

import json
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial import KDTree

from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh, joined, sample_surface
from sdfsim.geometry.solidify import solidify
from sdfsim.sdf.closed_forms import BoxSdf, SphereSdf
from sdfsim.sdf.fit.certificate import EXACT, USABLE, certify, certify_grid, coverage, verdict, walls_lost
from sdfsim.sdf.grid import sample_grid
from sdfsim.sdf.mesh_sdf import MeshSdf
from sdfsim.sdf.reference import MeshDistance, PiecesDistance
from sdfsim.sdf.sdf import Sdf
from sdfsim.shape.surface_nodes import sample_nodes, thin

CUBE = BoxSdf((0.5, 0.5, 0.5))


class Changed:
    """An SDF whose distance [P] and gradient [P, 3] go through `change(points, distance, gradient)`."""

    def __init__(self, sdf: Sdf, change: Callable) -> None:
        self.sdf, self.change, self.bounds = sdf, change, sdf.bounds

    def __call__(self, points):
        return self.change(points, *self.sdf(points))


class Exact:
    """A mesh's own distance as an Sdf."""

    def __init__(self, oracle: MeshDistance) -> None:
        self.oracle, self.bounds = oracle, oracle.bounds

    def __call__(self, points):
        truth = self.oracle(points)
        far = np.where(np.abs(truth.distance) < 1e-9, 1.0, truth.distance)
        return truth.distance, (points - truth.closest) / far[:, None]


def scaled_up(sdf: Sdf, factor: float) -> Changed:
    return Changed(sdf, lambda points, distance, gradient: (factor * distance, factor * gradient))


def shifted(sdf: Sdf, by: float) -> Changed:
    return Changed(sdf, lambda points, distance, gradient: (distance + by, gradient))


@pytest.fixture(scope="module")
def cube() -> MeshDistance:
    return MeshDistance(primitives.box())


def test_the_certificate_of_the_truth_is_clean_and_json(cube: MeshDistance) -> None:
    got = certify(CUBE, cube, points=2000)
    assert got["passed"]
    assert got["reason"] == ""
    assert max(got[key] for key in EXACT) < 1e-5
    assert got["far_field_ratio"] == pytest.approx(1.0, abs=1e-5)
    assert "coverage" not in got
    assert json.loads(json.dumps(got, allow_nan=False)) == got
    assert certify(CUBE, PiecesDistance([primitives.box()]), points=500)["passed"]


@pytest.mark.parametrize(
    ("solid", "wall", "most"),
    [
        (primitives.box((1.0, 1.0, 0.001)), 0.001, 0.99),
        (primitives.box((1.0, 1.0, 0.005)), 0.005, 0.95),
        (primitives.box((1.0, 1.0, 0.02)), 0.02, 0.9),
        (primitives.cylinder(0.5, 0.002, 100), 0.002, 0.95),
        (primitives.box((1.0, 0.002, 0.002)), 0.002, 0.85),
        (primitives.cylinder(0.001, 1.0, 64), 0.002, 0.95),
        (
            joined(
                [primitives.sphere(0.5), Mesh(primitives.sphere(0.496).vertices, primitives.sphere().faces[:, ::-1])]
            ),
            0.004,
            0.95,
        ),
    ],
)
def test_a_wall_without_an_inside_does_not_pass(solid: Mesh, wall: float, most: float) -> None:
    oracle = MeshDistance(solid)
    # Of an odd number of samples those in the middle of a plate would see its inside.
    exact, grid = MeshSdf(solid), sample_grid(oracle, oracle.bounds, 32)
    got = certify(exact, oracle, points=2000)
    assert got["walls_lost"] == 0 and got["passed"]
    # Off by half the wall and a little, everywhere outside: no sign that counts is wrong, but the inside is gone.
    lost = certify(Changed(exact, lambda points, d, g: (d + 0.55 * wall, g)), oracle, points=2000)
    assert lost["walls_lost"] > most and not lost["passed"]
    found = certify_grid(grid, oracle)
    assert found["walls_lost"] > 0.9 * most and not found["passed"] and "take a higher resolution" in found["reason"]


def test_walls_that_run_out_at_edges_are_not_lost() -> None:
    for mesh in (primitives.cone(), primitives.bowl(), primitives.gear()):
        oracle = MeshDistance(mesh)
        assert walls_lost(sample_grid(oracle, oracle.bounds, 48), oracle) == 0
    # A thin fin on a block, a twentieth of the surface, is told in proportion.
    block, fin = primitives.box((1.0, 1.0, 1.0)), primitives.box((0.4, 0.4, 0.002))
    both = MeshDistance(solidify(joined([block, Mesh(fin.vertices + np.array([0.7, 0.0, 0.0]), fin.faces)])))
    assert walls_lost(sample_grid(both, both.bounds, 48), both) == pytest.approx(0.32 / 6.32, abs=0.012)


def test_the_certificate_of_a_lie_is_not(cube: MeshDistance) -> None:
    got = certify(SphereSdf(0.5), cube, points=2000)
    assert not got["passed"]
    assert "allowed" in got["reason"]
    assert got["sign_errors"] > 0.1
    assert not verdict({key: float("nan") for key in EXACT})["passed"]


def test_what_is_usable_but_not_exact_passes_with_a_caveat(cube: MeshDistance) -> None:
    assert all(EXACT[key] < limit for key, limit in USABLE.items())
    got = certify(shifted(CUBE, 0.0012), cube, points=500)
    assert got["passed"] and got["reason"] == ""
    assert got["caveat"] == "error_within_0.01 is 0.0012, exact fits have 0.001"
    assert verdict(EXACT) == {"passed": True, "reason": "", "caveat": ""}
    at_limit = verdict(EXACT | USABLE)
    assert at_limit["passed"] and at_limit["caveat"]


@pytest.mark.parametrize("scale", [0.02, 1.0, 40.0])
def test_an_added_error_is_measured_as_it_is(scale: float) -> None:
    mesh = primitives.box((scale, 0.8 * scale, 0.6 * scale))
    got = certify(shifted(BoxSdf((0.5 * scale, 0.4 * scale, 0.3 * scale)), -0.003 * scale), MeshDistance(mesh))
    for key in ("error_within_0.01", "error_within_0.1", "error_in_box", "projected_from_0.01", "projected_from_0.1"):
        assert got[key] == pytest.approx(0.003, abs=2e-5)
    # Outside it says too little, so the worst is just inside the 0.1 in depth.
    assert got["far_field_ratio"] == pytest.approx(1.03, abs=2e-3)
    # Of the points farther than 0.002 those within 0.003 are inside out.
    assert 0.01 < got["sign_errors"] < 0.2


def test_slopes_and_the_far_field_are_reported(cube: MeshDistance) -> None:
    got = certify(scaled_up(CUBE, 1.2), cube, points=2000)
    assert got["far_field_ratio"] == pytest.approx(1.2, abs=1e-5)
    assert got["gradient_within_0.1"] < 1e-6
    assert got["projected_from_0.1"] < 1e-5

    def tilt(points, distance, gradient):
        # 60 degrees about a direction at right angles.
        side = np.cross(gradient, np.roll(gradient, 1, axis=1) + np.array([0.1, 0.2, 0.3]))
        return distance, 0.5 * gradient + 0.75**0.5 * side / np.linalg.norm(side, axis=1, keepdims=True)

    tilted = certify(Changed(CUBE, tilt), cube, points=1000)
    assert tilted["gradient_within_0.1"] == pytest.approx(0.5, abs=1e-4)


def test_a_flipped_region_is_a_sign_error_of_its_size(cube: MeshDistance) -> None:
    def flip(points, distance, gradient):
        side = np.where(points[:, 0] > 0.2, -1.0, 1.0)
        return side * distance, side[:, None] * gradient

    got = certify(Changed(CUBE, flip), cube)
    # Surface samples: the face at x = 0.5 and 0.3 of four others; box samples: 0.5 of 1.4.
    assert got["sign_errors"] == pytest.approx(0.36, abs=0.02)
    assert not got["passed"]


def test_what_an_open_mesh_leaves_in_doubt_is_ready_for_json(cube: MeshDistance) -> None:
    holed = MeshDistance(Mesh(cube.surface.vertices, cube.surface.faces[1:]))
    assert json.dumps(certify(shifted(CUBE, 0.01), holed, points=500), allow_nan=False)


def test_the_coverage_of_known_nodes_on_a_cube(cube: MeshDistance) -> None:
    corners = cube.surface.vertices
    got = coverage(corners, cube)
    assert got["count"] == 8
    # The middle of a face is farthest from its corners.
    assert got["largest_hole"] == pytest.approx(0.5**0.5, abs=0.01)
    # Eight corners with three quarter discs of radius 0.1 each.
    assert got["uncovered"] == pytest.approx(1 - np.pi * 0.1**2 * 6 / 6, abs=0.005)
    assert got["off_surface"] < 1e-6
    large = coverage(30.0 * corners, MeshDistance(primitives.box((30.0, 30.0, 30.0))))
    assert large == pytest.approx(got, rel=1e-3, abs=1e-6)
    assert coverage(np.concatenate([corners, np.zeros((1, 3))]), cube)["off_surface"] == pytest.approx(0.5)
    none = coverage(np.zeros((0, 3)), cube)
    assert (none["count"], none["largest_hole"], none["uncovered"]) == (0, None, 1.0)
    assert certify(CUBE, cube, nodes=corners, points=200)["coverage"] == got


def test_what_is_hidden_inside_needs_no_nodes() -> None:
    # Two halves of a cube that share a face: nodes on the outside cover it all.
    half = primitives.box((0.5, 1.0, 1.0))
    pieces = [Mesh(half.vertices + np.array([side, 0, 0]), half.faces) for side in (-0.25, 0.25)]
    nodes = sample_nodes(CUBE)
    assert coverage(nodes, PiecesDistance(pieces))["largest_hole"] < 0.06


@pytest.mark.parametrize("kind", ["bowl", "shoe"])
def test_hollows_are_covered_as_well_as_the_outside(kind: str) -> None:
    oracle = MeshDistance(primitives.PRIMITIVES[kind]())
    nodes = thin(sample_nodes(Exact(oracle)), 256)
    got = coverage(nodes, oracle)
    assert got["largest_hole"] < 0.1
    assert got["off_surface"] < 0.006
    # Nodes of the other side of the wall must not stand in: only what is in the hollow, for what is in the hollow.
    points, normal = sample_surface(oracle.surface, 20_000, np.random.default_rng(0))
    if kind == "bowl":
        in_hollow, own = np.linalg.norm(points, axis=1) < 0.45, np.linalg.norm(nodes, axis=1) < 0.45
    else:
        # The floor of the cavity is flat, at this height; the body's own side is farther out there.
        in_hollow = (normal[:, 2] > 0.99) & (np.abs(points[:, 2] + 0.0646) < 0.002) & (points[:, 0] < 0.25)
        own = (np.abs(nodes[:, 2] + 0.0646) < 0.006) & (np.abs(nodes[:, 1]) < 0.14) & (nodes[:, 0] < 0.3)
    assert in_hollow.sum() > 100
    assert own.sum() > 8
    assert KDTree(nodes[own]).query(points[in_hollow])[0].max() < 0.13


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
