from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from sdfsim.geometry.mesh import Frame
from sdfsim.sdf import far_field, mlp
from sdfsim.sdf.mlp import MlpSdf, Tape, value_and_gradient


def network(seed: int, width: int = 64, layers: int = 8) -> MlpSdf:
    generator = torch.Generator().manual_seed(seed)
    sizes = [3, *[width] * (layers - 1), 1]
    weights = tuple(
        torch.randn(out, inner, generator=generator) * (1.5 / inner) ** 0.5 for inner, out in pairwise(sizes)
    )
    biases = tuple(torch.randn(out, generator=generator) for out in sizes[1:])
    frame = Frame(np.array([0.1 * seed, -0.2, 0.3]), 0.5 + 0.3 * seed)
    bounds = frame.outward(np.array([[-0.5] * 3, [0.5] * 3]))
    return MlpSdf(weights, biases, frame, bounds)


def forward(weights: list[torch.Tensor], biases: list[torch.Tensor], points: torch.Tensor):
    hidden = points
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        before = hidden @ weight.T + bias
        rest = before - before.round()
        hidden = rest * (1 - 2 * rest.abs())
    return (hidden @ weights[-1].T + biases[-1])[..., 0]


def doubles(width: int, layers: int) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Weights and biases of a network."""
    net = network(3, width, layers)
    return [weight.double() for weight in net.weights], [bias.double() for bias in net.biases]


@pytest.mark.parametrize(("width", "layers"), [(64, 8), (7, 3), (16, 2)])
def test_the_hand_written_sweep_is_autograd(width: int, layers: int) -> None:
    weights, biases = doubles(width, layers)
    points = torch.rand(50, 3, dtype=torch.float64).requires_grad_()
    value, gradient = value_and_gradient(weights, biases, points)
    assert not value.requires_grad
    expected = forward(weights, biases, points)
    torch.testing.assert_close(value, expected.detach(), rtol=1e-12, atol=1e-12)
    (slope,) = torch.autograd.grad(expected.sum(), points)
    torch.testing.assert_close(gradient, slope, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("width", "layers"), [(16, 5), (7, 2)])
def test_the_hand_written_training_sweep_is_autograd(width: int, layers: int) -> None:
    weights, biases = doubles(width, layers)
    points, error = torch.rand(40, 3, dtype=torch.float64), torch.randn(40, dtype=torch.float64)
    tape = Tape(width, layers, weights[0])
    tape.forward(weights, biases, points)
    got = [torch.empty_like(part) for part in (*weights, *biases)]
    tape.parameter_gradients(weights, points, error, got[:layers], got[layers:])
    parameters = [part.requires_grad_() for part in (*weights, *biases)]
    value = forward(parameters[:layers], parameters[layers:], points)
    for ours, theirs in zip(got, torch.autograd.grad((value * error).sum(), parameters), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-12)


def test_memory_that_stays_does_not_leak_between_calls(monkeypatch: pytest.MonkeyPatch) -> None:
    net, points = network(1), torch.rand(1000, 3, dtype=torch.float64) - 0.5
    whole = net(points)
    monkeypatch.setitem(mlp.SWEPT, "cpu", 64)
    parts = net(points)
    assert net(torch.zeros(0, 3))[1].shape == (0, 3) and net(points.numpy())[0].dtype == np.float64
    again = [net(points[start : start + 100]) for start in range(0, 1000, 100)]
    for i in range(2):
        torch.testing.assert_close(parts[i], whole[i], rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(torch.cat([one[i] for one in again]), whole[i], rtol=1e-4, atol=1e-6)


def test_a_mirrored_network_is_the_same_on_both_sides() -> None:
    net = network(1)
    net = replace(net, mirrors=(True, False, True), frame=Frame(np.array([0.3, 0.0, 1.0]), 2.0))
    points = net.frame.outward(np.random.default_rng(0).uniform(-1.5, 1.5, (300, 3)))
    flip = np.array([-1.0, 1.0, -1.0])
    distance, gradient = net(points)
    image = net((points - net.frame.centre) * flip + net.frame.centre)
    np.testing.assert_allclose(image[0], distance, atol=1e-6)
    np.testing.assert_allclose(image[1] * flip, gradient, atol=1e-5)
    unfolded = replace(net, mirrors=(False, False, False))
    positive = (points >= net.frame.centre)[:, [0, 2]].all(1)
    np.testing.assert_array_equal(unfolded(points[positive])[0], distance[positive])


def test_metres_and_normalised_frame() -> None:
    net = network(2)
    local = torch.rand(100, 3, dtype=torch.float64) - 0.5
    value, gradient = value_and_gradient(net.weights, net.biases, local.float())
    distance, slope = net(local * net.frame.scale + torch.from_numpy(net.frame.centre))
    assert distance.dtype == torch.float64
    torch.testing.assert_close(distance.float(), value * net.frame.scale, rtol=1e-4, atol=1e-4)
    norm = gradient.norm(dim=1, keepdim=True)
    torch.testing.assert_close(slope.float(), gradient / norm * norm.clamp(*far_field.SLOPE), rtol=1e-3, atol=1e-3)


def test_large_coordinates_leave_before_the_cast() -> None:
    net = network(1)
    far = MlpSdf(net.weights, net.biases, Frame(net.frame.centre + 1e6, net.frame.scale), net.bounds + 1e6)
    points = net.frame.outward(np.random.default_rng(0).uniform(-0.6, 0.6, (100, 3)))
    np.testing.assert_allclose(far(points + 1e6)[0], net(points)[0], atol=1e-6)


def test_a_bad_network_cannot_undercut_the_bounding_box() -> None:
    sdf = network(2)
    points = sdf.frame.outward(np.random.default_rng(0).uniform(-3, 3, (2000, 3)))
    distance, gradient = sdf(points)
    excess = np.maximum(sdf.bounds[0] - points, 0) + np.maximum(points - sdf.bounds[1], 0)
    least = np.linalg.norm(excess, axis=1)
    assert (distance >= least - 1e-5).all()
    bound = (np.abs(distance - least) < 1e-5) & (least > 0.1)
    assert bound.any()
    np.testing.assert_allclose(np.linalg.norm(gradient[bound], axis=1), 1.0, atol=1e-4)
