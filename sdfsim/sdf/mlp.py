"""The compact SDF network, and its hand-written forward, gradient and training sweeps.

The sweeps keep their memory. Otherwise the system would take back an array of a megabyte and page it in again at every
operation, which costs more than the arithmetic.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sdfsim.geometry.mesh import Frame
from sdfsim.sdf.far_field import in_metres
from sdfsim.sdf.sdf import accepts_numpy

if TYPE_CHECKING:
    import torch
else:
    from sdfsim.base.lazy import torch

# Points prepared and finished at once, a few hundred bytes each.
PREPARED = 131_072
# Points in one sweep. With 8 layers of width 64 a point takes 4 kB: 33 MB on the CPU, where the two active layers stay
# in the cache. A GPU needs more points at a time.
SWEPT = {"cpu": 8192, "cuda": 131_072}


@dataclass(frozen=True, eq=False)
class MlpSdf:
    """A signed distance as a small network on the shape normalised to [-0.5, 0.5]."""

    weights: tuple[torch.Tensor, ...]  # per layer [out, in] float32
    biases: tuple[torch.Tensor, ...]  # per layer [out] float32
    frame: Frame  # metres <-> normalised
    bounds: np.ndarray  # [2, 3] float64 m, the box that holds the solid
    # for each of the frame's planes x = 0, y = 0, z = 0, whether the solid is its own mirror image; the network holds
    # the positive side only
    mirrors: tuple[bool, bool, bool] = (False, False, False)

    @property
    def device(self) -> torch.device:
        return self.weights[0].device

    def to(self, device: torch.device | str) -> MlpSdf:
        """The same network on `device`."""
        weights, biases = (tuple(part.to(device) for part in parts) for parts in (self.weights, self.biases))
        return replace(self, weights=weights, biases=biases)

    def scaled(self, factor: float) -> MlpSdf:
        """The solid `factor` times as large."""
        return replace(self, frame=self.frame.scaled(factor), bounds=self.bounds * factor)

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and gradient [P, 3] at `points` [P, 3] m; evaluated in float32, cast back. See `everywhere`
        for points outside the box."""
        return in_metres(self._inside, self.frame, self.bounds, points, PREPARED)

    def _inside(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        # -1 if the point is on the side of a mirror plane that the network does not hold.
        mirrored = torch.tensor(self.mirrors, device=points.device)
        side = 1.0 - 2.0 * (mirrored & (points < 0)).to(points.dtype)
        value, gradient = value_and_gradient(self.weights, self.biases, points * side)
        return value, gradient * side


def wave(before: torch.Tensor, slope: torch.Tensor, spare: torch.Tensor) -> None:
    """The activation of hidden layers: parabolic arcs r (1 - 2 |r|) with r = x - round(x), close to a sine at a quarter
    of its cost. `before`, x, becomes the value, `slope` the derivative 1 - 4 |r|; `spare` is overwritten."""
    torch.round(before, out=spare)
    before.sub_(spare)
    torch.abs(before, out=spare)
    torch.mul(spare, -4.0, out=slope).add_(1.0)
    before.addcmul_(before, spare, value=-2.0)


class Tape:
    """Working memory of the sweeps. A layer is `wave(W x + b)`; the last one, which `layers` counts too, is linear with
    one output. Each layer has weights [out, in] and biases [out], with the device and dtype of `like`."""

    def __init__(self, width: int, layers: int, like: torch.Tensor) -> None:
        self._width, self._layers = width, layers
        self._like = like.new_empty(0)
        self._room = 0

    def forward(
        self, weights: Sequence[torch.Tensor], biases: Sequence[torch.Tensor], points: torch.Tensor
    ) -> torch.Tensor:
        """Values [T] at normalised `points` [T, 3]."""
        if len(points) > self._room:
            self._room = len(points)
            self._memory = self._like.new_empty(2 * self._layers, self._room * self._width)
        views = self._memory[:, : len(points) * self._width].view(-1, len(points), self._width)
        self.hidden, self.slope = views[: self._layers - 1], views[self._layers - 1 : -2]
        self._flow, self._spare = views[-2], views[-1]
        below = points
        for weight, bias, hidden, slope in zip(weights[:-1], biases[:-1], self.hidden, self.slope, strict=True):
            torch.addmm(bias, below, weight.T, out=hidden)
            wave(hidden, slope, self._spare)
            below = hidden
        return torch.addmm(biases[-1], below, weights[-1].T)[:, 0]

    def gradient(self, weights: Sequence[torch.Tensor]) -> torch.Tensor:
        """Gradients [T, 3] of the values that `forward` returned; overwrites what it stored."""
        # The last layer is one row, so its product with the slope broadcasts.
        flow = self.slope[-1].mul_(weights[-1])
        for layer in range(len(weights) - 2, 0, -1):
            flow = torch.mm(flow, weights[layer], out=self._free(layer)).mul_(self.slope[layer - 1])
        return flow @ weights[0]

    def parameter_gradients(
        self,
        weights: Sequence[torch.Tensor],
        points: torch.Tensor,
        error: torch.Tensor,
        into_weights: Sequence[torch.Tensor],
        into_biases: Sequence[torch.Tensor],
    ) -> None:
        """Gradients of a loss in the parameters, after `forward` with the same weights at the same points. `error` [T]
        is the derivative of the loss in each value; `into_weights` and `into_biases` are overwritten."""
        last = len(weights) - 1
        torch.mm(error[None], self.hidden[-1], out=into_weights[last])
        into_biases[last].copy_(error.sum())
        flow = torch.mul(error[:, None], weights[last], out=self._free(last)).mul_(self.slope[-1])
        for layer in range(last - 1, -1, -1):
            torch.sum(flow, dim=0, out=into_biases[layer])
            if layer == 0:
                torch.mm(flow.T, points, out=into_weights[0])
            else:
                torch.mm(flow.T, self.hidden[layer - 1], out=into_weights[layer])
                flow = torch.mm(flow, weights[layer], out=self._free(layer)).mul_(self.slope[layer - 1])

    def _free(self, layer: int) -> torch.Tensor:
        """The one of two arrays that the layer above does not use."""
        return self._flow if layer % 2 else self._spare


_kept = threading.local()


def value_and_gradient(
    weights: Sequence[torch.Tensor], biases: Sequence[torch.Tensor], points: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Value [T] and gradient [T, 3] of a network (see `Tape`) at normalised points [T, 3]; no autograd graph is built.
    The forward sweep keeps each activation's derivative; one reverse sweep multiplies them back to the input."""
    tapes = _kept.__dict__.setdefault("tapes", {})
    like, width = weights[0], len(weights[0])
    key = (width, len(weights), like.device, like.dtype)
    if key not in tapes:
        tapes[key] = Tape(width, len(weights), like)
    tape, room = tapes[key], SWEPT[like.device.type]
    value, gradient = points.new_empty(len(points), dtype=like.dtype), torch.empty_like(points, dtype=like.dtype)
    with torch.no_grad():
        for start in range(0, len(points), room):
            part = slice(start, start + room)
            value[part] = tape.forward(weights, biases, points[part])
            gradient[part] = tape.gradient(weights)
    return value, gradient
