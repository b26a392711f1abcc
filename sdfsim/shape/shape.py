"""A `Shape` (geometry, SDF, surface nodes, mass properties), the folder that holds it, and the cache of fitted ones."""

from __future__ import annotations

import logging
import os
import secrets
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_json, user_cache, write_bytes, write_json
from sdfsim.base.parallel import Progress, silent
from sdfsim.geometry import primitives
from sdfsim.geometry.mass import mass_properties_of_sdf
from sdfsim.geometry.mesh import (
    GLTF,
    Frame,
    Mesh,
    convex_hull,
    lattice,
    load_mesh,
    read_glb,
    read_mesh,
    write_glb,
    write_ply,
)
from sdfsim.geometry.solidify import solidify
from sdfsim.sdf.closed_forms import (
    CLOSED_FORMS,
    BoxSdf,
    CapsuleSdf,
    ClosedForm,
    CylinderSdf,
    GridSdf,
    MeshSdf,
    PlaneSdf,
    Sdf,
    SphereSdf,
    sample_grid,
)
from sdfsim.sdf.fit.certificate import certify_grid
from sdfsim.sdf.mlp import ACTIVATIONS, MlpSdf
from sdfsim.sdf.reference import MeshDistance
from sdfsim.shape.surface_nodes import DEFAULT_COUNT, sample_nodes, surface_nodes

SdfKind = Literal["mlp", "grid", "mesh"]

FORMAT_VERSION = 1
# m, sizes of meshes that need no word; without known units the largest is less, for few things that move are larger.
USUAL, LARGE = (1e-3, 100.0), 5.0
# Samples along each side of a grid: its cells are then 0.022 of the solid's largest extent.
DEFAULT_RESOLUTION = 64
WEIGHTS_FILE, MESH_FILE, RECORD_FILE = "shape.safetensors", "mesh.ply", "shape.json"
SKIN_FILE = "textured.glb"  # where there is a texture

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Shape:
    """One rigid shape in its own frame, metres, at scale 1.

    Attributes:
        name: what messages and the viewer call it.
        mesh: what is shown, and what the SDF was made from (of convex pieces, the SDF is that of their union).
        sdf: signed distance in the same frame.
        nodes: [K, 3] float64 m, surface nodes that carry contact (empty for a plane).
        volume: m^3.
        com: [3] float64 m, centre of mass.
        inertia: [3, 3] float64 kg m^2 per unit density, about `com`, shape axes.
        certificate: errors measured on held-out points (empty where the distance is exact).
        source: where it came from and a content hash (for caching and for the record).
        pieces: the vertices [V, 3] float64 m of each of its convex pieces, where it was made of such.
        skin: a mesh with a texture that is shown in place of `mesh`, where there is one.
        faces: [F, 3] int64 triangles between the nodes, where these are the vertices of a mesh; never stored.
    """

    name: str
    mesh: Mesh
    sdf: Sdf
    nodes: np.ndarray
    volume: float
    com: np.ndarray
    inertia: np.ndarray
    certificate: dict = field(default_factory=dict)
    source: dict = field(default_factory=dict)
    pieces: tuple[np.ndarray, ...] = ()
    skin: Mesh | None = None
    faces: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int64))

    @property
    def shown(self) -> Mesh:
        """What to draw."""
        return self.mesh if self.skin is None else self.skin

    def save(self, folder: str | Path) -> Path:
        """Write the shape folder and return it. Each file appears complete or not at all, and shape.json last, beside
        the files it describes. Raises SdfsimError where the folder cannot be written, or the SDF is of a kind without a
        file format, or exact and of another mesh."""
        from safetensors.torch import save as to_bytes

        folder = Path(folder)
        tensors, description = _sdf_to_file(self.sdf, self.mesh)
        tensors["nodes"] = torch.from_numpy(np.ascontiguousarray(self.nodes, dtype=np.float64))
        if self.pieces:
            tensors["pieces"] = torch.from_numpy(np.concatenate(self.pieces))
        tensors["bounds"] = torch.from_numpy(np.ascontiguousarray(self.sdf.bounds, dtype=np.float64))
        record = {
            "version": FORMAT_VERSION,
            "name": self.name,
            "units": "m",
            "scale": description.get("scale", 1.0),
            "sdf": description,
            "volume": self.volume,
            "com": self.com.tolist(),
            "inertia": self.inertia.tolist(),
            "certificate": self.certificate,
            "source": self.source,
            "pieces": [len(piece) for piece in self.pieces],
        }
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / RECORD_FILE).unlink(missing_ok=True)
            write_bytes(folder / WEIGHTS_FILE, to_bytes(tensors))
            write_bytes(folder / MESH_FILE, write_ply(self.mesh))
            (folder / SKIN_FILE).unlink(missing_ok=True)
            if self.skin is not None:
                write_bytes(folder / SKIN_FILE, write_glb({self.name: self.skin}))
            write_json(folder / RECORD_FILE, record)
        except OSError as error:
            raise SdfsimError(f"{folder}: cannot write the shape ({error.strerror or error})") from error
        return folder


def load_shape(folder: str | Path) -> Shape:
    """Read a folder written by `Shape.save` (or by `fit` or `reconstruct`). Raises SdfsimError where a file is missing,
    cut short, of another version, or holds what it should not."""
    from safetensors import SafetensorError
    from safetensors.torch import load as from_bytes

    folder = Path(folder)
    if not folder.is_dir():
        raise SdfsimError(f"{folder}: no such shape folder")
    for name in (RECORD_FILE, WEIGHTS_FILE, MESH_FILE):
        if not (folder / name).is_file():
            raise SdfsimError(f"{folder}: {name} is missing, so this is no complete shape folder")
    record = read_json(folder / RECORD_FILE, "fit the mesh again")
    version = record.get("version") if isinstance(record, dict) else None
    if version != FORMAT_VERSION:
        told = f"shape format version {version!r}, this program reads {FORMAT_VERSION}"
        raise SdfsimError(f"{folder / RECORD_FILE}: {told}", "fit the mesh again")
    try:
        tensors = from_bytes((folder / WEIGHTS_FILE).read_bytes())
    except (SafetensorError, OSError) as error:
        raise SdfsimError(f"{folder / WEIGHTS_FILE}: damaged or cut short ({error})") from error
    mesh = read_mesh(folder / MESH_FILE)
    skins = read_glb(folder / SKIN_FILE) if (folder / SKIN_FILE).is_file() else {}
    try:
        for name, tensor in tensors.items():
            if name != "bounds":  # a plane's are infinite
                _finite(tensor.numpy(), name, *tensor.shape)
        sizes = record.get("pieces", [])
        return Shape(
            name=str(record["name"]),
            mesh=mesh,
            sdf=_sdf_from_file(record["sdf"], tensors, mesh),
            nodes=tensors["nodes"].numpy().reshape(-1, 3),
            volume=float(_finite(record["volume"], "volume")),
            com=_finite(record["com"], "com", 3),
            inertia=_finite(record["inertia"], "inertia", 3, 3),
            certificate=dict(record["certificate"]),
            source=dict(record["source"]),
            pieces=tuple(piece.numpy() for piece in tensors["pieces"].split(sizes)) if sizes else (),
            skin=next(iter(skins.values()), None),
        )
    except (SdfsimError, LookupError, TypeError, ValueError, ArithmeticError, RuntimeError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise SdfsimError(f"{folder}: not a valid shape folder ({reason})") from error


def _sdf_to_file(sdf: Sdf, mesh: Mesh) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Tensors and a description (for JSON) of an SDF, beside the folder's `mesh`."""
    if isinstance(sdf, MlpSdf | GridSdf):
        frame = {"centre": np.asarray(sdf.frame.centre).tolist(), "scale": float(sdf.frame.scale)}
        if isinstance(sdf, GridSdf):
            return {"grid": sdf.values.cpu().contiguous()}, {"kind": "grid", "resolution": sdf.resolution, **frame}
        tensors = {}
        for layer, (weight, bias) in enumerate(zip(sdf.weights, sdf.biases, strict=True)):
            tensors[f"layer{layer}.weight"] = weight.cpu().contiguous()
            tensors[f"layer{layer}.bias"] = bias.cpu().contiguous()
        described = {"kind": "mlp", "activation": sdf.activation, "mirrors": list(sdf.mirrors)}
        return tensors, {**described, "layers": len(sdf.weights), **frame}
    if isinstance(sdf, MeshSdf):
        if not all(np.array_equal(getattr(sdf.mesh, key), getattr(mesh, key)) for key in ("vertices", "faces")):
            raise SdfsimError("an exact SDF of another mesh than the shape's own cannot be saved")
        return {}, {"kind": "mesh"}
    if isinstance(sdf, ClosedForm):
        return {}, {"kind": sdf.KIND, **vars(sdf)}
    raise SdfsimError(f"an SDF of type {type(sdf).__name__} cannot be saved", "fit it first")


def _sdf_from_file(description: dict[str, Any], tensors: dict[str, torch.Tensor], mesh: Mesh) -> Sdf:
    """The SDF that `_sdf_to_file` described. Raises KeyError, TypeError, ValueError or SdfsimError otherwise."""
    kind = description["kind"]
    if kind == "mesh":
        return MeshSdf(mesh)
    if kind in CLOSED_FORMS:
        made: Any = CLOSED_FORMS[kind]
        return made(**{k: tuple(v) if isinstance(v, list) else v for k, v in description.items() if k != "kind"})
    frame = Frame(_finite(description["centre"], "centre", 3), float(_finite(description["scale"], "scale")))
    if frame.scale <= 0:
        raise ValueError(f"scale must be > 0 (got {frame.scale:g})")
    bounds = _finite(tensors["bounds"].numpy(), "bounds", 2, 3)
    if kind == "grid":
        return GridSdf(tensors["grid"].float(), frame, bounds)
    if kind != "mlp" or description["activation"] not in ACTIVATIONS:
        raise ValueError(f"unknown SDF kind {kind!r} or activation {description.get('activation')!r}")
    weights, biases = (
        tuple(tensors[f"layer{layer}.{part}"].float() for layer in range(int(description["layers"])))
        for part in ("weight", "bias")
    )
    if not weights:
        raise ValueError(f"layers must be at least 1 (got {description['layers']!r})")
    rows = [len(bias) for bias in biases]
    if rows[-1] != 1 or [tuple(weight.shape) for weight in weights] != list(zip(rows, [3, *rows[:-1]], strict=True)):
        raise ValueError("the layers do not fit together")
    x, y, z = (bool(mirror) for mirror in description.get("mirrors", (False, False, False)))
    return MlpSdf(weights, biases, description["activation"], frame, bounds, (x, y, z))


def _finite(value: Any, what: str, *shape: int) -> np.ndarray:
    """Finite numbers [*shape] out of JSON. Raises TypeError or ValueError otherwise."""
    numbers = np.array(value, dtype=np.float64).reshape(shape)
    if not np.isfinite(numbers).all():
        raise ValueError(f"{what} is not finite")
    return numbers


def scaled(shape: Shape, factor: float) -> Shape:
    """The same shape `factor` times as large, about its own origin. Raises SdfsimError where the factor is not positive
    and finite."""
    if not (np.isfinite(factor) and factor > 0):
        raise SdfsimError(f"{shape.name}: scale must be > 0 (got {factor})")
    if factor == 1.0:
        return shape
    assert isinstance(shape.sdf, MlpSdf | GridSdf | MeshSdf | ClosedForm)
    return replace(
        shape,
        mesh=replace(shape.mesh, vertices=shape.mesh.vertices * factor),
        skin=shape.skin and replace(shape.skin, vertices=shape.skin.vertices * factor),
        pieces=tuple(piece * factor for piece in shape.pieces),
        sdf=shape.sdf.scaled(factor),
        nodes=shape.nodes * factor,
        volume=shape.volume * factor**3,
        com=shape.com * factor,
        inertia=shape.inertia * factor**5,
    )


def own_pieces(shape: Shape) -> list[Mesh]:
    """Convex pieces [m] that a shape comes with, or that its primitive has; empty where there are none."""
    if shape.pieces:
        return [convex_hull(points) for points in shape.pieces]
    kind = str(shape.source.get("primitive", ""))
    if not (pieces := primitives.convex_pieces(kind)):
        return []
    usual = primitives.PRIMITIVES[kind]().vertices
    factor = float(np.ptp(shape.mesh.vertices, axis=0).max() / np.ptp(usual, axis=0).max())
    return [Mesh(piece.vertices * factor, piece.faces) for piece in pieces]


def with_sdf(shape: Shape, kind: SdfKind, *, resolution: int = DEFAULT_RESOLUTION) -> Shape:
    """The same shape with its distances taken from another source; mesh, nodes and mass properties stay.

    Kinds: "mlp" (the shape as it is, which must have a network), "grid" (samples of the exact distance to the mesh, see
    `sample_grid`, with the certificate of `certify_grid`) or "mesh" (that distance itself, which needs no certificate);
    `source` notes the kind as `sdf`.
    Raises SdfsimError where there is no network, of a plane, or of fewer than two samples a side.
    """
    if kind == "mlp":
        if not isinstance(shape.sdf, MlpSdf):
            raise SdfsimError(f"{shape.name}: the shape has no SDF network", "fit its mesh")
        return shape
    if isinstance(shape.sdf, PlaneSdf):
        raise SdfsimError(f"{shape.name}: a plane has no end, so no grid or mesh holds it")
    sdf, note, certificate = sdf_of_mesh(shape.mesh, kind, resolution)
    return replace(shape, sdf=sdf, certificate=certificate, source=shape.source | note)


def sdf_of_mesh(
    mesh: Mesh, kind: Literal["grid", "mesh"], resolution: int, on_progress: Progress = silent
) -> tuple[Sdf, dict, dict]:
    """A mesh's exact SDF or a grid of it, what a shape's `source` says about it, and its certificate."""
    if kind == "mesh":
        return MeshSdf(mesh), {"sdf": "mesh"}, {}
    oracle = MeshDistance(mesh)
    grid = sample_grid(oracle, oracle.bounds, resolution, on_progress)
    return grid, {"sdf": "grid", "resolution": resolution}, certify_grid(grid, oracle)


def with_nodes(shape: Shape, grid: int) -> Shape:
    """The same shape with the surface nodes of a grid of `grid`^3 points, sampled from its SDF alone, as the paper
    resamples a trained simulator's bodies. Raises as `sample_nodes` does."""
    # What was measured of the former nodes does not hold for these.
    certificate = {key: value for key, value in shape.certificate.items() if key != "coverage"}
    return replace(shape, nodes=sample_nodes(shape.sdf, grid=grid), certificate=certificate)


def with_wall(shape: Shape, wall: float) -> Shape:
    """The same shape as a hollow one: only what lies within `wall` m of its surface has mass.

    Volume, centre of mass and inertia are taken from the SDF on a grid. Where the SDF is exact and the wall at least
    1/100 of the shape's longest side, the volume is within 1 % and the inertia within 4 %. Raises SdfsimError for a
    plane.
    """
    volume, com, inertia = mass_properties_of_sdf(shape.sdf, wall=wall)
    return replace(shape, volume=volume, com=com, inertia=inertia, source=shape.source | {"wall": wall})


def shape_from_mesh(
    path: str | Path, cache_dir: str | Path | None = None, *, name: str | None = None, units: float | None = None,
    cap: bool = False, thicken: float | None = None, sdf: SdfKind = "mlp", resolution: int = DEFAULT_RESOLUTION,
    on_progress: Progress = silent,
) -> Shape:  # fmt: skip
    """The shape of a mesh file: made on first use, then taken from a cache (by default `sdfsim/shapes` in the user's
    cache folder) keyed by what the file describes.

    `units` are metres per unit of the file (None: metres, with a doubt), `thicken` m is a thickness for an open sheet;
    of `sdf`, "mlp" fits the network, "grid" and "mesh" fit nothing (see `mesh_shape`). `source["notes"]` tells what was
    done to the mesh, and what `remarks` there are. Raises SdfsimError where the mesh cannot be used.
    """
    path = Path(path)
    mesh = load_mesh(path)
    # Not of the file's bytes: a glTF keeps its vertices, and an OBJ its colours, in files beside it.
    key = mesh.digest()
    metres = 1.0 if units is None else units
    how = {"cap": cap, "thicken": None if thicken is None else thicken / metres, "on_progress": on_progress}
    shape = _cached(mesh, key, path.stem, sdf, resolution, cache_dir, file=str(path), **how)
    notes = [*shape.source.get("notes", []), *remarks(path, mesh, metres, given=units is not None)]
    source = {**shape.source, "file": path.name, "sha256": key} | ({"notes": notes} if notes else {})
    return scaled(replace(shape, name=name or path.stem, source=source), metres)


def remarks(path: Path, mesh: Mesh, units: float, *, given: bool) -> list[str]:
    """What to tell of a mesh file as it was read, a line each: that glTF was turned; and its size, where that is odd
    for the `units` (metres per unit) that are taken for its numbers. Many parts are drawn in millimetres, and few
    files say so."""
    notes = ["glTF has y up: it is turned to z up"] if path.suffix.lower() in GLTF else []
    size = units * float(np.ptp(mesh.vertices, axis=0).max())
    if not given and size > LARGE:
        notes.append(
            f"it is {size:.3g} m wide if it counts in metres: does it in millimetres? Then give --units mm (units: mm)"
        )
    elif not USUAL[0] <= size <= USUAL[1]:
        notes.append(f"it is {size:.3g} m wide; where that is wrong, --units (units) says what the file counts in")
    return notes


def shape_from_primitive(
    kind: str, size: float = 1.0, cache_dir: str | Path | None = None, *, name: str | None = None,
    sdf: SdfKind = "mlp", resolution: int = DEFAULT_RESOLUTION, on_progress: Progress = silent,
) -> Shape:  # fmt: skip
    """The shape of a procedural mesh of `primitives.PRIMITIVES`, its largest extent `size` m, made on first use and
    cached; other arguments as of `shape_from_mesh`. Raises SdfsimError for no such primitive."""
    if kind not in primitives.PRIMITIVES:
        raise SdfsimError(f"no primitive called {kind!r}", "there are " + ", ".join(primitives.PRIMITIVES))
    mesh = primitives.PRIMITIVES[kind]()
    unit = Mesh(mesh.vertices / float(np.ptp(mesh.vertices, axis=0).max()), mesh.faces)
    # Rounded, since sines and cosines differ in their last digit from machine to machine.
    key = Mesh(unit.vertices.round(9), unit.faces).digest()
    shape = _cached(unit, key, kind, sdf, resolution, cache_dir, on_progress=on_progress)
    return scaled(replace(shape, name=name or kind, source={**shape.source, "primitive": kind}), size)


def mesh_shape(
    mesh: Mesh, *, name: str, kind: Literal["grid", "mesh"], cap: bool = False, thicken: float | None = None,
    file: str = "", resolution: int = DEFAULT_RESOLUTION, on_progress: Progress = silent,
) -> Shape:  # fmt: skip
    """The shape of a mesh (metres) without any fit: its exact SDF or a grid of it, nodes and mass as a fit has them.
    Raises SdfsimError, which calls the mesh `file` (or else `name`), where it cannot be used."""
    solid = solidify(mesh, name=file or name, cap=cap, thicken=thicken)
    sdf, note, certificate = sdf_of_mesh(solid.surface, kind, resolution, on_progress)
    nodes = surface_nodes(sdf, solid.surface, DEFAULT_COUNT)
    source = {"kind": "mesh"} | note | ({"notes": list(solid.notes)} if solid.notes else {})
    return Shape(name, solid.surface, sdf, nodes, *solid.mass_properties(), certificate, source)


def _cached(
    mesh: Mesh, key: str, name: str, kind: SdfKind, resolution: int, cache_dir: str | Path | None, **how: Any
) -> Shape:
    if kind == "mesh":  # made as fast as it is read
        return mesh_shape(mesh, name=name, kind=kind, **how)
    from sdfsim.sdf.fit.train import FIT_VERSION, fit_mesh

    variant = "-cap" if how.get("cap") else ""
    variant += "" if how.get("thicken") is None else f"-thick{how['thicken']:g}"
    variant += f"-grid{resolution}" if kind == "grid" else ""
    folder = Path(cache_dir or user_cache("shapes")) / f"{key[:24]}{variant}-{FIT_VERSION}.{FORMAT_VERSION}"
    if folder.is_dir():
        try:
            return load_shape(folder)
        except SdfsimError:
            shutil.rmtree(folder, ignore_errors=True)  # a damaged entry is only a cache miss
    if how["on_progress"] is silent:  # nobody sees how it goes on: say at least what takes so long
        _log.warning("making the shape %s, once for this mesh: about half a minute", name)
    if kind == "grid":
        shape = mesh_shape(mesh, name=name, kind=kind, resolution=resolution, **how)
    else:
        shape = fit_mesh(mesh, name=name, **how)
    # A folder of its own first, so that processes and threads fitting the same mesh never see each other's half.
    partial = folder.with_name(f"{folder.name}.{os.getpid()}-{secrets.token_hex(4)}.partial")
    try:
        shape.save(partial)
        if not folder.is_dir():  # else another process was first: its entry is as good
            partial.rename(folder)
    except (SdfsimError, OSError) as error:
        _log.warning("the shape %s is not kept for the next time: %s", name, error)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return shape


def analytic_shape(
    kind: Literal["plane", "sphere", "capsule", "cylinder", "box"],
    *,
    radius: float = 0.0,
    height: float = 0.0,
    size: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    name: str | None = None,
) -> Shape:
    """A shape with an exact SDF, about the origin: "plane" (z = 0, +z outside, infinite), "sphere", "capsule",
    "cylinder" or "box".

    Radius and height (along z, of a capsule with its caps) are in m, and so is the box's size, full extents along x, y,
    z. Mass properties are exact (of the plane 0); the plane shows a 20 m square and has no nodes. Raises SdfsimError
    for a size that is missing or not positive.
    """
    volume, inertia, nodes = 0.0, np.zeros((3, 3)), np.zeros((0, 3))
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
    else:
        caps = kind == "capsule"
        half = 0.5 * (float(height) - 2.0 * radius * caps)
        sdf = (CapsuleSdf if caps else CylinderSdf)(float(radius), half)
        volume, inertia = _round_mass(sdf.radius, half, caps=caps)
        nodes = _round_nodes(sdf.radius, half, caps=caps)
        mesh = convex_hull(_round_nodes(sdf.radius, half, caps=caps, around=48))
    return Shape(name or kind, mesh, sdf, nodes, float(volume), np.zeros(3), inertia, source={"kind": kind})


def _round_mass(radius: float, half: float, *, caps: bool) -> tuple[float, np.ndarray]:
    """Volume m^3 and inertia [3, 3] m^5 (per unit density) of a cylinder about z, with half balls at its ends."""
    trunk = 2.0 * np.pi * radius**2 * half
    across, about = trunk * (radius**2 / 4.0 + half**2 / 3.0), trunk * radius**2 / 2.0
    if caps:
        balls = 4.0 / 3.0 * np.pi * radius**3
        # Half balls whose flat sides lie at +-half, their middles 3/8 of the radius beyond.
        across += balls * (0.4 * radius**2 + half**2 + 0.75 * half * radius)
        about += 0.4 * balls * radius**2
        trunk += balls
    return trunk, np.diag([across, across, about])


def _round_nodes(radius: float, half: float, *, caps: bool, around: int = 16) -> np.ndarray:
    """Rings about z on the surface of a capsule or cylinder: [K, 3] m, those of the ends first."""
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
