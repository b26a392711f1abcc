"""The triangles of a closed mesh in a tree of boxes, for exact distances in the contact solve."""

from dataclasses import dataclass

import numpy as np

from sdfsim.geometry.mesh import Mesh

LEAF = 4  # largest number of triangles of a leaf
FEATURES = 7


@dataclass(frozen=True, eq=False)
class TriangleTree:
    """The T triangles of a closed surface in the order of a complete binary tree, whose boxes are numbered like a
    heap: leaf l of 2**level holds the triangles T l >> level to T (l + 1) >> level."""

    level: int
    box: np.ndarray  # [2**(level + 1) - 1, 6] m, lower and upper ends
    corner: np.ndarray  # [T, 3, 3] m
    # [T, 7, 3] pseudonormals of the face, the edges and the corners: sums of the normals that meet there, weighted by
    # angle (Baerentzen and Aanaes 2005)
    normal: np.ndarray


def triangle_tree(mesh: Mesh) -> TriangleTree:
    """The tree of a closed mesh, split at medians along the widest side of the centres."""
    faces = mesh.faces[_area(mesh) > 0.0]
    corner = mesh.vertices[faces]
    count = len(faces)
    level = max(0, int(np.ceil(np.log2(count / LEAF))))
    middle, order = corner.mean(1), np.arange(count)
    for depth in range(level):
        start = (count * np.arange(2**depth)) >> depth
        part = np.repeat(np.arange(2**depth), np.diff([*start, count]))
        placed = middle[order]
        wide = np.maximum.reduceat(placed, start) - np.minimum.reduceat(placed, start)
        order = order[np.lexsort((placed[np.arange(count), wide.argmax(1)[part]], part))]
    corner = corner[order]
    start = (count * np.arange(2**level)) >> level
    lows, highs = [np.minimum.reduceat(corner.min(1), start)], [np.maximum.reduceat(corner.max(1), start)]
    for _ in range(level):
        lows.append(np.minimum(lows[-1][::2], lows[-1][1::2]))
        highs.append(np.maximum(highs[-1][::2], highs[-1][1::2]))
    box = np.concatenate([np.concatenate(lows[::-1]), np.concatenate(highs[::-1])], axis=1)
    return TriangleTree(level, box, corner, _pseudonormals(mesh.vertices, faces)[order])


def _area(mesh: Mesh) -> np.ndarray:
    sides = np.diff(mesh.vertices[mesh.faces], axis=1)
    return np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)


def _pseudonormals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[T, 7, 3]. Vertices at the same place are one: a file may repeat them for its texture."""
    _, same = np.unique(vertices, axis=0, return_inverse=True)
    faces, corner = same.reshape(-1)[faces], vertices[faces]
    sides = np.roll(corner, -1, axis=1) - corner  # ab, bc, ca
    face = np.cross(sides[:, 0], sides[:, 1])
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    unit = sides / np.linalg.norm(sides, axis=2, keepdims=True)
    angle = np.arccos(np.clip(-(unit * np.roll(unit, 1, axis=1)).sum(2), -1.0, 1.0))
    normal = np.empty((len(faces), FEATURES, 3))
    normal[:, 0] = face
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2)
    _, edge = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    for kind, number, weight in ((slice(1, 4), edge, np.ones(faces.shape)), (slice(4, 7), faces.reshape(-1), angle)):
        number = number.reshape(-1)
        total = np.zeros((number.max() + 1, 3))
        np.add.at(total, number, (weight[..., None] * face[:, None]).reshape(-1, 3))
        normal[:, kind] = total[number].reshape(-1, 3, 3)
    return normal
