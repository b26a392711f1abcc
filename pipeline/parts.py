"""A surface -> what a scene is made of: the scenery that stays, and the bodies that can move."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.cameras import View
from pipeline.cleaning import components, face_normals, islands, keep_faces
from pipeline.objects import Body, Level, body_mesh, find_bodies, find_levels, without_bodies
from pipeline.surface import FLOATER, Surface
from pipeline.visibility import Caster, Visibility, look, spread_colors, to_bytes
from pipeline.volume import Distance
from sdfsim.shape.mesh import Mesh

# Thickness of the layer in which a field cannot tell a body from what it stands on, in cells of its finest grid.
LAYER = 1.5
# What rises less than this (normalised units, or this many cells of the finest grid) stays part of what it stands on.
SMALLEST, SMALLEST_CELLS = 0.04, 4.0
# Samples of a body are so much closer than the cells of the field's finest grid.
FINER = 3.0


@dataclass(frozen=True)
class Parts:
    """What a scene is made of, in normalised space.

    Attributes:
        solid: closed mesh of the scenery; None where there are bodies alone.
        shown: what is displayed of it: its visible surface, and the places where bodies stood; None like `solid`.
        bodies: closed mesh of each body by name, with colours; the largest first.
        smallest: what rises less than this above its plane stayed part of the scenery.
        levels: the level planes, largest first.
        crumbs: how many crumbs beside bodies went where these went.
    """

    solid: Mesh | None
    shown: Mesh | None
    bodies: dict[str, Mesh]
    smallest: float
    levels: list[Level]
    crumbs: int = 0


def split(surface: Surface, distance: Distance, finest: float, views: list[View], photos_folder: Path, up: np.ndarray,
          *, alone: bool) -> Parts:  # fmt: skip
    """Finds bodies and takes them out of the scenery.

    Args:
        surface: extracted.
        distance: signed distance of the field that it was extracted from.
        finest: width of a cell of the field's finest grid.
        views: cameras in normalised space.
        photos_folder: of the photos stage.
        up: [3] unit, in normalised space.
        alone: there is no scenery: all there is are bodies.
    """
    smallest = max(SMALLEST, SMALLEST_CELLS * finest)
    if alone:
        return Parts(None, None, whole_bodies(surface), smallest, [])
    levels = find_levels(surface.visible, up, finest)
    bodies = find_bodies(surface, levels, LAYER * finest, smallest)
    if not bodies:
        return Parts(surface.solid, surface.visible, {}, smallest, levels)
    blocking = Caster(surface.raw)
    meshes = {}
    for body in bodies:
        cell = min(finest / FINER, surface.volume.cell)
        mesh = body_mesh(body, distance, cell)
        # Lifted clear of the surface in the way, which is sampled more coarsely.
        found = look(Visibility(mesh, 0.75 * surface.volume.cell, blocking), views, photos_folder)
        meshes[body.name] = colored(mesh, found.color, found.weight > 0)
    solid, shown = scenery(surface, bodies, distance)
    return Parts(solid, shown, meshes, smallest, levels, sum(body.crumbs for body in bodies))


def whole_bodies(surface: Surface) -> dict[str, Mesh]:
    """Every connected component of the solid as a body, the largest first."""
    solid = surface.solid
    label = components(solid)
    order = np.argsort(-np.bincount(label, face_normals(solid)[1]))
    return {f"object{n}": keep_faces(solid, label == k) for n, k in enumerate(order, start=1)}


def colored(mesh: Mesh, color: np.ndarray, known: np.ndarray) -> Mesh:
    """The mesh with its colours [V, 3] in 0..255, those that are not known [V] bool taken from around them."""
    color = color.copy()
    if known.any() and not known.all():
        color[~known] = spread_colors(mesh.vertices[~known], mesh.vertices[known], color[known])
    return replace(mesh, colors=to_bytes(color))


def scenery(surface: Surface, bodies: list[Body], distance: Distance) -> tuple[Mesh, Mesh]:
    """The scenery's solid without bodies, and what is displayed of it."""
    from scipy.spatial import KDTree

    raw, mesh = surface.raw, without_bodies(surface.volume, bodies, distance).mesh()
    assert raw.colors is not None
    # Wherever nothing was cut, the vertices are those of the whole surface: from these they take what is known.
    away, nearest = KDTree(raw.vertices).query(mesh.vertices)
    same = away < 1e-6
    shown = same & _at_faces(raw, surface.shown)[nearest]
    color = raw.colors[nearest].astype(float)
    color[~same] = spread_colors(mesh.vertices[~same], mesh.vertices[shown], color[shown])
    mesh = replace(mesh, colors=to_bytes(color))
    # Components of which nothing was there before are pockets that the cut has left.
    label = components(mesh)
    belongs = (same & _at_faces(raw, surface.kept)[nearest])[mesh.faces].any(1)
    closed = (np.bincount(label, belongs) > 0)[label]
    displayed = islands(mesh, closed & (shown | ~same)[mesh.faces].all(1), FLOATER)
    return keep_faces(mesh, closed), keep_faces(mesh, displayed)


def _at_faces(mesh: Mesh, faces: np.ndarray) -> np.ndarray:
    """Vertices [V] bool that some faces [F] bool use."""
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces[faces]] = True
    return used
