"""A `Shape` (geometry, SDF, surface nodes, mass properties), and the folder that stores it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_json, write_bytes, write_json
from sdfsim.base.parallel import Progress, silent
from sdfsim.geometry import primitives
from sdfsim.geometry.mass import mass_properties_of_sdf
from sdfsim.geometry.mesh import Frame, Mesh, convex_hull
from sdfsim.geometry.mesh_io import read_glb, read_mesh, write_glb, write_ply
from sdfsim.sdf.closed_forms import CLOSED_FORMS, ClosedForm, PlaneSdf
from sdfsim.sdf.fit.certificate import certify_grid
from sdfsim.sdf.grid import GridSdf, sample_grid
from sdfsim.sdf.mesh_sdf import MeshSdf
from sdfsim.sdf.mlp import MlpSdf
from sdfsim.sdf.reference import MeshDistance
from sdfsim.sdf.sdf import Sdf
from sdfsim.shape.contact_geometry import ContactGeometry
from sdfsim.shape.surface_nodes import sample_nodes

if TYPE_CHECKING:
    import torch
else:
    from sdfsim.base.lazy import torch

SdfKind = Literal["mlp", "grid", "mesh"]

FORMAT_VERSION = 1
# Samples along each side of a grid: its cells are then 0.022 of the solid's largest extent.
DEFAULT_RESOLUTION = 64
FINEST_GRID = 512  # samples along the longest side, at most
WEIGHTS_FILE, MESH_FILE, RECORD_FILE = "shape.safetensors", "mesh.ply", "shape.json"
SKIN_FILE = "textured.glb"  # only for shapes with a texture


@dataclass(frozen=True)
class Shape:
    """One rigid shape in its own frame, metres, at scale 1.

    Attributes:
        name: its name in messages and in the viewer.
        mesh: the mesh that is shown, and from which the SDF was made (for convex pieces the SDF is that of their
            union).
        sdf: signed distance in the same frame.
        nodes: [K, 3] float64 m, surface nodes that carry contact (empty for a plane).
        volume: m^3.
        com: [3] float64 m, centre of mass.
        inertia: [3, 3] float64 kg m^2 per unit density, about `com`, shape axes.
        certificate: errors measured on held-out points (empty if the distance is exact).
        source: where it came from, and a hash of its content.
        pieces: the vertices [V, 3] float64 m of each of its convex pieces, if it was made of pieces.
        skin: a mesh with a texture that is shown in place of `mesh`, or None.
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

    @property
    def shown(self) -> Mesh:
        """The mesh to draw."""
        return self.mesh if self.skin is None else self.skin

    @cached_property
    def contact(self) -> ContactGeometry:
        """The geometry that contacts need of it."""
        return ContactGeometry(self.sdf, self.nodes, self.pieces, self.mesh)

    def save(self, folder: str | Path) -> Path:
        """Write the shape folder and return it. Each file appears complete or not at all, and shape.json last, after
        the files that it describes. Raises SdfsimError if the folder cannot be written, if this kind of SDF has no file
        format, or if it is the exact SDF of another mesh."""
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
    """Read a folder written by `Shape.save` (or by `fit` or `reconstruct`). Raises SdfsimError if a file is missing,
    cut short, of another version, or has invalid content."""
    from safetensors import SafetensorError
    from safetensors.torch import load as from_bytes

    folder = Path(folder)
    if not folder.is_dir():
        raise SdfsimError(f"{folder}: no such shape folder")
    for name in (RECORD_FILE, WEIGHTS_FILE, MESH_FILE):
        if not (folder / name).is_file():
            raise SdfsimError(f"{folder}: {name} is missing, so this is not a complete shape folder")
    record = read_json(folder / RECORD_FILE, "fit the mesh again")
    version = record.get("version") if isinstance(record, dict) else None
    if version != FORMAT_VERSION:
        fault = f"shape format version {version!r}, this program reads {FORMAT_VERSION}"
        raise SdfsimError(f"{folder / RECORD_FILE}: {fault}", "fit the mesh again")
    try:
        tensors = from_bytes((folder / WEIGHTS_FILE).read_bytes())
    except (SafetensorError, OSError) as error:
        raise SdfsimError(f"{folder / WEIGHTS_FILE}: damaged or cut short ({error})") from error
    mesh = read_mesh(folder / MESH_FILE)
    skins = read_glb(folder / SKIN_FILE) if (folder / SKIN_FILE).is_file() else {}
    try:
        for name, tensor in tensors.items():
            if name != "bounds":  # a plane has infinite bounds
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
    """Tensors and a description (for JSON) of an SDF; the exact SDF of `mesh` needs no tensors."""
    if isinstance(sdf, MlpSdf | GridSdf):
        frame = {"centre": np.asarray(sdf.frame.centre).tolist(), "scale": float(sdf.frame.scale)}
        if isinstance(sdf, GridSdf):
            return {"grid": sdf.values.cpu().contiguous()}, {"kind": "grid", "resolution": sdf.resolution, **frame}
        tensors = {}
        for layer, (weight, bias) in enumerate(zip(sdf.weights, sdf.biases, strict=True)):
            tensors[f"layer{layer}.weight"] = weight.cpu().contiguous()
            tensors[f"layer{layer}.bias"] = bias.cpu().contiguous()
        described = {"kind": "mlp", "activation": "wave", "mirrors": list(sdf.mirrors)}
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
    if kind != "mlp" or description["activation"] != "wave":
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
    return MlpSdf(weights, biases, frame, bounds, (x, y, z))


def _finite(value: Any, what: str, *shape: int) -> np.ndarray:
    """Finite numbers [*shape] from JSON. Raises TypeError or ValueError otherwise."""
    numbers = np.array(value, dtype=np.float64).reshape(shape)
    if not np.isfinite(numbers).all():
        raise ValueError(f"{what} is not finite")
    return numbers


def scaled(shape: Shape, factor: float) -> Shape:
    """The same shape `factor` times as large, about its own origin. Raises SdfsimError if the factor is not positive
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


def centred(shape: Shape) -> Shape:
    """The same shape with its origin at its centre of mass. Raises SdfsimError for a closed form whose mass lies
    elsewhere."""
    away = -shape.com
    if not np.any(away):
        return shape
    if isinstance(shape.sdf, ClosedForm):
        raise SdfsimError(f"{shape.name}: a {shape.sdf.KIND} is about its origin, wherever its mass is")

    def moved(mesh: Mesh) -> Mesh:
        return replace(mesh, vertices=mesh.vertices + away)

    sdf, mesh = shape.sdf, moved(shape.mesh)
    if isinstance(sdf, MlpSdf | GridSdf):
        sdf = replace(sdf, frame=replace(sdf.frame, centre=sdf.frame.centre + away), bounds=sdf.bounds + away)
    else:
        assert isinstance(sdf, MeshSdf)
        sdf = MeshSdf(mesh if sdf.mesh is shape.mesh else moved(sdf.mesh))
    return replace(
        shape, mesh=mesh, skin=shape.skin and moved(shape.skin), sdf=sdf, nodes=shape.nodes + away,
        pieces=tuple(piece + away for piece in shape.pieces), com=np.zeros(3),
    )  # fmt: skip


def own_pieces(shape: Shape) -> list[Mesh]:
    """Convex pieces [m] that a shape has, or that its primitive has; empty if there are none."""
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
    `source["sdf"]` is the kind. Raises SdfsimError if there is no network, for a plane, or for fewer than two samples a
    side.
    """
    if kind == "mlp":
        if not isinstance(shape.sdf, MlpSdf):
            raise SdfsimError(f"{shape.name}: the shape has no SDF network", "fit its mesh")
        return shape
    if isinstance(shape.sdf, PlaneSdf):
        raise SdfsimError(f"{shape.name}: a plane is infinite, so no grid or mesh can hold it")
    sdf, note, certificate = sdf_of_mesh(shape.mesh, kind, resolution)
    return replace(shape, sdf=sdf, certificate=certificate, source=shape.source | note)


def sdf_of_mesh(
    mesh: Mesh, kind: Literal["grid", "mesh"], resolution: int, on_progress: Progress = silent, coarse: int = 1
) -> tuple[Sdf, dict, dict]:
    """A mesh's exact SDF or a grid of it (see `sample_grid`), its entries for a shape's `source`, and its
    certificate."""
    if kind == "mesh":
        return MeshSdf(mesh), {"sdf": "mesh"}, {}
    oracle = MeshDistance(mesh)
    grid = sample_grid(oracle, oracle.bounds, resolution, on_progress, coarse)
    return grid, {"sdf": "grid", "resolution": resolution}, certify_grid(grid, oracle)


def with_nodes(shape: Shape, grid: int) -> Shape:
    """The same shape with the surface nodes of a grid of `grid`^3 points, sampled from its SDF alone, as the paper
    resamples a trained simulator's bodies. Raises as `sample_nodes` does."""
    # Measurements of the former nodes do not hold for these.
    certificate = {key: value for key, value in shape.certificate.items() if key != "coverage"}
    return replace(shape, nodes=sample_nodes(shape.sdf, grid=grid), certificate=certificate)


def with_wall(shape: Shape, wall: float) -> Shape:
    """The same shape, but hollow: only the layer within `wall` m of its surface has mass.

    Volume, centre of mass and inertia are computed from the SDF on a grid. If the SDF is exact and the wall is at least
    1/100 of the shape's longest side, the volume is within 1 % and the inertia within 4 %. Raises SdfsimError for a
    plane.
    """
    volume, com, inertia = mass_properties_of_sdf(shape.sdf, shape.sdf.bounds, wall=wall)
    return replace(shape, volume=volume, com=com, inertia=inertia, source=shape.source | {"wall": wall})
