"""Where a shape is touched: surface nodes, and the patches of its surface that they belong to.

Two bodies touch at as many places as patches meet, and every pair of patches has contact points of its own: for a shape
that is made of convex pieces these are the pieces, as in the engines that collide them; any other shape is one patch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sdfsim.shape.distance import PiecesDistance
from sdfsim.shape.mesh import convex_hull
from sdfsim.shape.sdf import Sdf

CELLS = 40  # of the lattice that tells the nearest patch, along the largest extent
OUTSIDE = 1e-3  # of the extent: vertices that lie deeper in the union are not on its surface


@dataclass(frozen=True, eq=False)
class Surface:
    """Nodes of one shape and its patches, in the shape's own frame at scale 1.

    Attributes:
        nodes: [K, 3] m.
        patch: [K] int64, the patch of each.
        nearest: [X, Y, Z] int16, the patch that is nearest to the places of a lattice; None for a single patch.
        low: [3] m, the first of these places; cell: m between two.
    """

    nodes: np.ndarray
    patch: np.ndarray
    nearest: np.ndarray | None
    low: np.ndarray
    cell: float


def surface_of(sdf: Sdf, nodes: np.ndarray, pieces: Sequence[np.ndarray]) -> Surface:
    """The nodes that carry contact, with the vertices of convex pieces, where the shape has some, and their patches.

    Args:
        sdf: of the shape.
        nodes: [K, 3] m on its surface.
        pieces: the vertices [V, 3] m of each.
    """
    if len(pieces) == 0:
        return Surface(nodes, np.zeros(len(nodes), np.int64), None, np.zeros(3), 1.0)
    extent = float(np.ptp(sdf.bounds, axis=0).max())
    vertices, union = np.concatenate(pieces), PiecesDistance([convex_hull(piece) for piece in pieces])
    bare = union(vertices).distance > -OUTSIDE * extent
    nodes = union(nodes).closest  # those of a fitted surface lie beside it
    owner = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    cell = extent / CELLS
    low = sdf.bounds[0] - cell
    count = np.ceil((sdf.bounds[1] + cell - low) / cell).astype(int) + 1
    axes = [low[a] + cell * np.arange(count[a]) for a in range(3)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    nearest = _nearest_piece(pieces, np.concatenate([places, nodes]))
    return Surface(
        nodes=np.concatenate([vertices[bare], nodes]),
        patch=np.concatenate([owner[bare], nearest[len(places) :]]),
        nearest=nearest[: len(places)].astype(np.int16).reshape(count),
        low=low,
        cell=cell,
    )


def _nearest_piece(pieces: Sequence[np.ndarray], places: np.ndarray) -> np.ndarray:
    """[P] int64: the convex hull whose farthest face plane is least far from a place."""
    from scipy.spatial import ConvexHull

    least, nearest = np.full(len(places), np.inf), np.zeros(len(places), np.int64)
    for k, piece in enumerate(pieces):
        far = np.full(len(places), -np.inf)
        for plane in np.unique(np.round(ConvexHull(piece).equations, 6), axis=0):
            np.maximum(far, places @ plane[:3] + plane[3], out=far)
        nearest[far < least] = k
        np.minimum(least, far, out=least)
    return nearest
