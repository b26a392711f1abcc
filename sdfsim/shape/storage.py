"""The files of a shape folder: SDF parameters as tensors, the mesh as PLY, the record as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from sdfsim.errors import SdfsimError
from sdfsim.files import read_json, replacing
from sdfsim.shape.mesh import Frame, Mesh
from sdfsim.shape.mlp_sdf import ACTIVATIONS, MlpSdf
from sdfsim.shape.sdf import BoxSdf, CapsuleSdf, CylinderSdf, GridSdf, MeshSdf, PlaneSdf, Sdf, SphereSdf

FORMAT_VERSION = 1


def sdf_to_file(sdf: Sdf, mesh: Mesh) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Tensors and a description (for JSON) of an SDF.

    Args:
        sdf: what is to be written.
        mesh: what the folder's mesh.ply will hold; an exact SDF is that mesh and has nothing of its own to write.

    Raises:
        SdfsimError: an SDF of a kind that has no file format, or the exact SDF of another mesh.
    """
    if isinstance(sdf, MlpSdf):
        tensors = {}
        for layer, (weight, bias) in enumerate(zip(sdf.weights, sdf.biases, strict=True)):
            tensors[f"layer{layer}.weight"] = weight.cpu().contiguous()
            tensors[f"layer{layer}.bias"] = bias.cpu().contiguous()
        return tensors, {
            "kind": "mlp",
            "activation": sdf.activation,
            "mirrors": list(sdf.mirrors),
            "layers": len(sdf.weights),
            "centre": np.asarray(sdf.frame.centre).tolist(),
            "scale": float(sdf.frame.scale),
        }
    if isinstance(sdf, GridSdf):
        return {"grid": sdf.values.cpu().contiguous()}, {
            "kind": "grid",
            "resolution": sdf.resolution,
            "centre": np.asarray(sdf.frame.centre).tolist(),
            "scale": float(sdf.frame.scale),
        }
    if isinstance(sdf, MeshSdf):
        if not all(np.array_equal(getattr(sdf.mesh, key), getattr(mesh, key)) for key in ("vertices", "faces")):
            raise SdfsimError("an exact SDF of another mesh than the shape's own cannot be saved")
        return {}, {"kind": "mesh"}
    if isinstance(sdf, SphereSdf):
        return {}, {"kind": "sphere", "radius": sdf.radius}
    if isinstance(sdf, CapsuleSdf | CylinderSdf):
        kind = "capsule" if isinstance(sdf, CapsuleSdf) else "cylinder"
        return {}, {"kind": kind, "radius": sdf.radius, "half": sdf.half}
    if isinstance(sdf, BoxSdf):
        return {}, {"kind": "box", "half": list(sdf.half)}
    if isinstance(sdf, PlaneSdf):
        return {}, {"kind": "plane"}
    raise SdfsimError(f"an SDF of type {type(sdf).__name__} cannot be saved", "fit it first")


def sdf_from_file(description: dict[str, Any], tensors: dict[str, torch.Tensor], mesh: Mesh) -> Sdf:
    """The SDF that `sdf_to_file` described, beside the folder's `mesh`.

    Raises:
        KeyError, TypeError, ValueError: the description or the tensors are not what it writes.
    """
    kind = description["kind"]
    if kind in ("mlp", "grid") and not all(tensor.is_floating_point() for tensor in tensors.values()):
        raise ValueError("weights that are not floating-point numbers")
    if kind == "mlp":
        layers = range(int(description["layers"]))
        if description["activation"] not in ACTIVATIONS:
            raise ValueError(f"unknown activation {description['activation']!r}")
        weights = tuple(tensors[f"layer{layer}.weight"].float() for layer in layers)
        sizes = [3, *(weight.shape[0] for weight in weights)]
        if sizes[-1] != 1 or any(weight.shape[1] != size for weight, size in zip(weights, sizes, strict=False)):
            raise ValueError("the layers do not fit together")
        if any(tuple(tensors[f"layer{layer}.bias"].shape) != (sizes[layer + 1],) for layer in layers):
            raise ValueError("the layers do not fit together")
        x, y, z = (bool(mirror) for mirror in description.get("mirrors", (False, False, False)))
        return MlpSdf(
            weights,
            tuple(tensors[f"layer{layer}.bias"].float() for layer in layers),
            description["activation"],
            _frame(description),
            finite(tensors["bounds"].numpy(), "bounds", 2, 3),
            (x, y, z),
        )
    if kind == "grid":
        if tensors["grid"].ndim != 3 or len(set(tensors["grid"].shape)) != 1 or len(tensors["grid"]) < 2:
            raise ValueError(f"a grid of {list(tensors['grid'].shape)} samples")
        return GridSdf(tensors["grid"].float(), _frame(description), finite(tensors["bounds"].numpy(), "bounds", 2, 3))
    if kind == "mesh":
        return MeshSdf(mesh)
    if kind == "sphere":
        return SphereSdf(positive(description["radius"], "radius"))
    if kind in ("capsule", "cylinder"):
        make = CapsuleSdf if kind == "capsule" else CylinderSdf
        return make(positive(description["radius"], "radius"), positive(description["half"], "half"))
    if kind == "box":
        x, y, z = description["half"]
        return BoxSdf((positive(x, "half"), positive(y, "half"), positive(z, "half")))
    if kind == "plane":
        return PlaneSdf()
    raise ValueError(f"unknown SDF kind {kind!r}")


def _frame(description: dict[str, Any]) -> Frame:
    return Frame(finite(description["centre"], "centre", 3), positive(description["scale"], "scale"))


def finite(value: Any, what: str, *shape: int) -> np.ndarray:
    """Finite numbers [*shape] out of JSON. Raises TypeError or ValueError otherwise."""
    numbers = np.array(value, dtype=np.float64).reshape(shape)
    if not np.isfinite(numbers).all():
        raise ValueError(f"{what} is not finite")
    return numbers


def positive(value: Any, what: str) -> float:
    """A finite number above 0 out of JSON. Raises TypeError or ValueError otherwise."""
    number = float(finite(value, what))
    if number <= 0:
        raise ValueError(f"{what} must be > 0 (got {number:g})")
    return number


def read_record(path: Path) -> dict[str, Any]:
    """The content of a shape.json.

    Raises:
        SdfsimError: not readable, or of another format version.
    """
    record = read_json(path, "fit the mesh again")
    if not isinstance(record, dict) or record.get("version") != FORMAT_VERSION:
        found = record.get("version") if isinstance(record, dict) else None
        raise SdfsimError(
            f"{path}: shape format version {found!r}, this program reads {FORMAT_VERSION}", "fit the mesh again"
        )
    return record


def write(path: Path, content: bytes) -> None:
    """Put `content` at `path` in one step: what was there before, or all of it, even when interrupted.

    Raises:
        SdfsimError: the file cannot be written.
    """
    with replacing(path) as partial:
        partial.write_bytes(content)


def write_ply(mesh: Mesh) -> bytes:
    """A mesh as binary PLY, vertices in double precision: what is read back is what was written, to the last bit."""
    columns: list[tuple[str, str]] = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    header += [f"property double {axis}" for axis in "xyz"]
    if mesh.colors is not None:
        columns += [(channel, "u1") for channel in ("red", "green", "blue")]
        header += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header", ""]
    vertices = np.empty(len(mesh.vertices), dtype=columns)
    for column, axis in enumerate("xyz"):
        vertices[axis] = mesh.vertices[:, column]
    if mesh.colors is not None:
        for column, channel in enumerate(("red", "green", "blue")):
            vertices[channel] = mesh.colors[:, column]
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corner", "<i4", 3)])
    faces["count"], faces["corner"] = 3, mesh.faces
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()


def read_mesh(path: Path) -> Mesh:
    """The mesh of a shape folder as it was written: not cleaned, not reordered.

    Raises:
        SdfsimError: not readable.
    """
    import trimesh

    try:
        loaded: Any = trimesh.load(path, force="mesh", process=False)
        vertices = np.array(loaded.vertices, dtype=np.float64)
        faces = np.array(loaded.faces, dtype=np.int64).reshape(-1, 3)
        colors = None
        if loaded.visual.kind == "vertex":
            colors = np.array(loaded.visual.vertex_colors)[:, :3].astype(np.uint8)
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise ValueError("face indices out of range")
        if not np.isfinite(vertices).all():
            raise ValueError("vertices that are not finite")
    except Exception as error:  # the readers raise whatever their format made them stumble over
        raise SdfsimError(f"{path}: damaged or cut short ({error})") from error
    return Mesh(vertices, faces, colors)
