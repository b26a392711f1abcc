from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from sdfsim.shape import mlp
from sdfsim.shape.mesh import Frame
from sdfsim.shape.mlp import BOX, MlpSdf, value_and_gradient


def network(seed: int, activation: mlp.Activation, width: int = 64, layers: int = 8) -> MlpSdf:
    generator = torch.Generator().manual_seed(seed)
    sizes = [3, *[width] * (layers - 1), 1]
    weights = tuple(
        torch.randn(out, inner, generator=generator) * (1.5 / inner) ** 0.5 for inner, out in pairwise(sizes)
    )
    biases = tuple(torch.randn(out, generator=generator) for out in sizes[1:])
    frame = Frame(np.array([0.1 * seed, -0.2, 0.3]), 0.5 + 0.3 * seed)
    bounds = frame.outward(np.array([[-0.5] * 3, [0.5] * 3]))
    return MlpSdf(weights, biases, activation, frame, bounds)


def ball(radius: float = 0.4) -> MlpSdf:
    """ReLU units that add up to a distance-like function (an octahedron's), known in closed form."""
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    return MlpSdf(
        (axes, torch.full((1, 6), 3.0**-0.5)),
        (torch.zeros(6), torch.tensor([-radius])),
        "relu",
        Frame(np.zeros(3), 1.0),
        np.array([[-BOX] * 3, [BOX] * 3]),
    )


@pytest.mark.parametrize("activation", ["sine", "relu"])
@pytest.mark.parametrize(("width", "layers"), [(64, 8), (7, 3), (16, 2)])
def test_the_hand_written_sweep_is_autograd(activation: mlp.Activation, width: int, layers: int) -> None:
    nets = [network(seed, activation, width, layers) for seed in range(3)]
    weights = [torch.stack(layer).double() for layer in zip(*(net.weights for net in nets), strict=True)]
    biases = [torch.stack(layer).double() for layer in zip(*(net.biases for net in nets), strict=True)]
    points = torch.rand(3, 50, 3, dtype=torch.float64).requires_grad_()
    value, gradient = value_and_gradient(weights, biases, activation, points)
    assert not value.requires_grad
    hidden = points
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        hidden = torch.einsum("sti,soi->sto", hidden, weight) + bias[:, None]
        hidden = hidden.sin() if activation == "sine" else hidden.relu()
    expected = (torch.einsum("sti,soi->sto", hidden, weights[-1]) + biases[-1][:, None])[..., 0]
    torch.testing.assert_close(value, expected.detach(), rtol=1e-12, atol=1e-12)
    (slope,) = torch.autograd.grad(expected.sum(), points)
    torch.testing.assert_close(gradient, slope, rtol=1e-10, atol=1e-12)


def test_metres_and_normalised_frame() -> None:
    net = network(2, "sine")
    local = torch.rand(100, 3, dtype=torch.float64) - 0.5
    value, gradient = value_and_gradient(
        [w[None] for w in net.weights], [b[None] for b in net.biases], "sine", local[None].float()
    )
    distance, slope = net(local * net.frame.scale + torch.from_numpy(net.frame.centre))
    assert distance.dtype == torch.float64
    torch.testing.assert_close(distance.float(), value[0] * net.frame.scale, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(slope.float(), gradient[0], rtol=1e-3, atol=1e-3)


def test_large_coordinates_leave_before_the_cast() -> None:
    net = network(1, "sine")
    far = MlpSdf(net.weights, net.biases, "sine", Frame(net.frame.centre + 1e6, net.frame.scale), net.bounds + 1e6)
    points = net.frame.outward(np.random.default_rng(0).uniform(-0.6, 0.6, (100, 3)))
    np.testing.assert_allclose(far(points + 1e6)[0], net(points)[0], atol=1e-6)


def test_beyond_the_box_the_distance_goes_on() -> None:
    sdf = ball()
    direction = torch.nn.functional.normalize(torch.randn(200, 3, dtype=torch.float64), dim=1)
    on_box = direction * (BOX / direction.abs().amax(1, keepdim=True))
    inner, outer = sdf(on_box * (1 - 1e-6)), sdf(on_box * (1 + 1e-6))
    torch.testing.assert_close(inner[0], outer[0], rtol=0, atol=1e-5)
    torch.testing.assert_close(inner[1], outer[1], rtol=0, atol=1e-4)
    points = on_box * (1.0 + 30.0 * torch.rand(200, 1, dtype=torch.float64))
    distance, gradient = sdf(points)
    assert torch.isfinite(distance).all()
    torch.testing.assert_close(gradient.norm(dim=1), torch.ones(200, dtype=torch.float64), atol=1e-5, rtol=0)
    # At least the way to the box, at most the way to the centre of it.
    assert (distance >= (points.abs() - BOX).clamp_min(0).norm(dim=1) - 1e-6).all()
    assert (distance <= points.norm(dim=1)).all()
    step = 1e-3
    slope = (sdf(points + step * gradient)[0] - sdf(points - step * gradient)[0]) / (2 * step)
    assert (slope - 1).abs().max() < 0.2


def test_a_bad_network_cannot_undercut_the_bounding_box() -> None:
    sdf = network(2, "sine")
    points = sdf.frame.outward(np.random.default_rng(0).uniform(-3, 3, (2000, 3)))
    distance, gradient = sdf(points)
    excess = np.maximum(sdf.bounds[0] - points, 0) + np.maximum(points - sdf.bounds[1], 0)
    least = np.linalg.norm(excess, axis=1)
    assert (distance >= least - 1e-5).all()
    bound = (np.abs(distance - least) < 1e-5) & (least > 0.1)
    assert bound.any()
    np.testing.assert_allclose(np.linalg.norm(gradient[bound], axis=1), 1.0, atol=1e-4)


def test_never_nan() -> None:
    sdf = network(1, "sine")
    points = np.array([[0.0, 0, 0], [1e15, -1e15, 1e15], [0.1, -0.2, 0.3]])
    for part in sdf(points):
        assert np.isfinite(part).all()
    for part in sdf(np.array([[1e30, 0.0, 0.0]])):
        assert not np.isnan(part).any()


def test_empty_chunked_and_numpy_questions(monkeypatch: pytest.MonkeyPatch) -> None:
    sdf = network(3, "sine")
    assert sdf(torch.zeros(0, 3))[1].shape == (0, 3)
    points = torch.rand(1000, 3)
    whole = sdf(points)
    monkeypatch.setattr(mlp, "CHUNK", 37)
    for one, other in zip(whole, sdf(points), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)
    array, _ = sdf(points.double().numpy())
    assert array.dtype == np.float64
