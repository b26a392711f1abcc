"""Scripted motion: where kinematic bodies are at any time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.scene.scene import Waypoints


@dataclass(frozen=True)
class Tracks:
    """The paths of K kinematic bodies with up to P poses each, model units."""

    body: Tensor  # [K] int64 the bodies they move
    time: Tensor  # [K, P] float64, increasing; infinite beyond the last pose of a path
    origin: Tensor  # [K, P, 3] float64, of the shapes' own origins
    orientation: Tensor  # [K, P, 4] float64 xyzw
    com: Tensor  # [K, 3] float64, centre of mass from the shape's origin (shape axes)

    def at(self, time: float) -> tuple[Tensor, Tensor]:
        """Centres of mass [K, 3] and orientations [K, 4] at `time`."""
        row = torch.arange(len(self.body), device=self.time.device)
        before = ((self.time <= time).sum(1) - 1).clamp(0, self.time.shape[1] - 2)
        start, stop = self.time[row, before], self.time[row, before + 1]
        share = ((time - start) / (stop - start)).clamp(0.0, 1.0)[:, None]
        origin = torch.lerp(self.origin[row, before], self.origin[row, before + 1], share)
        first, last = self.orientation[row, before], self.orientation[row, before + 1]
        turn = pose.to_rotvec(pose.multiply(last, pose.conjugate(first)))
        orientation = pose.normalise(pose.multiply(pose.from_rotvec(share * turn), first))
        return origin + pose.rotate(orientation, self.com), orientation

    def velocity(self, time: float, dt: float) -> tuple[Tensor, Tensor]:
        """Mean velocity [K, 3] and angular velocity [K, 3] from `time` to `time + dt`: what leads from pose to pose."""
        (place, turn), (later, turned) = self.at(time), self.at(time + dt)
        return (later - place) / dt, pose.to_rotvec(pose.multiply(turned, pose.conjugate(turn))) / dt


def from_paths(
    paths: Sequence[tuple[int, Waypoints]], com: np.ndarray, *, length: float, time: float, device: torch.device
) -> Tracks | None:
    """The paths of a scene, in SI units by the number of the body, as tracks; None where there are none. Centres of
    mass [N, 3] from the shapes' origins are in model units, of which one is `length` m and `time` s."""
    if not paths:
        return None
    most = 1 + max(len(path.time) for _, path in paths)

    def padded(values: np.ndarray, fill) -> np.ndarray:
        return np.concatenate([values, np.broadcast_to(fill, (most - len(values), *values.shape[1:]))])

    def tensor(rows) -> Tensor:
        return torch.as_tensor(np.stack(rows), dtype=torch.float64, device=device)

    return Tracks(
        body=torch.tensor([k for k, _ in paths], device=device),
        time=tensor([padded(p.time / time, np.inf) for _, p in paths]),
        origin=tensor([padded(p.position / length, p.position[-1] / length) for _, p in paths]),
        orientation=tensor([padded(p.quat_xyzw, p.quat_xyzw[-1]) for _, p in paths]),
        com=tensor([com[k] for k, _ in paths]),
    )
