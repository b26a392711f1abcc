"""Mixed precision: matrix products in bfloat16, everything else as it was."""

from __future__ import annotations

from copy import deepcopy

from torch import Tensor, nn


def in_bfloat16(network: nn.Module) -> nn.Module:
    """The network with the products of its linear layers taken in bfloat16.

    Weights stay as they are and stay the network's own: what trains the one trains the other.
    """
    own = {id(tensor): tensor for tensor in (*network.parameters(), *network.buffers())}
    rounded = nn.Sequential(deepcopy(network, own)) if isinstance(network, nn.Linear) else deepcopy(network, own)
    for parent in list(rounded.modules()):
        for name, child in list(parent.named_children()):
            if isinstance(child, nn.Linear):
                setattr(parent, name, _Rounded(child))
    return rounded


class _Rounded(nn.Module):
    """A linear layer whose inputs, weights and outputs are rounded to bfloat16."""

    def __init__(self, layer: nn.Linear) -> None:
        super().__init__()
        self.layer = layer

    def forward(self, x: Tensor) -> Tensor:
        bias = None if self.layer.bias is None else self.layer.bias.bfloat16()
        return nn.functional.linear(x.bfloat16(), self.layer.weight.bfloat16(), bias).to(x.dtype)
