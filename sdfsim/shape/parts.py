"""Bodies of several parts: primitives and meshes in one frame. Some touch others, some are shown, most do both."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.mesh import Mesh, convex_hull, is_closed, joined, signed_volume
from sdfsim.geometry.skins import Painted, one_skin
from sdfsim.shape.make import analytic_shape, fit_pieces, mesh_shape
from sdfsim.shape.shape import Shape

CONVEX = 1e-3  # relative: how much less volume than its hull a convex mesh may have
GREY = (180, 180, 185)

PartKind = Literal["box", "sphere", "capsule", "cylinder", "cone", "torus", "plane", "mesh"]


@dataclass(frozen=True)
class Part:
    """A geometry of a body."""

    kind: PartKind
    pose: np.ndarray  # [4, 4] in the body
    sizes: dict[str, Any] = field(default_factory=dict)  # m, as scene.yaml has them: size, radius, height
    mesh: Mesh | None = None  # m, of the kind "mesh"
    where: str = ""  # file, line and element, for messages
    color: tuple[int, int, int] | None = None  # sRGB


def pose_of(place: Any = (0.0, 0.0, 0.0), turn: Any = None) -> np.ndarray:
    """[4, 4] of a place [3] and a rotation."""
    made = np.eye(4)
    made[:3, 3] = place
    if turn is not None:
        made[:3, :3] = turn.as_matrix()
    return made


def moved(mesh: Mesh, pose: np.ndarray) -> Mesh:
    """A mesh, transformed by `pose`."""
    return replace(mesh, vertices=mesh.vertices @ pose[:3, :3].T + pose[:3, 3])


def mesh_of(part: Part) -> Mesh:
    return moved(primitive_of(part, "").mesh if part.mesh is None else part.mesh, part.pose)


def primitive_of(part: Part, name: str) -> Shape:
    kind: Any = part.kind
    return analytic_shape(kind, name=name, **part.sizes)


def solid_of(parts: Sequence[Part], name: str) -> Shape:
    """The shape of several parts, or of a mesh. If all parts are convex, they are the pieces that collide. What is no
    solid becomes its convex hull, with a note in `source`. Raises SdfsimError for a flat mesh."""
    meshes, convex, notes = [], [], {}
    for part in parts:
        mesh = mesh_of(part)
        if part.mesh is None:
            meshes.append(mesh)
            convex.append(mesh)
            continue
        try:
            hull = convex_hull(mesh.vertices)
        except SdfsimError as error:
            raise SdfsimError(
                f"{part.where}: the mesh is flat, so it cannot be a body", "give it a thickness"
            ) from error
        closed = is_closed(mesh)
        if closed and abs(signed_volume(mesh)) >= (1.0 - CONVEX) * signed_volume(hull):
            convex.append(hull)
        meshes.append(mesh)
    if len(convex) == len(parts) > 1:
        return fit_pieces(convex, name=name, kind="grid")
    try:
        shape = mesh_shape(joined(meshes), name=name, kind="mesh")
    except SdfsimError as error:
        notes = {"notes": [f"its convex hull replaces it ({error.message})"]}
        hulls = [convex_hull(mesh.vertices) for mesh in meshes]
        shape = fit_pieces(hulls, name=name, kind="grid")
    source = {key: value for key, value in shape.source.items() if key != "notes"}
    return replace(shape, source=source | notes)


def skin_of(parts: Sequence[Part], frame: np.ndarray) -> Mesh | None:
    """What is shown of a body of these parts, with their colours and textures, in the axes `frame` [4, 4]; None if an
    image repeats too often."""
    return one_skin([_painted(part, np.linalg.inv(frame)) for part in parts])


def color_of(part: Part) -> tuple[int, ...] | None:
    """The colour of a part, or the mean of its mesh's."""
    if part.color or part.mesh is None or part.mesh.colors is None:
        return part.color
    return tuple(int(c) for c in part.mesh.colors.mean(0))


def textured(part: Part) -> bool:
    own = part.mesh
    return part.color is None and own is not None and own.uv is not None and own.texture is not None


def _painted(part: Part, back: np.ndarray) -> Painted:
    """A part with its colour, or with the texture of its mesh."""
    mesh, own = moved(mesh_of(part), back), part.mesh
    if own is not None and own.texture is not None and own.uv is not None and textured(part):
        return Painted(mesh.vertices, mesh.faces, own.uv, own.texture)
    color = np.array([[color_of(part) or GREY]], np.uint8)
    return Painted(mesh.vertices, mesh.faces, np.full((len(mesh.vertices), 2), 0.5), color)
