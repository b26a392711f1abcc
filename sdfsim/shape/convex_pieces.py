"""Convex pieces of a shape as contacts use them: closed forms, and hulls with their flat faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sdfsim.shape.mesh import Mesh
from sdfsim.shape.sdf import BoxSdf, CapsuleSdf, CylinderSdf, Sdf, SphereSdf

FLAT = 1e-6  # faces whose unit normals differ by less are one
CORNERS = 64  # of a face at most: of one with more, so many evenly chosen ones bound the contact


@dataclass(frozen=True, eq=False)
class ConvexPiece:
    """One convex solid in the frame of its shape, at scale 1."""

    kind: str  # "sphere", "capsule", "box", "cylinder" or "hull"
    sizes: tuple[float, ...]  # m, as the closed form has them; of a hull none
    ball: np.ndarray  # [4] m, middle and radius of a ball around it
    thickness: float  # m, the least distance of two parallel planes that hold it, along the normals of faces
    vertices: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # [V, 3] m, of a hull
    normals: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # [F, 3] outward, one a flat face
    loops: tuple[np.ndarray, ...] = ()  # [F] the vertices of each face, counter-clockwise as seen from outside


def closed_form(sdf: Sdf) -> ConvexPiece | None:
    """The piece that a closed form is; None for a plane, and for what has no closed form."""
    if isinstance(sdf, SphereSdf):
        return ConvexPiece("sphere", sdf.sizes, np.array([0, 0, 0, sdf.radius]), 2.0 * sdf.radius)
    if isinstance(sdf, CapsuleSdf):
        return ConvexPiece("capsule", sdf.sizes, np.array([0, 0, 0, sdf.radius + sdf.half]), 2.0 * sdf.radius)
    if isinstance(sdf, BoxSdf):
        return ConvexPiece("box", sdf.sizes, np.array([0, 0, 0, np.linalg.norm(sdf.half)]), 2.0 * min(sdf.half))
    if isinstance(sdf, CylinderSdf):
        ball = np.array([0, 0, 0, np.hypot(sdf.radius, sdf.half)])
        return ConvexPiece("cylinder", sdf.sizes, ball, 2.0 * min(sdf.radius, sdf.half))
    return None


def hull(vertices: np.ndarray) -> ConvexPiece:
    """The convex hull of vertices [V, 3] m that are not all in one plane."""
    from scipy.spatial import ConvexHull

    found = ConvexHull(vertices)
    corners = vertices[found.vertices]
    number = np.full(len(vertices), -1)
    number[found.vertices] = np.arange(len(corners))
    normals, loops = [], []
    left = np.ones(len(found.simplices), bool)
    for k in range(len(found.simplices)):
        if not left[k]:
            continue
        normal = found.equations[k, :3]
        alike = left & (np.linalg.norm(found.equations[:, :3] - normal, axis=1) < FLAT)
        left &= ~alike
        normals.append(normal)
        loops.append(_around(corners, np.unique(number[found.simplices[alike]]), normal))
    widths = [np.ptp(corners @ normal) for normal in normals]
    middle = 0.5 * (corners.min(0) + corners.max(0))
    ball = np.array([*middle, np.linalg.norm(corners - middle, axis=1).max()])
    return ConvexPiece("hull", (), ball, float(min(widths)), corners, np.array(normals), tuple(loops))


def _around(corners: np.ndarray, chosen: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The vertices of a flat face in turn."""
    places = corners[chosen] - corners[chosen].mean(0)
    one = places[np.argmax(np.linalg.norm(places, axis=1))]
    one = one - (one @ normal) * normal
    two = np.cross(normal, one)
    loop = chosen[np.argsort(np.arctan2(places @ two, places @ one), kind="stable")]
    return loop[np.linspace(0, len(loop), min(len(loop), CORNERS), endpoint=False).astype(int)]


def is_convex(mesh: Mesh, within: float) -> bool:
    """Whether a closed mesh is its own convex hull to `within` m: no face lies deeper below the hull."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        found = ConvexHull(mesh.vertices)
    except QhullError:
        return False  # flat
    # The corners and the middles of faces and edges of a dent lie below all planes of the hull.
    corners = mesh.vertices[mesh.faces]
    places = np.concatenate(
        [mesh.vertices, corners.mean(1), 0.5 * (corners + np.roll(corners, 1, axis=1)).reshape(-1, 3)]
    )
    planes = np.unique(found.equations.round(9), axis=0)
    for part in np.array_split(places, -(-len(places) * len(planes) // 2**22) or 1):
        if ((part @ planes[:, :3].T + planes[:, 3]).max(1) < -within).any():
            return False
    return True


def pieces_of(sdf: Sdf, pieces: Sequence[np.ndarray]) -> tuple[ConvexPiece, ...]:
    """What a shape collides as: its closed form, or its convex pieces (the vertices [V, 3] m of each); none for a
    plane, and for a surface that has no pieces."""
    if len(pieces):
        return tuple(hull(piece) for piece in pieces)
    found = closed_form(sdf)
    return () if found is None else (found,)
