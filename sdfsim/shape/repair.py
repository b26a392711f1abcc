"""Topology of triangle meshes: doubled faces, winding, openings. Arrays in, arrays out; no distances.

`vertices` are [V, 3 + K]: coordinates, and K columns (colours) that new vertices get by the same averages.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def without_doubles(faces: np.ndarray) -> np.ndarray:
    """One face [F', 3] for each set of three corners in `faces` [F, 3].

    Two faces back to back are either a wall between two touching cells, which is inside the solid, or a surface that
    was drawn from both sides. Without a wall the rest is still closed; then both go. Otherwise one stays.
    """
    order = np.argsort(faces, axis=1)
    # The sorted corners' permutation is even exactly when its inversions are.
    odd = ((order[:, 0] > order[:, 1]) ^ (order[:, 0] > order[:, 2]) ^ (order[:, 1] > order[:, 2])).astype(bool)
    _, first, label = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True)
    label = label.reshape(-1)
    both = (np.bincount(label, weights=odd) > 0) & (np.bincount(label, weights=~odd) > 0)
    kept = np.sort(first)
    single, wall = faces[kept], both[label[kept]]
    if not wall.any():
        return single
    edge, _ = _edges(single)
    component = components(single)
    uneven = np.bincount(edge[~np.tile(wall, 3)], minlength=edge.max() + 1) % 2 == 1
    broken = np.zeros(component.max() + 1, dtype=bool)
    broken[np.tile(component, 3)[uneven[edge]]] = True
    emptied = np.bincount(component[~wall], minlength=component.max() + 1) == 0
    return single[~(wall & ~(broken | emptied)[component])]


def components(faces: np.ndarray) -> np.ndarray:
    """[F] labels: faces that share an edge, with whatever others, are of one component."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edge, _ = _edges(faces)
    face = np.tile(np.arange(len(faces)), 3)
    links = coo_matrix((np.ones(len(edge)), (face, len(faces) + edge)), shape=(len(faces) + edge.max() + 1,) * 2)
    _, label = np.unique(connected_components(links, directed=False)[1][: len(faces)], return_inverse=True)
    return label


def consistent(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wind neighbours alike within each patch (faces joined by edges of two faces), as most of its area was wound.

    Returns:
        faces [F, 3] and the patch [F] of each.
    """
    import igl

    oriented: tuple[Any, Any] = igl.bfs_orient(np.ascontiguousarray(faces, dtype=np.int64))
    turned, patch = oriented
    same = np.zeros(len(faces), dtype=bool)
    for k in range(3):
        same |= (faces[:, k] == turned[:, 0]) & (faces[:, (k + 1) % 3] == turned[:, 1])
    area = face_areas(vertices[faces])
    minority = np.bincount(patch, weights=area * same) < 0.5 * np.bincount(patch, weights=area)
    wrong = same == minority[patch]
    return np.where(wrong[:, None], faces[:, ::-1], faces), patch


def bodies(faces: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """[F] labels of what can be turned on its own: closed patches, and components of all the other faces."""
    edge, sign = _edges(faces)
    owner = np.tile(patch, 3)
    _, pair = np.unique(edge * (int(patch.max()) + 1) + owner, return_inverse=True)
    leaks = np.bincount(owner, weights=np.bincount(pair, weights=sign)[pair] != 0) > 0
    label, rest = patch.copy(), leaks[patch]
    if rest.any():
        label[rest] = patch.max() + 1 + components(faces[rest])
    _, label = np.unique(label, return_inverse=True)
    return label


def leaking(faces: np.ndarray) -> np.ndarray:
    """[F] bool: faces with an edge at which the surface ends. None: it is a cycle, winding numbers are whole."""
    edge, sign = _edges(faces)
    open_ = np.bincount(edge, weights=sign)[edge] != 0
    return open_.reshape(3, -1).any(0)


def openings(faces: np.ndarray) -> list[np.ndarray]:
    """Loops of vertices [N] around which the surface ends, in the direction of its faces' edges."""
    edge, sign = _edges(faces)
    net = np.bincount(edge, weights=sign).astype(np.int64)
    _, first = np.unique(edge, return_index=True)
    starts = np.concatenate([faces[:, 0], faces[:, 1], faces[:, 2]])[first]
    ends = np.concatenate([faces[:, 1], faces[:, 2], faces[:, 0]])[first]
    # The direction in which there are too many of them.
    forward = net * sign[first] > 0
    starts, ends = np.where(forward, starts, ends), np.where(forward, ends, starts)
    leaving: dict[int, list[int]] = {}
    for start, end, count in zip(starts.tolist(), ends.tolist(), np.abs(net).tolist(), strict=True):
        if count:
            leaving.setdefault(start, []).extend([end] * count)
    loops = []
    # As many edges come to a vertex as leave it, so a walk can only end where it began.
    for origin in list(leaving):
        path, place = [origin], {origin: 0}
        while leaving.get(path[-1]):
            vertex = leaving[path[-1]].pop()
            if vertex in place:
                cut = place[vertex]
                loops.append(np.array(path[cut:]))
                for gone in path[cut + 1 :]:
                    del place[gone]
                del path[cut + 1 :]
            else:
                place[vertex] = len(path)
                path.append(vertex)
    return loops


def fill(vertices: np.ndarray, faces: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Close openings by fans around their middle, smallest first, while the fans' area is below `limit` in all.

    A fan is right for any flat loop, though it may lie over itself: what it covers twice cancels in winding numbers.

    Returns:
        vertices, faces, and the areas [H] of the openings that were closed.
    """
    fans, points = [], []
    for loop in openings(faces):
        ring = vertices[loop]
        after = np.roll(ring, -1, axis=0)
        length = np.linalg.norm((after - ring)[:, :3], axis=1, keepdims=True)
        middle = (0.5 * (ring + after) * length).sum(0) / max(length.sum(), 1e-300)
        area = face_areas(np.stack([after, ring, np.broadcast_to(middle, ring.shape)], axis=1)).sum()
        fans.append((area, loop, middle))
    fans.sort(key=lambda fan: fan[0])
    areas = np.array([fan[0] for fan in fans])
    closed = int((np.cumsum(areas) <= limit).sum())
    added = [faces]
    for _, loop, middle in fans[:closed]:
        if len(loop) == 3:
            added.append(loop[None, ::-1])
            continue
        centre = np.full(len(loop), len(vertices) + len(points))
        points.append(middle)
        added.append(np.stack([np.roll(loop, -1), loop, centre], axis=1))
    return np.concatenate([vertices, *[point[None] for point in points]]), np.concatenate(added), areas[:closed]


def face_areas(corners: np.ndarray) -> np.ndarray:
    """[F] areas of triangles [F, 3, 3 + K]."""
    return 0.5 * np.linalg.norm(face_normals(corners), axis=1)


def face_normals(corners: np.ndarray) -> np.ndarray:
    """[F, 3] normals of triangles [F, 3, 3 + K], as long as twice their area."""
    points = corners[..., :3]
    return np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For the 3 F directed edges (first ones, second, third): the undirected edge's number, and its sense +1 or -1."""
    start = np.concatenate([faces[:, 0], faces[:, 1], faces[:, 2]]).astype(np.int64)
    end = np.concatenate([faces[:, 1], faces[:, 2], faces[:, 0]]).astype(np.int64)
    key = np.minimum(start, end) * (int(faces.max()) + 1) + np.maximum(start, end)
    _, edge = np.unique(key, return_inverse=True)
    return edge, np.where(start < end, 1, -1)
