"""Matrix products in bfloat16: what is rounded, what is not, and whose weights learn."""

from copy import deepcopy

import pytest
import torch
from torch import nn

from sdfsim.dynamics.model import new_network
from sdfsim.dynamics.precision import in_bfloat16


@pytest.fixture
def rows():
    return torch.randn(32, 3, generator=torch.Generator().manual_seed(0))


def test_a_layers_inputs_weights_and_product_are_rounded_and_its_output_is_single(rows):
    layer = nn.Linear(3, 2)
    exact, rounded = layer(rows), in_bfloat16(layer)(rows)
    expected = nn.functional.linear(rows.bfloat16(), layer.weight.bfloat16(), layer.bias.bfloat16()).float()
    assert rounded.dtype == torch.float32
    assert torch.equal(rounded, expected) and not torch.equal(rounded, exact)
    assert torch.equal(layer(rows), exact)


def test_gradients_reach_the_networks_own_weights(rows):
    network = nn.Sequential(nn.Linear(3, 16), nn.SiLU(), nn.Sequential(nn.Linear(16, 1, bias=False)))
    twin = deepcopy(network)
    in_bfloat16(network)(rows).square().mean().backward()
    twin(rows).square().mean().backward()
    for own, exact in zip(network.parameters(), twin.parameters(), strict=True):
        assert own.dtype == own.grad.dtype == torch.float32
        assert 0 < (own.grad - exact.grad).abs().max() < 0.05 * exact.grad.abs().max()


@pytest.mark.parametrize("kind, config", [("impulse", {"rounds": 2}), ("paper", {"steps": 2})])
def test_every_linear_layer_of_a_network_is_rounded_and_no_weight_is_copied(kind, config):
    network = new_network(kind, config | {"width": 8})
    rounded = in_bfloat16(network)
    inside = [name for name, module in rounded.named_modules() if isinstance(module, nn.Linear)]
    assert len(inside) == sum(isinstance(module, nn.Linear) for module in network.modules()) > 0
    assert all(name.endswith(".layer") for name in inside)
    assert {id(p) for p in rounded.parameters()} == {id(p) for p in network.parameters()}
