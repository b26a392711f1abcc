"""Parts of meshes: normals, connected components, and dropping those that do not belong."""

from __future__ import annotations

import numpy as np

from sdfsim.shape.mesh import Mesh


def face_normals(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals [F, 3] and areas [F]."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    double = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(double, 1e-30)[:, None], double / 2


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """Area-weighted unit normals [V, 3]."""
    normals, areas = face_normals(mesh)
    total = np.zeros_like(mesh.vertices)
    for k in range(3):
        np.add.at(total, mesh.faces[:, k], normals * areas[:, None])
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


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


def drop_small(mesh: Mesh, seen: np.ndarray | None, share: float) -> tuple[Mesh, np.ndarray, dict]:
    """Drops components that are small, or that no photo shows (cavities, matter behind the scenery).

    Args:
        mesh: any.
        seen: [F] bool, faces that photos show; None keeps unseen components.
        share: smallest share of the whole area that a component may have.

    Returns:
        The rest, which faces were kept [F] bool, and counts for the report.
    """
    label = components(mesh)
    _, area = face_normals(mesh)
    total = np.bincount(label, area)
    small = total < share * total.sum()
    unseen = np.zeros_like(small) if seen is None else np.bincount(label, area * seen) < 0.05 * total
    largest = int(np.argmax(total if seen is None else np.bincount(label, area * seen)))
    small[largest] = unseen[largest] = False
    keep = ~(small | unseen)[label]
    counts = {
        "components": len(total), "dropped_small": int((small & ~unseen).sum()), "dropped_unseen": int(unseen.sum()),
        "dropped_area_share": round(float(total[small | unseen].sum() / total.sum()), 4),
    }  # fmt: skip
    return keep_faces(mesh, keep), keep, counts
