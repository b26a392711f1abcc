"""Reading mesh files of all kinds, and the files that we write: PLY, glTF with textures, convex pieces as OBJ."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sdfsim.base.errors import SdfsimError, nearest
from sdfsim.base.files import visible
from sdfsim.geometry.gltf import GltfWriter, read_gltf, read_painted
from sdfsim.geometry.mesh import Mesh, clean, convex_hull, require_whole
from sdfsim.geometry.mesh_formats import (
    TEXTURES,
    averaged,
    by_trimesh,
    looked_up,
    off_surface,
    plain_obj,
    plain_stl,
    ply_surface,
    read_image,
    read_ply,
    scene_by_trimesh,
    side_file,
)
from sdfsim.geometry.skins import Painted, one_skin

# trimesh logs what it skips, sometimes with tracebacks. Callers may add a handler to see these lines.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

MESH_SUFFIXES = (".obj", ".ply", ".glb", ".gltf", ".stl", ".off")
GLTF = (".glb", ".gltf")
OTHERS: dict[str, str] = dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), "USD")
OTHERS |= {".fbx": "FBX", ".blend": "Blender's own format"}
OTHERS |= {".dae": "COLLADA", ".3ds": "3DS", ".abc": "Alembic", ".step": "STEP", ".stp": "STEP", ".3mf": "3MF"}


class Loaded(NamedTuple):
    """What a mesh file holds."""

    mesh: Mesh  # cleaned by `clean`; vertices get their colours from the texture
    skin: Mesh | None = None  # the same triangles with their texture, if they have one
    notes: tuple[str, ...] = ()  # what is lost on reading, one line each


def load_mesh(path: str | Path) -> Mesh:
    """Read a triangle mesh (obj, ply, glb, gltf, stl, off), cleaned by `clean`; glTF has y up and is turned to z up.
    Raises SdfsimError if the file is missing, cut short or not a mesh, if it needs an unsupported extension, or if it
    has no faces, vertices that are not finite or indices out of range."""
    return load_textured(path).mesh


def load_textured(path: str | Path) -> Loaded:
    """As `load_mesh`, with the texture."""
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
        mesh, painted = _read(path, suffix)
        mesh = clean(mesh, name=str(path))
        if not painted:
            return Loaded(mesh)
        skin = None if None in painted else one_skin([part for part in painted if part is not None])
        return Loaded(mesh, skin, () if skin is not None else ("its texture becomes colours of its vertices",))
    except SdfsimError:
        raise
    except Exception as error:  # readers raise errors of many types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise SdfsimError(f"{path}: not a readable mesh ({reason})") from error


def _read(path: Path, suffix: str) -> tuple[Mesh, tuple[Painted | None, ...]]:
    """The triangles of a file, and its parts with their images; no parts if there are no images."""
    if suffix in GLTF:
        found = read_gltf(path)
    elif suffix == ".ply":
        found = ply_surface(path.read_bytes())
    elif suffix == ".off":
        found = off_surface(path.read_bytes())
    else:
        plain = (plain_obj if suffix == ".obj" else plain_stl)(path.read_bytes())
        loaded = by_trimesh(path, plain)
        vertices = np.array(loaded.vertices, dtype=np.float64).reshape(-1, 3)
        mesh = Mesh(vertices, _faces(loaded), _vertex_colors(loaded, len(vertices)))
        return mesh, _painted(path, plain) if suffix == ".obj" and b"mtllib" in plain else ()
    colors, painted = found.colors, found.painted
    if found.places is not None:
        try:
            image = read_image(side_file(path, found.texture))
        except ValueError:
            image = None
        if image is not None:
            colors = averaged(looked_up(image, found.places), found.faces, len(found.vertices))
            corners = np.concatenate([found.vertices[found.faces], found.places], axis=2).reshape(-1, 5)
            corners, label = np.unique(corners, axis=0, return_inverse=True)
            painted = (Painted(corners[:, :3], label.reshape(-1, 3), corners[:, 3:], image),)
    return Mesh(found.vertices, found.faces, colors), painted


def _painted(path: Path, content: bytes) -> tuple[Painted, ...]:
    """The parts of an OBJ file by their materials; none if no material has an image."""
    parts, textured = [], False
    for drawn in scene_by_trimesh(path, content).geometry.values():
        faces = _faces(drawn)
        if not len(faces):
            continue
        vertices, visual = np.array(drawn.vertices, dtype=np.float64), drawn.visual
        uv, image = np.zeros((len(vertices), 2)), np.full((1, 1, 3), 255, np.uint8)
        if getattr(visual, "kind", None) == "texture":
            picture = _picture(visual)
            if picture is not None:
                # trimesh counts from the lower edge of a texture.
                uv, image = np.asarray(visual.uv) * [1.0, -1.0] + [0.0, 1.0], np.asarray(picture.convert("RGB"))
                textured = True
            else:
                image[:] = np.asarray(visual.material.main_color)[:3]
        parts.append(Painted(vertices, faces, uv, image))
    return tuple(parts) if textured else ()


def _picture(visual: Any) -> Any:
    """The image of a trimesh material, None if it has no readable one."""
    image = getattr(visual.material, "image", None) or getattr(visual.material, "baseColorTexture", None)
    return None if image is None or image.format not in TEXTURES or visual.uv is None else image


def _faces(loaded: Any) -> np.ndarray:
    return np.array(getattr(loaded, "faces", []), dtype=np.int64).reshape(-1, 3)


def _vertex_colors(loaded: Any, count: int) -> np.ndarray | None:
    """[V, 3] uint8 if the file has colours; from a texture, its colour at each vertex."""
    visual: Any = getattr(loaded, "visual", None)
    if getattr(visual, "kind", None) == "texture":
        if _picture(visual) is None:
            return None
        visual = visual.to_color()
    elif getattr(visual, "kind", None) not in ("vertex", "face"):
        return None
    colors = np.asarray(visual.vertex_colors)
    return colors[:, :3].astype(np.uint8) if colors.shape[:1] == (count,) else None


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
        found = {
            name: Mesh(part.vertices, part.faces, None, part.uv, part.image)
            for name, part in read_painted(path).items()
        }
        for mesh in found.values():
            require_whole(mesh)
    return found


def write_glb(meshes: dict[str, Mesh]) -> bytes:
    """Meshes with textures as binary glTF: a node for each with its name, all below one that turns them to glTF's y up.

    Vertices become single precision, textures JPEG. Textures contain the light of the photos, so viewers should add no
    light.
    """
    file = GltfWriter()
    for name, mesh in meshes.items():
        assert mesh.uv is not None and mesh.texture is not None
        places = {"POSITION": file.array(mesh.vertices), "TEXCOORD_0": file.array(mesh.uv)}
        corners = file.array(mesh.faces.reshape(-1), "<u4")
        drawn = file.mesh(name, places, corners, file.material(name, np.ones(3), mesh.texture))
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
