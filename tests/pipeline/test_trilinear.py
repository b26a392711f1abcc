"""Grids that are learned, against torch's own sampler of volumes."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from pipeline.field.interpolation import interpolate


def twin(grid: Tensor, points: Tensor) -> Tensor:
    """The same by `grid_sample`."""
    found = functional.grid_sample(
        grid.permute(3, 0, 1, 2)[None], points.view(1, 1, 1, -1, 3), padding_mode="border", align_corners=True
    )
    return found.view(grid.shape[3], -1).t()


@pytest.mark.parametrize(("side", "channels"), [(2, 1), (5, 4), (33, 2)])
def test_values_and_gradient_are_those_of_the_general_sampler(side, channels):
    rng = torch.Generator().manual_seed(side)
    grid = torch.randn(side, side, side, channels, generator=rng, dtype=torch.float64, requires_grad=True)
    inside = torch.rand(500, 3, generator=rng, dtype=torch.float64) * 2.4 - 1.2  # some of them outside
    knots = torch.linspace(-1, 1, side, dtype=torch.float64)
    points = torch.cat([inside, torch.cartesian_prod(knots, knots, knots)])
    found, wanted = interpolate(grid, points), twin(grid, points)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-12)
    weights = torch.randn(found.shape, generator=rng, dtype=torch.float64)
    (one,) = torch.autograd.grad((found * weights).sum(), grid)
    (two,) = torch.autograd.grad((wanted * weights).sum(), grid)
    torch.testing.assert_close(one, two, rtol=0, atol=1e-12)


def test_a_linear_function_of_x_y_z_is_itself():
    line = torch.linspace(-1, 1, 9, dtype=torch.float64)
    z, y, x = torch.meshgrid(line, line, line, indexing="ij")
    points = torch.rand(100, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 2 - 1
    found = interpolate((x + 10 * y + 100 * z)[..., None], points)[:, 0]
    torch.testing.assert_close(
        found, points @ torch.tensor([1.0, 10.0, 100.0], dtype=torch.float64), rtol=0, atol=1e-12
    )


def test_nothing_asked_is_nothing_found():
    grid = torch.ones(4, 4, 4, 3, requires_grad=True)
    found = interpolate(grid, torch.zeros(0, 3))
    assert found.shape == (0, 3)
    found.sum().backward()
    assert grid.grad is not None and not grid.grad.any()
