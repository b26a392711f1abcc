"""The compact SDF network: a shape's signed distance, sane everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from sdfsim.shape.far_field import everywhere, half_extents
from sdfsim.shape.mesh import Frame
from sdfsim.shape.mlp_sdf import Activation, value_and_gradient
from sdfsim.shape.sdf import accepts_numpy

# Points prepared and finished at once, a few hundred bytes each.
CHUNK = 131_072


@dataclass(frozen=True, eq=False)
class MlpSdf:
    """A signed distance as a small network on the shape normalised to [-0.5, 0.5].

    Attributes:
        weights: per layer [out, in] float32.
        biases: per layer [out] float32.
        activation: of the hidden layers (the frequency of the periodic ones is part of the weights).
        frame: metres <-> normalised.
        bounds: [2, 3] float64 m, the box that holds the solid.
        mirrors: across which of the frame's planes x = 0, y = 0, z = 0 the solid is its own mirror image; the network
            knows the positive side only.
    """

    weights: tuple[torch.Tensor, ...]
    biases: tuple[torch.Tensor, ...]
    activation: Activation
    frame: Frame
    bounds: np.ndarray
    mirrors: tuple[bool, bool, bool] = (False, False, False)

    @property
    def device(self) -> torch.device:
        return self.weights[0].device

    @property
    def architecture(self) -> tuple:
        """Networks with equal architecture can be evaluated in one batched product."""
        return (self.activation, *(tuple(weight.shape) for weight in self.weights))

    @cached_property
    def _stack(self) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        return [weight[None] for weight in self.weights], [bias[None] for bias in self.biases]

    def to(self, device: torch.device | str) -> MlpSdf:
        """The same network on `device`."""
        return MlpSdf(
            tuple(weight.to(device) for weight in self.weights),
            tuple(bias.to(device) for bias in self.biases),
            self.activation,
            self.frame,
            self.bounds,
            self.mirrors,
        )

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and gradient [P, 3] at `points` [P, 3] m; evaluated in float32, cast back.

        Near the solid the gradient is the network's own; see `everywhere` for what is not.
        """
        centre = torch.as_tensor(self.frame.centre, dtype=points.dtype, device=points.device)
        half = half_extents(self.frame, self.bounds).to(points.device)
        mirrors = torch.tensor(self.mirrors, device=points.device)

        def inner(rows: torch.Tensor | None, local: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            side = sides(local, mirrors)
            value, slope = value_and_gradient(*self._stack, self.activation, (local * side)[None])
            return value[0], slope[0] * side

        distance, gradient = [], []
        for part in points.split(CHUNK) if len(points) else (points,):
            # The centre leaves in the precision of the points, before the cast.
            local = ((part - centre) / self.frame.scale).float()
            value, slope = everywhere(inner, local, half)
            distance.append(value.to(points.dtype) * self.frame.scale)
            gradient.append(slope.to(points.dtype))
        return torch.cat(distance), torch.cat(gradient)


def sides(points: torch.Tensor, mirrors: torch.Tensor) -> torch.Tensor:
    """-1 where a coordinate of `points` [P, 3] is on the negative side of one of `mirrors` [3] or [P, 3], else 1."""
    return 1.0 - 2.0 * (mirrors & (points < 0)).to(points.dtype)
