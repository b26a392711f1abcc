"""The compact SDF network: value and gradient in one call, by a hand-written reverse sweep."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch

from sdfsim.shape.analytic import BoxSdf, PlaneSdf, SphereSdf, box_distance, plane_distance, sphere_distance
from sdfsim.shape.mesh import Frame
from sdfsim.shape.sdf import Sdf, accepts_numpy

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
        half = _half_extents(self).to(points.device)
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


def _half_extents(sdf: MlpSdf) -> torch.Tensor:
    """[3] float32: how far the solid reaches from the centre of the normalised frame."""
    return torch.from_numpy(np.abs(sdf.bounds - sdf.frame.centre).max(0) / sdf.frame.scale).float()


class SdfBank:
    """Many SDFs asked at once: each point of its own shape.

    Networks of one architecture share batched matrix products; spheres, boxes and planes are evaluated by kind.
    Anything else that speaks the protocol is called once per shape.

    Args:
        sdfs: the shapes; `index` refers to them in this order.
        device: where to compute; by default where the first network is, or on the CPU.
    """

    def __init__(self, sdfs: Sequence[Sdf], device: torch.device | str | None = None) -> None:
        self.sdfs = tuple(sdfs)
        networks = [sdf.device for sdf in self.sdfs if isinstance(sdf, MlpSdf)]
        self.device = torch.device(device if device is not None else networks[0] if networks else "cpu")
        kinds: dict[object, list[int]] = {}
        for number, sdf in enumerate(self.sdfs):
            if isinstance(sdf, MlpSdf):
                key: object = sdf.architecture
            elif isinstance(sdf, PlaneSdf | SphereSdf | BoxSdf):
                key = type(sdf)
            else:
                key = number
            kinds.setdefault(key, []).append(number)
        self._groups = [_group([self.sdfs[number] for number in members], self.device) for members in kinds.values()]
        group_of, slot_of = [0] * len(self.sdfs), [0] * len(self.sdfs)
        for group, members in enumerate(kinds.values()):
            for slot, number in enumerate(members):
                group_of[number], slot_of[number] = group, slot
        self._group_of = torch.tensor(group_of, dtype=torch.int64, device=self.device)
        self._slot_of = torch.tensor(slot_of, dtype=torch.int64, device=self.device)

    def to(self, device: torch.device | str) -> SdfBank:
        """The same bank on `device`."""
        return SdfBank(self.sdfs, device)

    def __call__(self, index: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance and gradient of shape `index[p]` at `points[p]`.

        Args:
            index: [P] int64 into the sequence given at construction.
            points: [P, 3] m, each in its own shape's frame.

        Returns:
            distance [P] m and gradient [P, 3], in the dtype of `points`: what each SDF alone would give.
        """
        slot = self._slot_of[index]
        if len(self._groups) == 1:
            return self._groups[0](slot, points)
        group_of = self._group_of[index]
        distance, gradient = torch.empty_like(points[:, 0]), torch.empty_like(points)
        for number, group in enumerate(self._groups):
            chosen = (group_of == number).nonzero()[:, 0]
            if len(chosen):
                distance[chosen], gradient[chosen] = group(slot[chosen], points[chosen])
        return distance, gradient


def _group(sdfs: list[Sdf], device: torch.device):
    """One callable (slot [P], points [P, 3]) -> (distance, gradient) for SDFs of one kind."""
    first = sdfs[0]
    if isinstance(first, MlpSdf):
        return _MlpGroup([sdf for sdf in sdfs if isinstance(sdf, MlpSdf)], device)
    if isinstance(first, PlaneSdf):
        return lambda slot, points: plane_distance(points)
    if isinstance(first, SphereSdf):
        radius = torch.tensor(
            [sdf.radius for sdf in sdfs if isinstance(sdf, SphereSdf)], dtype=torch.float64, device=device
        )
        return lambda slot, points: sphere_distance(points, radius[slot].to(points.dtype))
    if isinstance(first, BoxSdf):
        half = torch.tensor([sdf.half for sdf in sdfs if isinstance(sdf, BoxSdf)], dtype=torch.float64, device=device)
        return lambda slot, points: box_distance(points, half[slot].to(points.dtype))
    return lambda slot, points: first(points)


class _MlpGroup:
    """Networks of one architecture. Points are sorted by network and cut into tiles of one network each."""

    TILES = (8, 16, 32, 64, 128, 256, 512, 1024)

    def __init__(self, sdfs: list[MlpSdf], device: torch.device) -> None:
        layers = range(len(sdfs[0].weights))
        self._weights = [torch.stack([sdf.weights[layer] for sdf in sdfs]).to(device) for layer in layers]
        self._biases = [torch.stack([sdf.biases[layer] for sdf in sdfs]).to(device) for layer in layers]
        self._activation: Activation = sdfs[0].activation
        self._centre = torch.tensor(np.stack([sdf.frame.centre for sdf in sdfs]), device=device)
        self._scale = torch.tensor([sdf.frame.scale for sdf in sdfs], dtype=torch.float64, device=device)
        self._half = torch.stack([_half_extents(sdf) for sdf in sdfs]).to(device)
        self._count = len(sdfs)

    def __call__(self, slot: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        distance, gradient = [], []
        for some, part in zip(slot.split(CHUNK), points.split(CHUNK), strict=True) if len(slot) else ((slot, points),):
            scale = self._scale[some].to(points.dtype)
            local = ((part - self._centre[some].to(points.dtype)) / scale[:, None]).float()
            clamped = local.clamp(-BOX, BOX)
            value, slope = complete(*self._evaluate(some, clamped), clamped, local, self._half[some])
            distance.append(value.to(points.dtype) * scale)
            gradient.append(slope.to(points.dtype))
        return torch.cat(distance), torch.cat(gradient)

    def _evaluate(self, slot: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Network `slot[p]` at `points[p]`: [P], [P, 3]."""
        if self._count == 1 or len(slot) == 0:
            value, gradient = value_and_gradient(self._weights, self._biases, self._activation, points[None])
            return value[0], gradient[0]
        counts = torch.bincount(slot, minlength=self._count)
        order = slot.argsort(stable=True)
        known = counts.tolist()
        # A tile costs its padding and a copy of its network, which is worth about 24 points.
        tile = min(self.TILES, key=lambda size: sum(-(-count // size) for count in known) * (size + 24))
        tiles = (counts + tile - 1).div(tile, rounding_mode="floor")
        first_tile, first_point = tiles.cumsum(0) - tiles, counts.cumsum(0) - counts
        owner = slot[order]
        place = first_tile[owner] * tile + torch.arange(len(slot), device=slot.device) - first_point[owner]
        network = torch.repeat_interleave(torch.arange(self._count, device=slot.device), tiles)
        padded = points.new_zeros(len(network) * tile, 3)
        padded[place] = points[order]
        value, gradient = value_and_gradient(
            [weight[network] for weight in self._weights],
            [bias[network] for bias in self._biases],
            self._activation,
            padded.view(len(network), tile, 3),
        )
        back = torch.empty_like(place)
        back[order] = place
        return value.reshape(-1)[back], gradient.reshape(-1, 3)[back]
