"""The compact SDF network: a shape's signed distance, sane everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from sdfsim.shape.mesh import Frame
from sdfsim.shape.sdf import accepts_numpy
from sdfsim.shape.sweep import Activation, value_and_gradient

# Half extent of the box, in the normalised frame, on which the network is fitted (the paper's sampling box).
BOX = 0.7
# Points prepared and finished at once, a few hundred bytes each.
CHUNK = 131_072
# Gradients are returned no shorter and no longer than this. A network's slope is within it almost everywhere near the
# surface, but rounds off the ridge in the middle of a thin wall, where x - f grad f / |grad f|^2 would fly off.
SLOPE = (0.9, 1.1)


def complete(
    value: torch.Tensor, gradient: torch.Tensor, clamped: torch.Tensor, points: torch.Tensor, half: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Make a fitted SDF sane where a fit is not: on ridges, and away from where it was fitted.

    The length of the gradient is kept within `SLOPE`; where it vanishes, it points away from the centre.

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
    norm = gradient.norm(dim=-1, keepdim=True)
    away = clamped + clamped.new_tensor([0.0, 0.0, 1e-6])
    unit = torch.where(norm > 1e-6, gradient / norm.clamp_min(1e-6), away / away.norm(dim=-1, keepdim=True))
    gradient = unit * norm.clamp(*SLOPE)
    # So far out the direction of a fitted gradient is better than its length, which is known to be 1.
    ray = points - clamped + value.clamp_min(0)[:, None] * unit
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

        Near the solid the gradient is the network's own; see `complete` for what is not.
        """
        centre = torch.as_tensor(self.frame.centre, dtype=points.dtype, device=points.device)
        half = half_extents(self.frame, self.bounds).to(points.device)
        mirrors = torch.tensor(self.mirrors, device=points.device)
        distance, gradient = [], []
        for part in points.split(CHUNK) if len(points) else (points,):
            # The centre leaves in the precision of the points, before the cast.
            local = ((part - centre) / self.frame.scale).float()
            clamped = local.clamp(-BOX, BOX)
            side = sides(clamped, mirrors)
            value, slope = value_and_gradient(*self._stack, self.activation, (clamped * side)[None])
            value, slope = complete(value[0], slope[0] * side, clamped, local, half)
            distance.append(value.to(points.dtype) * self.frame.scale)
            gradient.append(slope.to(points.dtype))
        return torch.cat(distance), torch.cat(gradient)


def sides(points: torch.Tensor, mirrors: torch.Tensor) -> torch.Tensor:
    """-1 where a coordinate of `points` [P, 3] is on the negative side of one of `mirrors` [3] or [P, 3], else 1."""
    return 1.0 - 2.0 * (mirrors & (points < 0)).to(points.dtype)


def half_extents(frame: Frame, bounds: np.ndarray) -> torch.Tensor:
    """[3] float32: how far a solid with `bounds` [2, 3] m reaches from the centre of its normalised frame."""
    return torch.from_numpy(np.abs(bounds - frame.centre).max(0) / frame.scale).float()
