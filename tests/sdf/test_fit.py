"""Fits of networks to solids, and the optimiser of their weights."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry import primitives
from sdfsim.geometry.mass import mass_properties, mass_properties_of_sdf
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import load_mesh, load_pieces
from sdfsim.sdf.fit import train as fit_module
from sdfsim.sdf.fit.soap import Soap
from sdfsim.sdf.mlp import MlpSdf
from sdfsim.shape.make import fit_mesh, fit_pieces
from sdfsim.shape.shape import Shape


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = replace(
        fit_module.RECIPES["default"], width=16, layers=4, steps=600, batch=256, pool=5000, goal=None, decay=0.5
    )
    monkeypatch.setitem(fit_module.RECIPES, "default", plan)


def weights(shape: Shape) -> list[torch.Tensor]:
    assert isinstance(shape.sdf, MlpSdf)
    return [*shape.sdf.weights, *shape.sdf.biases]


def test_a_torus_in_a_few_hundred_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = replace(fit_module.RECIPES["default"], steps=450, batch=1024, pool=60_000, goal=None)
    monkeypatch.setitem(fit_module.RECIPES, "default", plan)
    mesh = primitives.torus(0.35, 0.15)
    shape = fit_mesh(Mesh(mesh.vertices * 0.2 + [5.0, 0.0, -3.0], mesh.faces), name="ring")
    got = shape.certificate
    assert got["passed"], got["reason"]
    assert got["error_within_0.01"] < 8e-4
    assert got["error_within_0.1"] < 1e-3
    assert got["error_in_box"] < 4e-3
    assert got["gradient_within_0.1"] < 4e-3
    assert got["projected_from_0.01"] < 1e-3
    assert got["sign_errors"] < 2e-3
    # The certificate is about held-out points of the mesh; this is the closed form.
    local = np.random.default_rng(3).uniform(-0.6, 0.6, (4000, 3))
    truth = np.hypot(np.hypot(local[:, 0], local[:, 1]) - 0.35, local[:, 2]) - 0.15
    distance, gradient = shape.sdf(local * 0.2 + [5.0, 0.0, -3.0])
    assert np.abs(distance / 0.2 - truth).mean() < 3e-3
    norm = np.linalg.norm(gradient, axis=1)[np.abs(truth) < 0.1]
    assert 0.9 < np.quantile(norm, 0.02) < np.quantile(norm, 0.98) < 1.1
    # The hole is open; at its middle, a cusp of the distance, the network rounds off.
    assert 0.03 < shape.sdf(np.array([[5.0, 0.0, -3.0]]))[0][0] < 0.041
    # Far outside the fitted box it still is a distance; a full fit is within a few percent.
    far = np.random.default_rng(4).normal(size=(500, 3))
    far *= np.random.default_rng(5).uniform(1.3, 20.0, (500, 1)) / np.linalg.norm(far, axis=1, keepdims=True)
    truth = np.hypot(np.hypot(far[:, 0], far[:, 1]) - 0.35, far[:, 2]) - 0.15
    ratio = shape.sdf(far * 0.2 + [5.0, 0.0, -3.0])[0] / 0.2 / truth
    assert 0.85 < ratio.min()
    assert ratio.max() < 1.12
    assert shape.nodes.shape == (512, 3)
    on = (shape.nodes - [5.0, 0.0, -3.0]) / 0.2
    assert np.abs(np.hypot(np.hypot(on[:, 0], on[:, 1]) - 0.35, on[:, 2]) - 0.15).max() < 3e-3
    assert shape.volume == pytest.approx(mass_properties(mesh)[0] * 0.2**3)
    np.testing.assert_allclose(shape.com, [5.0, 0.0, -3.0], atol=1e-6)


def test_the_same_seed_gives_the_same_weights(tiny: None) -> None:
    mesh = primitives.cone(segments=16)
    first, second, other = (fit_mesh(mesh, name="cone", seed=seed) for seed in (0, 0, 1))
    assert all(torch.equal(a, b) for a, b in zip(weights(first), weights(second), strict=True))
    assert not torch.equal(weights(first)[0], weights(other)[0])
    np.testing.assert_array_equal(first.nodes, second.nodes)


def test_a_budget_is_kept_and_still_ends_in_a_decay(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = replace(fit_module.RECIPES["default"], width=16, layers=4, batch=256, pool=5000, goal=None, steps=10**6)
    monkeypatch.setitem(fit_module.RECIPES, "default", plan)
    started = time.process_time()  # a busy machine does not count
    shape = fit_mesh(primitives.box(), name="box", budget=2.0)
    assert time.process_time() - started < 6.0
    assert shape.certificate["steps"] < 10**5
    with pytest.raises(SdfsimError, match="budget"):
        fit_mesh(primitives.box(), name="box", budget=0.0)


def test_a_goal_that_is_met_ends_the_fit_early(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = replace(
        fit_module.RECIPES["default"], width=16, layers=4, batch=256, pool=5000, goal=(1.0,) * 4, settle=100, steps=5000
    )
    monkeypatch.setitem(fit_module.RECIPES, "default", plan)
    assert fit_mesh(primitives.box(), name="box").certificate["steps"] == 200


def test_pieces_keep_their_own_vertices_as_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = replace(fit_module.RECIPES["default"], width=32, layers=5, steps=500, batch=512, pool=30_000, goal=None)
    monkeypatch.setitem(fit_module.RECIPES, "default", plan)
    half = primitives.box((0.5, 1.0, 1.0))
    shifts = [np.array([-0.25, 0, 0]), np.array([0.25, 0, 0])]
    buried = primitives.box((0.2, 0.2, 0.2))
    pieces = [
        *(Mesh(half.vertices + shift, half.faces) for shift in shifts),
        Mesh(buried.vertices - 0.25, buried.faces),
    ]
    display = primitives.box()
    shape = fit_pieces(pieces, name="block", display=display, nodes=40)
    assert shape.mesh is display
    assert [len(piece) for piece in shape.pieces] == [8, 8, 8]
    assert shape.nodes.shape == (40, 3)
    corners = {tuple(corner) for corner in primitives.box().vertices}
    assert {tuple(node) for node in shape.nodes[:8]} == corners
    # None of the buried cube's, and no repetition of the shared corners.
    assert np.abs(np.abs(shape.nodes).max(1) - 0.5).max() < 0.02
    assert len(np.unique(shape.nodes.round(6), axis=0)) == 40
    assert shape.volume == pytest.approx(1.0, rel=0.02)
    np.testing.assert_allclose(shape.inertia, np.eye(3) / 6, rtol=0.03, atol=1e-3)


def test_pieces_between_the_samples_of_a_grid_keep_their_corners():
    cube = primitives.box((0.001, 0.001, 0.001))
    pieces = [Mesh(cube.vertices + np.array([x, y, 0.0]), cube.faces) for x in (-0.25, 0.25) for y in (-0.1, 0.1)]
    shape = fit_pieces(pieces, name="feet", kind="grid")
    corners = np.concatenate([piece.vertices for piece in pieces])
    assert np.abs(shape.nodes[:, None] - corners).sum(2).min(0).max() < 1e-9
    assert shape.volume == pytest.approx(4 * 0.001**3, rel=0.05)


def test_a_shape_with_mirror_planes_is_fitted_on_one_side(tiny: None) -> None:
    cone = fit_mesh(primitives.cone(), name="cone").sdf
    assert isinstance(cone, MlpSdf)
    assert cone.mirrors == (True, True, False)
    shoe = fit_mesh(primitives.shoe(), name="shoe").sdf
    assert isinstance(shoe, MlpSdf)
    assert shoe.mirrors == (False, False, False)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["suzanne", "sponge", "cube", "spot"])
def test_real_shapes_within_the_default_recipe(data_dir: Path, name: str) -> None:
    started = time.monotonic()
    got = fit_mesh(load_mesh(data_dir / "kubasic" / name / "visual_geometry.obj"), name=name).certificate
    assert time.monotonic() - started < 120
    assert got["passed"], got["reason"]
    assert got["error_within_0.01"] < (1e-3 if name == "sponge" else 5e-4)
    assert got["projected_from_0.01"] < 5e-4


@pytest.mark.slow
def test_convex_pieces_of_a_real_shape(data_dir: Path) -> None:
    pieces = load_pieces(data_dir / "kubasic" / "torus" / "collision_geometry.obj")
    shape = fit_pieces(pieces, name="torus")
    assert shape.certificate["error_within_0.01"] < 8e-4
    assert mass_properties_of_sdf(shape.sdf, shape.sdf.bounds)[0] == pytest.approx(shape.volume, rel=0.01)


def stack(shape: tuple[int, ...], seed: int) -> torch.Tensor:
    parameter = torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    parameter.grad = torch.zeros_like(parameter)
    return parameter


def descend(optimiser: Soap | torch.optim.Adam, parameters: list[torch.Tensor], steps: int, *factor: float) -> None:
    """Towards a quadratic's minimum."""
    for _ in range(steps):
        for parameter in parameters:
            parameter.grad.copy_(torch.linspace(0.1, 3.0, parameter.shape[-1]) * parameter + 0.3)
        optimiser.step(*factor)


def test_soap_without_matrices_to_rotate_is_adam() -> None:
    # A 1 x 1 "matrix" has no basis; the first step of SOAP only looks.
    ours, theirs = stack((2, 1, 1), 0), stack((2, 1, 1), 0)
    adam = torch.optim.Adam([theirs], 0.01, betas=(Soap.MOMENTUM, Soap.SECOND), eps=Soap.LEAST)
    descend(Soap([ours], 0.01), [ours], 31, 1.0)
    descend(adam, [theirs], 30)
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


def test_equal_layers_of_a_stack_do_not_touch_each_other_and_a_factor_of_0_leaves_them() -> None:
    together = [stack((3, 4, 5), 0), stack((3, 1, 5), 1)]
    alone = [p[1:2].clone() for p in together]
    for p in alone:
        p.grad = torch.zeros_like(p)
    descend(Soap(together, 0.01), together, 40, 0.5)
    descend(Soap(alone, 0.01), alone, 40, 0.5)
    for one, other in zip(together, alone, strict=True):
        torch.testing.assert_close(one[1:2], other, rtol=1e-9, atol=1e-9)
    before = together[0].clone()
    descend(Soap(together, 0.01), together, 3, 0.0)
    assert torch.equal(together[0], before)
