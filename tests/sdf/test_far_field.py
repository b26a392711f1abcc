import numpy as np
import pytest
import torch

from sdfsim.sdf.far_field import BOX, CAUTION, FADE, SLOPE, everywhere


def ball(points: torch.Tensor, centre: tuple[float, float, float] = (0, 0, 0), radius: float = 0.5) -> torch.Tensor:
    return (points - points.new_tensor(centre)).norm(dim=-1) - radius


def torus(points: torch.Tensor) -> torch.Tensor:
    return torch.hypot(points[:, :2].norm(dim=-1) - 0.35, points[:, 2]) - 0.15


def block(points: torch.Tensor) -> torch.Tensor:
    q = points.abs() - points.new_tensor([0.5, 0.3, 0.2])
    return q.clamp_min(0).norm(dim=-1) + q.amax(-1).clamp_max(0)


def dumb_bell(points: torch.Tensor) -> torch.Tensor:
    return torch.minimum(ball(points, (0.35, 0, 0), 0.15), ball(points, (-0.4, 0.1, 0), 0.1))


SOLIDS = {
    "ball": (ball, (0.5, 0.5, 0.5)),
    "torus": (torus, (0.5, 0.5, 0.15)),
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
