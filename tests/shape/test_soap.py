from __future__ import annotations

import torch

from sdfsim.shape.soap import Adam, Soap


def stack(shape: tuple[int, ...], seed: int) -> torch.Tensor:
    parameter = torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    parameter.grad = torch.zeros_like(parameter)
    return parameter


def descend(optimiser: Adam, parameters: list[torch.Tensor], steps: int, factor: torch.Tensor) -> None:
    """Towards a quadratic's minimum."""
    for _ in range(steps):
        for parameter in parameters:
            assert parameter.grad is not None
            parameter.grad.copy_(torch.linspace(0.1, 3.0, parameter.shape[-1]) * parameter + 0.3)
        optimiser.step(factor)


def test_adam_is_torchs() -> None:
    ours, theirs = stack((2, 3, 4, 5), 0), stack((2, 3, 4, 5), 0)
    reference = torch.optim.Adam([theirs], lr=0.01)
    optimiser = Adam([ours], 0.01)
    for _ in range(50):
        for parameter in (ours, theirs):
            assert parameter.grad is not None
            parameter.grad.copy_(parameter.detach().sin() + 0.1)
        optimiser.step(torch.ones(3, dtype=torch.float64))
        reference.step()
    torch.testing.assert_close(ours, theirs.detach(), rtol=1e-12, atol=1e-12)


def test_soap_without_matrices_to_rotate_is_adam() -> None:
    # A 1 x 1 "matrix" has no basis; the first step of SOAP only looks.
    ours, theirs = stack((1, 2, 1, 1), 0), stack((1, 2, 1, 1), 0)
    soap, adam = Soap([ours], 0.01), Adam([theirs], 0.01)
    adam.MOMENTUM, adam.SECOND, adam.LEAST = Soap.MOMENTUM, Soap.SECOND, Soap.LEAST
    descend(soap, [ours], 31, torch.ones(2, dtype=torch.float64))
    descend(adam, [theirs], 30, torch.ones(2, dtype=torch.float64))
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


def test_networks_of_a_stack_do_not_touch_each_other() -> None:
    together = [stack((2, 3, 4, 5), 0), stack((1, 3, 1, 5), 1)]
    alone = [p[:, 1:2].clone() for p in together]
    for p in alone:
        p.grad = torch.zeros_like(p)
    half = torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64)
    before = [p[:, 2].clone() for p in together]
    descend(Soap(together, 0.01), together, 40, half)
    descend(Soap(alone, 0.01), alone, 40, half[1:2])
    for one, other, still in zip(together, alone, before, strict=True):
        torch.testing.assert_close(one[:, 1:2], other, rtol=1e-9, atol=1e-9)
        assert torch.equal(one[:, 2], still)


def test_a_row_that_is_forgotten_is_as_new_and_rows_can_leave() -> None:
    parameters = [stack((2, 3, 4, 5), 0)]
    optimiser = Soap(parameters, 0.01)
    descend(optimiser, parameters, 25, torch.ones(3, dtype=torch.float64))
    kept = {key: value[:, 1:].clone() for key, value in optimiser.state[0].items()}
    optimiser.forget(torch.tensor([True, False, False]))
    fresh = Soap([stack((2, 3, 4, 5), 9)], 0.01)
    for key, value in optimiser.state[0].items():
        assert torch.equal(value[:, :1], fresh.state[0][key][:, :1])
        assert torch.equal(value[:, 1:], kept[key])
    rows = torch.tensor([1, 2])
    fewer = [p[:, rows].clone() for p in parameters]
    for p in fewer:
        p.grad = torch.zeros_like(p)
    optimiser.keep(rows, fewer)
    descend(optimiser, fewer, 10, torch.ones(2, dtype=torch.float64))
    assert not torch.equal(fewer[0], parameters[0][:, rows])
