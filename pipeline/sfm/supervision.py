"""What structure-from-motion knows about a scene: points on its surface, and the free space in front of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pipeline.cameras import Sparse, View
from pipeline.field.interpolation import interpolate

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


@dataclass(frozen=True)
class Normalisation:
    """World -> unit sphere: x -> (x - center) / radius.

    Attributes:
        center: [3] world.
        radius: world units.
    """

    center: np.ndarray
    radius: float

    def apply(self, points: np.ndarray) -> np.ndarray:
        """World points [P, 3] -> normalised points."""
        return (points - self.center) / self.radius

    def views(self, views: list[View]) -> list[View]:
        """The same cameras in normalised space."""
        return [v.transformed(1 / self.radius, np.eye(3), -self.center / self.radius) for v in views]


def nearest_to_axes(centers: np.ndarray, axes: np.ndarray, anchor: np.ndarray | None = None) -> np.ndarray:
    """The point [3] nearest to all lines (centre + t axis) in the least-squares sense.

    Args:
        centers: [N, 3] points on the lines.
        axes: [N, 3] unit directions.
        anchor: [3] drawn to weakly, which settles the depth where the lines are nearly parallel.
    """
    projector = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    matrix, right = projector.sum(0), (projector @ centers[:, :, None]).sum(0)[:, 0]
    weight = 1e-6 if anchor is None else 0.02
    pull = centers.mean(0) + axes.mean(0) if anchor is None else anchor
    matrix = matrix + weight * len(centers) * np.eye(3)
    return np.linalg.solve(matrix, right + weight * len(centers) * pull)


def point_weights(sparse: Sparse, count: int) -> np.ndarray:
    """Weight [P] of each sparse point: how many of the views see it, less where its error is large."""
    seen = np.bincount(sparse.point_of, minlength=count).astype(float)
    return seen / (1 + np.maximum(sparse.error, 0) ** 2)


def weighted_quantile(values: np.ndarray, weights: np.ndarray, q: float) -> float:
    """Quantile of `values` [P] with `weights` [P]."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, q * total[-1])])


def find_normalisation(views: list[View], sparse: Sparse, *, masked: bool = False) -> Normalisation:
    """Robust bounds of the object from the cameras and the sparse points.

    The centre is where the optical axes meet, drawn weakly to the points' median. The radius is what fits the longer
    side of most photos, less where nearly all points are nearer, and never past the nearest cameras.

    Args:
        views: posed cameras.
        sparse: points of the same reconstruction.
        masked: every photo has a mask, so all points lie on the object.
    """
    centers = np.array([v.center for v in views])
    axes = np.array([v.rotation[2] for v in views])
    weights = point_weights(sparse, len(sparse.xyz))
    median = np.array([weighted_quantile(sparse.xyz[:, k], weights, 0.5) for k in range(3)])
    if masked:
        low = np.array([weighted_quantile(sparse.xyz[:, k], weights, 0.005) for k in range(3)])
        high = np.array([weighted_quantile(sparse.xyz[:, k], weights, 0.995) for k in range(3)])
        center = (low + high) / 2
        distance = np.linalg.norm(sparse.xyz - center, axis=1)
        return Normalisation(center, 1.15 * weighted_quantile(distance, weights, 0.99))
    center = nearest_to_axes(centers, axes, anchor=median)
    in_front = ((center - centers) * axes).sum(1) > 0
    if in_front.mean() < 0.8:  # Axes that meet behind the cameras (a capture looking outwards) say nothing.
        center = median
    away = np.linalg.norm(centers - center, axis=1)
    half = np.array([np.arctan(0.5 * max(v.width, v.height) / v.focal) for v in views])
    radius = float(np.median(away * np.sin(half)))
    distance = np.linalg.norm(sparse.xyz - center, axis=1)
    radius = min(radius, 1.25 * weighted_quantile(distance, weights, 0.95), 0.9 * float(np.quantile(away, 0.05)))
    return Normalisation(center, max(radius, 1e-9))


class CameraUp(NamedTuple):
    """Up from the cameras alone: the unit vector [3], and degrees within which it can be trusted."""

    normal: np.ndarray
    within: float


# People hold cameras level to about this; where photos are turned, or all from one place, next to nothing is known.
CAREFUL, UNKNOWN = 2.0, 30.0  # degrees


def camera_up(views: list[View]) -> CameraUp:
    """Up from the cameras alone: people hold cameras level, so their right axes are horizontal.

    The direction with the least spread of the right axes, with the sign of the mean image up. Where the right axes
    span no plane (a single viewpoint, or photos turned by 90 degrees) the mean image up itself.
    """
    right = np.array([v.rotation[0] for v in views])
    mean = -np.mean([v.rotation[1] for v in views], axis=0)
    mean /= np.linalg.norm(mean) + 1e-12
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    up = vectors[:, 0] * np.sign(vectors[:, 0] @ mean or 1.0)
    if values[1] < 0.05 or values[0] > 0.3 * values[1] or up @ mean < 0.5:
        return CameraUp(mean, UNKNOWN)
    # Where the right axes fan out little, a roll of each camera tilts the whole the more.
    return CameraUp(up, float(np.hypot(CAREFUL, np.degrees(np.sqrt(max(values[0], 0) / values[1])))))


class Plane(NamedTuple):
    """A plane: unit normal [3], its share of all the area, and the slope in degrees that its unevenness amounts to."""

    normal: np.ndarray
    share: float
    slope: float


def plane_up(
    points: np.ndarray, normals: np.ndarray, weights: np.ndarray, guess: np.ndarray, tolerance: float, *,
    max_angle: float = 25.0, min_share: float = 0.08, seed: int = 0,
) -> Plane | None:  # fmt: skip
    """The largest plane among surface samples whose normal is near a guess (RANSAC).

    Args:
        points: [P, 3].
        normals: [P, 3] unit, outwards.
        weights: [P] area of each sample.
        guess: [3] unit; only planes within `max_angle` degrees of it count.
        tolerance: distance within which a sample belongs to a plane.
        max_angle: degrees.
        min_share: share of all the area that a plane needs.
        seed: of the random choice of samples.

    Returns:
        The plane, or None where none is large enough.
    """
    near = normals @ guess > np.cos(np.radians(max_angle))
    if near.sum() < 10:
        return None
    p, n, w = points[near], normals[near], weights[near]
    rng = np.random.default_rng(seed)
    best, inside = 0.0, None
    for pick in rng.choice(len(p), size=min(200, len(p)), replace=False, p=w / w.sum()) if len(p) > 10 else []:
        member = (np.abs((p - p[pick]) @ n[pick]) < tolerance) & (n @ n[pick] > 0.9)
        if w[member].sum() > best:
            best, inside = float(w[member].sum()), member
    if inside is None or best < min_share * weights.sum():
        return None
    spread = np.ones(3)
    for _ in range(3):
        center = np.average(p[inside], axis=0, weights=w[inside])
        offset = p[inside] - center
        spread, axes = np.linalg.eigh((offset * w[inside, None]).T @ offset)
        normal = axes[:, 0] * np.sign(axes[:, 0] @ guess)
        inside = (np.abs((p - center) @ normal) < tolerance) & (n @ normal > 0.9)
        if inside.sum() < 10:
            return None
    if normal @ guess < np.cos(np.radians(max_angle)):
        return None
    slope = float(np.degrees(np.arctan(np.sqrt(max(spread[0], 0) / max(spread[1], 1e-30)))))
    return Plane(normal, float(w[inside].sum() / weights.sum()), slope)
