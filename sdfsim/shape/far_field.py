"""Signed distances that are known in a box around a solid, made sane everywhere."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
import torch

from sdfsim.shape.mesh import Frame

# Half extent of the box, in the normalised frame, on which distances are fitted or sampled (the paper's sampling box).
BOX = 0.7
# Gradients are returned no shorter and no longer than this. A network's slope is within it almost everywhere near the
# surface, but rounds off the ridge in the middle of a thin wall, where x - f grad f / |grad f|^2 would fly off.
SLOPE = (0.9, 1.1)
# Beyond the box distances are returned smaller by this part, which makes up for feet that are not quite the nearest;
# the full part from `FADE` on, so that nothing jumps at the box.
CAUTION, FADE = 0.03, 0.1

# (rows of the points that are asked, or None for all; points [P, 3] in the box) -> value [P], gradient [P, 3].
Inner = Callable[[torch.Tensor | None, torch.Tensor], tuple[torch.Tensor, torch.Tensor]]


class Boxed(Protocol):
    """An SDF that is known on the box of its normalised frame; see `MlpSdf` and `GridSdf`."""

    @property
    def frame(self) -> Frame: ...

    @property
    def bounds(self) -> np.ndarray: ...


class BoxedStack(ABC):
    """Boxed SDFs of one kind, asked together; `_inside` knows them within the box.

    Args:
        sdfs: the SDFs; slots refer to them in this order.
        device: where to compute.
        chunk: points prepared and finished at once.
    """

    def __init__(self, sdfs: Sequence[Boxed], device: torch.device, chunk: int) -> None:
        self._centre = torch.tensor(np.stack([sdf.frame.centre for sdf in sdfs]), device=device)
        self._scale = torch.tensor([sdf.frame.scale for sdf in sdfs], dtype=torch.float64, device=device)
        half = np.stack([np.abs(sdf.bounds - sdf.frame.centre).max(0) / sdf.frame.scale for sdf in sdfs])
        self._half = torch.from_numpy(half).float().to(device)
        self._chunk = chunk
        self._count = len(sdfs)

    def __call__(self, slot: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and gradient [P, 3] of SDF `slot[p]` at `points[p]`; computed in float32, cast back."""
        distance, gradient = [], []
        for some, part in zip(slot.split(self._chunk), points.split(self._chunk), strict=True):
            scale = self._scale.index_select(0, some).to(points.dtype)
            centre, half = self._centre.index_select(0, some), self._half.index_select(0, some)
            # The centre leaves in the precision of the points, before the cast.
            local = ((part - centre.to(points.dtype)) / scale[:, None]).float()

            def inner(rows: torch.Tensor | None, local: torch.Tensor, some: torch.Tensor = some):
                return self._inside(some if rows is None else some[rows], local)

            value, slope = everywhere(inner, local, half)
            distance.append(value.to(points.dtype) * scale)
            gradient.append(slope.to(points.dtype))
        return torch.cat(distance), torch.cat(gradient)

    def alone(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance and gradient of the first SDF."""
        return self(torch.zeros(len(points), dtype=torch.int64, device=points.device), points)

    @abstractmethod
    def _inside(self, slot: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Normalised distance [P] and gradient [P, 3] of SDF `slot[p]` at `points[p]`, within the box."""


def everywhere(inner: Inner, points: torch.Tensor, half: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances inside the box and beyond it.

    The length of the gradient is kept within `SLOPE`; where it vanishes, it points away from the centre. Outside the
    solid's bounding box the distance to that box is a lower bound that no error of the fit may undercut.

    Args:
        inner: what is known in the box.
        points: [P, 3], normalised.
        half: [3] or [P, 3] half extents of the solid's bounding box, normalised.

    Returns:
        value [P] and gradient [P, 3] at `points`.
    """
    clamped = points.clamp(-BOX, BOX)
    value, gradient = inner(None, clamped)
    norm = gradient.norm(dim=-1, keepdim=True)
    away = clamped + clamped.new_tensor([0.0, 0.0, 1e-6])
    unit = torch.where(norm > 1e-6, gradient / norm.clamp_min(1e-6), away / away.norm(dim=-1, keepdim=True))
    gradient = unit * norm.clamp(*SLOPE)
    outside = (points != clamped).any(-1).nonzero()[:, 0]
    if len(outside):
        first = clamped[outside] - value[outside].clamp_min(0)[:, None] * unit[outside]
        value[outside], gradient[outside] = _beyond(inner, outside, points[outside], first)
    beyond = (points.abs() - half).clamp_min(0)
    least = beyond.norm(dim=-1)
    short = (least > 0) & (least > value)
    straight = beyond.copysign(points) / least.clamp_min(1e-12)[:, None]
    return torch.where(short, least, value), torch.where(short[:, None], straight, gradient)


def _beyond(
    inner: Inner, rows: torch.Tensor, points: torch.Tensor, first: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance and gradient outside the box.

    From a point q of the box with value f and direction g the nearest surface is at its foot c = q - f g. No |x - c| is
    shorter than the distance, so the shortest of several is taken: `first`, the foot from where the segment from x to
    that one enters the box, and the same two from where the segment from x to the middle enters it. The gradient
    points from the foot to x; so far out this is better than the fitted one.

    Args:
        inner: what is known in the box.
        rows: [P] of `points` among those that `inner` was first asked for.
        points: [P, 3] outside the box.
        first: [P, 3] feet from the nearest points of the box.
    """
    shortest = torch.full_like(points[:, 0], torch.inf)
    ray = torch.empty_like(points)

    def consider(foot: torch.Tensor) -> None:
        nonlocal shortest, ray
        way = points - foot
        length = way.norm(dim=-1)
        closer = length < shortest
        shortest, ray = torch.where(closer, length, shortest), torch.where(closer[:, None], way, ray)

    def feet_towards(*goals: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """A foot for each goal, of one query."""
        way = points - torch.stack(goals)
        # Of the sides of the box that lie between, the segment passes the one it comes to last.
        passed = ((points.abs() - BOX) / way.abs().clamp_min(1e-12)).clamp(0, 1).amax(-1, keepdim=True)
        entry = (points - passed * way).clamp(-BOX, BOX)
        value, gradient = inner(rows.repeat(len(goals)), entry.flatten(0, 1))
        unit = gradient / gradient.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        foot = entry - (value.clamp_min(0)[:, None] * unit).view_as(entry)
        return foot.clamp(-BOX, BOX).unbind()

    first = first.clamp(-BOX, BOX)
    nearer, middle = feet_towards(first, torch.zeros_like(points))
    (through,) = feet_towards(middle)
    for foot in (first, nearer, middle, through):
        consider(foot)
    out = (points.abs() - BOX).amax(-1)
    value = shortest * (1.0 - CAUTION * (out / FADE).clamp(0.0, 1.0))
    return value, ray / shortest.clamp_min(1e-6)[:, None]
