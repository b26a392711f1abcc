"""The compact SDF network: value and gradient in one call, by a hand-written reverse sweep."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch

from sdfsim.shape.mesh import Frame
from sdfsim.shape.sdf import accepts_numpy

Activation = Literal["sine", "relu"]

# Half extent of the box, in the normalised frame, on which the network is fitted (the paper's sampling box).
BOX = 0.7
# Points evaluated at once: 7 layers x 64 wide x 2 arrays x 4 bytes x this many is about 120 MB.
CHUNK = 32_768


def value_and_gradient(
    weights: list[torch.Tensor], biases: list[torch.Tensor], activation: Activation, points: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Evaluate a stack of networks of one architecture, each on its own points; no autograd graph is built.

    A layer is `act(W x + b)`, the last one is linear with one output. The forward sweep keeps each activation's
    derivative; one reverse sweep multiplies them back to the input, which costs as much as the forward one.

    Args:
        weights: per layer [S, out, in].
        biases: per layer [S, out].
        activation: of the hidden layers.
        points: [S, T, 3], in the networks' own (normalised) coordinates.

    Returns:
        value [S, T] and its gradient [S, T, 3], in the dtype of the weights.
    """
    with torch.no_grad():
        slopes = []
        hidden = points
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            before = torch.baddbmm(bias[:, None, :], hidden, weight.transpose(1, 2))
            if activation == "sine":
                slopes.append(before.cos())
                hidden = before.sin_()
            else:
                slopes.append((before > 0).to(before.dtype))
                hidden = before.relu_()
        value = torch.baddbmm(biases[-1][:, None, :], hidden, weights[-1].transpose(1, 2))[..., 0]
        # The last layer is one row, so its product with the slope broadcasts.
        flow = slopes[-1].mul_(weights[-1])
        for weight, slope in zip(weights[-2:0:-1], slopes[-2::-1], strict=True):
            flow = torch.bmm(flow, weight).mul_(slope)
        return value, torch.bmm(flow, weights[0])


def complete(
    value: torch.Tensor, gradient: torch.Tensor, clamped: torch.Tensor, points: torch.Tensor, half: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Make a fitted SDF sane away from where it was fitted.

    Beyond the fitted box: from the clamped point q with value f and gradient g the nearest surface is near
    c = q - f g / |g|, so the distance is |x - c| and its gradient points from c to x. It meets the inner value
    continuously at the box and, unlike f + |x - q|, does not overestimate what lies sideways.

    Outside the solid's bounding box the distance to that box is a lower bound that no error of the fit may undercut.

    Args:
        value: [P] at the clamped points.
        gradient: [P, 3] likewise.
        clamped: [P, 3], `points` moved to the nearest point of the fitted box.
        points: [P, 3], normalised.
        half: [3] or [P, 3] half extents of the solid's bounding box, normalised.

    Returns:
        value [P] and gradient [P, 3] at `points`.
    """
    outside = (points != clamped).any(-1)
    # So far out the direction of a fitted gradient is better than its length, which is known to be 1.
    step = value.clamp_min(0) / gradient.norm(dim=-1).clamp_min(1e-6)
    ray = points - clamped + step[:, None] * gradient
    length = ray.norm(dim=-1)
    value = torch.where(outside, length, value)
    gradient = torch.where(outside[:, None], ray / length.clamp_min(1e-6)[:, None], gradient)
    beyond = (points.abs() - half).clamp_min(0)
    least = beyond.norm(dim=-1)
    short = (least > 0) & (least > value)
    straight = beyond.copysign(points) / least.clamp_min(1e-12)[:, None]
    return torch.where(short, least, value), torch.where(short[:, None], straight, gradient)


@dataclass(frozen=True, eq=False)
class MlpSdf:
    """A signed distance as a small network on the shape normalised to [-0.5, 0.5].

    Attributes:
        weights: per layer [out, in] float32.
        biases: per layer [out] float32.
        activation: of the hidden layers ("sine": sin(W x + b), the frequency is part of W).
        frame: metres <-> normalised.
        bounds: [2, 3] float64 m, the box that holds the solid.
    """

    weights: tuple[torch.Tensor, ...]
    biases: tuple[torch.Tensor, ...]
    activation: Activation
    frame: Frame
    bounds: np.ndarray

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
        )

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and gradient [P, 3] at `points` [P, 3] m; evaluated in float32, cast back.

        Near the solid the gradient is the network's own; see `complete` for what is far.
        """
        centre = torch.as_tensor(self.frame.centre, dtype=points.dtype, device=points.device)
        half = half_extents(self.frame, self.bounds).to(points.device)
        distance, gradient = [], []
        for part in points.split(CHUNK) if len(points) else (points,):
            # The centre leaves in the precision of the points, before the cast.
            local = ((part - centre) / self.frame.scale).float()
            clamped = local.clamp(-BOX, BOX)
            value, slope = value_and_gradient(*self._stack, self.activation, clamped[None])
            value, slope = complete(value[0], slope[0], clamped, local, half)
            distance.append(value.to(points.dtype) * self.frame.scale)
            gradient.append(slope.to(points.dtype))
        return torch.cat(distance), torch.cat(gradient)


def half_extents(frame: Frame, bounds: np.ndarray) -> torch.Tensor:
    """[3] float32: how far a solid with `bounds` [2, 3] m reaches from the centre of its normalised frame."""
    return torch.from_numpy(np.abs(bounds - frame.centre).max(0) / frame.scale).float()
