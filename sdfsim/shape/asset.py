"""A `Shape`: geometry, SDF (learned, sampled or exact), surface nodes, mass properties; and the folder it lives in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from sdfsim.errors import SdfsimError
from sdfsim.files import write_json
from sdfsim.shape.distance import MeshDistance
from sdfsim.shape.mesh import Frame, Mesh, convex_hull, read_mesh, write_ply
from sdfsim.shape.mlp_sdf import MlpSdf
from sdfsim.shape.sdf import BoxSdf, CapsuleSdf, CylinderSdf, GridSdf, MeshSdf, PlaneSdf, Sdf, SphereSdf, sample_grid
from sdfsim.shape.shape import FORMAT_VERSION, finite, read_record, sdf_from_file, sdf_to_file, write

SdfKind = Literal["mlp", "grid", "mesh"]

# Samples along each side of a grid: its cells are then 0.022 of the solid's largest extent.
DEFAULT_RESOLUTION = 64
WEIGHTS_FILE, MESH_FILE, RECORD_FILE = "shape.safetensors", "mesh.ply", "shape.json"


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
        certificate: fit errors measured on held-out points (empty where nothing was fitted).
        source: where it came from and a content hash (for caching and for the record).
        pieces: the vertices [V, 3] float64 m of each of its convex pieces, where it was made of such.
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

    def save(self, folder: str | Path) -> Path:
        """Write the shape folder: shape.safetensors, mesh.ply and, last, shape.json.

        Each file appears complete or not at all, and shape.json only beside the files it describes.

        Returns:
            the folder.

        Raises:
            SdfsimError: the folder cannot be written, or the SDF has no file format: its kind has none, or it is exact
                and not of this shape's mesh.
        """
        folder = Path(folder)
        tensors, description = sdf_to_file(self.sdf, self.mesh)
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
        from safetensors.torch import save as to_bytes

        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / RECORD_FILE).unlink(missing_ok=True)
            write(folder / WEIGHTS_FILE, to_bytes(tensors))
            write(folder / MESH_FILE, write_ply(self.mesh))
            write_json(folder / RECORD_FILE, record)
        except OSError as error:
            raise SdfsimError(f"{folder}: cannot write the shape ({error.strerror or error})") from error
        return folder


def load_shape(folder: str | Path) -> Shape:
    """Read a folder written by `Shape.save` (or by `fit` or `reconstruct`).

    Raises:
        SdfsimError: a file is missing, cut short, of another version, or holds what it should not.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise SdfsimError(f"{folder}: no such shape folder")
    for name in (RECORD_FILE, WEIGHTS_FILE, MESH_FILE):
        if not (folder / name).is_file():
            raise SdfsimError(f"{folder}: {name} is missing, so this is no complete shape folder")
    record = read_record(folder / RECORD_FILE)
    from safetensors import SafetensorError
    from safetensors.torch import load as from_bytes

    try:
        tensors = from_bytes((folder / WEIGHTS_FILE).read_bytes())
    except (SafetensorError, OSError) as error:
        raise SdfsimError(f"{folder / WEIGHTS_FILE}: damaged or cut short ({error})") from error
    for name, tensor in tensors.items():
        if name != "bounds" and not torch.isfinite(tensor).all():
            raise SdfsimError(f"{folder / WEIGHTS_FILE}: {name} is not finite")
    mesh = read_mesh(folder / MESH_FILE)
    try:
        return Shape(
            name=str(record["name"]),
            mesh=mesh,
            sdf=sdf_from_file(record["sdf"], tensors, mesh),
            nodes=tensors["nodes"].numpy().reshape(-1, 3),
            volume=float(finite(record["volume"], "volume")),
            com=finite(record["com"], "com", 3),
            inertia=finite(record["inertia"], "inertia", 3, 3),
            certificate=dict(record["certificate"]),
            source=dict(record["source"]),
            pieces=_pieces(tensors, record.get("pieces", [])),
        )
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise SdfsimError(f"{folder}: not a valid shape folder ({reason})") from error


def _pieces(tensors: dict[str, torch.Tensor], sizes: list[int]) -> tuple[np.ndarray, ...]:
    return tuple(piece.numpy() for piece in tensors["pieces"].split(sizes)) if sizes else ()


def scaled(shape: Shape, factor: float) -> Shape:
    """The same shape `factor` times as large, about its own origin.

    Raises:
        SdfsimError: the factor is not a positive finite number.
    """
    if not (np.isfinite(factor) and factor > 0):
        raise SdfsimError(f"{shape.name}: scale must be > 0 (got {factor})")
    if factor == 1.0:
        return shape
    sdf = shape.sdf
    if isinstance(sdf, MlpSdf | GridSdf):
        frame = Frame(sdf.frame.centre * factor, sdf.frame.scale * factor)
        sdf = replace(sdf, frame=frame, bounds=sdf.bounds * factor)
    elif isinstance(sdf, SphereSdf):
        sdf = SphereSdf(sdf.radius * factor)
    elif isinstance(sdf, CapsuleSdf | CylinderSdf):
        sdf = replace(sdf, radius=sdf.radius * factor, half=sdf.half * factor)
    elif isinstance(sdf, BoxSdf):
        x, y, z = sdf.half
        sdf = BoxSdf((x * factor, y * factor, z * factor))
    elif isinstance(sdf, MeshSdf):
        sdf = MeshSdf(replace(sdf.mesh, vertices=sdf.mesh.vertices * factor))
    elif not isinstance(sdf, PlaneSdf):
        raise SdfsimError(f"{shape.name}: an SDF of type {type(sdf).__name__} cannot be scaled")
    return replace(
        shape,
        mesh=replace(shape.mesh, vertices=shape.mesh.vertices * factor),
        pieces=tuple(piece * factor for piece in shape.pieces),
        sdf=sdf,
        nodes=shape.nodes * factor,
        volume=shape.volume * factor**3,
        com=shape.com * factor,
        inertia=shape.inertia * factor**5,
    )


def with_sdf(shape: Shape, kind: SdfKind, *, resolution: int = DEFAULT_RESOLUTION) -> Shape:
    """The same shape with its distances taken from another source; mesh, nodes and mass properties stay.

    Args:
        shape: any but a plane; "grid" and "mesh" are made from its mesh, whatever its SDF was.
        kind: "mlp" (the shape as it is, which must have a network), "grid" (samples of the exact distance to the
            mesh, see `sample_grid`) or "mesh" (that distance itself).
        resolution: of a grid, samples along each side.

    Returns:
        Shape without a certificate, since nothing was fitted; its `source` notes the kind as `sdf`.

    Raises:
        SdfsimError: there is no network, the shape is a plane, or the grid has fewer than two samples a side.
    """
    if kind == "mlp":
        if not isinstance(shape.sdf, MlpSdf):
            raise SdfsimError(f"{shape.name}: the shape has no SDF network", "fit its mesh")
        return shape
    if isinstance(shape.sdf, PlaneSdf):
        raise SdfsimError(f"{shape.name}: a plane has no end, so no grid or mesh holds it")
    sdf, note = sdf_of_mesh(shape.mesh, kind, resolution)
    return replace(shape, sdf=sdf, certificate={}, source=shape.source | note)


def with_nodes(shape: Shape, grid: int) -> Shape:
    """The same shape with other surface nodes: those of a grid of `grid`^3 points, sampled from its SDF alone.

    The paper resamples a trained simulator's bodies like this (7^3 instead of the meshes' vertices). Nearer than a
    40th of the shape's size no two nodes are kept.

    Raises:
        SdfsimError: the SDF has no end, or no point of the grid reached its surface.
    """
    from sdfsim.shape.surface_nodes import sample_nodes

    nodes = sample_nodes(shape.sdf, grid=grid)
    # What was measured of the former nodes does not hold for these.
    certificate = {key: value for key, value in shape.certificate.items() if key != "coverage"}
    return replace(shape, nodes=nodes, certificate=certificate)


def sdf_of_mesh(
    mesh: Mesh,
    kind: Literal["grid", "mesh"],
    resolution: int,
    on_progress: Callable[[float, str], None] | None = None,
) -> tuple[Sdf, dict]:
    """A mesh's exact SDF or a grid of it, and what a shape's `source` says about it.

    Raises:
        SdfsimError: the mesh has no faces or no extent, or the grid fewer than two samples a side.
    """
    if kind == "mesh":
        return MeshSdf(mesh), {"sdf": "mesh"}
    oracle = MeshDistance(mesh)
    return sample_grid(oracle, oracle.bounds, resolution, on_progress), {"sdf": "grid", "resolution": resolution}


def analytic_shape(
    kind: Literal["plane", "sphere", "capsule", "cylinder", "box"],
    *,
    radius: float | None = None,
    height: float | None = None,
    size: Sequence[float] | np.ndarray | None = None,
    name: str | None = None,
) -> Shape:
    """A shape with an exact SDF, about the origin.

    Args:
        kind: "plane" (z = 0, +z outside, infinite), "sphere", "capsule", "cylinder" or "box".
        radius: of the sphere, capsule or cylinder, m.
        height: of the capsule, its caps included, or cylinder, both along z; m.
        size: (x, y, z) full extents of the box, m.
        name: by default the kind.

    Returns:
        Shape with exact mass properties (per unit density; those of the plane are 0), a mesh for display (of the
        plane: a 20 m square) and nodes: sphere 128 spread as a Fibonacci spiral, capsule and cylinder rings,
        box 8 corners and points along edges and on faces, plane none.

    Raises:
        SdfsimError: unknown kind, or a size that is missing or not positive.
    """
    from sdfsim.shape import primitives

    source = {"kind": kind}
    if kind == "plane":
        square = np.array([[-10, -10, 0], [10, -10, 0], [10, 10, 0], [-10, 10, 0]], dtype=np.float64)
        mesh = Mesh(square, np.array([[0, 1, 2], [0, 2, 3]]))
        return Shape(
            name or kind, mesh, PlaneSdf(), np.zeros((0, 3)), 0.0, np.zeros(3), np.zeros((3, 3)), source=source
        )
    if kind == "sphere":
        if radius is None:
            raise SdfsimError("a sphere needs a radius")
        sdf = SphereSdf(float(radius))
        volume = 4.0 / 3.0 * np.pi * sdf.radius**3
        inertia = 0.4 * volume * sdf.radius**2 * np.eye(3)
        mesh, nodes = primitives.sphere(sdf.radius), _sphere_nodes(sdf.radius, 128)
    elif kind == "box":
        if size is None or len(size) != 3:
            raise SdfsimError("a box needs its size along x, y and z")
        x, y, z = (0.5 * float(value) for value in size)
        sdf = BoxSdf((x, y, z))
        volume = 8.0 * x * y * z
        inertia = volume / 3.0 * np.diag([y * y + z * z, z * z + x * x, x * x + y * y])
        mesh, nodes = primitives.box((2 * x, 2 * y, 2 * z)), _box_nodes(np.array([x, y, z]))
    elif kind in ("capsule", "cylinder"):
        if radius is None or height is None:
            raise SdfsimError(f"a {kind} needs a radius and a height")
        caps = 2.0 * radius if kind == "capsule" else 0.0
        if not height > caps:
            raise SdfsimError(f"a capsule's height must be above twice its radius (got {height:g} and {radius:g})")
        half = 0.5 * (float(height) - caps)
        sdf = (CapsuleSdf if kind == "capsule" else CylinderSdf)(float(radius), half)
        volume, inertia = _round_mass(sdf.radius, half, caps=caps > 0)
        nodes = _round_nodes(sdf.radius, half, caps=caps > 0)
        mesh = convex_hull(_round_nodes(sdf.radius, half, caps=caps > 0, around=48))
    else:
        raise SdfsimError(f"unknown analytic shape {kind!r}", "use plane, sphere, capsule, cylinder or box")
    return Shape(name or kind, mesh, sdf, nodes, float(volume), np.zeros(3), inertia, source=source)


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


def _sphere_nodes(radius: float, count: int) -> np.ndarray:
    """Fibonacci spiral on the sphere: [count, 3] m."""
    number = np.arange(count) + 0.5
    height = 1.0 - 2.0 * number / count
    turn = np.pi * (1.0 + 5.0**0.5) * number
    ring = np.sqrt(1.0 - height**2)
    return radius * np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)


def _box_nodes(half: np.ndarray) -> np.ndarray:
    """Corners, edges and faces of a 5 x 5 x 5 lattice on the box: [98, 3] m, the corners first."""
    axis = np.linspace(-1.0, 1.0, 5)
    lattice = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    sides = (np.abs(lattice) == 1.0).sum(1)
    order = np.argsort(-sides, kind="stable")
    return (lattice * half)[order[sides[order] > 0]]
