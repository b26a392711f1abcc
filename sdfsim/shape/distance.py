"""Reference signed distances from a bounding-volume hierarchy, and where their sign can be trusted."""

from __future__ import annotations

import os
from typing import Any, NamedTuple, Protocol

import numpy as np

from sdfsim.errors import SdfsimError
from sdfsim.shape.mesh import Mesh, is_closed, signed_volume

# A single ray meets edges and vertices of plain cubes; five randomly directed ones outvote that.
PARITY_RAYS = 5
# The paper trusts a sign only where the offset to the surface is less than 75 degrees from the normal's line.
TRUSTED_COSINE = float(np.cos(np.radians(75.0)))
CHUNK = 200_000
# Points tested together against the convex pieces.
BLOCK = 512


class Reference(NamedTuple):
    """What is known about query points.

    Attributes:
        distance: [P] float64 m, positive outside.
        closest: [P, 3] float64 m, the nearest point of the surface.
        trusted: [P] bool, where the sign of `distance` may be used.
    """

    distance: np.ndarray
    closest: np.ndarray
    trusted: np.ndarray


class DistanceOracle(Protocol):
    """Something that knows true distances: what the fit learns from.

    Attributes:
        surface: the boundary as triangles, for sampling points on it.
        closed: whether signs are reliable everywhere, not only where `Reference.trusted` says so.
        bounds: [2, 3] float64 m, the box of the surface.
    """

    surface: Mesh
    closed: bool
    bounds: np.ndarray

    def __call__(self, points: np.ndarray) -> Reference: ...


class _ClosestPoint:
    """Nearest triangle of a mesh, in coordinates moved to the mesh's centre (open3d computes in float32)."""

    def __init__(self, mesh: Mesh) -> None:
        import open3d as o3d

        self._tensor: Any = o3d.core.Tensor
        self.centre = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
        threads = int(os.environ.get("OMP_NUM_THREADS", "0") or 0)
        self.scene = o3d.t.geometry.RaycastingScene(nthreads=max(threads, 0))
        self.threads = max(threads, 0)
        local = np.ascontiguousarray(mesh.vertices - self.centre, dtype=np.float32)
        self.scene.add_triangles(self._tensor(local), self._tensor(np.ascontiguousarray(mesh.faces, dtype=np.uint32)))

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest surface point [P, 3] m and the unit normal [P, 3] of its triangle."""
        answer = self.scene.compute_closest_points(self._local(points), nthreads=self.threads)
        normal = answer["primitive_normals"].numpy().astype(np.float64)
        return answer["points"].numpy().astype(np.float64) + self.centre, normal

    def inside(self, points: np.ndarray) -> np.ndarray:
        """[P] bool by the majority of ray parities."""
        occupancy = self.scene.compute_occupancy(self._local(points), nthreads=self.threads, nsamples=PARITY_RAYS)
        return occupancy.numpy() > 0.5

    def _local(self, points: np.ndarray):
        return self._tensor(np.ascontiguousarray(points - self.centre, dtype=np.float32))


class MeshDistance:
    """Signed distance to a triangle mesh.

    The sign comes from ray parity. `trusted` follows the paper (appendix on SDF training): the angle between
    (point - closest) and the face normal is below 75 or above 105 degrees; on a mesh with holes the normal
    must also agree with the parity, because each of them is wrong there in different places.

    Args:
        mesh: metres.

    Raises:
        SdfsimError: the mesh has no faces.
    """

    def __init__(self, mesh: Mesh) -> None:
        if len(mesh.faces) == 0:
            raise SdfsimError("mesh has no faces")
        self.surface = mesh
        self.closed = is_closed(mesh)
        self.bounds = np.stack([mesh.vertices.min(0), mesh.vertices.max(0)])
        # A closed mesh with negative volume is inside out: its normals point in.
        self._outward = -1.0 if self.closed and signed_volume(mesh) < 0 else 1.0
        self._nearest = _ClosestPoint(mesh)

    def __call__(self, points: np.ndarray) -> Reference:
        """Reference values at `points` [P, 3] m."""
        parts = [self._chunk(part) for part in _chunks(points)]
        return Reference(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _chunk(self, points: np.ndarray) -> Reference:
        closest, normal = self._nearest(points)
        offset = points - closest
        unsigned = np.linalg.norm(offset, axis=1)
        inside = self._nearest.inside(points)
        height = np.einsum("pi,pi->p", offset, normal) * self._outward
        trusted = np.abs(height) >= TRUSTED_COSINE * unsigned
        if not self.closed:
            trusted &= (height < 0) == inside
        return Reference(np.where(inside, -unsigned, unsigned), closest, trusted)


class PiecesDistance:
    """Signed distance to a union of convex pieces: the exact body that a rigid-body engine collides.

    Whether a point is inside is exact (half-spaces of each piece). Outside, the distance is the minimum over the
    pieces. Inside, it is the distance to the boundary of the *union*: faces that another piece covers are left out,
    so that the seams between touching pieces do not show up as a surface within the solid.

    Args:
        pieces: convex closed meshes, metres.

    Raises:
        SdfsimError: no pieces.
    """

    def __init__(self, pieces: list[Mesh]) -> None:
        if not pieces:
            raise SdfsimError("a shape of convex pieces needs at least one piece")
        self.pieces = pieces
        self.closed = True
        everything = merge(pieces)
        self.bounds = np.stack([everything.vertices.min(0), everything.vertices.max(0)])
        size = float((self.bounds[1] - self.bounds[0]).max())
        # Pieces that touch leave seams of no width between them: a hair's breadth outside still counts as inside.
        self._seam = 1e-5 * size
        self._boxes = np.stack([np.stack([piece.vertices.min(0), piece.vertices.max(0)]) for piece in pieces])
        self._planes = [half_spaces(piece) for piece in pieces]
        self._outside = _ClosestPoint(everything)
        self.surface = everything if len(pieces) == 1 else self._boundary(everything, size)
        self._inside = self._outside if len(pieces) == 1 else _ClosestPoint(self.surface)

    def __call__(self, points: np.ndarray) -> Reference:
        """Reference values at `points` [P, 3] m; every sign is trusted."""
        parts = [self._chunk(np.asarray(part, dtype=np.float64)) for part in _chunks(points)]
        return Reference(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def inside(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """[P] bool: deeper than `margin` m in at least one piece."""
        result = np.zeros(len(points), dtype=bool)
        low, high = self._boxes[:, 0] + margin, self._boxes[:, 1] - margin
        # Neighbours are judged together, against the few pieces that reach their block.
        order = _by_block(points, self.bounds)
        for start in range(0, len(points), BLOCK):
            some = order[start : start + BLOCK]
            block = points[some]
            found = np.zeros(len(block), dtype=bool)
            reach = (low <= block.max(0)).all(1) & (high >= block.min(0)).all(1)
            for piece in np.flatnonzero(reach):
                near = np.flatnonzero(~found & ((block >= low[piece]) & (block <= high[piece])).all(1))
                if len(near):
                    planes = self._planes[piece]
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
        """The parts of the pieces' faces that no other piece covers, cut finely only where a face is half covered."""
        corners = everything.vertices[everything.faces]
        kept: list[np.ndarray] = []
        while len(corners):
            covered = self._covered(corners, size)
            longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
            # A large face may hide a covered patch between its test points, so it is cut before it is judged.
            judged = longest <= 0.1 * size
            # The smallest ones go by their centroid: wrong by a fraction of their size, along seams only.
            tiny = longest <= 0.008 * size
            kept.append(corners[(judged & ~covered.any(1)) | (tiny & ~covered[:, 0])])
            corners = _quarter(corners[~judged | (covered.any(1) & ~covered.all(1) & ~tiny)])
        triangles = np.concatenate(kept)
        return Mesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))

    def _covered(self, corners: np.ndarray, size: float) -> np.ndarray:
        """[F, 7] bool for centroid, near-corners and near-midpoints of [F, 3, 3] triangles: just outside is inside."""
        weights = np.array(
            [[1, 1, 1], [30, 1, 1], [1, 30, 1], [1, 1, 30], [15, 15, 1], [15, 1, 15], [1, 15, 15]], dtype=np.float64
        )
        weights /= weights.sum(1, keepdims=True)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        tests = np.einsum("kc,fci->fki", weights, corners) + 1e-3 * size * normal[:, None]
        return self.inside(tests.reshape(-1, 3)).reshape(len(corners), -1)


def merge(pieces: list[Mesh]) -> Mesh:
    """All pieces in one mesh (faces concatenated, nothing cut away)."""
    starts = np.cumsum([0] + [len(piece.vertices) for piece in pieces[:-1]])
    return Mesh(
        np.concatenate([piece.vertices for piece in pieces]),
        np.concatenate([piece.faces + start for piece, start in zip(pieces, starts, strict=True)]),
    )


def half_spaces(piece: Mesh) -> np.ndarray:
    """[H, 4] outward unit normal and offset of the piece's convex hull; inside is normal . x + offset < 0."""
    from scipy.spatial import ConvexHull

    return np.unique(ConvexHull(piece.vertices).equations.round(9), axis=0)


def _by_block(points: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """An order in which points of the same cell of a 16^3 grid over `bounds` follow each other."""
    cell = np.clip((points - bounds[0]) / (bounds[1] - bounds[0]) * 16, 0, 15).astype(np.int64)
    return np.argsort((cell[:, 0] * 16 + cell[:, 1]) * 16 + cell[:, 2], kind="stable")


def _quarter(corners: np.ndarray) -> np.ndarray:
    """Cut triangles [F, 3, 3] at their edge midpoints: [4 F, 3, 3]."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return np.concatenate([np.stack(part, axis=1) for part in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])


def _chunks(points: np.ndarray):
    points = np.asarray(points, dtype=np.float64)
    for start in range(0, max(len(points), 1), CHUNK):
        yield points[start : start + CHUNK]
