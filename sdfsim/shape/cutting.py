"""Cutting triangles [F, 3, 3 + K] (K further columns, such as colours, are interpolated) to keep parts of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sdfsim.shape.watertight import face_normals

# [P, 3] points of faces and the unit normals there -> [P] int: 0 where that is no boundary, else of how many layers in
# the same place, negative where it is wound inwards.
Side = Callable[[np.ndarray, np.ndarray], np.ndarray]


def exposed(
    corners: np.ndarray, side: Side, *, fine: float = 0.008, coarse: float = 0.1
) -> tuple[np.ndarray, np.ndarray]:
    """The parts of triangles [F, 3, 3 + K] that are boundary, [F', 3, 3 + K] wound outwards, and their layers [F'].

    Lengths are relative to the size: faces longer than `coarse` may hide something between the points at which they
    are tested, and are cut before they are judged; those shorter than `fine` go by their centroid, which is wrong by
    a fraction of their size, along seams only.
    """
    weights = np.array([[30, 1, 1], [1, 30, 1], [1, 1, 30], [15, 15, 1], [15, 1, 15], [1, 15, 15]], dtype=np.float64)
    weights /= weights.sum(1, keepdims=True)
    kept, layers = [corners[:0]], [np.zeros(0, dtype=np.int64)]
    corners = no_longer_than(corners, coarse)
    while len(corners):
        centres, normals = centres_and_normals(corners)
        verdict = side(centres, normals)
        decided = np.ones(len(corners), dtype=bool)
        large = np.flatnonzero(_longest(corners) > fine)
        tests = np.einsum("kc,fci->fki", weights, corners[large, :, :3])
        others = side(tests.reshape(-1, 3), np.repeat(normals[large], len(weights), axis=0))
        decided[large] = (others.reshape(-1, len(weights)) == verdict[large, None]).all(1)
        outward, inward = decided & (verdict > 0), decided & (verdict < 0)
        kept += [corners[outward], corners[inward][:, ::-1]]
        layers += [verdict[outward], -verdict[inward]]
        corners = _halved(corners[~decided])
    return np.concatenate(kept), np.concatenate(layers)


def centres_and_normals(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroids and unit normals [F, 3] of triangles [F, 3, 3 + K]."""
    normals = face_normals(corners)
    return corners[..., :3].mean(1), normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def _longest(corners: np.ndarray) -> np.ndarray:
    """[F] longest edges of triangles [F, 3, 3 + K]."""
    points = corners[..., :3]
    return np.linalg.norm(points - np.roll(points, 1, axis=1), axis=2).max(1)


def no_longer_than(corners: np.ndarray, length: float) -> np.ndarray:
    """The triangles, halved until no edge is longer than `length`."""
    done = []
    while len(corners):
        short = _longest(corners) <= length
        done.append(corners[short])
        corners = _halved(corners[~short])
    return np.concatenate(done)


def _halved(corners: np.ndarray) -> np.ndarray:
    """Cut triangles [F, 3, 3 + K] across their longest edge, so that slivers do not become many: [2 F, 3, 3 + K]."""
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1)[..., :3] - corners[..., :3], axis=2)
    turn = (lengths.argmax(1)[:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(corners, turn[..., None], axis=1), 1, 0)
    middle = (a + b) / 2
    return np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
