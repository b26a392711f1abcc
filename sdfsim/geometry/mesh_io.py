"""Reading mesh files of all kinds, and the files that we write: PLY, glTF with textures, convex pieces as OBJ."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sdfsim.base.errors import SdfsimError, nearest
from sdfsim.base.files import visible
from sdfsim.geometry.gltf import GltfWriter, read_gltf, read_painted
from sdfsim.geometry.mesh import Mesh, clean, convex_hull, far_middle, require_whole
from sdfsim.geometry.mesh_formats import (
    FileMesh,
    averaged,
    collada_surface,
    image_beside,
    looked_up,
    obj_surface,
    off_surface,
    ply_surface,
    read_ply,
    stl_surface,
)
from sdfsim.geometry.skins import Painted, one_skin, painted_mesh, plain_parts

MESH_SUFFIXES = (".obj", ".ply", ".glb", ".gltf", ".stl", ".off", ".dae")
GLTF = (".glb", ".gltf")
OTHERS: dict[str, str] = dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), "USD")
OTHERS |= {".fbx": "FBX", ".blend": "Blender's own format"}
OTHERS |= {".3ds": "3DS", ".abc": "Alembic", ".step": "STEP", ".stp": "STEP", ".3mf": "3MF"}


class Loaded(NamedTuple):
    """What a mesh file holds."""

    mesh: Mesh  # cleaned by `clean`; vertices get their colours from the texture
    skin: Mesh | None = None  # the same triangles with their texture, if they have one
    notes: tuple[str, ...] = ()  # what is lost on reading, one line each


def load_mesh(path: str | Path) -> Mesh:
    """Read a triangle mesh (obj, ply, glb, gltf, stl, off, dae), cleaned by `clean`; glTF and COLLADA are turned to z
    up. Raises SdfsimError if the file is missing, cut short or not a mesh, if it needs an unsupported extension, or if
    it has no faces, vertices that are not finite or indices out of range."""
    return load_textured(path).mesh


def load_textured(path: str | Path, *, upright: bool = True) -> Loaded:
    """As `load_mesh`, with the texture. Unless `upright`, a COLLADA file keeps its axes (see `collada_surface`)."""
    path = Path(path)
    suffix = path.suffix.lower()
    if not path.is_file():
        around = visible(path.parent) if path.parent.is_dir() else []
        near = nearest(path.name, [file.name for file in around if file.suffix.lower() in MESH_SUFFIXES])
        raise SdfsimError(f"{path}: no such mesh file{near}", f"sdfsim looked for it in {path.parent.resolve()}")
    if suffix not in MESH_SUFFIXES:
        kind = OTHERS.get(suffix)
        fault = f"{kind} is not supported" if kind else f"not a mesh file ({path.suffix or 'no suffix'})"
        how = "export glb from Blender; " if kind else ""
        raise SdfsimError(f"{path}: {fault}", f"{how}use " + " ".join(MESH_SUFFIXES))
    try:
        found = _read(path, suffix) if suffix != ".dae" else collada_surface(path, upright=upright)
        notes = list(dict.fromkeys(found.notes))
        colors, painted = _shown(found, notes)
        mesh = clean(Mesh(found.vertices, found.faces, colors), name=str(path))
        skin = one_skin([part for part in painted if part is not None]) if painted and None not in painted else None
        if painted and skin is None:
            notes.append("its texture becomes colours of its vertices")
        return Loaded(mesh, skin, tuple(notes))
    except SdfsimError:
        raise
    except Exception as error:  # readers raise errors of many types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise SdfsimError(f"{path}: not a readable mesh ({reason})") from error


def _read(path: Path, suffix: str) -> FileMesh:
    """The triangles of a file."""
    if suffix in GLTF:
        return read_gltf(path)
    content = path.read_bytes()
    if suffix == ".obj":
        return obj_surface(path, content)
    if suffix != ".ply":
        return (off_surface if suffix == ".off" else stl_surface)(content)
    found, notes = ply_surface(content), []
    image = image_beside(path, found.texture, notes) if found.texture else None
    if image is None or found.places is None:
        return found._replace(notes=(*found.notes, *notes))
    corners = np.concatenate([found.vertices[found.faces], found.places], axis=2).reshape(-1, 5)
    corners, label = np.unique(corners, axis=0, return_inverse=True)
    painted = (Painted(corners[:, :3], label.reshape(-1, 3), corners[:, 3:], image),)
    return found._replace(colors=looked_up(image, found.places), painted=painted)


def _shown(found: FileMesh, notes: list[str]) -> tuple[np.ndarray | None, tuple[Painted | None, ...]]:
    """Colours of the vertices [V, 3], and the parts that are shown with images; no parts if colours of vertices are
    enough. Where faces of several colours meet, as on a die, each colour becomes a part; or a note says that they
    mix."""
    colors = found.corner_colors()
    if colors is None or not len(found.faces):
        return None, found.painted
    _, label = np.unique(found.vertices, axis=0, return_inverse=True)
    corner, painted = label.reshape(-1)[found.faces], found.painted
    if not painted:
        pairs = np.unique((corner << 24) + colors @ np.array([1 << 16, 1 << 8, 1]))
        if (np.diff(pairs >> 24) == 0).any():
            painted = plain_parts(found.vertices, found.faces, colors)
        if None in painted:
            painted = ()
            notes.append("where its colours meet, they are mixed at the vertices")
    return averaged(colors, corner, len(found.vertices))[label.reshape(-1)], painted


def read_mesh(path: Path) -> Mesh:
    """The mesh of a shape folder as `write_ply` wrote it: not cleaned, not reordered. Raises SdfsimError if it is
    damaged."""
    with _reading(path):
        found = ply_surface(path.read_bytes())
        mesh = Mesh(found.vertices, found.faces, found.colors)
        require_whole(mesh)
    return mesh


def read_attributes(path: Path, names: Sequence[str]) -> list[np.ndarray]:
    """Properties of the vertices [V] of a PLY file that `write_ply` wrote, by their names. Raises SdfsimError if it
    is not readable or has no such property."""
    with _reading(path, f"damaged, or without {', '.join(names)}"):
        vertices = read_ply(path.read_bytes())[0]["vertex"]
        return [np.array(vertices[name]) for name in names]


def write_ply(mesh: Mesh, attributes: Mapping[str, np.ndarray] | None = None) -> bytes:
    """A mesh as binary PLY with vertices in double precision, so that it is read back to the last bit. `attributes` are
    more properties of the vertices by name, [V] int32 or float32; most programs ignore them."""
    columns = [(axis, "<f8", "double") for axis in "xyz"]
    values = list(mesh.vertices.T)
    if mesh.colors is not None:
        columns += [(channel, "u1", "uchar") for channel in ("red", "green", "blue")]
        values += list(mesh.colors.T)
    for name, column in (attributes or {}).items():
        columns.append((name, column.dtype.newbyteorder("<").str, {"i": "int", "f": "float"}[column.dtype.kind]))
        values.append(column)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    header += [f"property {kind} {name}" for name, _, kind in columns]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header", ""]
    vertices = np.empty(len(mesh.vertices), dtype=[(name, kind) for name, kind, _ in columns])
    for (name, _, _), column in zip(columns, values, strict=True):
        vertices[name] = column
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corner", "<i4", 3)])
    faces["count"], faces["corner"] = 3, mesh.faces
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()


def read_glb(path: Path) -> dict[str, Mesh]:
    """The meshes that `write_glb` wrote, z up, by their names. Raises SdfsimError if it is not readable."""
    with _reading(path):
        found = {name: painted_mesh(part) for name, part in read_painted(path).items()}
        for mesh in found.values():
            require_whole(mesh)
    return found


def write_glb(meshes: dict[str, Mesh]) -> bytes:
    """Meshes with textures as binary glTF: a node for each with its name, all below one that turns them to glTF's y up.

    Vertices become single precision, textures JPEG. Textures contain the light of the photos, so viewers should add no
    light.
    """
    file = GltfWriter()
    file.origin = far_middle(np.concatenate([mesh.vertices for mesh in meshes.values()]))
    for name, mesh in meshes.items():
        assert mesh.uv is not None and mesh.texture is not None
        places = {"POSITION": file.array(mesh.vertices - file.origin), "TEXCOORD_0": file.array(mesh.uv)}
        corners = file.array(mesh.faces.reshape(-1), "<u4")
        material = file.material(name, np.ones(3), mesh.texture, mesh.maps, lit=mesh.maps is not None)
        drawn = file.mesh(name, places, corners, material)
        file.nodes.append({"name": name, "mesh": drawn})
    return file.to_bytes()


def load_pieces(path: str | Path) -> list[Mesh]:
    """The convex pieces of a collision geometry in Wavefront OBJ: the convex hull of each `o` group's vertices. Raises
    SdfsimError if it cannot be read, has no pieces, or a piece is flat."""
    path = Path(path)
    if not path.is_file():
        raise SdfsimError(f"{path}: no such mesh file")
    groups: list[list[list[float]]] = [[]]
    with _reading(path, "not a readable OBJ file"):
        for line in path.read_text(encoding="utf-8").splitlines():
            key, _, rest = line.strip().partition(" ")
            if key == "o":
                groups.append([])
            elif key == "v":
                groups[-1].append([float(number) for number in rest.split()[:3]])
    if not any(groups):
        raise SdfsimError(f"{path}: no vertices, so no convex pieces")
    try:
        return [convex_hull(np.array(group)) for group in groups if group]
    except (SdfsimError, ValueError) as error:
        raise SdfsimError(f"{path}: {getattr(error, 'message', error)}") from error


def wavefront(pieces: list[Mesh]) -> str:
    """Wavefront OBJ with one `o` group a piece."""
    lines, before = [], 1
    for number, piece in enumerate(pieces):
        lines.append(f"o piece_{number}")
        lines += ["v {:.9g} {:.9g} {:.9g}".format(*vertex) for vertex in piece.vertices]
        lines += ["f {} {} {}".format(*(face + before)) for face in piece.faces]
        before += len(piece.vertices)
    return "\n".join(lines) + "\n"


@contextmanager
def _reading(path: Path, fault: str = "damaged or cut short") -> Iterator[None]:
    """Turn any error of a reader into an SdfsimError."""
    try:
        yield
    except Exception as error:
        raise SdfsimError(f"{path}: {fault} ({getattr(error, 'message', error)})") from error
