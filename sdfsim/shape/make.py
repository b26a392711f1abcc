"""Makes shapes: from closed forms, from meshes (with a cached fit or without one), and from convex pieces."""

from __future__ import annotations

import logging
import os
import secrets
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import user_cache
from sdfsim.base.parallel import Progress, silent
from sdfsim.geometry import primitives
from sdfsim.geometry.mass import mass_properties, mass_properties_of_sdf
from sdfsim.geometry.mesh import Mesh, clean, convex_hull, is_closed, joined, lattice, signed_volume
from sdfsim.geometry.mesh_io import GLTF, Loaded, load_textured
from sdfsim.geometry.solidify import solidify
from sdfsim.sdf.closed_forms import BoxSdf, CapsuleSdf, ConeSdf, CylinderSdf, PlaneSdf, SphereSdf, TorusSdf
from sdfsim.sdf.fit import FIT_VERSION, Recipe
from sdfsim.sdf.fit.certificate import certify_grid
from sdfsim.sdf.grid import sample_grid
from sdfsim.sdf.reference import MeshDistance, PiecesDistance
from sdfsim.sdf.sdf import Sdf
from sdfsim.shape.shape import (
    DEFAULT_RESOLUTION,
    FINEST_GRID,
    FORMAT_VERSION,
    SdfKind,
    Shape,
    load_shape,
    scaled,
    sdf_of_mesh,
)
from sdfsim.shape.surface_nodes import DEFAULT_COUNT, edge_nodes, hull_nodes, sample_nodes, surface_nodes, thin

if TYPE_CHECKING:
    import torch

# m, sizes of meshes that need no remark. If the units are not given the upper limit is lower, as few moving things are
# larger.
USUAL, LARGE = (1e-3, 100.0), 5.0
FAR_OFF = 10.0  # sizes of a mesh: a note tells of an origin that is farther away
# For convex pieces: largest share of nodes that are vertices, and largest share that are vertices or points on edges.
OWN_SHARE, EDGE_SHARE = 0.6, 0.85
# Distance of points on the edges of convex pieces, relative to the size of the whole shape.
EDGE_SPACING = 0.06

_log = logging.getLogger(__name__)


def analytic_shape(
    kind: Literal["plane", "sphere", "capsule", "cylinder", "box", "cone", "torus"],
    *,
    radius: float = 0.0,
    height: float = 0.0,
    tube: float = 0.0,
    size: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    name: str | None = None,
) -> Shape:
    """A shape with an exact SDF, about the origin: "plane" (z = 0, +z outside, infinite), "sphere", "capsule",
    "cylinder", "box", "cone" (its tip up, the middle of its height at the origin) or "torus" (around z).

    Radius (of a torus that of the circle in the middle of its tube) and height (along z, for a capsule with its caps)
    are in m, and so are `tube`, the radius of a torus' tube, and the box's size, its full extents along x, y, z. Mass
    properties are exact (0 for the plane). The plane is shown as a 20 m square and has no nodes. Raises SdfsimError if
    a size is missing or not positive.
    """
    volume, com, inertia, nodes = 0.0, np.zeros(3), np.zeros((3, 3)), np.zeros((0, 3))
    if kind == "plane":
        sdf, mesh = PlaneSdf(), primitives.plane(10.0)
    elif kind == "sphere":
        sdf = SphereSdf(float(radius))
        volume = 4.0 / 3.0 * np.pi * sdf.radius**3
        inertia = 0.4 * volume * sdf.radius**2 * np.eye(3)
        mesh, nodes = primitives.sphere(sdf.radius), sdf.radius * primitives.spiral(128)
    elif kind == "box":
        x, y, z = (0.5 * float(value) for value in size)
        sdf = BoxSdf((x, y, z))
        volume = 8.0 * x * y * z
        inertia = volume / 3.0 * np.diag([y * y + z * z, z * z + x * x, x * x + y * y])
        mesh, nodes = primitives.box((2 * x, 2 * y, 2 * z)), _box_nodes(np.array([x, y, z]))
    elif kind == "cone":
        sdf = ConeSdf(float(radius), 0.5 * float(height))
        volume, com = np.pi * radius**2 * height / 3.0, np.array([0.0, 0.0, -0.25 * height])
        across = 0.15 * radius**2 + 0.0375 * height**2
        inertia = volume * np.diag([across, across, 0.3 * radius**2])
        mesh = primitives.cone(radius, height)
        outline = np.array([[0.0, -0.5], [0.5, -0.5], [1.0, -0.5], [0.75, -0.25], [0.5, 0.0], [0.25, 0.25], [0.0, 0.5]])
        nodes = primitives.revolve(outline * (radius, height), 16).vertices
    elif kind == "torus":
        sdf = TorusSdf(float(radius), float(tube))
        volume = 2.0 * np.pi**2 * radius * tube**2
        across = 0.5 * radius**2 + 0.625 * tube**2
        inertia = volume * np.diag([across, across, radius**2 + 0.75 * tube**2])
        mesh, nodes = primitives.torus(radius, tube), primitives.torus(radius, tube, 32, 8).vertices
    else:
        caps = kind == "capsule"
        half = 0.5 * (float(height) - 2.0 * radius * caps)
        sdf = (CapsuleSdf if caps else CylinderSdf)(float(radius), half)
        volume, inertia = _round_mass(sdf.radius, half, caps=caps)
        nodes = _round_nodes(sdf.radius, half, caps=caps)
        mesh = convex_hull(_round_nodes(sdf.radius, half, caps=caps, around=48))
    return Shape(name or kind, mesh, sdf, nodes, float(volume), com, inertia, source={"kind": kind})


def _round_mass(radius: float, half: float, *, caps: bool) -> tuple[float, np.ndarray]:
    """Volume m^3 and inertia [3, 3] m^5 (per unit density) of a cylinder about z; with `caps`, half balls at its
    ends."""
    trunk = 2.0 * np.pi * radius**2 * half
    across, about = trunk * (radius**2 / 4.0 + half**2 / 3.0), trunk * radius**2 / 2.0
    if caps:
        balls = 4.0 / 3.0 * np.pi * radius**3
        # Half balls with flat sides at +-half; their centres of mass are 3/8 of the radius beyond.
        across += balls * (0.4 * radius**2 + half**2 + 0.75 * half * radius)
        about += 0.4 * balls * radius**2
        trunk += balls
    return trunk, np.diag([across, across, about])


def _round_nodes(radius: float, half: float, *, caps: bool, around: int = 16) -> np.ndarray:
    """Rings about z on the surface of a capsule or cylinder: [K, 3] m, the rings of the ends first."""
    turns = 2.0 * np.pi * np.arange(around) / around
    circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    rings = [(radius, half * z) for z in (-1.0, 1.0)]
    if caps:
        tilts = np.arange(1, 4) * np.pi / 8.0
        rings += [(radius * np.cos(t), z * (half + radius * np.sin(t))) for t in tilts for z in (-1.0, 1.0)]
    else:
        rings += [(0.5 * radius, half * z) for z in (-1.0, 1.0)]
    rings += [(radius, half * z) for z in (-0.5, 0.0, 0.5)]
    tips = np.array([[0.0, 0.0, z * (half + (radius if caps else 0.0))] for z in (-1.0, 1.0)])
    placed = [np.column_stack([r * circle, np.full(around, z)]) for r, z in rings]
    return np.concatenate([*placed, tips])


def _box_nodes(half: np.ndarray) -> np.ndarray:
    """Corners, edges and faces of a 5 x 5 x 5 lattice on the box: [98, 3] m, the corners first."""
    axis = np.linspace(-1.0, 1.0, 5)
    places = lattice(axis, axis, axis)
    sides = (np.abs(places) == 1.0).sum(1)
    order = np.argsort(-sides, kind="stable")
    return (places * half)[order[sides[order] > 0]]


def shape_from_primitive(
    kind: str, size: float = 1.0, cache_dir: str | Path | None = None, *, name: str | None = None,
    sdf: SdfKind = "mlp", resolution: int = DEFAULT_RESOLUTION, on_progress: Progress = silent,
) -> Shape:  # fmt: skip
    """The shape of a procedural mesh of `primitives.PRIMITIVES`, with the largest extent `size` m. It is made on first
    use and cached; other arguments are as in `shape_from_mesh`. Raises SdfsimError for an unknown primitive."""
    if kind not in primitives.PRIMITIVES:
        raise SdfsimError(f"no primitive called {kind!r}", "primitives are " + ", ".join(primitives.PRIMITIVES))
    mesh = primitives.PRIMITIVES[kind]()
    unit = Mesh(mesh.vertices / float(np.ptp(mesh.vertices, axis=0).max()), mesh.faces)
    # Rounded, since sines and cosines differ in their last digit from machine to machine.
    key = Mesh(unit.vertices.round(9), unit.faces).digest()
    shape = _cached(unit, key, name or kind, sdf, resolution, cache_dir, on_progress=on_progress)
    return scaled(replace(shape, name=name or kind, source={**shape.source, "primitive": kind}), size)


def shape_from_mesh(
    path: str | Path, cache_dir: str | Path | None = None, *, name: str | None = None, units: float | None = None,
    cap: bool = False, thicken: float | None = None, sdf: SdfKind = "mlp", resolution: int = DEFAULT_RESOLUTION,
    on_progress: Progress = silent, scales: Sequence[float] = (1.0,),
) -> Shape:  # fmt: skip
    """The shape of a mesh file. It is made on first use, then taken from a cache (by default `sdfsim/shapes` in the
    user's cache folder), whose key is the content of the mesh.

    `units` are metres per unit of the file (None: unknown, taken as metres), `thicken` m is a thickness for an open
    sheet. With `sdf` "mlp" the network is fitted, which takes up to a minute; "grid" and "mesh" need no fit (see
    `mesh_shape`). `source["notes"]` lists what was done to the mesh, and `remarks` on its size, by which `scales` its
    bodies have. Raises SdfsimError if the mesh cannot be used.
    """
    path = Path(path)
    loaded = load_textured(path)
    mesh = loaded.mesh
    # Not the file's bytes: a glTF may keep its vertices, and an OBJ its colours, in other files.
    key = mesh.digest()
    metres = 1.0 if units is None else units
    how = {"cap": cap, "thicken": None if thicken is None else thicken / metres, "on_progress": on_progress}
    shape = _cached(mesh, key, name or path.stem, sdf, resolution, cache_dir, file=str(path), **how)
    skin, lost = dressed(loaded, thicken=thicken)
    remarked = remarks(path, mesh, metres, given=units is not None, scales=scales)
    notes = [*shape.source.get("notes", []), *lost, *remarked]
    source = {**shape.source, "file": path.name, "sha256": key} | ({"notes": notes} if notes else {})
    return scaled(replace(shape, name=name or path.stem, source=source, skin=skin), metres)


def dressed(loaded: Loaded, *, thicken: float | None) -> tuple[Mesh | None, list[str]]:
    """The textured mesh that is shown for a mesh file, in the file's units, and notes on what is lost. A thickened
    sheet is shown as the solid that it becomes."""
    if loaded.skin is None or thicken is None:
        return loaded.skin, list(loaded.notes)
    return None, ["its texture becomes colours of its vertices, as thicken gives it other surfaces"]


def remarks(path: Path, mesh: Mesh, units: float, *, given: bool, scales: Sequence[float] = (1.0,)) -> list[str]:
    """Notes on a mesh file, one line each: that glTF was turned, and its size, if that is unusual in these `units`
    (metres per unit) for a body of one of these `scales`. Many parts are drawn in millimetres, and few files state
    it."""
    notes = ["glTF has y up: it is turned to z up"] if path.suffix.lower() in GLTF else []
    most = USUAL[1] if given else LARGE
    sizes = [scale * units * float(np.ptp(mesh.vertices, axis=0).max()) for scale in scales]
    size = next((size for size in sizes if not USUAL[0] <= size <= most), None)
    if size is not None and not given and size > LARGE:
        notes.append(f"it is {size:.3g} m wide in metres; if its unit is millimetres, give --units mm (units: mm)")
    elif size is not None:
        notes.append(f"it is {size:.3g} m wide; if that is wrong, give the file's unit with --units (units)")
    return notes


def far_origin(mesh: Mesh, units: float = 1.0) -> str:
    """A line on a mesh whose origin is far away for its size; else an empty one. `units` are metres per unit."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    away = units * float(np.linalg.norm(low + high)) / 2
    if away <= FAR_OFF * units * float((high - low).max()):
        return ""
    distance = f"{away / 1000:,.0f} km" if away >= 1e4 else f"{away:.3g} m"
    return f"it lies {distance} from its origin, which is the point that a body's position places"


def mesh_shape(
    mesh: Mesh, *, name: str, kind: Literal["grid", "mesh"], cap: bool = False, thicken: float | None = None,
    file: str = "", resolution: int = DEFAULT_RESOLUTION, on_progress: Progress = silent, coarse: int = 1,
) -> Shape:  # fmt: skip
    """The shape of a mesh (metres) without a fit: its exact SDF or a grid of it (see `sample_grid`), with nodes and
    mass as for a fit. Raises SdfsimError, which calls the mesh `file` (or else `name`), if the mesh cannot be used."""
    solid = solidify(mesh, name=file or name, cap=cap, thicken=thicken)
    sdf, note, certificate = sdf_of_mesh(solid.surface, kind, resolution, on_progress, coarse)
    try:
        nodes = surface_nodes(sdf, solid.surface, DEFAULT_COUNT)
    except SdfsimError as error:
        if kind != "grid":
            raise
        extent, wall = float(np.ptp(solid.surface.vertices, axis=0).max()), _wall(solid.surface)
        enough = int(np.ceil(2.0 * extent / wall)) + 1  # two samples in the wall
        fault = f"no surface nodes: walls of about {wall:.2g} m lie between the samples of a grid of {resolution}"
        hint = f"give resolution: {enough}, or sdf: mesh" if enough <= FINEST_GRID else "give sdf: mesh, which has none"
        raise SdfsimError(f"{file or name}: {fault}", hint) from error
    source = {"kind": "mesh"} | note | ({"notes": list(solid.notes)} if solid.notes else {})
    return Shape(name, solid.surface, sdf, nodes, *solid.mass_properties(), certificate, source)


def _wall(mesh: Mesh) -> float:
    """The mean thickness of a closed sheet, m: its volume over half its area."""
    sides = np.diff(mesh.vertices[mesh.faces], axis=1)
    return 4.0 * abs(signed_volume(mesh)) / float(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum())


def _cached(
    mesh: Mesh, key: str, name: str, kind: SdfKind, resolution: int, cache_dir: str | Path | None, **how: Any
) -> Shape:
    variant = "-cap" if how.get("cap") else ""
    variant += "" if how.get("thicken") is None else f"-thick{how['thicken']:g}"
    variant += f"-grid{resolution}" if kind == "grid" else "-mesh" if kind == "mesh" else ""
    folder = Path(cache_dir or user_cache("shapes")) / f"{key[:24]}{variant}-{FIT_VERSION}.{FORMAT_VERSION}"
    if folder.is_dir():
        try:
            return load_shape(folder)
        except SdfsimError:
            shutil.rmtree(folder, ignore_errors=True)  # a damaged entry is only a cache miss
    if how["on_progress"] is silent and kind != "mesh":  # no progress is shown, so log what takes long
        _log.warning("making the shape %s, once for this mesh: about half a minute", name)
    if kind == "mlp":
        shape = fit_mesh(mesh, name=name, **how)
    else:
        shape = mesh_shape(mesh, name=name, kind=kind, resolution=resolution, **how)
    # Write to a temporary folder first, so that processes and threads that fit the same mesh never see half-written
    # files.
    partial = folder.with_name(f"{folder.name}.{os.getpid()}-{secrets.token_hex(4)}.partial")
    try:
        shape.save(partial)
        if not folder.is_dir():  # else another process was faster, and its entry is as good
            partial.rename(folder)
    except (SdfsimError, OSError) as error:
        _log.warning("the shape %s cannot be cached: %s", name, error)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return shape


def fit_mesh(
    mesh: Mesh,
    *,
    name: str,
    recipe: Recipe = "default",
    budget: float | None = None,
    seed: int = 0,
    cap: bool = False,
    thicken: float | None = None,
    file: str = "",
    on_progress: Progress = silent,
    device: torch.device | str = "cpu",
) -> Shape:
    """Fit the compact SDF network to the solid that a triangle mesh in metres bounds, see `solidify`.

    The result depends only on the mesh, the recipe (see `RECIPES`) and the seed, up to rounding, which depends on the
    number of threads and the device; unless the budget in s ends the training early. The shape's `certificate` has the
    errors and whether it is usable (`passed`); `source["notes"]` says what was done to the mesh. Raises SdfsimError,
    which calls the mesh `file` (or else `name`), if the mesh cannot be used or bounds no solid.
    """
    solid = solidify(mesh, name=file or name, cap=cap, thicken=thicken)

    def pick(sdf: Sdf) -> np.ndarray:
        return surface_nodes(sdf, solid.surface, DEFAULT_COUNT)

    from sdfsim.sdf.fit.train import fit_sdf  # torch is slow to load

    sdf, points, certificate = fit_sdf(MeshDistance(solid), recipe, budget, seed, pick, on_progress, device)
    source: dict[str, Any] = {"kind": "mesh", "recipe": recipe, "fit_version": FIT_VERSION}
    source |= {"notes": list(solid.notes)} if solid.notes else {}
    return Shape(name, solid.surface, sdf, points, *solid.mass_properties(), certificate, source)


def fit_pieces(
    pieces: list[Mesh],
    *,
    name: str,
    display: Mesh | None = None,
    nodes: int = DEFAULT_COUNT,
    kind: Literal["mlp", "grid"] = "mlp",
) -> Shape:
    """Fit the compact SDF network to the union of convex pieces (the body that a rigid-body engine collides), or sample
    its distance on a grid (`kind` "grid", which takes a second).

    The shape has at most `nodes` nodes: first the pieces' own vertices (without repetitions and those inside another
    piece), because contact with a flat floor is exact only there; then points along their sharp edges, then points all
    over the surface. Mass properties are those of the union, and so is the mesh to show unless `display` is given.
    """
    oracle = PiecesDistance(pieces)
    size = float(np.ptp(oracle.bounds, axis=0).max())

    def bare(points: np.ndarray) -> np.ndarray:
        _, first = np.unique(np.round(points / (1e-4 * size)), axis=0, return_index=True)
        points = points[np.sort(first)]
        # Measured from the boundary of the union: a point on the seam of two pieces is not deep in either.
        return points[oracle(points).distance >= -1e-3 * size]

    vertices = bare(np.concatenate([piece.vertices for piece in pieces]))
    edges = bare(np.concatenate([edge_nodes(piece.vertices, EDGE_SPACING * size) for piece in pieces]))

    def pick(sdf: Sdf) -> np.ndarray:
        own = hull_nodes(vertices, round(OWN_SHARE * nodes))
        try:
            spread = sample_nodes(sdf)
        except SdfsimError:  # Pieces between the samples of a grid still have corners and edges.
            spread = vertices
        return thin(spread, nodes, keep=thin(edges, round(EDGE_SHARE * nodes), keep=own))

    if kind == "grid":
        sdf: Sdf = sample_grid(oracle, oracle.bounds, DEFAULT_RESOLUTION)
        points, certificate = pick(sdf), certify_grid(sdf, oracle)
        source: dict[str, Any] = {"kind": "pieces", "sdf": "grid", "resolution": DEFAULT_RESOLUTION}
    else:
        from sdfsim.sdf.fit.train import fit_sdf

        sdf, points, certificate = fit_sdf(oracle, "default", None, 0, pick, silent, "cpu")
        source = {"kind": "pieces", "recipe": "default", "fit_version": FIT_VERSION}
    low, high = (np.array([edge(piece.vertices, 0) for piece in pieces]) for edge in (np.min, np.max))
    apart = ((low[:, None] > high) | (low > high[:, None])).any(2) | np.eye(len(pieces), dtype=bool)
    exact = apart.all() and all(is_closed(piece) for piece in pieces)  # what overlaps would count twice
    volume, com, inertia = mass_properties(joined(pieces)) if exact else mass_properties_of_sdf(oracle, oracle.bounds)
    mesh = display if display is not None else clean(oracle.surface, name=name)
    hulls = tuple(piece.vertices for piece in pieces)
    return Shape(name, mesh, sdf, points, volume, com, inertia, certificate, source, hulls)
