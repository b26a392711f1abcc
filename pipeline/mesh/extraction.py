"""Field -> surface: signed distances on a grid, marching cubes, and which part of the closed mesh the photos show."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree

from pipeline.cameras import PosedPhotos
from pipeline.field.grid_field import GridField
from pipeline.mesh.visibility import Visibility, look, spread_colors, to_bytes
from sdfsim.base.errors import EXIT_QUALITY, SdfsimError
from sdfsim.base.parallel import Progress, silent
from sdfsim.geometry.mesh import Mesh, face_normals, vertex_normals
from sdfsim.sdf.grid import near_samples

Distance = Callable[[np.ndarray], np.ndarray]

BATCH = 1 << 17  # points per query; more need more memory and save no time
RIM = 0.99  # normalised units, radius at which the solid ends: beyond it the field was never trained
EXTENT = 1.02  # normalised units, half the side of the sampled cube: it holds the ball with two samples around it
LIFT = 0.75  # cells of the samples by which vertices are lifted off a surface before views look for them
MIN_SEEN = 2  # photos that have to show a vertex: one alone does not determine its position
# Normalised units. What is farther than this from every point of structure-from-motion shows no piece of the surface to
# be real, and measures no level plane. Chosen on a rendered set without dense depth.
MAX_FROM_POINTS = 0.1
# Shares of area and of neighbours, chosen by hand on the photo sets of the project.
FLOATER = 0.01  # of the visible surface: smaller patches are ignored; for the closed solid a quarter of that
UNSEEN = 0.05  # a component with less than this share of its area seen is matter behind the scenery
CLOSING, CLOSINGS = 0.6, 4  # share of seen neighbours for which an unseen vertex counts as seen, and rounds
SPECK = 0.02  # normalised units, smallest reported length of pieces left out: 1 % of the trained space's width


@dataclass(frozen=True)
class Volume:
    """Samples of a signed distance."""

    values: np.ndarray  # [X, Y, Z] float32
    low: np.ndarray  # [3] position of the first sample
    cell: float  # between neighbouring samples

    def axes(self) -> list[np.ndarray]:
        """Positions of the samples along x, y and z."""
        return [low + self.cell * np.arange(count) for low, count in zip(self.low, self.values.shape, strict=True)]

    def points(self) -> np.ndarray:
        """Positions [X, Y, Z, 3] of the samples."""
        return np.stack(np.meshgrid(*self.axes(), indexing="ij"), -1)

    def along(self, direction: np.ndarray) -> np.ndarray:
        """Coordinate [X, Y, Z] of the samples along a direction [3]."""
        x, y, z = np.ix_(*self.axes())
        return x * direction[0] + y * direction[1] + z * direction[2]

    def at(self, points: np.ndarray) -> np.ndarray:
        """Trilinear values [P] at points [P, 3]; outside the grid those of its border."""
        return map_coordinates(self.values, ((points - self.low) / self.cell).T, order=1, mode="nearest")

    def limited(self, limit: Distance) -> "Volume":
        """The part of the solid within another one, given by its distance [P] at points [P, 3]."""
        values = self.values.copy()
        for number, x in enumerate(self.axes()[0]):  # A fine grid has too many points to hold at once.
            slab = Volume(values[number : number + 1], np.array([x, *self.low[1:]]), self.cell)
            values[number] = np.maximum(slab.values, limit(slab.points().reshape(-1, 3)).reshape(slab.values.shape))[0]
        return replace(self, values=values)

    def mesh(self) -> Mesh:
        """The zero surface by marching cubes, faces counter-clockwise from outside. Raises SdfsimError (exit code 3)
        if the values have one sign everywhere."""
        if not self.values.min() < 0 < self.values.max():
            raise SdfsimError("mesh: the field holds no surface", exit_code=EXIT_QUALITY)
        from skimage.measure import marching_cubes

        # A surface through a sample gives several vertices at one point; merged later, they would pinch a closed mesh.
        least = 0.02 * self.cell
        values = np.where(np.abs(self.values) < least, np.where(self.values < 0, -least, least), self.values)
        vertices, faces, _, _ = marching_cubes(values, 0.0)
        return Mesh(self.low + self.cell * vertices.astype(np.float64), faces.astype(np.int64))


def marked(table: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Whether places [P, D] int of a table of D dimensions are set [P] bool; those outside are not."""
    inside = np.all((index >= 0) & (index < table.shape), axis=1)
    inside[inside] = table[tuple(index[inside].T)]
    return inside


def sample(distance: Distance, points: np.ndarray) -> np.ndarray:
    """Values [P] float32 of a distance at points [P, 3], in batches."""
    parts = np.array_split(points, max(1, len(points) // BATCH))
    return np.concatenate([distance(part) for part in parts]).astype(np.float32)


def sample_volume(
    distance: Distance, resolution: int, *, extent: float = EXTENT, coarse: int = 4, on_progress: Progress = silent
) -> Volume:
    """Samples over [-extent, extent]^3, `resolution` a side (rounded up to a multiple of `coarse` plus 1), fine only
    near the surface of a distance [P] at points [P, 3]: a factor of 2 is left for fields that are not quite SDFs."""
    count = -(-(resolution - 1) // coarse) * coarse
    corner = np.full(3, extent)
    return sample_near(distance, -corner, corner, 2 * extent / count, coarse, on_progress)


def sample_box(distance: Distance, low: np.ndarray, high: np.ndarray, cell: float) -> Volume:
    """All samples in the box between two corners [3], `cell` apart."""
    counts = np.ceil((np.asarray(high) - low) / cell).astype(int) + 1
    empty = Volume(np.empty(counts, np.float32), np.asarray(low, float), cell)
    return replace(empty, values=sample(distance, empty.points().reshape(-1, 3)).reshape(counts))


def sample_near(distance: Distance, low: np.ndarray, high: np.ndarray, cell: float, coarse: int = 4,
                on_progress: Progress = silent) -> Volume:  # fmt: skip
    """Samples in the box between two corners [3], `cell` apart, fine only near the surface, see `sample_volume`; the
    box is made longer to hold whole blocks of `coarse` cells."""
    counts = coarse * np.ceil((high - low) / (coarse * cell) - 1e-6).astype(int) + 1
    volume = Volume(np.empty(counts, np.float32), np.asarray(low, float), cell)
    # No point of a block is farther from a corner than half of its diagonal.
    reach = np.sqrt(3) * coarse * cell
    lines = [line.astype(np.float32) for line in volume.axes()]  # as fields take them
    return replace(volume, values=near_samples(partial(sample, distance), lines, coarse, reach, on_progress))


@dataclass(frozen=True)
class FieldSurface:
    """The extracted surface, in normalised space."""

    volume: Volume  # the signed distance it comes from
    raw: Mesh  # all of the closed surface, with colours
    seen: np.ndarray  # [V] bool, vertices of it that photos show well enough
    kept: np.ndarray  # [F] bool, faces of it to keep
    shown: np.ndarray  # [F] bool, faces to keep that photos show
    left_out: list[float]  # longest sides of pieces left out, the largest first
    views: np.ndarray  # [V] int, photos that show each vertex of it

    @property
    def visible(self) -> Mesh:
        """The surface that photos show, an open mesh with colours."""
        return keep_faces(self.raw, self.shown)

    @property
    def solid(self) -> Mesh:
        """The closed surface of the faces to keep."""
        return keep_faces(self.raw, self.kept)


def ball(points: np.ndarray) -> np.ndarray:
    """Distance [P] from the ball in which the field was trained, at points [P, 3]."""
    return np.linalg.norm(points, axis=1) - RIM


def field_distance(field: GridField) -> Distance:
    """The field's signed distance as a function of points [P, 3] float in normalised space."""

    @torch.no_grad()
    def distance(points: np.ndarray) -> np.ndarray:
        there = torch.from_numpy(np.ascontiguousarray(points, np.float32)).to(field.device)
        return field.sdf(there).cpu().numpy()

    return distance


def trusted_vertices(mesh: Mesh, count: np.ndarray, at_limit: np.ndarray) -> np.ndarray:
    """Vertices [V] bool of a closed mesh that enough views see (`count` [V]) and where the solid was not cut off
    (`at_limit` [V] bool); small gaps are closed."""
    trusted = (count >= MIN_SEEN) & ~at_limit
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    degree = np.maximum(np.bincount(edges[:, 0], minlength=len(trusted)), 1)
    for _ in range(CLOSINGS):
        neighbours = np.bincount(edges[:, 0], trusted[edges[:, 1]], minlength=len(trusted))
        trusted |= (neighbours > CLOSING * degree) & ~at_limit
    return trusted


def surface_of(
    volume: Volume, field: GridField, poses: PosedPhotos, photos_folder: Path, limit: Distance, *,
    known: Callable[[np.ndarray], np.ndarray] | None = None, on_progress: Progress = silent,
) -> FieldSurface:  # fmt: skip
    """The solid of a sampled field within a `limit`, given by its distance [P], and its visible surface; the
    poses are in normalised space. Points [P, 3] that are `known` [P] count as seen in any case. Raises
    SdfsimError (exit code 3) if the field has no surface, or hardly any of it is in the photos."""
    raw, cell = volume.mesh(), volume.cell
    found = look(Visibility(raw, LIFT * cell), poses.views, photos_folder, on_progress)
    far = KDTree(poses.sparse.xyz).query(raw.vertices, distance_upper_bound=MAX_FROM_POINTS)[0] > MAX_FROM_POINTS
    seen = trusted_vertices(raw, found.count, np.abs(limit(raw.vertices)) < 1.5 * cell) & ~far
    completed = np.zeros(len(seen), bool) if known is None else known(raw.vertices)
    seen |= completed
    faces_seen = seen[raw.faces].sum(1) >= 2
    kept, left_out = belonging(raw, faces_seen, FLOATER / 4, SPECK)
    shown = islands(raw, faces_seen & kept, FLOATER)
    if shown.sum() < 100:
        message = "mesh: hardly any of the surface is visible in the photos"
        raise SdfsimError(message, "check the poses", exit_code=EXIT_QUALITY)
    rgb = np.where(found.weight[:, None] > 0, found.color, 255 * field_colors(field, raw))
    if (unseen := completed & (found.weight == 0)).any():
        rgb[unseen] = spread_colors(raw.vertices[unseen], raw.vertices[seen & ~unseen], rgb[seen & ~unseen])
    return FieldSurface(volume, replace(raw, colors=to_bytes(rgb)), seen, kept, shown, left_out, found.count)


def all_seen(surface: FieldSurface, limit: Distance) -> FieldSurface:
    """The same, and all of the solid within the limit [P] that photos see is shown, also far from points of
    structure-from-motion. On the bundled set its median error there is 1.5 times that of the surface next to it."""
    at_limit = np.abs(limit(surface.raw.vertices)) < 1.5 * surface.volume.cell
    seen = surface.seen | trusted_vertices(surface.raw, surface.views, at_limit)
    shown = islands(surface.raw, (seen[surface.raw.faces].sum(1) >= 2) & surface.kept, FLOATER)
    return replace(surface, seen=seen, shown=shown)


@torch.no_grad()
def field_colors(field: GridField, mesh: Mesh) -> np.ndarray:
    """The field's colour [V, 3] in 0..1 of each vertex, seen straight on."""
    device = field.device
    points = torch.tensor(mesh.vertices, dtype=torch.float32, device=device)
    against = -torch.tensor(vertex_normals(mesh), dtype=torch.float32, device=device)
    parts = []
    for p, d in zip(points.split(1 << 16), against.split(1 << 16), strict=True):
        _, geometry, features = field.geometry_at(p)
        parts.append(field.color_of(geometry, features, d))
    return torch.cat(parts).cpu().numpy()


def keep_faces(mesh: Mesh, keep: np.ndarray) -> Mesh:
    """The mesh of the faces `keep` [F] bool, without unused vertices."""
    faces = mesh.faces[keep]
    used, inverse = np.unique(faces, return_inverse=True)
    colors = None if mesh.colors is None else mesh.colors[used]
    return Mesh(mesh.vertices[used], inverse.reshape(-1, 3).astype(np.int64), colors)


def components(mesh: Mesh) -> np.ndarray:
    """Component number [F] of each face; faces that share a vertex are connected."""
    import igl

    return np.asarray(igl.vertex_components(np.ascontiguousarray(mesh.faces, dtype=np.int64)))[mesh.faces[:, 0]]


def belonging(mesh: Mesh, seen: np.ndarray, share: float, speck: float) -> tuple[np.ndarray, list[float]]:
    """The faces [F] bool of a closed mesh to keep, by connected components: those that photos show (`seen` [F] bool)
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
    # A cavity is a flaw of the piece around it, not a separate piece.
    left_out = size[(small | unseen) & ~inward & (size >= speck)]
    return ~(small | unseen)[label], sorted(left_out.tolist(), reverse=True)


def islands(mesh: Mesh, faces: np.ndarray, share: float) -> np.ndarray:
    """Those of some faces [F] bool that form patches: a patch needs this share of the area of all the faces, or of
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
