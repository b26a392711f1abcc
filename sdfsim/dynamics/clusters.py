"""Neighbouring surface nodes in balls: one distance to the middle of a ball often answers for all that it holds.

A signed distance changes by no more than the way gone. So where it is large against a ball's radius no node in the ball
can be within reach, and what a search costs goes with the area that is near, not with the number of nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sdfsim.dynamics.bodies import Bodies

NODES = 24  # about so many in a ball
_HALF = 2**12  # cells on either side of a body's centre along each axis; what lies beyond shares the last one


@dataclass(frozen=True)
class Layer:
    """K balls about their bodies' centres of mass, shape axes, model lengths.

    Attributes:
        centre: [K, 3] float64.
        radius: [K] float64; 0 in the layer of the nodes.
        start: [parents + 1] int64: ball p of the layer above holds balls start[p] : start[p + 1] of this one. Above the
            first layer are the bodies.
        node: [K] int64 index into `Bodies.node`; in the layer of the nodes only, else empty.
    """

    centre: Tensor
    radius: Tensor
    start: Tensor
    node: Tensor

    def __len__(self) -> int:
        return len(self.centre)


def layers(bodies: Bodies) -> tuple[Layer, Layer, Layer]:
    """The balls around whole bodies (those without nodes have none), around patches of them, and the nodes."""
    count = bodies.node_start[1:] - bodies.node_start[:-1]
    owner = torch.repeat_interleave(torch.arange(len(bodies), device=bodies.device), count)
    cell = (bodies.node / _patch(bodies, count)[owner, None]).floor().clamp(-_HALF, _HALF - 1).long() + _HALF
    key = ((owner * 2 * _HALF + cell[:, 0]) * 2 * _HALF + cell[:, 1]) * 2 * _HALF + cell[:, 2]
    patch, of_patch = torch.unique(key, return_inverse=True)
    order = of_patch.argsort(stable=True)
    node, of_patch = bodies.node[order], of_patch[order]
    parent, of_body = torch.unique_consecutive(patch // (2 * _HALF) ** 3, return_inverse=True)
    whole = Layer(*_balls(node, of_body[of_patch], len(parent)), _starts(parent, len(bodies)), order[:0])
    patches = Layer(*_balls(node, of_patch, len(patch)), _starts(of_body, len(parent)), order[:0])
    return whole, patches, Layer(node, torch.zeros_like(node[:, 0]), _starts(of_patch, len(patch)), order)


def _patch(bodies: Bodies, count: Tensor) -> Tensor:
    """[N] how wide patches of a body are so that each gets about `NODES`, as if its nodes covered its box evenly."""
    side = bodies.bounds[:, 1] - bodies.bounds[:, 0]
    area = 2.0 * (side * side.roll(1, -1)).sum(-1)
    width = (NODES * area / count.clamp_min(1)).sqrt()
    return torch.where(width.isfinite() & (width > 0), width, torch.ones_like(width))


def _balls(points: Tensor, group: Tensor, groups: int) -> tuple[Tensor, Tensor]:
    """Middle [G, 3] of the box around the points [K, 3] of each group, and how far [G] they are from it."""
    index = group[:, None].expand_as(points)
    start = torch.zeros(groups, 3, dtype=points.dtype, device=points.device)
    low = start.scatter_reduce(0, index, points, "amin", include_self=False)
    high = start.scatter_reduce(0, index, points, "amax", include_self=False)
    centre = 0.5 * (low + high)
    far = (points - centre[group]).norm(dim=-1)
    return centre, start[:, 0].scatter_reduce(0, group, far, "amax", include_self=False)


def _starts(parent: Tensor, parents: int) -> Tensor:
    """[parents + 1] where the children of each begin, of children sorted by their `parent` [K]."""
    ends = torch.bincount(parent, minlength=parents).cumsum(0)
    return torch.cat([ends.new_zeros(1), ends])
