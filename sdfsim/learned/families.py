"""The networks on surface nodes by name: SDF-Sim (*sdf-sim*) and the baselines of its paper, which differ in their
graphs.

All graphs are made from a state with its two earlier poses. In all of them vertices, particles and body nodes have the
features of SDF-Sim's nodes, contact edges reach farther by the distance that their ends close in a step, and an
infinite floor is one node below whatever is near it. The papers of the baselines differ in this, or do not say.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from torch import device

from sdfsim.geometry.mesh import Mesh, convex_hull, joined
from sdfsim.learned import graphs
from sdfsim.learned.message_passing import Layout, MultiGraph
from sdfsim.learned.near import Contacts, Pairs, face_pairs, find_contacts, no_contacts, no_pairs, node_pairs
from sdfsim.learned.tensors import BodyTensors, StateTensors
from sdfsim.physics.solver.prepare import Compiled
from sdfsim.sdf.closed_forms import PlaneSdf
from sdfsim.shape.shape import Shape


def points(shape: Shape, count: int | None) -> Shape:
    """The shape with the first `count` of its nodes (None: all): the outermost ones, then the most evenly spread."""
    return replace(shape, nodes=shape.nodes[:count])


def particles(shape: Shape, count: int | None) -> Shape:
    """As `points`; an infinite plane gets one node, so that edges have an end there."""
    return replace(points(shape, count), nodes=np.zeros((1, 3))) if _endless(shape) else points(shape, count)


def vertices(shape: Shape, count: int | None) -> Shape:
    """The shape with the vertices of a mesh as nodes, at most about `count`; an infinite plane gets one node and one
    face.

    If the shape is made of convex pieces with at most `count` vertices, the mesh is that of their hulls: this is what
    PyBullet collides, and has as many vertices as the published graphs (their sizes fit 440 per body). Otherwise it is
    the shown mesh, reduced by quadric error to 2 `count` - 4 faces, as for example 76 hulls cannot have a mesh of 64
    vertices. The reduced mesh lacks what the reduction cuts off (up to 5 cm of the shapes of MOVi-B at 64).
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
    """The mesh with doubled vertices merged, and at most about `count` vertices."""
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


@dataclass(frozen=True)
class Family:
    """Everything that is specific to one network, except its weights."""

    layout: Layout  # layout of its graphs
    # the shape with the nodes that the network uses (at most the given number, None for all)
    surface: Callable[[Shape, int | None], Shape]
    # finds the near parts of bodies, from bodies, state, gravity, reach, time step and the compiled scene of a run
    near: Callable[[BodyTensors, StateTensors, np.ndarray, float, float, Compiled | None], Contacts | Pairs]
    none: Callable[[device], Contacts | Pairs]  # the same for bodies that are near nothing
    graph: Callable[[BodyTensors, StateTensors, Any], MultiGraph]  # the graph of bodies, their state and near parts
    distances: bool = False  # whether `near` uses the compiled distances of a scene


_no_faces, _no_nodes = partial(no_pairs, corners=3), partial(no_pairs, corners=1)

FAMILIES = {
    "sdf-sim": Family(graphs.SDF_SIM, points, find_contacts, no_contacts, graphs.sdf_sim_graph, distances=True),
    "fignet": Family(graphs.FIGNET, vertices, face_pairs, _no_faces, graphs.fignet_graph),
    "fignet-star": Family(graphs.FIGNET_STAR, vertices, face_pairs, _no_faces, graphs.fignet_star_graph),
    "mgn": Family(graphs.MGN, vertices, node_pairs, _no_nodes, graphs.mgn_graph),
    "dpi": Family(graphs.DPI, particles, node_pairs, _no_nodes, graphs.dpi_graph),
}
