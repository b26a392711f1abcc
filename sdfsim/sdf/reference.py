"""Reference signed distances from a bounding-volume hierarchy, and where their sign can be trusted."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.bvh import Around, ClosestPoint, Winding
from sdfsim.geometry.mesh import Mesh, components, is_closed, joined
from sdfsim.geometry.solidify import Solid, exposed

# The paper trusts a sign only where the offset to the surface is less than 75 degrees from the normal's line.
TRUSTED_COSINE = float(np.cos(np.radians(75.0)))
# Least difference of a winding number from one half for a reliable sign, if the surface is not quite closed.
CLEAR = 0.2
# Cosine between the offset and a face's normal, above which the nearest point is within the face; and the distance,
# relative to the mesh's size, below which float32 gives the offset no direction.
STRAIGHT, TOUCHING = 1.0 - 1e-4, 1e-4
CHUNK = 200_000
# Number of points tested together against the convex pieces.
BLOCK = 512


class Reference(NamedTuple):
    """Distances at query points."""

    distance: np.ndarray  # [P] float64 m, positive outside
    closest: np.ndarray  # [P, 3] float64 m, the nearest point of the surface
    trusted: np.ndarray  # [P] bool, where the sign of `distance` may be used


class DistanceOracle(Protocol):
    """True distances, to which networks are fitted."""

    surface: Mesh  # the boundary as triangles, for sampling points on it
    closed: bool  # whether signs are reliable everywhere, not only where `Reference.trusted`
    bounds: np.ndarray  # [2, 3] float64 m, the box of the surface

    def __call__(self, points: np.ndarray) -> Reference: ...


class MeshDistance:
    """Signed distance to a solid that is bounded by triangles (see `solidify`), or to a mesh as it is (then a sheet has
    no inside). Raises SdfsimError if the mesh has no faces.

    The sign comes from the solid's winding number: a point is inside if the surface goes around it more than half a
    time. If a single clean surface bounds the solid, ray parity gives the same and is faster. `trusted` follows the
    paper (appendix on SDF training): the angle between (point - closest) and the face normal is below 75 or above 105
    degrees; if the surface is not quite closed, the winding number must also be clear.
    """

    def __init__(self, body: Solid | Mesh) -> None:
        if isinstance(body, Mesh):
            if len(body.faces) == 0:
                raise SdfsimError("mesh has no faces")
            closed = is_closed(body)
            body = Solid(body, body, closed=closed, simple=closed and components(body.faces).max() == 0)
        self.solid = body
        self.surface = body.surface
        self.closed = body.closed
        self.bounds = np.stack([self.surface.vertices.min(0), self.surface.vertices.max(0)])
        # Distances to a thickened sheet are measured from the sheet.
        self._nearest = ClosestPoint(body.body if body.thickness else body.surface)
        self._winding = Around(body.body) if body.closed else Winding(body.body)

    def __call__(self, points: np.ndarray) -> Reference:
        """Reference values at `points` [P, 3] m."""
        return _in_chunks(self._chunk, points)

    def closest(self, points: np.ndarray) -> np.ndarray:
        """The points [P, 3] m of the surface that are nearest to others [P, 3] m."""
        return self(points).closest if self.solid.thickness else self._nearest(points)[0]

    def _chunk(self, points: np.ndarray) -> Reference:
        closest, normal = self._nearest(points)
        offset = points - closest
        unsigned = np.linalg.norm(offset, axis=1)
        if self.solid.thickness:  # everything within half of it from the sheet
            half = 0.5 * self.solid.thickness
            # On the sheet itself both of its sides are equally near.
            on = unsigned <= 1e-7 * half
            direction = np.where(on[:, None], normal, offset / np.where(on, 1.0, unsigned)[:, None])
            return Reference(unsigned - half, closest + half * direction, np.ones(len(points), dtype=bool))
        clear = np.ones(len(points), dtype=bool)
        side = np.einsum("pi,pi->p", offset, normal)
        height = np.abs(side)
        if self.solid.simple:
            inside = side < 0.0
            # Straight above or below a face the sign is that of its normal; beside an edge rays are counted.
            size = float((self.bounds[1] - self.bounds[0]).max())
            aside = (height < STRAIGHT * unsigned) | (unsigned < TOUCHING * size)
            inside[aside] = self._nearest.odd(points[aside])
        else:
            winding = self._winding(points)
            inside = winding > 0.5
            if not self.closed:
                clear = np.abs(winding - 0.5) > CLEAR
        trusted = clear & (height >= TRUSTED_COSINE * unsigned)
        return Reference(np.where(inside, -unsigned, unsigned), closest, trusted)


class PiecesDistance:
    """Signed distance to a union of convex closed pieces, metres: the exact body that a rigid-body engine collides.
    Raises SdfsimError if there are no pieces.

    Whether a point is inside is exact (half-spaces of each piece). Outside, the distance is the minimum over the
    pieces. Inside, it is the distance to the boundary of the *union*: faces that another piece covers are left out, so
    that the seams between touching pieces do not show up as a surface.
    """

    def __init__(self, pieces: list[Mesh]) -> None:
        from scipy.spatial import ConvexHull

        if not pieces:
            raise SdfsimError("a shape of convex pieces needs at least one piece")
        self.pieces = pieces
        self.closed = True
        everything = joined(pieces)
        self.bounds = np.stack([everything.vertices.min(0), everything.vertices.max(0)])
        size = float((self.bounds[1] - self.bounds[0]).max())
        # Touching pieces leave seams without width between them, so points outside by a tiny margin count as inside.
        self._seam = 1e-5 * size
        self._boxes = np.stack([np.stack([piece.vertices.min(0), piece.vertices.max(0)]) for piece in pieces])
        # [H, 4] outward normals and offsets of each piece's faces, without repetitions; inside is normal . x + offset <
        # 0.
        unit = np.array([1.0, 1.0, 1.0, size])
        planes = (ConvexHull(piece.vertices).equations / unit for piece in pieces)
        self.planes = [np.unique(found.round(9), axis=0) * unit for found in planes]
        self._outside = ClosestPoint(everything)
        self.surface = everything if len(pieces) == 1 else self._boundary(everything, size)
        self._inside = self._outside if len(pieces) == 1 else ClosestPoint(self.surface)

    def __call__(self, points: np.ndarray) -> Reference:
        """Reference values at `points` [P, 3] m; every sign is trusted."""
        return _in_chunks(self._chunk, points)

    def inside(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """[P] bool: deeper than `margin` m in at least one piece."""
        result = np.zeros(len(points), dtype=bool)
        low, high = self._boxes[:, 0] + margin, self._boxes[:, 1] - margin
        # Neighbouring points are tested together, against the few pieces that reach their block.
        cell = np.clip((points - self.bounds[0]) / (self.bounds[1] - self.bounds[0]) * 16, 0, 15).astype(np.int64)
        order = np.argsort(cell @ [256, 16, 1], kind="stable")
        for start in range(0, len(points), BLOCK):
            some = order[start : start + BLOCK]
            block = points[some]
            found = np.zeros(len(block), dtype=bool)
            reach = (low <= block.max(0)).all(1) & (high >= block.min(0)).all(1)
            for piece in np.flatnonzero(reach):
                near = np.flatnonzero(~found & ((block >= low[piece]) & (block <= high[piece])).all(1))
                if len(near):
                    planes = self.planes[piece]
                    found[near] = (block[near] @ planes[:, :3].T + planes[:, 3]).max(1) < -margin
            result[some] = found
        return result

    def _chunk(self, points: np.ndarray) -> Reference:
        inside = self.inside(points, -self._seam)
        closest, _ = self._outside(points)
        if inside.any():
            closest[inside] = self._inside(points[inside])[0]
        distance = np.linalg.norm(points - closest, axis=1)
        return Reference(np.where(inside, -distance, distance), closest, np.ones(len(points), dtype=bool))

    def _boundary(self, everything: Mesh, size: float) -> Mesh:
        """The parts of the pieces' faces that no other piece covers."""

        def bare(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
            return (~self.inside(points * size + 1e-3 * size * normals)).astype(np.int64)

        triangles = exposed(everything.vertices[everything.faces] / size, bare)[0] * size
        return Mesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))


def _in_chunks(ask: Callable[[np.ndarray], Reference], points: np.ndarray) -> Reference:
    points = np.asarray(points, dtype=np.float64)
    parts = [ask(points[start : start + CHUNK]) for start in range(0, max(len(points), 1), CHUNK)]
    return Reference(*(np.concatenate(column) for column in zip(*parts, strict=True)))
