"""Signed distances that are known in a box around a solid, extended to all of space."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from sdfsim.geometry.mesh import Frame

if TYPE_CHECKING:
    import torch

    Inner = Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]
else:
    from sdfsim.base.lazy import torch

# Half extent of the box, in the normalised frame, on which distances are fitted or sampled (the paper's sampling box).
BOX = 0.7
# Bounds of the length of returned gradients. A network's slope is within them almost everywhere near the surface, but a
# network rounds off the ridge in the middle of a thin wall, where x - f grad f / |grad f|^2 would be far away.
SLOPE = (0.9, 1.1)
# Beyond the box distances are reduced by this part, because feet are not quite the nearest points. The reduction is
# full from `FADE` on, so that distances do not jump at the box.
CAUTION, FADE = 0.03, 0.1

# Points [P, 3] in the box -> value [P], gradient [P, 3].


def in_metres(
    inner: Inner, frame: Frame, bounds: np.ndarray, points: torch.Tensor, chunk: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance [P] m and gradient [P, 3] at `points` [P, 3] m; computed in float32, `chunk` at once, and cast back.
    `inner` gives values and gradients in the box of the normalised `frame`; `bounds` [2, 3] m are those of the
    solid."""
    centre = torch.from_numpy(frame.centre).to(points)
    half = torch.from_numpy(np.abs(bounds - frame.centre).max(0) / frame.scale).to(points.device, torch.float32)
    distance, gradient = [], []
    for part in points.split(chunk):
        # The centre is subtracted in the precision of the points, before the cast.
        value, slope = everywhere(inner, ((part - centre) / frame.scale).float(), half)
        distance.append(value.to(points.dtype) * frame.scale)
        gradient.append(slope.to(points.dtype))
    return torch.cat(distance), torch.cat(gradient)


def everywhere(inner: Inner, points: torch.Tensor, half: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Value [P] and gradient [P, 3] at normalised points [P, 3], inside the box and beyond it.

    The length of the gradient is kept within `SLOPE`; a zero gradient is replaced by the direction away from the
    centre. Outside the solid's bounding box, of half extents `half` [3], the value is at least the distance to that
    box, whatever the error of the fit.
    """
    clamped = points.clamp(-BOX, BOX)
    value, gradient = inner(clamped)
    norm = gradient.norm(dim=-1, keepdim=True)
    away = clamped + clamped.new_tensor([0.0, 0.0, 1e-6])
    unit = torch.where(norm > 1e-6, gradient / norm.clamp_min(1e-6), away / away.norm(dim=-1, keepdim=True))
    gradient = unit * norm.clamp(*SLOPE)
    outside = (points != clamped).any(-1).nonzero()[:, 0]
    if len(outside):
        first = clamped[outside] - value[outside].clamp_min(0)[:, None] * unit[outside]
        value[outside], gradient[outside] = _beyond(inner, points[outside], first)
    beyond = (points.abs() - half).clamp_min(0)
    least = beyond.norm(dim=-1)
    short = (least > 0) & (least > value)
    straight = beyond.copysign(points) / least.clamp_min(1e-12)[:, None]
    return torch.where(short, least, value), torch.where(short[:, None], straight, gradient)


def _beyond(inner: Inner, points: torch.Tensor, first: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance and gradient at points [P, 3] outside the box, where `first` [P, 3] are feet from its nearest points.

    For a point q of the box with value f and direction g, the nearest surface point is its foot c = q - f g. No |x - c|
    is shorter than the distance from x, so the shortest of several is taken: `first`; the foot from where the segment
    from x to that foot enters the box; and the same two for the segment from x to the middle. The gradient points from
    the foot to x; this far out it is better than the fitted one.
    """

    def feet_towards(*goals: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """A foot for each goal, from one query."""
        way = points - torch.stack(goals)
        # Where the segment enters the box: at the side of the box that it reaches last.
        passed = ((points.abs() - BOX) / way.abs().clamp_min(1e-12)).clamp(0, 1).amax(-1, keepdim=True)
        entry = (points - passed * way).clamp(-BOX, BOX)
        value, gradient = inner(entry.flatten(0, 1))
        unit = gradient / gradient.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        foot = entry - (value.clamp_min(0)[:, None] * unit).view_as(entry)
        return foot.clamp(-BOX, BOX).unbind()

    first = first.clamp(-BOX, BOX)
    nearer, middle = feet_towards(first, torch.zeros_like(points))
    (through,) = feet_towards(middle)
    ways = points - torch.stack([first, nearer, middle, through])
    shortest, which = ways.norm(dim=-1).min(0)
    ray = ways[which, torch.arange(len(points), device=points.device)]
    out = (points.abs() - BOX).amax(-1)
    value = shortest * (1.0 - CAUTION * (out / FADE).clamp(0.0, 1.0))
    return value, ray / shortest.clamp_min(1e-6)[:, None]
