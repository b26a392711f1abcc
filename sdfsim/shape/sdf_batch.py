"""Many SDFs asked at once, grouped by kind so that shapes of one kind share their arithmetic."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from sdfsim.shape.mlp_sdf import MlpSdf, MlpStack
from sdfsim.shape.sdf import ClosedForm, GridSdf, GridStack, Sdf

FITTED_TRUST = 0.8  # of a fitted or sampled distance: its errors are far smaller, and grow with the distance

Answer = tuple[torch.Tensor, torch.Tensor]


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
            elif isinstance(sdf, ClosedForm):
                key = type(sdf)
            else:
                key = number
            kinds.setdefault(key, []).append(number)
        fitted = [isinstance(sdf, MlpSdf | GridSdf) for sdf in self.sdfs]
        trust = [FITTED_TRUST if each else 1.0 for each in fitted]
        self.trust = torch.tensor(trust, dtype=torch.float64, device=self.device)
        self._members = list(kinds.values())
        self._groups: dict[int, Callable[[torch.Tensor, torch.Tensor], Answer]] = {}
        group_of, slot_of = [0] * len(self.sdfs), [0] * len(self.sdfs)
        for group, members in enumerate(kinds.values()):
            for slot, number in enumerate(members):
                group_of[number], slot_of[number] = group, slot
        self._group_of = torch.tensor(group_of, dtype=torch.int64, device=self.device)
        self._slot_of = torch.tensor(slot_of, dtype=torch.int64, device=self.device)

    def __call__(self, index: torch.Tensor, points: torch.Tensor) -> Answer:
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

    def _group(self, number: int) -> Callable[[torch.Tensor, torch.Tensor], Answer]:
        if number not in self._groups:
            self._groups[number] = _group([self.sdfs[member] for member in self._members[number]], self.device)
        return self._groups[number]


def _group(sdfs: Sequence[Any], device: torch.device) -> Callable[[torch.Tensor, torch.Tensor], Answer]:
    """One callable (slot [P], points [P, 3]) -> (distance, gradient) for SDFs of one kind."""
    first = sdfs[0]
    if isinstance(first, MlpSdf):
        return MlpStack(list(sdfs), device)
    if isinstance(first, GridSdf):
        return GridStack(list(sdfs), device)
    if isinstance(first, ClosedForm):
        sizes = torch.tensor([sdf.sizes for sdf in sdfs], dtype=torch.float64, device=device)
        return lambda slot, points: first.measure(points, sizes[slot].to(points.dtype))
    return lambda slot, points: first(points)
