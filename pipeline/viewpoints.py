"""Where the cameras of a set stand about the scene: how far apart, and on how many sides."""

from __future__ import annotations

import numpy as np

from pipeline.cameras import View
from pipeline.normalise import camera_up, nearest_to_axes


def focus(views: list[View]) -> tuple[np.ndarray, np.ndarray]:
    """Point [3] that the cameras look at, and unit directions [N, 3] from them to it."""
    centers = np.array([v.center for v in views])
    point = nearest_to_axes(centers, np.array([v.rotation[2] for v in views]))
    rays = point - centers
    return point, rays / (np.linalg.norm(rays, axis=1, keepdims=True) + 1e-12)


def spread_angle(views: list[View]) -> float:
    """Largest angle (degrees) between viewing rays to the centre of what the cameras look at."""
    rays = focus(views)[1]
    return float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))


def view_span(views: list[View]) -> float:
    """Degrees around the scene's upright axis from which it was photographed: 360 less the largest gap."""
    rays, up = focus(views)[1], camera_up(views).normal
    flat = rays - np.outer(rays @ up, up)
    level = np.linalg.norm(flat, axis=1) > 0.1  # a photo from straight above has no side
    if level.sum() < 2:
        return 0.0
    east = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    angle = np.sort(np.degrees(np.arctan2(flat[level] @ np.cross(up, east), flat[level] @ east)))
    return 360.0 - float(np.diff(np.append(angle, angle[0] + 360)).max())
