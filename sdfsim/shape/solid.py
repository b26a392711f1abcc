"""Any triangle mesh -> the solid it stands for, or one line saying why it stands for none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdfsim.errors import SdfsimError
from sdfsim.shape import watertight
from sdfsim.shape.bvh import ClosestPoint, Winding
from sdfsim.shape.mass import integrals
from sdfsim.shape.mesh import Frame, Mesh, clean, is_closed, normal_frame
from sdfsim.shape.watertight import centres_and_normals, exposed, no_longer_than

# Openings are closed unasked up to this fraction of the surface, smallest first.
SMALL = 0.02
# Sheets that stick out of a solid, or float beside it, are left out up to this fraction of the surface.
LOOSE = 0.25
# Mean of how far winding numbers at the surface are from those of a closed one. A sphere with an opening of the
# fraction a has a / 2; cracks of no width have nearly nothing, however long they are.
LEAK = 0.01
# Sides of a face are looked at from this far off; sizes are relative to the largest extent.
STEP = 1e-4
# Less of the surface than this is not worth cutting: the corners of small faces that cross each other.
TRIFLE = 1e-3
# A sheet thinner than this is below what a fit resolves (mean errors of 0.0015 near the surface are allowed).
THINNEST = 0.01
THICKEST = 2.0  # likewise, of what is thickened
HINT = "--cap (cap: on) closes openings of any size, --thicken METRES (thicken: METRES) gives a sheet a thickness"


@dataclass(frozen=True)
class Solid:
    """A body bounded by triangles.

    Attributes:
        surface: its boundary, wound outwards: for distances, samples and display. Edges need not match where faces
            were cut along the line in which they cross others.
        body: what winding numbers, or the distance of a thickened solid, are taken of: the whole mesh, repaired.
        notes: what was done to the mesh, a plain line each.
        thickness: m, of the sheet that `body` then is; 0 if it is none.
        closed: whether it has an inside without doubt; cracks and pinholes leave some.
        simple: whether `surface` is one clean boundary, for which ray parity is exact.
        layers: [F] int, how many faces of `surface` lie on each other where each is; None: one everywhere.
    """

    surface: Mesh
    body: Mesh
    notes: tuple[str, ...] = ()
    thickness: float = 0.0
    closed: bool = True
    simple: bool = False
    layers: np.ndarray | None = None

    def mass_properties(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Volume m^3, centre of mass [3] m, and inertia [3, 3] m^5 (per unit density) about it.

        Exact to rounding for a surface that was not cut, to about 0.1 % otherwise.

        Raises:
            SdfsimError: it encloses nothing.
        """
        return integrals(self.surface, 1.0 if self.layers is None else 1.0 / self.layers)


def as_it_is(mesh: Mesh) -> Solid:
    """`mesh` (metres, with faces) without any repair or refusal; a sheet has no inside then."""
    closed = is_closed(mesh)
    return Solid(mesh, mesh, closed=closed, simple=closed and repair.components(mesh.faces).max() == 0)


def solidify(mesh: Mesh, *, name: str = "mesh", cap: bool = False, thicken: float | None = None) -> Solid:
    """The solid that `mesh` bounds.

    Inside is what the surface goes around, once or more (winding number above one half): overlapping parts are one
    body, shells inside it do not count unless they are wound the other way (cavities). Windings are made consistent,
    small openings closed, loose sheets and everything within the solid left out.

    Args:
        mesh: metres, of any kind.
        name: how messages call it.
        cap: close openings of any size.
        thicken: m; the solid is all within half of this distance from the mesh instead.

    Raises:
        SdfsimError: the mesh encloses no volume, is open beyond small holes, or `thicken` is too small or too large.
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
    faces, patch = repair.consistent(vertices, before)
    faces = _outwards(vertices, faces, patch)
    turned = int(_differ(before, faces).sum())
    if turned:
        notes.append(f"{turned} of {len(before)} faces turned round, to be wound alike and outwards")

    area = repair.face_areas(vertices[faces]).sum()
    vertices, faces = _close(vertices, faces, SMALL * area, area, frame.scale, notes)
    if repair.leaking(faces).any():
        faces = _without_sheets(vertices, faces, area, notes)
        vertices, faces = _close(vertices, faces, np.inf if cap else SMALL * area, area, frame.scale, notes)
        faces = _outwards(vertices, *repair.consistent(vertices, faces))
    closed = not repair.leaking(faces).any()
    winding = Winding(_plain(vertices, faces))
    if not closed:
        _require_tight(vertices, faces, winding, area, frame.scale, name)

    def side(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        within, without = winding(points - STEP * normals), winding(points + STEP * normals)
        layers = np.maximum(np.round(np.abs(within - without)), 1).astype(np.int64)
        return layers * ((within > 0.5).astype(np.int64) - (without > 0.5))

    body = _mesh(vertices, faces, frame, mesh.colors)
    corners = vertices[faces]
    # First a look at every 0.05 of the surface; only what crosses itself is cut, and that finely.
    probes = no_longer_than(corners, 0.05)
    boundary = side(*centres_and_normals(probes))
    weights = repair.face_areas(probes)
    odd = float(weights[boundary != 1].sum() / weights.sum())
    surface, layers = body, None
    if odd > TRIFLE:
        kept, layers = exposed(corners, side)
        if len(kept):
            surface = _mesh(*_joined(kept), frame, mesh.colors)
        left = 1.0 - float((repair.face_areas(kept) / layers).sum() / repair.face_areas(corners).sum())
        if left > 5e-4:
            notes.append(f"faces that do not bound the solid left out ({left:.1%} of the area)")
    solid = Solid(surface, body, tuple(notes), closed=closed, simple=closed and odd == 0.0, layers=layers)
    try:
        if layers is None or len(layers):
            solid.mass_properties()
            return solid
    except SdfsimError:
        pass
    count = "1 face encloses" if len(before) == 1 else f"{len(before)} faces enclose"
    raise SdfsimError(f"{name}: {count} no volume (a flat sheet?)", HINT)


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
    """Turn bodies that are inside out, except shells in others that are so by the winding of the whole: cavities."""
    label = repair.bodies(faces, patch)
    middle = np.stack([np.bincount(label, weights=vertices[faces, k].mean(1)) for k in range(3)], axis=1)
    middle /= np.bincount(label)[:, None]
    corners = vertices[faces][..., :3] - middle[label][:, None]
    volume = np.bincount(label, weights=np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))
    if volume.sum() < 0:
        faces, volume = faces[:, ::-1], -volume
    inverted = (volume < 0)[label]
    if inverted.any() and not inverted.all():
        # At most some points of each: a body that reaches out of all others is no cavity.
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
    """Close openings up to `limit` in all (normalised area) and say so."""
    vertices, faces, closed = repair.fill(vertices, faces, limit)
    if len(closed):
        largest = (
            f", the largest about {2 * np.sqrt(closed.max() / np.pi) * scale:.3g} m across" if limit > area else ""
        )
        kind = "opening" if limit > area else "small hole"
        plural = "" if len(closed) == 1 else "s"
        notes.append(f"{len(closed)} {kind}{plural} closed ({closed.sum() / area:.1%} of the surface{largest})")
    return vertices, faces


def _without_sheets(vertices: np.ndarray, faces: np.ndarray, area: float, notes: list[str]) -> np.ndarray:
    """Leave out patches that are open and have the same on both sides: fins, partitions, sheets that float beside."""
    faces, patch = repair.consistent(vertices, faces)
    suspects = np.unique(patch[repair.leaking(faces)])
    among = np.flatnonzero(np.isin(patch, suspects))
    centres, normals = centres_and_normals(vertices[faces[among]])
    winding = Winding(_plain(vertices, faces))
    # The mean of both sides is what all other faces make of the place; at a boundary it is a half.
    middle = 0.5 * (winding(centres + STEP * normals) + winding(centres - STEP * normals))
    areas = repair.face_areas(vertices[faces])
    loose = np.bincount(patch[among], weights=areas[among] * (np.abs(middle - 0.5) > 0.25))
    sheets = np.flatnonzero(loose > 0.5 * np.bincount(patch, weights=areas)[: len(loose)])
    out = np.isin(patch, sheets)
    fraction = areas[out].sum() / area
    if len(sheets) == 0 or fraction > LOOSE:
        return faces
    plural = "" if len(sheets) == 1 else "s"
    notes.append(f"{len(sheets)} loose sheet{plural} left out ({fraction:.1%} of the surface)")
    return faces[~out]


def _require_tight(
    vertices: np.ndarray, faces: np.ndarray, winding: Winding, area: float, scale: float, name: str
) -> None:
    """Refuse a surface whose openings let the outside be seen from within."""
    centres, normals = centres_and_normals(no_longer_than(vertices[faces], 0.05))
    weights = repair.face_areas(no_longer_than(vertices[faces], 0.05))
    if len(centres) > 4000:
        some = np.random.default_rng(0).choice(len(centres), 4000, p=weights / weights.sum())
        centres, normals, weights = centres[some], normals[some], np.ones(4000)
    middle = 0.5 * (winding(centres + STEP * normals) + winding(centres - STEP * normals)) - 0.5
    if np.average(np.abs(middle - np.round(middle)), weights=weights) <= LEAK:
        return
    loops = [vertices[loop, :3] for loop in repair.openings(faces)]
    across = max(float(np.ptp(loop, axis=0).max()) for loop in loops) * scale
    count = "an opening" if len(loops) == 1 else f"{len(loops)} openings, the largest"
    raise SdfsimError(f"{name}: not a solid: the surface has {count} {across:.3g} m across", HINT)


def _thickened(mesh: Mesh, frame: Frame, name: str, thickness: float) -> Solid:
    """All within half the thickness: its surface by marching cubes, on cells that are computed only near it."""
    from skimage.measure import marching_cubes

    size = frame.scale + thickness
    if not thickness <= THICKEST * frame.scale:
        raise SdfsimError(
            f"{name}: a thickness of {thickness:g} m is too large for a mesh of {frame.scale:.3g} m",
            f"use at most {THICKEST * frame.scale:.2g} m",
        )
    if not thickness >= THINNEST * size:
        raise SdfsimError(
            f"{name}: a thickness of {thickness:g} m is too small for a mesh of {frame.scale:.3g} m",
            f"use at least {THINNEST * frame.scale / (1 - THINNEST):.2g} m",
        )
    cell = min(size / 100, thickness / 2.5)
    low = mesh.vertices.min(0) - 0.5 * thickness - 2 * cell
    block = 8
    counts = np.ceil((np.ptp(mesh.vertices, axis=0) + thickness + 4 * cell) / (block * cell)).astype(int)
    nearest = ClosestPoint(mesh)

    def distance(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - nearest(points)[0], axis=1) - 0.5 * thickness

    def nodes(starts: np.ndarray, axis: np.ndarray) -> np.ndarray:
        grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(1, -1, 3)
        return (low + cell * (starts[:, None] * block + grid)).reshape(-1, 3)

    blocks = np.stack(np.meshgrid(*(np.arange(count) for count in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    # Distances change by no more than the way gone: a block that is far from the surface has its middle's sign.
    middle = distance(nodes(blocks, np.array([0.5 * (block - 1)])))
    values = np.repeat(middle[:, None], block**3, axis=1).astype(np.float32)
    near = np.abs(middle) < np.sqrt(3.0) * (0.5 * (block - 1) + 1.0) * cell
    values[near] = distance(nodes(blocks[near], np.arange(block))).reshape(-1, block**3)
    values = values.reshape(*counts, block, block, block).transpose(0, 3, 1, 4, 2, 5).reshape(counts * block)
    # A node on the very surface would make triangles without area.
    values[np.abs(values) < 0.01 * cell] = 0.01 * cell
    vertices, faces, *_ = marching_cubes(values, 0.0, spacing=(cell,) * 3, gradient_direction="descent")
    vertices = vertices.astype(np.float64) + low
    # Straight lines through the cells are off by a fraction of a cell; the true distance puts them right.
    foot, _ = nearest(vertices)
    away = vertices - foot
    vertices = foot + away * (0.5 * thickness / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300))
    solid = Solid(Mesh(vertices, faces.astype(np.int64)), mesh, (f"thickened to {thickness:g} m",), thickness)
    solid.mass_properties()
    return solid
