"""Many SDFs asked at once, grouped by kind so that shapes of one kind share their arithmetic."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np
import torch

from sdfsim.shape import mlp_sdf
from sdfsim.shape import sdf as sdf_module
from sdfsim.shape.far_field import everywhere, half_extents
from sdfsim.shape.mlp_sdf import Activation, MlpSdf, sides, value_and_gradient
from sdfsim.shape.sdf import (
    BoxSdf,
    CapsuleSdf,
    CylinderSdf,
    GridSdf,
    PlaneSdf,
    Sdf,
    SphereSdf,
    box_distance,
    capsule_distance,
    cylinder_distance,
    plane_distance,
    sphere_distance,
    trilinear,
)

FITTED_TRUST = 0.8  # of a fitted or sampled distance: its errors are far smaller, and grow with the distance


class SdfBank:
    """Many SDFs asked at once: each point of its own shape.

    Networks of one architecture share batched matrix products, grids of one resolution a gather; closed forms
    are evaluated by kind. Anything else that speaks the protocol (an exact mesh) is called once per shape.

    What a kind needs is brought to the device when one of its shapes is first asked for.

    Args:
        sdfs: the shapes; `index` refers to them in this order.
        device: where to compute; by default where the first network or grid is, or on the CPU.

    Attributes:
        trust: [S] float64: going a way w from where the distance was d, it stays above `trust` d - w / `trust`. 1 for
            an exact distance, which no way shortens by more than its length.
    """

    def __init__(self, sdfs: Sequence[Sdf], device: torch.device | str | None = None) -> None:
        self.sdfs = tuple(sdfs)
        devices = [sdf.device for sdf in self.sdfs if isinstance(sdf, MlpSdf | GridSdf)]
        self.device = torch.device(device if device is not None else devices[0] if devices else "cpu")
        kinds: dict[object, list[int]] = {}
        for number, sdf in enumerate(self.sdfs):
            if isinstance(sdf, MlpSdf):
                key: object = sdf.architecture
            elif isinstance(sdf, GridSdf):
                key = (GridSdf, sdf.resolution)
            elif isinstance(sdf, PlaneSdf | SphereSdf | CapsuleSdf | CylinderSdf | BoxSdf):
                key = type(sdf)
            else:
                key = number
            kinds.setdefault(key, []).append(number)
        fitted = [isinstance(sdf, MlpSdf | GridSdf) for sdf in self.sdfs]
        trust = [FITTED_TRUST if each else 1.0 for each in fitted]
        self.trust = torch.tensor(trust, dtype=torch.float64, device=self.device)
        self._members = list(kinds.values())
        self._groups: dict[int, Callable[[torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]]] = {}
        group_of, slot_of = [0] * len(self.sdfs), [0] * len(self.sdfs)
        for group, members in enumerate(kinds.values()):
            for slot, number in enumerate(members):
                group_of[number], slot_of[number] = group, slot
        self._group_of = torch.tensor(group_of, dtype=torch.int64, device=self.device)
        self._slot_of = torch.tensor(slot_of, dtype=torch.int64, device=self.device)

    def __call__(self, index: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance and gradient of shape `index[p]` at `points[p]`.

        Args:
            index: [P] int64 into the sequence given at construction.
            points: [P, 3] m, each in its own shape's frame.

        Returns:
            distance [P] m and gradient [P, 3], in the dtype of `points`: what each SDF alone would give.
        """
        slot = self._slot_of[index]
        if len(self._members) == 1 and len(index):
            return self._group(0)(slot, points)
        group_of = self._group_of[index]
        distance, gradient = torch.empty_like(points[:, 0]), torch.empty_like(points)
        for number in range(len(self._members)):
            chosen = (group_of == number).nonzero()[:, 0]
            if len(chosen):
                distance[chosen], gradient[chosen] = self._group(number)(slot[chosen], points[chosen])
        return distance, gradient

    def _group(self, number: int):
        if number not in self._groups:
            self._groups[number] = _group([self.sdfs[member] for member in self._members[number]], self.device)
        return self._groups[number]


def _group(sdfs: list[Sdf], device: torch.device):
    """One callable (slot [P], points [P, 3]) -> (distance, gradient) for SDFs of one kind."""
    first = sdfs[0]
    if isinstance(first, MlpSdf):
        return _MlpGroup([sdf for sdf in sdfs if isinstance(sdf, MlpSdf)], device)
    if isinstance(first, GridSdf):
        return _GridGroup([sdf for sdf in sdfs if isinstance(sdf, GridSdf)], device)
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
    if isinstance(first, CapsuleSdf | CylinderSdf):
        sizes = torch.tensor(
            [(sdf.radius, sdf.half) for sdf in sdfs if isinstance(sdf, CapsuleSdf | CylinderSdf)],
            dtype=torch.float64,
            device=device,
        )
        ask = capsule_distance if isinstance(first, CapsuleSdf) else cylinder_distance
        return lambda slot, points: ask(points, *sizes[slot].to(points.dtype).unbind(1))
    return lambda slot, points: first(points)


class _FramedGroup(ABC):
    """SDFs that are fitted or sampled on the box of their normalised frame; `_evaluate` asks them there."""

    def __init__(self, sdfs: Sequence[MlpSdf | GridSdf], device: torch.device, chunk: int) -> None:
        self._centre = torch.tensor(np.stack([sdf.frame.centre for sdf in sdfs]), device=device)
        self._scale = torch.tensor([sdf.frame.scale for sdf in sdfs], dtype=torch.float64, device=device)
        self._half = torch.stack([half_extents(sdf.frame, sdf.bounds) for sdf in sdfs]).to(device)
        self._chunk = chunk
        self._count = len(sdfs)

    def __call__(self, slot: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        distance, gradient = [], []
        parts = zip(slot.split(self._chunk), points.split(self._chunk), strict=True) if len(slot) else ((slot, points),)
        for some, part in parts:
            scale = self._scale.index_select(0, some).to(points.dtype)
            centre, half = self._centre.index_select(0, some), self._half.index_select(0, some)
            local = ((part - centre.to(points.dtype)) / scale[:, None]).float()

            def inner(
                rows: torch.Tensor | None, local: torch.Tensor, some: torch.Tensor = some
            ) -> tuple[torch.Tensor, torch.Tensor]:
                return self._evaluate(some if rows is None else some[rows], local)

            value, slope = everywhere(inner, local, half)
            distance.append(value.to(points.dtype) * scale)
            gradient.append(slope.to(points.dtype))
        return torch.cat(distance), torch.cat(gradient)

    @abstractmethod
    def _evaluate(self, slot: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Normalised distance [P] and gradient [P, 3] of SDF `slot[p]` at `points[p]`, within the box."""


class _GridGroup(_FramedGroup):
    """Grids of one resolution."""

    def __init__(self, sdfs: list[GridSdf], device: torch.device) -> None:
        super().__init__(sdfs, device, sdf_module.CHUNK)
        # One grid alone is not copied: at 512 samples a side it is half a gigabyte.
        alone = len(sdfs) == 1
        self._values = sdfs[0].values.to(device)[None] if alone else torch.stack([s.values.to(device) for s in sdfs])

    def _evaluate(self, slot: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return trilinear(self._values, slot if self._count > 1 else None, points)


class _MlpGroup(_FramedGroup):
    """Networks of one architecture. Points are sorted by network and cut into tiles of one network each."""

    TILES = (8, 16, 32, 64, 128, 256, 512, 1024)

    def __init__(self, sdfs: list[MlpSdf], device: torch.device) -> None:
        super().__init__(sdfs, device, mlp_sdf.PREPARED)
        layers = range(len(sdfs[0].weights))
        self._weights = [torch.stack([sdf.weights[layer] for sdf in sdfs]).to(device) for layer in layers]
        self._biases = [torch.stack([sdf.biases[layer] for sdf in sdfs]).to(device) for layer in layers]
        self._activation: Activation = sdfs[0].activation
        self._mirrors = torch.tensor([sdf.mirrors for sdf in sdfs], device=device)

    def _evaluate(self, slot: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        side = sides(points, self._mirrors.index_select(0, slot))
        value, gradient = self._network(slot, points * side)
        return value, gradient * side

    def _network(self, slot: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
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
