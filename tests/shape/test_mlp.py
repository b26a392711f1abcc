from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from sdfsim.shape import mlp
from sdfsim.shape.analytic import BoxSdf, PlaneSdf, SphereSdf
from sdfsim.shape.mesh import Frame
from sdfsim.shape.mlp import BOX, MlpSdf, SdfBank, value_and_gradient
from sdfsim.shape.sdf import Sdf


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


@pytest.fixture
def mixed() -> list[Sdf]:
    return [
        network(1, "sine"),
        SphereSdf(0.3),
        network(2, "relu"),
        PlaneSdf(),
        network(3, "sine"),
        BoxSdf((0.2, 0.3, 0.4)),
        SphereSdf(0.7),
        network(4, "sine"),
        network(5, "sine", width=16),
        BoxSdf((1.0, 0.1, 0.4)),
    ]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [0, 1, 7, 500, 5000])
def test_the_bank_is_each_one_alone(mixed: list[Sdf], count: int, dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(count)
    # Uneven shares, and some shapes not asked at all.
    index = (torch.rand(count, generator=generator) ** 2 * (len(mixed) - 1)).long()
    points = (torch.rand(count, 3, generator=generator, dtype=dtype) - 0.5) * 3
    distance, gradient = SdfBank(mixed)(index, points)
    assert distance.dtype == gradient.dtype == dtype
    assert gradient.shape == (count, 3)
    for number, sdf in enumerate(mixed):
        alone = sdf(points[index == number])
        torch.testing.assert_close(distance[index == number], alone[0], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(gradient[index == number], alone[1], rtol=1e-3, atol=1e-4)


def test_the_bank_takes_strangers_and_devices(mixed: list[Sdf]) -> None:
    class Slab:
        bounds = np.array([[-1.0] * 3, [1.0] * 3])

        def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return points[:, 0] - 1, torch.tensor([1.0, 0, 0]).expand_as(points)

    bank = SdfBank([*mixed, Slab()]).to("cpu")
    points = torch.rand(20, 3)
    distance, _ = bank(torch.full((20,), len(mixed)), points)
    torch.testing.assert_close(distance, points[:, 0] - 1)
    # "meta" stands in for a GPU: every index the bank looks up must have moved.
    assert SdfBank([SphereSdf(0.3), PlaneSdf()]).to("meta")._slot_of.device.type == "meta"


def test_order_of_questions_does_not_matter() -> None:
    bank = SdfBank([network(seed, "sine") for seed in range(1, 6)])
    index, points = torch.randint(5, (3000,)), torch.rand(3000, 3)
    turn = torch.randperm(3000)
    straight, turned = bank(index, points), bank(index[turn], points[turn])
    torch.testing.assert_close(straight[0][turn], turned[0], rtol=1e-4, atol=1e-5)


@pytest.mark.gpu
def test_cuda_gives_what_the_cpu_gives(mixed: list[Sdf]) -> None:
    index, points = torch.randint(len(mixed), (5000,)), torch.rand(5000, 3)
    here = SdfBank(mixed)(index, points)
    there = SdfBank(mixed).to("cuda")(index.cuda(), points.cuda())
    torch.testing.assert_close(here[0], there[0].cpu(), rtol=1e-3, atol=1e-3)


@pytest.mark.gpu
@pytest.mark.parametrize(
    "sdfs", [[SphereSdf(0.3)], [PlaneSdf(), SphereSdf(0.3), BoxSdf((0.2, 0.3, 0.4))]], ids=["one", "several"]
)
def test_a_bank_without_networks_goes_to_cuda_too(sdfs: list[Sdf]) -> None:
    index, points = torch.randint(len(sdfs), (5000,)), torch.rand(5000, 3)
    here = SdfBank(sdfs)(index, points)
    bank = SdfBank(sdfs).to("cuda")
    assert bank.device.type == "cuda"
    there = bank(index.cuda(), points.cuda())
    assert there[0].is_cuda and there[1].is_cuda
    torch.testing.assert_close(here[0], there[0].cpu(), rtol=1e-5, atol=1e-5)
