"""Distances on grids, to meshes and in closed form."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Frame, Mesh
from sdfsim.geometry.primitives import box, sphere, torus
from sdfsim.physics.solver.prepare import _planted, compiled_shapes
from sdfsim.physics.solver.triangles import signed_distances
from sdfsim.sdf import grid as grid_module
from sdfsim.sdf.closed_forms import BoxSdf, ConeSdf, PlaneSdf, SphereSdf, TorusSdf
from sdfsim.sdf.far_field import BOX, CAUTION, FADE, SLOPE, everywhere
from sdfsim.sdf.grid import GridSdf, sample_grid, trilinear
from sdfsim.sdf.mesh_sdf import MeshSdf
from sdfsim.sdf.reference import MeshDistance
from sdfsim.sdf.sdf import Sdf
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.triangle_tree import triangle_tree

BOUNDS = np.array([[-0.5] * 3, [0.5] * 3])


def ball(resolution: int, radius: float = 0.5) -> GridSdf:
    sdf = SphereSdf(radius)
    return sample_grid(sdf, sdf.bounds, resolution)


def around(count: int, reach: float, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-reach, reach, (count, 3))


def test_a_linear_field_comes_back_exactly() -> None:
    slope = np.array([0.3, -0.5, 0.8])

    def tilted(points: np.ndarray) -> tuple[np.ndarray]:
        return (points @ slope + 0.9,)

    sdf = sample_grid(tilted, BOUNDS, 9)
    points = around(500, 0.5)
    distance, gradient = sdf(points)
    np.testing.assert_allclose(distance, points @ slope + 0.9, atol=1e-6)
    np.testing.assert_allclose(gradient, np.tile(slope, (500, 1)), atol=1e-5)


@pytest.mark.parametrize("which", ["values", "gradients"])
def test_errors_shrink_with_the_cells(which: str) -> None:
    """Twice the samples: a quarter of the error in the distance, half of that in the gradient."""
    points = around(20_000, 0.6)
    points = points[np.linalg.norm(points, axis=1) > 0.25]
    exact = SphereSdf(0.5)(points)
    errors = []
    for resolution in (29, 57, 113):
        found = ball(resolution)(points)
        errors.append(np.abs(found[which == "gradients"] - exact[which == "gradients"]).max())
    order = 2.0 if which == "values" else 1.0
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.25)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(order, abs=0.25)


def test_the_gradient_is_that_of_the_value() -> None:
    """In double precision: against autograd, and against differences within a cell, where they are exact."""
    values = torch.from_numpy(np.random.default_rng(0).normal(size=(6, 6, 6)))
    cell = 2 * BOX / 5
    points = (torch.randint(5, (300, 3)) + 0.2 + 0.6 * torch.rand(300, 3, dtype=torch.float64)) * cell - BOX
    points.requires_grad_()
    value, gradient = trilinear(values, points)
    (slope,) = torch.autograd.grad(value.sum(), points)
    torch.testing.assert_close(gradient.detach(), slope, rtol=1e-9, atol=1e-9)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = 0.1 * cell
        ahead, behind = trilinear(values, points.detach() + step), trilinear(values, points.detach() - step)
        torch.testing.assert_close((ahead[0] - behind[0]) / (0.2 * cell), gradient[:, axis].detach())


def test_metres_far_from_the_origin() -> None:
    sdf = ball(32)
    moved = GridSdf(sdf.values, Frame(np.array([1e6, 0.0, -1e6]), 3.0), 3.0 * sdf.bounds + [1e6, 0.0, -1e6])
    points = around(200, 0.9)
    distance, gradient = moved(3.0 * points + [1e6, 0.0, -1e6])
    np.testing.assert_allclose(distance, 3.0 * sdf(points)[0], atol=1e-5)
    np.testing.assert_allclose(gradient, sdf(points)[1], atol=1e-3)


def test_beyond_the_box_the_distance_goes_on() -> None:
    sdf = ball(64)
    direction = around(300, 1.0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    on_box = direction * (BOX / np.abs(direction).max(1, keepdims=True))
    inner, outer = sdf(on_box * (1 - 1e-6)), sdf(on_box * (1 + 1e-6))
    np.testing.assert_allclose(inner[0], outer[0], atol=1e-5)
    for reach in (1.1, 3.0, 100.0):
        distance, gradient = sdf(reach * on_box)
        over = distance / (np.linalg.norm(reach * on_box, axis=1) - 0.5) - 1
        assert over.min() > -CAUTION - 0.003 and over.max() < 0.02
        assert (gradient * direction).sum(1).min() > 0.95


@pytest.mark.parametrize("resolution", [2, 15, 16])
def test_never_nan_and_never_beside_the_grid(resolution: int) -> None:
    sdf = ball(resolution)
    points = np.array([[0.0, 0, 0], [BOX] * 3, [-BOX] * 3, [1e15, -1e15, 1e15], [0.0, 0.0, 0.5]])
    for part in sdf(points):
        assert np.isfinite(part).all()
    # What is not a number stays none, rather than reading beside the grid.
    assert np.isnan(sdf(np.array([[np.nan, 0.0, 0.0]]))[0]).all()


def test_an_oracle_and_an_sdf_can_be_sampled() -> None:
    cube = box()
    offset = np.array([3.0, 0.0, 0.0])
    oracle = MeshDistance(Mesh(cube.vertices * 0.2 + offset, cube.faces))
    told: list[float] = []
    sdf = sample_grid(oracle, oracle.bounds, 20, lambda fraction, _: told.append(fraction))
    assert told[0] == 0.0 and told[-1] == 1.0
    np.testing.assert_allclose(sdf.bounds, oracle.bounds)
    points = around(300, 0.13) + offset
    np.testing.assert_allclose(sdf(points)[0], oracle(points).distance, atol=0.006)
    again = BoxSdf((0.1, 0.1, 0.1))
    whole = sample_grid(again, again.bounds, 20).values
    np.testing.assert_allclose(whole.numpy(), sdf.values.numpy(), atol=1e-6)


def test_empty_chunked_and_numpy_questions(monkeypatch: pytest.MonkeyPatch) -> None:
    sdf = ball(20)
    assert sdf(torch.zeros(0, 3))[1].shape == (0, 3)
    points = torch.rand(1000, 3) * 2 - 1
    whole = sdf(points)
    for chunk in (37, 500, 1000):
        monkeypatch.setattr(grid_module, "CHUNK", chunk)
        for one, other in zip(whole, replace(sdf)(points), strict=True):
            assert torch.equal(one, other)
    assert sdf(points.double().numpy())[0].dtype == np.float64


@pytest.mark.parametrize(
    ("make", "error", "told"),
    [
        (lambda: ball(1), SdfsimError, "two samples"),
        (lambda: sample_grid(SphereSdf(0.5), np.array([[-np.inf] * 3, [np.inf] * 3]), 8), SdfsimError, "no extent"),
        (
            lambda: GridSdf(torch.zeros((4, 4, 5)), Frame(np.zeros(3), 1.0), BOUNDS),
            ValueError,
            "equal numbers of samples",
        ),
        (lambda: GridSdf(torch.zeros((4, 4)), Frame(np.zeros(3), 1.0), BOUNDS), ValueError, "equal numbers of samples"),
        (
            lambda: GridSdf(torch.zeros((1, 1, 1)), Frame(np.zeros(3), 1.0), BOUNDS),
            ValueError,
            "equal numbers of samples",
        ),
    ],
)
def test_grids_that_cannot_be_are_refused(make, error, told) -> None:
    with pytest.raises(error, match=told):
        make()


@pytest.mark.gpu
def test_cuda_gives_what_the_cpu_gives() -> None:
    sdf, points = ball(40), torch.rand(5000, 3) * 2 - 1
    here, there = sdf(points), sdf.to("cuda")(points.cuda())
    assert there[0].is_cuda
    torch.testing.assert_close(here[0], there[0].cpu(), rtol=1e-4, atol=1e-5)
    # The slope jumps from cell to cell, and rounding may put a point at a face on its other side: on the one GPU where
    # this has run a few of 5,000 points were off, by 0.003 at most.
    apart = (here[1] - there[1].cpu()).abs().amax(1)
    assert int((apart > 1e-3).sum()) <= 5 and float(apart.max()) < 0.02


@pytest.mark.parametrize("coarse", [2, 4, 8])
def test_a_grid_sampled_near_the_surface_only_is_the_same_there(coarse):
    """A ball of 0.5 m: equal wherever a block reaches the surface, and near enough to the distance elsewhere."""
    ball, asked = SphereSdf(0.5), []

    def counted(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        asked.append(len(points))
        return ball(points)

    whole = sample_grid(ball, ball.bounds, 129).values.numpy()
    near = sample_grid(counted, ball.bounds, 129, coarse=coarse).values.numpy()
    block = 1.4 * coarse / 128
    close = np.abs(whole) < 0.25 * block
    np.testing.assert_array_equal(near[close], whole[close])
    assert np.abs(near - whole).max() < 0.3 * block
    assert sum(asked) < 0.6 * 129**3


SIZE = (1.0, 0.6, 0.8)
HALF = np.array(SIZE) / 2


@pytest.fixture(scope="module")
def crate() -> MeshSdf:
    return MeshSdf(box(SIZE))


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


def test_metres_of_a_mesh_far_from_the_origin() -> None:
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


def ball_at(points: torch.Tensor, centre: tuple[float, float, float] = (0, 0, 0), radius: float = 0.5) -> torch.Tensor:
    return (points - points.new_tensor(centre)).norm(dim=-1) - radius


def ring_at(points: torch.Tensor) -> torch.Tensor:
    return torch.hypot(points[:, :2].norm(dim=-1) - 0.35, points[:, 2]) - 0.15


def block(points: torch.Tensor) -> torch.Tensor:
    q = points.abs() - points.new_tensor([0.5, 0.3, 0.2])
    return q.clamp_min(0).norm(dim=-1) + q.amax(-1).clamp_max(0)


def dumb_bell(points: torch.Tensor) -> torch.Tensor:
    return torch.minimum(ball_at(points, (0.35, 0, 0), 0.15), ball_at(points, (-0.4, 0.1, 0), 0.1))


SOLIDS = {
    "ball": (ball_at, (0.5, 0.5, 0.5)),
    "torus": (ring_at, (0.5, 0.5, 0.15)),
    "block": (block, (0.5, 0.3, 0.2)),
    "dumb-bell": (dumb_bell, (0.5, 0.2, 0.15)),
}


def known(solid):
    """`solid` as it is in the box, and nothing beyond it."""

    def inner(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        assert (points.abs() <= BOX).all()
        points = points.detach().requires_grad_()
        with torch.enable_grad():
            value = solid(points)
            (gradient,) = torch.autograd.grad(value.sum(), points)
        return value.detach(), gradient

    return inner


def asked(name: str, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    solid, half = SOLIDS[name]
    return *everywhere(known(solid), points, points.new_tensor(half)), solid(points)


@pytest.mark.parametrize("name", SOLIDS)
def test_the_far_field_is_the_distance_within_two_percent(name: str) -> None:
    generator = torch.Generator().manual_seed(0)
    points = (torch.rand(20_000, 3, dtype=torch.float64, generator=generator) * 2 - 1) * 3
    value, gradient, true = asked(name, points)
    outside = (points.abs() > BOX).any(-1)
    ratio = value[outside] / true[outside]
    assert ratio.max() < 1.02
    assert ratio.min() > 1 - CAUTION - 1e-6
    torch.testing.assert_close(gradient[outside].norm(dim=-1), torch.ones_like(ratio))
    inside = ~outside
    torch.testing.assert_close(value[inside], true[inside], rtol=0, atol=1e-12)
    # The nearest surface point is where the gradient says.
    foot = points - true[:, None] * gradient
    assert SOLIDS[name][0](foot[outside]).abs().quantile(0.99) < 0.25


@pytest.mark.parametrize("name", SOLIDS)
def test_nothing_jumps_at_the_box(name: str) -> None:
    direction = torch.randn(500, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    on_box = direction * (BOX / direction.abs().amax(1, keepdim=True))
    inner, outer = (asked(name, on_box * factor)[0] for factor in (1 - 1e-7, 1 + 1e-7))
    torch.testing.assert_close(inner, outer, rtol=0, atol=1e-5)
    full = on_box * (1 + FADE / BOX)
    value, _, true = asked(name, full)
    assert ((value / true) <= 1.02 * (1 - CAUTION) + 0.02).all()


def test_gradients_keep_their_length_and_never_vanish() -> None:
    def flat(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        length = torch.where(points[:, :1] > 0, 5.0, 0.0)
        return torch.full_like(points[:, 0], -0.1), length * torch.tensor([1.0, 0, 0])

    points = torch.tensor([[0.0, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]])
    _, gradient = everywhere(flat, points, torch.full((3,), 0.5))
    np.testing.assert_allclose(gradient, [[0, 0, SLOPE[0]], [-SLOPE[0], 0, 0], [SLOPE[1], 0, 0]], atol=1e-4)
