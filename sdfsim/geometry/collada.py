"""COLLADA files (.dae), in which most robots have their looks: triangles in metres with flat colours."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.geometry.mesh_formats import FileMesh

WHITE = (255, 255, 255)
# The axes of a file that become x, y and z, by its `up_axis`: right, in, with the sign turned, and up.
UPRIGHT = {"X_UP": ((1, 2, 0), (-1, -1, 1)), "Y_UP": ((0, 2, 1), (1, -1, 1)), "Z_UP": ((0, 1, 2), (1, 1, 1))}


def collada_surface(path: Path, *, upright: bool) -> FileMesh:
    """The triangles of all instances in the file's scene, in metres, with z up. Unless `upright`, its axes are taken as
    they are, whatever `up_axis` says: robot files rely on that, as RViz, MoveIt and Gazebo do it. Raises ValueError if
    there are none, and the errors of the reader if it is damaged."""
    collada: Any = importlib.import_module("collada")  # few need it
    file = collada.Collada(str(path), ignore=[collada.common.DaeUnsupportedError, collada.common.DaeBrokenRefError])
    vertices, faces, colors, first, textured = [], [], [], 0, False
    for instance in file.scene.objects("geometry") if file.scene is not None else ():
        mirrored = np.linalg.det(instance.matrix[:3, :3]) < 0.0
        for part in instance.primitives():
            if not isinstance(part, collada.triangleset.BoundTriangleSet):
                if not hasattr(part, "triangleset"):  # lines
                    continue
                part = part.triangleset()
            if part.vertex is None or not len(part.vertex_index):
                continue
            vertices.append(part.vertex)
            corners = np.asarray(part.vertex_index, np.int64) + first
            faces.append(corners[:, ::-1] if mirrored else corners)
            color = _color(part.material)
            textured |= color is None
            colors.append(np.broadcast_to(np.array(color or WHITE, np.uint8), (len(corners), 3, 3)))
            first += len(part.vertex)
    if not faces:
        raise ValueError("it has no triangles in its scene")
    notes = ["its textures are left out"] if textured else []
    up = file.assetInfo.upaxis or "Y_UP"
    if up != "Z_UP":
        notes.append(f"its up axis, {up[0].lower()}, is {'turned to z' if upright else 'taken as z, as in RViz'}")
    unit = float(file.assetInfo.unitmeter or 1.0)
    order, signs = UPRIGHT[up if upright else "Z_UP"]
    whole = unit * np.concatenate(vertices).astype(np.float64)[:, order] * signs
    return FileMesh(whole, np.concatenate(faces), np.concatenate(colors), notes=tuple(notes))


def _color(material: Any) -> tuple[int, int, int] | None:
    """sRGB of a material; None if it has an image."""
    diffuse = getattr(getattr(material, "effect", None), "diffuse", None)
    if diffuse is None:
        return WHITE
    if not isinstance(diffuse, tuple):
        return None
    red, green, blue = (round(255 * float(channel)) for channel in np.clip(diffuse[:3], 0.0, 1.0))
    return red, green, blue
