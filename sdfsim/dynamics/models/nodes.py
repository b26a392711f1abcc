"""Which surface nodes a network works on: points of a shape, or the vertices of a mesh with faces between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sdfsim.shape.mesh import Mesh, convex_hull, joined
from sdfsim.shape.sdf import PlaneSdf
from sdfsim.shape.shape import Shape


def points(shape: Shape, count: int | None) -> Shape:
    """The shape with the first `count` of its nodes (None: all): those that reach farthest, then the most spread."""
    return replace(shape, nodes=shape.nodes[:count])


def particles(shape: Shape, count: int | None) -> Shape:
    """As `points`; an infinite plane is one node, so that edges have an end there."""
    return replace(points(shape, count), nodes=np.zeros((1, 3))) if _endless(shape) else points(shape, count)


def vertices(shape: Shape, count: int | None) -> Shape:
    """The shape with the vertices of a mesh as nodes, about `count` at most; an infinite plane is one node and one
    face.

    The mesh is that of the hulls of the convex pieces, where a shape was made of such and they have no more vertices
    than wanted: what the teacher collides, and as many vertices as the published graphs have (their sizes fit 440 a
    body). Else it is the shown mesh, reduced by quadric error to 2 `count` - 4 faces: 76 hulls have no mesh of 64
    vertices, and what the reduction takes off a body (up to 5 cm of the shapes of MOVi-B at 64) its mesh lacks.
    """
    if _endless(shape):
        return replace(shape, nodes=np.zeros((1, 3)), faces=np.zeros((1, 3), dtype=np.int64))
    hulls = [convex_hull(piece) for piece in shape.pieces]
    if hulls and (count is None or sum(len(hull.vertices) for hull in hulls) <= count):
        mesh = joined(hulls)
    else:
        mesh = _reduced(shape.mesh, count)
    return replace(shape, nodes=mesh.vertices, faces=mesh.faces)


def _reduced(mesh: Mesh, count: int | None) -> Mesh:
    """The mesh with doubled vertices joined and at most `count` of them, about."""
    import open3d as o3d

    given = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.faces.astype(np.int32))
    ).remove_duplicated_vertices()
    if count is not None and len(given.vertices) > count:
        given = given.simplify_quadric_decimation(2 * count - 4)
    given = given.remove_degenerate_triangles().remove_unreferenced_vertices()
    return Mesh(np.asarray(given.vertices), np.asarray(given.triangles).astype(np.int64))


def _endless(shape: Shape) -> bool:
    return isinstance(shape.sdf, PlaneSdf)
