import torch

from sdfsim.sdf.fit.soap import Soap


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
