"""How meshes look: normals that keep creases, colours that are easy to tell apart, a sheet for infinite planes."""

from __future__ import annotations

import colorsys
from collections.abc import Iterator

import numpy as np

from sdfsim.shape.mesh import Mesh

_CREASE = np.cos(np.radians(40.0))
_MOST_CORNER_PAIRS = 1_000_000  # more, about 10,000 vertices, and a mesh counts as smooth: splitting triples its size


def sheet(half: float) -> Mesh:
    """A square of z = 0, `half` m to each side, shown for an infinite plane."""
    vertices = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]))


def distinct_colors(count: int) -> Iterator[tuple[int, ...]]:
    """`count` RGB colours (0 to 255) whose hues are a golden angle from each other."""
    for i in range(count):
        rgb = colorsys.hsv_to_rgb((0.58 + i * 0.61803398875) % 1.0, 0.62, 0.9 if i % 2 == 0 else 0.75)
        yield tuple(round(255 * c) for c in rgb)


def with_normals(mesh: Mesh) -> tuple[Mesh, np.ndarray]:
    """The mesh with normals [V, 3]: smooth, its vertices split along creases so that boxes keep their edges."""
    normals = _corner_normals(mesh.vertices, mesh.faces)
    if normals is None:
        return mesh, _smooth_normals(mesh.vertices, mesh.faces)
    colors = None if mesh.colors is None else mesh.colors[mesh.faces].reshape(-1, 3)
    vertices = mesh.vertices[mesh.faces].reshape(-1, 3)
    return Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3), colors), normals


def _face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[F, 3], twice the area long."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def _smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[V, 3] area-weighted means of the faces around each vertex."""
    total = np.zeros_like(vertices)
    normal = _face_normals(vertices, faces)
    for k in range(3):
        np.add.at(total, faces[:, k], normal)
    return _normalise(total)


def _corner_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray | None:
    """[3 F, 3] for every face corner the mean of the faces at its vertex that bend less than the crease angle.

    None for a mesh so fine that it may pass as smooth.
    """
    owner = faces.reshape(-1)
    order = np.argsort(owner, kind="stable")
    valence = np.bincount(owner, minlength=len(vertices))
    if (valence**2).sum() > _MOST_CORNER_PAIRS:
        return None
    start = np.cumsum(valence) - valence
    repeats = valence[owner]
    first = np.repeat(np.arange(len(owner)), repeats)
    second = order[np.repeat(start[owner] - (np.cumsum(repeats) - repeats), repeats) + np.arange(repeats.sum())]
    normal = _face_normals(vertices, faces)
    unit = _normalise(normal)
    near = (unit[first // 3] * unit[second // 3]).sum(1) >= _CREASE
    total = np.zeros((len(owner), 3))
    np.add.at(total, first[near], normal[second[near] // 3])
    return _normalise(total)


def _normalise(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
