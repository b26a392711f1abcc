"""What structure-from-motion knows about a scene: points on its surface, and the free space in front of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipeline.cameras import Sparse, View
from pipeline.normalise import Normalisation, point_weights
from pipeline.trilinear import interpolate

# Lines of sight end this far before their points, normalised units.
GAP = 0.015
# Clearance that free space asks for: at most, and as a share of the way to the point, which may be on a grazed plane.
CLEARANCE, SLOPE = 0.02, 0.1
# Free space counts as filled where the field is below this; between, it may be its coarseness.
FILLED, JUST_EMPTY = -0.004, 0.002
TRIES = 16  # places along each line at which filled free space is looked for


@dataclass(frozen=True)
class Landmarks:
    """What structure-from-motion knows about the scene, in normalised space.

    Attributes:
        points: [P, 3] surface points in the unit sphere.
        weights: [P] how far each is trusted, mean 1.
        sight: [L, 6] starts and ends of stretches of free space.
    """

    points: np.ndarray
    weights: np.ndarray
    sight: np.ndarray


def find_landmarks(sparse: Sparse, views: list[View], normalisation: Normalisation) -> Landmarks:
    """Sparse points seen by three views or more with a small error, and their lines of sight within the sphere.

    Args:
        sparse: in the world of the poses.
        views: in normalised space.
        normalisation: from one to the other.
    """
    points = normalisation.apply(sparse.xyz)
    seen = np.bincount(sparse.point_of, minlength=len(points))
    good = (seen >= 3) & (sparse.error < 1.5)
    inside = good & (np.linalg.norm(points, axis=1) < 1.0)
    weights = point_weights(sparse, len(points))[inside]
    use = good[sparse.point_of]
    end, start = points[sparse.point_of[use]], np.array([v.center for v in views]).reshape(-1, 3)[sparse.view_of[use]]
    length = np.linalg.norm(end - start, axis=1)
    direction = (end - start) / np.maximum(length, 1e-9)[:, None]
    along = -(start * direction).sum(1)
    half = np.sqrt(np.maximum(1 - ((start**2).sum(1) - along**2), 0))
    # Not all the way: a point is uncertain by a little, and so is the surface there.
    low, high = np.maximum(along - half, 0), np.minimum(along + half, length - GAP)
    crosses = (half > 0) & (high > low + 0.02)
    sight = np.concatenate([start + low[:, None] * direction, start + high[:, None] * direction], 1)[crosses]
    return Landmarks(points[inside], weights / max(float(weights.mean()), 1e-9) if len(weights) else weights, sight)


class FreeSpace:
    """Points between cameras and what they see, which must be empty whatever the colours say.

    Half of those handed out are where the field is solid all the same: a vase's mouth is crossed by one line of sight
    in hundreds, and would stay filled if lines were drawn evenly.

    Args:
        sight: [L, 6] starts and ends of stretches of free space, normalised units.
        device: of the points.
    """

    def __init__(self, sight: np.ndarray, device: str) -> None:
        self.start, self.end = (
            torch.tensor(part, dtype=torch.float32, device=device).reshape(-1, 3) for part in np.split(sight, 2, 1)
        )
        self.filled = torch.zeros(0, 2, device=device)

    def __len__(self) -> int:
        return len(self.start)

    def look(self, cache: Tensor, rng: torch.Generator) -> None:
        """Finds filled places by the SDF on a grid [n, n, n, 1] over [-1, 1]^3, at random places of every line."""
        device = self.start.device
        found = []
        for _ in range(TRIES):
            along = torch.rand(len(self), generator=rng).to(device)
            line = torch.arange(len(self), device=device)
            wrong = interpolate(cache, self.at(line, along)[0])[:, 0] < FILLED
            found.append(torch.stack([line[wrong].float(), along[wrong]], 1))
        self.filled = torch.cat(found)

    def at(self, line: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
        """Points [P, 3] at fractions [P] of lines [P], and the clearance [P] that each asks for."""
        start, end = self.start[line], self.end[line]
        rest = (1 - along) * (end - start).norm(dim=1) + GAP
        return start + along[:, None] * (end - start), (SLOPE * rest).clamp_max(CLEARANCE)

    def pick(self, count: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
        """At most `count` points [P, 3] and the SDF [P] that each must at least have."""
        count, device = min(count, len(self)), self.start.device
        line = torch.randint(max(1, len(self)), (count,), generator=rng).to(device)
        along = torch.rand(count, generator=rng).to(device)
        again = torch.randint(max(1, len(self.filled)), (count // 2,), generator=rng).to(device)
        if not len(self.filled):
            return self.at(line, along)
        line[: count // 2] = self.filled[again, 0].long()
        along[: count // 2] = self.filled[again, 1]
        points, clearance = self.at(line, along)
        # Emptied, but no more: right beside may be a surface, and this loss comes back to the same places.
        clearance[: count // 2].clamp_(max=JUST_EMPTY)
        return points, clearance
