from __future__ import annotations

import torch

from sdfsim.shape.soap import Soap


def stack(shape: tuple[int, ...], seed: int) -> torch.Tensor:
    parameter = torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    parameter.grad = torch.zeros_like(parameter)
    return parameter


def descend(
    optimiser: Soap | torch.optim.Adam, parameters: list[torch.Tensor], steps: int, *factor: torch.Tensor
) -> None:
    """Towards a quadratic's minimum."""
    for _ in range(steps):
        for parameter in parameters:
            assert parameter.grad is not None
            parameter.grad.copy_(torch.linspace(0.1, 3.0, parameter.shape[-1]) * parameter + 0.3)
        optimiser.step(*factor)


def test_soap_without_matrices_to_rotate_is_adam() -> None:
    # A 1 x 1 "matrix" has no basis; the first step of SOAP only looks.
    ours, theirs = stack((1, 2, 1, 1), 0), stack((1, 2, 1, 1), 0)
    adam = torch.optim.Adam([theirs], 0.01, betas=(Soap.MOMENTUM, Soap.SECOND), eps=Soap.LEAST)
    descend(Soap([ours], 0.01), [ours], 31, torch.ones(2, dtype=torch.float64))
    descend(adam, [theirs], 30)
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
