"""Textures of reconstructed meshes: charts by xatlas, and for each texel the photos that show it best.

Everything here is in metres. A texture is baked in blocks of texels: the weight of each photo is computed once per
block; the colours are then taken texel by texel, with interpolated weights.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from pipeline.cameras import View
from pipeline.inputs.photos import Photo, open_photo
from pipeline.mesh.extraction import keep_faces
from pipeline.mesh.visibility import FLATTEST, bilinear, framed, to_bytes
from sdfsim.base.parallel import Progress, share_of, silent
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, face_normals, halves, joined, sample_surface, vertex_normals

FACES = 40_000  # of a textured mesh: finer detail is in its texture
PIECE = 300  # faces per call of xatlas: its time grows with the square of the faces of a chart
LARGEST = 4096  # px, longest side of a texture
SMALLEST = 16  # smallest length of a mesh in texels, even if no photo shows it
FULL = 0.5  # share of a texture that charts will fill at least
BLOCK = 4  # texels per side
BATCH = 1 << 21  # rays per batch
# Views are weighted by this power of their quality at a place: high enough that the best one gives nearly all of the
# colour, because a mean of photos that are a few pixels apart is blurred; low enough for a soft transition to the next
# one.
POWER = 8.0
LEAST = 0.05  # share of the colour below which a view is left out
FAINT = 1e-3  # weight of the vertex colours, used where no photo shows the surface


@dataclass(frozen=True)
class Shots:
    """Photos to take colours from."""

    views: Sequence[View]  # cameras, metres
    sharpness: np.ndarray  # [N] of each photo, in any unit
    folder: Path  # of the photos stage
    blocking: Caster  # occluding surfaces
    lift: float  # m, offset of a place along its normal before tracing rays from it

    def photo(self, view: View) -> np.ndarray:
        """Colours [H, W, 3] uint8."""
        return np.asarray(open_photo(self.folder, view))

    def density(self, points: np.ndarray, normals: np.ndarray) -> float:
        """Photo pixels per metre of the surface in the best view: the median over points [P, 3]."""
        best = np.zeros(len(points))
        for view in self.views:
            index, density, _ = _facing(view, points, normals)
            best[index] = np.maximum(best[index], density)
        return float(np.median(best[best > 0])) if best.any() else 0.0


def shots_of(views: Sequence[View], photos: list[Photo], folder: Path, meshes: Sequence[Mesh], cell: float) -> Shots:
    """The photos of some views of a scene of `meshes`, all in metres, exact to about a `cell`."""
    sharpness = {photo.name: photo.sharpness for photo in photos}
    return Shots(views, np.array([sharpness[view.name] for view in views]), folder, Caster(joined(meshes)), cell)


@dataclass(frozen=True)
class Texels:
    """The texels of a texture that lie on the surface."""

    shape: tuple[int, int]  # rows and columns of the texture, multiples of `BLOCK`
    at: np.ndarray  # [T] index of each in the flat texture
    positions: np.ndarray  # [T, 3] float32 m
    normals: np.ndarray  # [T, 3] float32, about unit
    colors: np.ndarray  # [T, 3] float32 in 0..255, those of the mesh's vertices


def texture_parts(meshes: dict[str, Mesh], shots: Shots, on_progress: Progress = silent) -> dict[str, Mesh]:
    """Each mesh with a texture, with fewer faces if it has many, and with vertices doubled where its charts meet; its
    vertex colours stay where no photo shows the surface."""
    made, done, total = {}, 0.0, sum(len(mesh.faces) for mesh in meshes.values())
    for name, mesh in meshes.items():
        share = len(mesh.faces) / total
        made[name] = textured(mesh, shots, share_of(on_progress, done, share))
        done += share
    return made


def textured(mesh: Mesh, shots: Shots, on_progress: Progress = silent) -> Mesh:
    """One mesh with a texture, see `texture_parts`."""
    on_progress(0.0, "unfolding the surface")
    points, normals = sample_surface(mesh, 4000, np.random.default_rng(0))
    coarse = fewer(mesh, FACES)
    flat, origin, shape = unfold(coarse, shots.density(points, normals))
    texels = rasterise(flat, vertex_normals(coarse)[origin], shape)
    return replace(flat, colors=None, texture=bake(texels, shots, share_of(on_progress, 0.3, 0.7)))


def fewer(mesh: Mesh, most: int) -> Mesh:
    """The mesh with at most about `most` faces; its vertices have the colours of the nearest original ones."""
    if len(mesh.faces) <= most:
        return mesh
    import open3d as o3d

    given = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.faces.astype(np.int32))
    )
    made = given.simplify_quadric_decimation(most)
    vertices, faces = np.asarray(made.vertices), np.asarray(made.triangles).astype(np.int64)
    coarse = keep_faces(Mesh(vertices, faces), face_normals(Mesh(vertices, faces))[1] > 0)
    nearest = KDTree(mesh.vertices).query(coarse.vertices)[1]
    return replace(coarse, colors=None if mesh.colors is None else mesh.colors[nearest])


def unfold(mesh: Mesh, density: float) -> tuple[Mesh, np.ndarray, tuple[int, int]]:
    """Lays out the faces of a mesh in a texture of `density` texels per metre, or fewer if it would be too large: the
    mesh with `uv` and vertices doubled where charts meet; the original vertex [V'] of each; and the rows and columns of
    the texture, multiples of `BLOCK`."""
    import xatlas

    pieces = halves(mesh.vertices[mesh.faces].mean(1), PIECE)
    parts = [np.unique(mesh.faces[piece], return_inverse=True) for piece in pieces]
    extent = float(np.ptp(mesh.vertices, axis=0).max())  # xatlas ignores faces of a micrometre
    density = min(max(density, SMALLEST / extent), LARGEST * np.sqrt(FULL / face_normals(mesh)[1].sum()))
    while True:
        atlas = xatlas.Atlas()
        for used, corners in parts:
            vertices = (mesh.vertices[used] / extent).astype(np.float32)
            atlas.add_mesh(vertices, corners.reshape(-1, 3).astype(np.uint32))
        packing = xatlas.PackOptions()
        packing.texels_per_unit, packing.padding = density * extent, BLOCK
        packing.blockAlign = packing.bilinear = True
        atlas.generate(pack_options=packing)
        size = np.array([atlas.height, atlas.width])
        if size.max() <= LARGEST:
            break
        density *= 0.97 * LARGEST / size.max()
    rows, columns = np.maximum(-(-size // BLOCK), 1) * BLOCK
    origin, faces, uv = [], [], []
    for number, (used, _) in enumerate(parts):
        of, corners, at = atlas.get_mesh(number)
        faces.append(corners.astype(np.int64) + sum(map(len, origin)))
        origin.append(used[of])
        uv.append(at * size[::-1] / [columns, rows])
    of = np.concatenate(origin)
    colors = None if mesh.colors is None else mesh.colors[of]
    flat = Mesh(mesh.vertices[of], np.concatenate(faces), colors, np.concatenate(uv))
    return flat, of, (int(rows), int(columns))


def rasterise(flat: Mesh, normals: np.ndarray, shape: tuple[int, int]) -> Texels:
    """The positions of a texture's texels on a surface with `uv`, optional colours, and vertex normals [V, 3]."""
    assert flat.uv is not None
    rows, columns = shape
    # The charts lie in a plane; a ray through each texel's centre finds the face and the point that cover it.
    sheet = Caster(Mesh(np.c_[flat.uv * [columns, rows], np.zeros(len(flat.uv))], flat.faces))
    parts = []
    for first in range(0, rows * columns, BATCH):
        texel = np.arange(first, min(first + BATCH, rows * columns))
        rays = np.tile(np.array([0, 0, 1, 0, 0, -1], np.float32), (len(texel), 1))
        rays[:, 0], rays[:, 1] = texel % columns + 0.5, texel // columns + 0.5
        away, face, places = sheet.cast(rays)
        hit = np.isfinite(away)
        parts.append((texel[hit], face[hit], places[hit]))
    at, face, places = (np.concatenate(part) for part in zip(*parts, strict=True))
    corners = flat.faces[face.astype(np.int64)]
    second, third = places.T
    weights = np.stack([1 - second - third, second, third])

    def spread(values: np.ndarray) -> np.ndarray:
        values = values.astype(np.float32)
        return sum(weight[:, None] * values[corners[:, k]] for k, weight in enumerate(weights))  # type: ignore[return-value]

    colors = np.full((len(normals), 3), 128) if flat.colors is None else flat.colors
    return Texels(shape, at, spread(flat.vertices), spread(normals), spread(colors))


def bake(texels: Texels, shots: Shots, on_progress: Progress = silent) -> np.ndarray:
    """The texture [H, W, 3] uint8: for each texel the colour in the photos that show it best.

    The weight of a view depends on its pixels on the surface, its viewing angle and the sharpness of its photo. Within
    two blocks of an occlusion, or of the photo's border, it fades out, because edges of the reconstruction are not
    exact. Photos differ in exposure, so detail larger than a few blocks has the mean colour of all photos.
    """
    import cv2

    rows, columns = texels.shape
    small = rows // BLOCK, columns // BLOCK
    block = texels.at // columns // BLOCK * small[1] + texels.at % columns // BLOCK
    count = np.bincount(block, minlength=small[0] * small[1])
    used = np.flatnonzero(count)

    def by_block(values: np.ndarray) -> np.ndarray:
        """Means [B, C] over the blocks in use of values [T, C]."""
        return np.stack([np.bincount(block, axis, len(count))[used] / count[used] for axis in values.T], 1)

    sites, normals = by_block(texels.positions), by_block(texels.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    covered = np.zeros(small, np.float32)
    covered.reshape(-1)[used] = 1
    fully = covered / np.maximum(cv2.blur(covered, (3, 3)), 1e-6)

    def soft(image: np.ndarray) -> np.ndarray:
        """An image of blocks [h, w] or [h, w, 3] blurred within each chart: one block at least is between them."""
        return cv2.blur(image, (3, 3)) * (fully if image.ndim == 2 else fully[..., None])

    scores = np.zeros((len(shots.views), *small), np.float16)
    unit = max(shots.density(sites[::16], normals[::16]), 1e-12) ** 2 * shots.sharpness.max()
    mean, seen = FAINT * by_block(texels.colors), np.full(len(used), FAINT)
    for number, view in enumerate(shots.views):
        index, density, pixels = _facing(view, sites, normals)
        free = ~shots.blocking.blocked(sites[index] + shots.lift * normals[index], view.center)
        index, pixels = index[free], pixels[free]
        # Next to the blocks of a chart are empty ones, which must not count as unseen.
        image = np.where(covered > 0, 0, np.inf).astype(np.float32)
        image.reshape(-1)[used[index]] = density[free] ** 2 * shots.sharpness[number] / unit
        image = np.where(covered > 0, cv2.erode(image, np.ones((3, 3))), 0)
        scores[number] = np.clip(soft(image), 0, 1e4)
        share = scores[number].reshape(-1)[used[index], None].astype(float)
        photo = cv2.resize(shots.photo(view), None, fx=1 / BLOCK, fy=1 / BLOCK, interpolation=cv2.INTER_AREA)
        scale = np.array(photo.shape[1::-1]) / [view.width, view.height]
        mean[index] += share * bilinear(photo.astype(np.float32), pixels * scale - 0.5)
        seen[index] += share[:, 0]
        on_progress(0.5 * (number + 1) / len(shots.views), f"what photo {number + 1} of {len(shots.views)} shows")
    total = np.zeros(small, np.float32)
    for score in scores:
        total += score.astype(np.float32) ** POWER
    color, weight = FAINT * texels.colors, np.full(len(texels.at), FAINT, np.float32)
    for number, view in enumerate(shots.views):
        share = np.maximum(scores[number].astype(np.float32) ** POWER / np.maximum(total, 1e-37) - LEAST, 0)
        if not share.any():
            continue
        own = cv2.resize(share, (columns, rows), interpolation=cv2.INTER_LINEAR).reshape(-1)[texels.at]
        index = np.flatnonzero(own)
        pixels, _ = view.project(texels.positions[index])
        color[index] += own[index, None] * bilinear(shots.photo(view), pixels - 0.5)
        weight[index] += own[index]
        on_progress(0.5 + 0.5 * (number + 1) / len(shots.views), f"colours of photo {number + 1}")
    color /= weight[:, None]
    off = np.zeros((*small, 3), np.float32)
    off.reshape(-1, 3)[used] = mean / seen[:, None] - by_block(color)
    off = _filled(soft(soft(off)), covered > 0)
    color += cv2.resize(off, (columns, rows), interpolation=cv2.INTER_LINEAR).reshape(-1, 3)[texels.at]
    image = np.zeros((rows * columns, 3), np.float32)
    image[texels.at] = color
    known = np.zeros(rows * columns, bool)
    known[texels.at] = True
    return to_bytes(_filled(image.reshape(rows, columns, 3), known.reshape(rows, columns)))


def _facing(view: View, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [S] of [P, 3] that lie in a view's photo and face it; their pixels per metre of the surface [S], along the
    shorter side if seen at an angle; and their positions [S, 2] in the photo, px."""
    towards = view.center - points
    away = np.maximum(np.linalg.norm(towards, axis=1), 1e-12)
    cosine = (towards * normals).sum(1) / away
    index = np.flatnonzero(cosine > FLATTEST)
    pixels, inside = framed(view, points[index])
    index = index[inside]
    return index, cosine[index] * view.focal / away[index], pixels[inside]


def _filled(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """An image [H, W, C] whose unknown pixels (not `known` [H, W]) take the colour of the nearest known one, because
    viewers that shrink textures read pixels between charts, and interpolation reads pixels next to them."""
    import cv2

    free = np.logical_not(known).astype(np.uint8)
    labels = cv2.distanceTransformWithLabels(free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)[1]
    nearest = np.asarray(labels, np.intp)
    colors = np.zeros((nearest.max() + 1, image.shape[2]), np.float32)
    colors[nearest[known]] = image[known]
    return colors[nearest]
