"""Parts of meshes: connected components, and which of them belong."""

from __future__ import annotations

import numpy as np

from sdfsim.shape.mesh import Mesh, face_normals

# A component of whose area photos show less than this share is matter behind the scenery.
UNSEEN = 0.05


def keep_faces(mesh: Mesh, keep: np.ndarray) -> Mesh:
    """The mesh of the faces `keep` [F] bool, without the vertices that nothing uses."""
    faces = mesh.faces[keep]
    used, inverse = np.unique(faces, return_inverse=True)
    colors = None if mesh.colors is None else mesh.colors[used]
    return Mesh(mesh.vertices[used], inverse.reshape(-1, 3).astype(np.int64), colors)


def components(mesh: Mesh) -> np.ndarray:
    """Component number [F] of each face; faces that share a vertex are connected."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])
    count = len(mesh.vertices)
    graph = coo_matrix((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1][mesh.faces[:, 0]]


def belonging(mesh: Mesh, seen: np.ndarray, share: float, speck: float) -> tuple[np.ndarray, list[float]]:
    """Which faces [F] bool of a closed mesh belong, by connected components: those that photos show (`seen` [F] bool)
    and that have at least this share of all the area. Also the longest sides of the other components from the largest
    down, without those shorter than `speck`."""
    label = components(mesh)
    _, area = face_normals(mesh)
    total, shown = np.bincount(label, area), np.bincount(label, area * seen)
    unseen, small = shown < UNSEEN * total, total < share * total.sum()
    largest = int(np.argmax(shown))
    small[largest] = unseen[largest] = False
    corner = mesh.vertices[mesh.faces]
    inward = np.bincount(label, np.einsum("fi,fi->f", corner[:, 0], np.cross(corner[:, 1], corner[:, 2]))) < 0
    low, high = (np.full((len(total), 3), sign * np.inf) for sign in (1, -1))
    np.minimum.at(low, label, corner.min(1))
    np.maximum.at(high, label, corner.max(1))
    size = (high - low).max(1)
    # A cavity is a flaw of the piece around it and no piece of its own.
    left_out = size[(small | unseen) & ~inward & (size >= speck)]
    return ~(small | unseen)[label], sorted(left_out.tolist(), reverse=True)


def islands(mesh: Mesh, faces: np.ndarray, share: float) -> np.ndarray:
    """Of some faces [F] bool those that lie together: a patch needs this share of the area of all the faces, or of
    those of its own component of the mesh."""
    _, area = face_normals(mesh)
    area = np.where(faces, area, 0)
    index = np.flatnonzero(faces)
    patch = components(Mesh(mesh.vertices, mesh.faces[index]))
    _, whole = np.unique(components(mesh)[index], return_inverse=True)
    size = np.bincount(patch, area[index])[patch]
    own = np.bincount(whole, area[index])[whole]
    result = np.zeros(len(faces), bool)
    result[index] = size >= share * np.minimum(area.sum(), 5 * own)
    return result
