"""Parts of meshes: normals, connected components, and which of those belong."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from sdfsim.errors import SdfsimError
from sdfsim.shape.mesh import Mesh

# A component of whose area photos show less than this share is matter behind the scenery.
UNSEEN = 0.05


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


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one, without colours."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def components(mesh: Mesh) -> np.ndarray:
    """Component number [F] of each face; faces that share a vertex are connected."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])
    count = len(mesh.vertices)
    graph = coo_matrix((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1][mesh.faces[:, 0]]


@dataclass(frozen=True)
class Piece:
    """A connected component that does not belong.

    Attributes:
        name: piece1, piece2 ... from the largest down; the same again for the same mesh.
        faces: [K] indices of its faces.
        size: the longest side of its bounding box.
        middle: [3] of that box.
        why: it was left out, in words.
    """

    name: str
    faces: np.ndarray
    size: float
    middle: np.ndarray
    why: str


@dataclass(frozen=True)
class Judged:
    """Which components of a mesh belong.

    Attributes:
        kept: [F] bool.
        pieces: what has a name and does not belong, kept all the same or not.
        counts: for the report.
    """

    kept: np.ndarray
    pieces: tuple[Piece, ...]
    counts: dict


def judge(mesh: Mesh, seen: np.ndarray, share: float, speck: float, keep: Collection[str] = ()) -> Judged:
    """Which connected components of a closed mesh belong: those that photos show and that are not floaters.

    Args:
        mesh: closed, wound outwards.
        seen: [F] bool, faces that photos show.
        share: a component with less than this share of all the area is a floater.
        speck: components shorter than this are only counted.
        keep: names of components to keep all the same; "all" keeps every one that has a name.

    Raises:
        SdfsimError: no component has a name that is to be kept.
    """
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
    dropped = np.flatnonzero((small | unseen) & ~inward)
    named = dropped[(size[dropped] >= speck)]
    pieces = tuple(
        Piece(f"piece{n}", np.flatnonzero(label == k), float(size[k]), (low[k] + high[k]) / 2,
              "no photo shows it" if unseen[k] else f"less than {share:.2%} of the surface")
        for n, k in enumerate(named[np.argsort(-size[named], kind="stable")], start=1)
    )  # fmt: skip
    wrong = sorted(set(keep) - {"all"} - {piece.name for piece in pieces})
    if wrong:
        names = ", ".join(piece.name for piece in pieces) or "nothing was left out"
        raise SdfsimError(f"keep: no piece is called {', '.join(wrong)}", f"left out: {names}")
    belongs = ~(small | unseen)[label]
    for piece in pieces:
        if "all" in keep or piece.name in keep:
            belongs[piece.faces] = True
    counts = {
        "components": len(total), "dropped_small": int((small & ~unseen).sum()), "dropped_unseen": int(unseen.sum()),
        "dropped_area_share": round(float(total[small | unseen].sum() / total.sum()), 4),
    }  # fmt: skip
    return Judged(belongs, pieces, counts)


def islands(mesh: Mesh, faces: np.ndarray, share: float) -> np.ndarray:
    """Of some faces [F] bool those [F] bool that lie together: patches too small to mean anything are left out.

    Args:
        mesh: any.
        faces: [F] bool.
        share: a patch needs this share of the area of all the faces, or of those of its own component of the mesh.
    """
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
