"""Where the object is: the similarity that puts what the cameras look at into the unit sphere; and which way is up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipeline.cameras import Sparse, View


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
