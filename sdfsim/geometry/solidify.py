"""From any triangle mesh to the solid that it bounds, or an error that says why it bounds none.

Vertices [V, 3 + K] and corners of triangles [F, 3, 3 + K] hold coordinates, and K columns (colours) that new vertices
get by the same averages.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.bvh import Around, ClosestPoint, Winding
from sdfsim.geometry.mass import integrals
from sdfsim.geometry.mesh import (
    Frame,
    Mesh,
    area_vectors,
    clean,
    components,
    directed_edges,
    is_closed,
    lattice,
    normal_frame,
)

# Openings are always closed, smallest first, up to this fraction of the surface in all.
SMALL = 0.02
# Largest mean deviation of winding numbers at the surface from those of a closed one. A sphere with an opening of the
# fraction a has a / 2; cracks without width have almost none, however long they are.
LEAK = 0.01
# Both sides of a face are tested at this distance from it; sizes are relative to the largest extent.
STEP = 1e-4
# A smaller part of the surface is not worth cutting: the corners of small faces that cross each other.
TRIFLE = 1e-3
# Longer faces may hide something between the points at which they are tested. For shorter ones the centroid is enough:
# that is wrong along seams only, by a fraction of their size.
COARSE, FINE = 0.1, 0.008
# A fit cannot resolve a thinner sheet (mean errors of 0.0015 near the surface are allowed).
THINNEST = 0.01
THICKEST = 2.0  # likewise: the largest thickness
THICKEN = "--thicken METRES (thicken: METRES) gives a sheet a thickness"
HINT = f"--cap (cap: on) closes openings of any size, {THICKEN}"
SHEET = 1e-3  # a surface thinner than this part of its size is a flat sheet, and a cap does not make a solid of it
# Points [P, 3] of faces and the unit normals there -> [P] int: 0 if the face is not boundary there, else the number of
# layers in the same place, negative if they are wound inwards.
Side = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Solid:
    """A body bounded by triangles."""

    # its boundary, wound outwards: for distances, samples and display. Where faces were cut along the line in which
    # they cross others, edges need not match.
    surface: Mesh
    body: Mesh  # the whole mesh, repaired: for winding numbers, and for the distance of a thickened solid
    notes: tuple[str, ...] = ()  # what was done to the mesh, one line each
    thickness: float = 0.0  # m, if `body` is a sheet; 0 for a solid
    closed: bool = True  # whether inside and outside are certain; with cracks and pinholes they are not
    simple: bool = False  # whether `surface` is one clean boundary, for which ray parity is exact
    # [F] int, how many faces of `surface` lie on each other there; None: one everywhere
    layers: np.ndarray | None = None

    def mass_properties(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Volume m^3, centre of mass [3] m, and inertia [3, 3] m^5 (per unit density) about it: exact to rounding if
        the surface was not cut, else to about 0.1 %. Raises SdfsimError if it encloses nothing."""
        return integrals(self.surface, 1.0 if self.layers is None else 1.0 / self.layers)


def solidify(mesh: Mesh, *, name: str = "mesh", cap: bool = False, thicken: float | None = None) -> Solid:
    """The solid that `mesh`, in metres, bounds; with `thicken`, all points within half of `thicken` m from it.

    A point is inside if the surface goes around it once or more (winding number above one half). Overlapping parts are
    one body, and shells inside it do not count unless they are wound the other way (cavities). Windings are made
    consistent, small openings are closed, and all faces within the solid are left out. Raises SdfsimError if the mesh
    encloses no volume or is open beyond small holes, or `thicken` is too small or too large.
    """
    mesh = clean(mesh, name=name)
    frame = normal_frame(np.stack([mesh.vertices.min(0), mesh.vertices.max(0)]))
    if thicken is not None:
        return _thickened(mesh, frame, name, thicken)
    notes: list[str] = []
    vertices = frame.inward(mesh.vertices)
    if mesh.colors is not None:
        vertices = np.concatenate([vertices, mesh.colors], axis=1)
    before = mesh.faces
    faces, patch = consistent(vertices, before)
    faces = _outwards(vertices, faces, patch)
    turned = int(_differ(before, faces).sum())
    if turned:
        notes.append(f"{turned} of {len(before)} faces turned over, so that all are wound outwards")

    area = face_areas(vertices[faces]).sum()
    vertices, faces = _close(vertices, faces, SMALL * area, area, frame.scale, notes)
    if cap and not is_closed(_plain(vertices, faces)):
        vertices, faces = _close(vertices, faces, np.inf, area, frame.scale, notes)
        faces = _outwards(vertices, *consistent(vertices, faces))
    closed = is_closed(_plain(vertices, faces))
    if not closed:
        _require_tight(vertices, faces, frame.scale, name)

    around = Around(_plain(vertices, faces))

    def side(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        within, without = around(points - STEP * normals), around(points + STEP * normals)
        layers = np.maximum(np.round(np.abs(within - without)), 1).astype(np.int64)
        return layers * ((within > 0.5).astype(np.int64) - (without > 0.5))

    body = _mesh(vertices, faces, frame, mesh.colors)
    corners = vertices[faces]
    # First a test in steps of 0.05; only surfaces that cross themselves are cut finely.
    probes = no_longer_than(corners, 0.05)
    boundary = side(*centres_and_normals(probes))
    weights = face_areas(probes)
    odd = float(weights[boundary != 1].sum() / weights.sum())
    surface, layers = body, None
    if odd > TRIFLE:
        kept, layers = exposed(corners, side)
        if len(kept):
            surface = _mesh(*_joined(kept), frame, mesh.colors)
        left = 1.0 - float((face_areas(kept) / layers).sum() / face_areas(corners).sum())
        if left > 5e-4:
            notes.append(f"left out faces that do not bound the solid ({left:.1%} of the area)")
    solid = Solid(surface, body, tuple(notes), closed=closed, simple=closed and odd == 0.0, layers=layers)
    try:
        if layers is None or len(layers):
            solid.mass_properties()
            return solid
    except SdfsimError:
        pass
    count = "1 face encloses" if len(before) == 1 else f"{len(before)} faces enclose"
    raise SdfsimError(f"{name}: {count} no volume (a flat sheet?)", THICKEN)


def _plain(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    return Mesh(vertices[:, :3], faces)


def _mesh(vertices: np.ndarray, faces: np.ndarray, frame: Frame, colors: np.ndarray | None) -> Mesh:
    """Back to metres, and colours to bytes."""
    shades = None if colors is None else np.round(vertices[:, 3:]).astype(np.uint8)
    return Mesh(frame.outward(vertices[:, :3]), faces, shades)


def _joined(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of separate normalised triangles [F, 3, 3 + K]."""
    separate = corners.reshape(-1, corners.shape[-1])
    _, first, label = np.unique(np.round(separate, 9), axis=0, return_index=True, return_inverse=True)
    return separate[first], label.reshape(-1, 3)


def _differ(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """[F] bool: faces whose corners now go the other way round."""
    return ~np.any([(before == np.roll(after, k, axis=1)).all(1) for k in range(3)], axis=0)


def _outwards(vertices: np.ndarray, faces: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """Turn bodies that are inside out, except shells inside others whose winding makes them cavities."""
    label = bodies(faces, patch)
    middle = np.stack([np.bincount(label, weights=vertices[faces, k].mean(1)) for k in range(3)], axis=1)
    middle /= np.bincount(label)[:, None]
    corners = vertices[faces][..., :3] - middle[label][:, None]
    volume = np.bincount(label, weights=np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))
    if volume.sum() < 0:
        faces, volume = faces[:, ::-1], -volume
    inverted = (volume < 0)[label]
    if inverted.any() and not inverted.all():
        # At most 16 points of each body are tested: one that reaches out of all others is not a cavity.
        chosen = np.flatnonzero(inverted)
        chosen = chosen[np.argsort(label[chosen], kind="stable")]
        chosen = chosen[np.arange(len(chosen)) - np.searchsorted(label[chosen], label[chosen]) < 16]
        around = Winding(_plain(vertices, faces[~inverted]))(vertices[faces[chosen]][..., :3].mean(1)) > 0.5
        cavity = np.ones(len(volume), dtype=bool)
        np.logical_and.at(cavity, label[chosen], around)
        inverted &= ~cavity[label]
    return np.where(inverted[:, None], faces[:, ::-1], faces)


def _close(
    vertices: np.ndarray, faces: np.ndarray, limit: float, area: float, scale: float, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Close openings by fans around their middle, smallest first, up to `limit` in all (normalised area), and add a
    note. A fan is right for any flat loop, though it may overlap itself: what it covers twice cancels in winding
    numbers."""
    fans = []
    for loop in openings(faces):
        ring = vertices[loop]
        after = np.roll(ring, -1, axis=0)
        length = np.linalg.norm((after - ring)[:, :3], axis=1, keepdims=True)
        middle = (0.5 * (ring + after) * length).sum(0) / max(length.sum(), 1e-300)
        size = face_areas(np.stack([after, ring, np.broadcast_to(middle, ring.shape)], axis=1)).sum()
        fans.append((size, loop, middle))
    fans.sort(key=lambda fan: fan[0])
    areas = np.array([fan[0] for fan in fans])
    areas = areas[np.cumsum(areas) <= limit]
    if not len(areas):
        return vertices, faces
    points, added = [vertices], [faces]
    count = len(vertices)
    for _, loop, middle in fans[: len(areas)]:
        if len(loop) == 3:
            added.append(loop[None, ::-1])
            continue
        points.append(middle[None])
        added.append(np.stack([np.roll(loop, -1), loop, np.full(len(loop), count)], axis=1))
        count += 1
    capped = np.isinf(limit)
    largest = f", the largest about {2 * np.sqrt(areas.max() / np.pi) * scale:.3g} m across" if capped else ""
    kind = ("opening" if capped else "small hole") + ("" if len(areas) == 1 else "s")
    notes.append(f"{len(areas)} {kind} closed ({areas.sum() / area:.1%} of the surface{largest})")
    return np.concatenate(points), np.concatenate(added)


def _require_tight(vertices: np.ndarray, faces: np.ndarray, scale: float, name: str) -> None:
    """Raise SdfsimError if the surface has openings that are too large to count as closed."""
    winding = Winding(_plain(vertices, faces))
    probes = no_longer_than(vertices[faces], 0.05)
    centres, normals = centres_and_normals(probes)
    weights = face_areas(probes)
    if len(centres) > 4000:
        some = np.random.default_rng(0).choice(len(centres), 4000, p=weights / weights.sum())
        centres, normals, weights = centres[some], normals[some], np.ones(4000)
    middle = 0.5 * (winding(centres + STEP * normals) + winding(centres - STEP * normals)) - 0.5
    if np.average(np.abs(middle - np.round(middle)), weights=weights) <= LEAK:
        return
    loops = [vertices[loop, :3] for loop in openings(faces)]
    across = max(float(np.ptp(loop, axis=0).max()) for loop in loops) * scale
    count = "an opening" if len(loops) == 1 else f"{len(loops)} openings, the largest"
    points = vertices[np.unique(faces), :3]
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
    flat = spread[-1] < SHEET * spread[0]
    raise SdfsimError(f"{name}: not a solid: the surface has {count} {across:.3g} m across", THICKEN if flat else HINT)


def _thickened(mesh: Mesh, frame: Frame, name: str, thickness: float) -> Solid:
    """All points within half the thickness of a mesh: the surface by marching cubes, on cells near it only."""
    from skimage.measure import marching_cubes

    size = frame.scale + thickness
    least, most = THINNEST * frame.scale / (1 - THINNEST), THICKEST * frame.scale
    if not least <= thickness <= most:
        raise SdfsimError(
            f"{name}: a thickness of {thickness:g} m is too small or too large for a mesh of {frame.scale:.3g} m",
            f"use {least:.2g} to {most:.2g} m",
        )
    cell = min(size / 100, thickness / 2.5)
    low = mesh.vertices.min(0) - 0.5 * thickness - 2 * cell
    block = 8
    counts = np.ceil((np.ptp(mesh.vertices, axis=0) + thickness + 4 * cell) / (block * cell)).astype(int)
    nearest = ClosestPoint(mesh)

    def distance(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - nearest(points)[0], axis=1) - 0.5 * thickness

    def nodes(starts: np.ndarray, axis: np.ndarray) -> np.ndarray:
        return (low + cell * (starts[:, None] * block + lattice(axis, axis, axis))).reshape(-1, 3)

    blocks = lattice(*(np.arange(count) for count in counts))
    # A distance changes by at most the step taken: a block far from the surface has the sign of its middle everywhere.
    middle = distance(nodes(blocks, np.array([0.5 * (block - 1)])))
    values = np.repeat(middle[:, None], block**3, axis=1).astype(np.float32)
    near = np.abs(middle) < np.sqrt(3.0) * (0.5 * (block - 1) + 1.0) * cell
    values[near] = distance(nodes(blocks[near], np.arange(block))).reshape(-1, block**3)
    values = values.reshape(*counts, block, block, block).transpose(0, 3, 1, 4, 2, 5).reshape(counts * block)
    # A node exactly on the surface would make triangles without area.
    values[np.abs(values) < 0.01 * cell] = 0.01 * cell
    vertices, faces, *_ = marching_cubes(values, 0.0, spacing=(cell,) * 3, gradient_direction="descent")
    vertices = vertices.astype(np.float64) + low
    # Linear interpolation in the cells is off by a fraction of a cell; the true distance corrects it.
    foot, _ = nearest(vertices)
    away = vertices - foot
    vertices = foot + away * (0.5 * thickness / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300))
    solid = Solid(Mesh(vertices, faces.astype(np.int64)), mesh, (f"thickened to {thickness:g} m",), thickness)
    solid.mass_properties()
    return solid


def consistent(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wind all faces of a patch (faces joined by edges of two faces) alike, as most of its area was wound. Returns the
    faces [F, 3] and the patch [F] of each."""
    import igl

    oriented: tuple[Any, Any] = igl.bfs_orient(np.ascontiguousarray(faces, dtype=np.int64))
    turned, patch = oriented
    same = ~_differ(faces, turned)
    area = face_areas(vertices[faces])
    minority = np.bincount(patch, weights=area * same) < 0.5 * np.bincount(patch, weights=area)
    wrong = same == minority[patch]
    return np.where(wrong[:, None], faces[:, ::-1], faces), patch


def bodies(faces: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """[F] labels of parts that can be turned on their own: closed patches, and components of all other faces."""
    edge, sign = directed_edges(faces)
    owner = np.tile(patch, 3)
    _, pair = np.unique(edge * (int(patch.max()) + 1) + owner, return_inverse=True)
    leaks = np.bincount(owner, weights=np.bincount(pair, weights=sign)[pair] != 0) > 0
    label, rest = patch.copy(), leaks[patch]
    if rest.any():
        label[rest] = patch.max() + 1 + components(faces[rest])
    _, label = np.unique(label, return_inverse=True)
    return label


def openings(faces: np.ndarray) -> list[np.ndarray]:
    """Loops of vertices [N] where the surface ends, in the direction of its faces' edges."""
    import igl

    ends: Any = igl.exterior_edges(np.ascontiguousarray(faces, dtype=np.int64))
    leaving: dict[int, list[int]] = {}
    for start, end in ends.tolist():
        leaving.setdefault(start, []).append(end)
    loops = []
    # As many edges end at a vertex as begin there, so a walk can only end where it began.
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


def face_areas(corners: np.ndarray) -> np.ndarray:
    """[F] areas of triangles [F, 3, 3 + K]."""
    return 0.5 * np.linalg.norm(area_vectors(corners), axis=1)


def exposed(corners: np.ndarray, side: Side) -> tuple[np.ndarray, np.ndarray]:
    """The parts of triangles [F, 3, 3 + K] that are boundary, [F', 3, 3 + K] wound outwards, and their layers [F'].
    Faces longer than `COARSE` are cut before they are tested; those shorter than `FINE` are tested at their centroid
    only."""
    weights = np.array([[30, 1, 1], [1, 30, 1], [1, 1, 30], [15, 15, 1], [15, 1, 15], [1, 15, 15]], dtype=np.float64)
    weights /= weights.sum(1, keepdims=True)
    kept, layers = [corners[:0]], [np.zeros(0, dtype=np.int64)]
    corners = no_longer_than(corners, COARSE)
    while len(corners):
        centres, normals = centres_and_normals(corners)
        verdict = side(centres, normals)
        decided = np.ones(len(corners), dtype=bool)
        large = np.flatnonzero(_sides(corners).max(1) > FINE)
        tests = np.einsum("kc,fci->fki", weights, corners[large, :, :3])
        others = side(tests.reshape(-1, 3), np.repeat(normals[large], len(weights), axis=0))
        decided[large] = (others.reshape(-1, len(weights)) == verdict[large, None]).all(1)
        outward, inward = decided & (verdict > 0), decided & (verdict < 0)
        kept += [corners[outward], corners[inward][:, ::-1]]
        layers += [verdict[outward], -verdict[inward]]
        corners = _halved(corners[~decided])
    return np.concatenate(kept), np.concatenate(layers)


def centres_and_normals(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroids and unit normals [F, 3] of triangles [F, 3, 3 + K]."""
    normals = area_vectors(corners)
    return corners[..., :3].mean(1), normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def no_longer_than(corners: np.ndarray, length: float) -> np.ndarray:
    """The triangles, halved until no edge is longer than `length`."""
    done = []
    while len(corners):
        short = _sides(corners).max(1) <= length
        done.append(corners[short])
        corners = _cut(corners[~short], length)
    return np.concatenate(done)


def _cut(corners: np.ndarray, length: float) -> np.ndarray:
    """Smaller triangles. Needles are cut across into strips, as many as repeated halving would make of their long
    edges, but with fewer triangles (two a strip instead of three). Both ways cut edges at the same places."""
    sides = _sides(corners)
    # How often each edge must be halved. A needle has one short edge; the two others are halved equally often, at least
    # twice.
    times = np.ceil(np.log2(np.maximum(sides / length, 1.0))).astype(np.int64)
    foot = times.argmin(1)
    turn = (foot[:, None] + np.arange(3)) % 3
    low, right, left = np.take_along_axis(times, turn, axis=1).T
    needle = (low == 0) & (right == left) & (right > 1)
    pieces = [_halved(corners[~needle])]
    b, c, apex = np.moveaxis(np.take_along_axis(corners, turn[..., None], axis=1), 1, 0)
    for count in np.unique(right[needle]):
        some = needle & (right == count)
        part = np.arange(2**count + 1)[:, None, None] / 2**count
        on_b, on_c = (apex[some] + part * (end[some] - apex[some]) for end in (b, c))
        pieces.append(np.stack([on_b[1:], on_c[1:], on_b[:-1]], axis=2).reshape(-1, 3, corners.shape[-1]))
        pieces.append(np.stack([on_c[1:], on_c[:-1], on_b[:-1]], axis=2)[1:].reshape(-1, 3, corners.shape[-1]))
    return np.concatenate(pieces)


def _halved(corners: np.ndarray) -> np.ndarray:
    """Cut triangles [F, 3, 3 + K] across their longest edge, so that slivers do not become many: [2 F, 3, 3 + K]."""
    turn = (_sides(corners).argmax(1)[:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(corners, turn[..., None], axis=1), 1, 0)
    middle = (a + b) / 2
    return np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])


def _sides(corners: np.ndarray) -> np.ndarray:
    """[F, 3] lengths of the edges of triangles [F, 3, 3 + K]."""
    return np.linalg.norm(np.roll(corners, -1, axis=1)[..., :3] - corners[..., :3], axis=2)
