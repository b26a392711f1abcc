"""The networks on surface nodes by name: SDF-Sim (*paper*) and the baselines of its paper. They differ in their graphs.

All graphs are of a state that carries its two earlier poses. Vertices, particles and body nodes of all have the
features of SDF-Sim's nodes, contact edges reach farther by what their ends close in during a step, and an infinite
floor is one node below whatever is near it. The papers of the baselines do otherwise, or do not say.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, device

from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.models.message_passing import EdgeKind, Edges, Features, Graph, Layout, both_ways
from sdfsim.dynamics.models.near import Contacts, Pairs, face_pairs, find_contacts, no_contacts, no_pairs, node_pairs
from sdfsim.dynamics.models.surfaces import INTRA, NODE, mesh_edges, motion_features, star
from sdfsim.dynamics.run_memory import Memory
from sdfsim.shape.mesh import Mesh, convex_hull, joined
from sdfsim.shape.sdf import PlaneSdf
from sdfsim.shape.shape import Shape

NODES = {"body": NODE, "node": NODE}
STAR = {"intra_up": EdgeKind("node", "body", INTRA), "intra_down": EdgeKind("body", "node", INTRA)}
MESH = EdgeKind("node", "node", INTRA)

# SDF-Sim as published (section 3 and appendix). Every body has one body node and its surface nodes, joined both ways
# (up: to the body node). A surface node within the contact radius of another body joins that body's node both ways. No
# surface node is ever joined to another.

CONTACT = Features(15, (0, 3, 6, 9))
PAPER = Layout(
    NODES,
    STAR | {"contact_up": EdgeKind("node", "body", CONTACT), "contact_down": EdgeKind("body", "node", CONTACT)},
)


def paper_graph(bodies: Bodies, state: State, contacts: Contacts) -> Graph:
    """The published graph."""
    features = _contact_features(bodies, state, contacts).float()
    node, body = contacts.node[:, None], contacts.body[:, None]
    edges = {"contact_up": Edges(features, node, body), "contact_down": Edges(features, body, node)}
    return Graph(motion_features(bodies, state), star(bodies, state) | edges)


def _contact_features(bodies: Bodies, state: State, contacts: Contacts) -> Tensor:
    """[E, 15]: node to closest point, normal, both seen from the other body's centre, distances. An infinite floor has
    no centre: its body node stands in for the closest point."""
    c = contacts
    to_closest = -c.distance[:, None] * c.normal
    bounded = bodies.size[c.body].isfinite()[:, None]
    seen = torch.where(bounded, c.seen, -to_closest)
    closest = seen + to_closest
    lengths = [c.distance, seen.norm(dim=-1), closest.norm(dim=-1)]
    return torch.cat([to_closest, c.normal, seen, closest, torch.stack(lengths, -1)], -1)


# MeshGraphNets (Pfaff et al., 2021, arXiv 2010.03409). Nodes are the vertices of meshes. Mesh edges join neighbours,
# world edges join vertices of different bodies within a radius: a small one in *mgn*, a large one in *mgn-large*. There
# are no body nodes; shape matching makes motions rigid.

WORLD = Features(4, (0,))
MGN = Layout({"node": NODE}, {"mesh": MESH, "world": EdgeKind("node", "node", WORLD)})


def mgn_graph(bodies: Bodies, state: State, pairs: Pairs) -> Graph:
    """Of MeshGraphNets."""
    nodes = {"node": motion_features(bodies, state)["node"]}
    return Graph(nodes, {"mesh": mesh_edges(bodies, state), "world": world_edges(pairs)})


def world_edges(pairs: Pairs) -> Edges:
    """Edges both ways between nodes of different bodies: from sender to receiver, and how far."""
    length = pairs.way.norm(dim=-1, keepdim=True)
    forth, back = torch.cat([pairs.way, length], -1), torch.cat([-pairs.way, length], -1)
    return both_ways(forth, back, pairs.first, pairs.second)


# DPI (Li et al., 2019, arXiv 1810.01566): particles, and one root for each body, joined both ways; particles of
# different bodies within a radius of each other too. Here particles lie on the surface (the paper's fill the body), and
# all kinds of edges pass messages at once in every step, with weights of that step (there one after the other, in every
# round with the same).

DPI = Layout(NODES, STAR | {"contact": EdgeKind("node", "node", WORLD)})


def dpi_graph(bodies: Bodies, state: State, pairs: Pairs) -> Graph:
    """Of DPI."""
    return Graph(motion_features(bodies, state), star(bodies, state) | {"contact": world_edges(pairs)})


# FIGNet (Allen et al., 2023, arXiv 2212.03574) and FIGNet* (Lopez-Guevara et al., 2024, arXiv 2401.11985). Nodes are
# the vertices of meshes and one node a body. Edges join neighbours on a mesh, vertices and their body's node, and the
# faces of two bodies that are near each other. A face edge knows the closest points of the two faces; its message has a
# part for each of the receiving face's three vertices, in the order of their distance to its closest point. FIGNet* is
# FIGNet without mesh edges.

FACE = Features(34, (0, 4, 7, 10, 16, 19, 22, 28, 31))
FIGNET_STAR = Layout(NODES, STAR | {"face": EdgeKind("node", "node", FACE, corners=3)})
FIGNET = Layout(NODES, FIGNET_STAR.edges | {"mesh": MESH})


def fignet_star_graph(bodies: Bodies, state: State, pairs: Pairs) -> Graph:
    """Of FIGNet*."""
    p = pairs
    forth = _features(p.way, p.from_first, p.from_second, p.normal_first, p.normal_second)
    back = _features(-p.way, p.from_second, p.from_first, p.normal_second, p.normal_first)
    face = {"face": both_ways(forth, back, p.first, p.second)}
    return Graph(motion_features(bodies, state), star(bodies, state) | face)


def fignet_graph(bodies: Bodies, state: State, pairs: Pairs) -> Graph:
    """Of FIGNet."""
    made = fignet_star_graph(bodies, state, pairs)
    return Graph(made.nodes, made.edges | {"mesh": mesh_edges(bodies, state)})


def _features(way: Tensor, sending: Tensor, receiving: Tensor, normal: Tensor, other: Tensor) -> Tensor:
    """[E, 34]: between the closest points, from these to the corners of both faces, with lengths; both normals."""
    corners = [part for face in (sending, receiving) for part in (face.flatten(1), face.norm(dim=-1))]
    return torch.cat([way, way.norm(dim=-1, keepdim=True), *corners, normal, other], -1)


# Which surface nodes a network works on: points of a shape, or the vertices of a mesh with faces between them.


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


@dataclass(frozen=True)
class Family:
    """What is a network's own beside its weights."""

    layout: Layout  # of its graphs
    # a shape, with the nodes (at most so many, None for all) that the network works on
    surface: Callable[[Shape, int | None], Shape]
    # what of the bodies is near what, for bodies, state, gravity, reach, time step and what the run remembers
    near: Callable[[Bodies, State, Tensor, float, float, Memory], Contacts | Pairs]
    none: Callable[[device], Contacts | Pairs]  # the same of bodies that are near nothing
    graph: Callable[[Bodies, State, Any], Graph]  # the graph of bodies, their state and what is near


_no_faces, _no_nodes = partial(no_pairs, corners=3), partial(no_pairs, corners=1)

FAMILIES = {
    "paper": Family(PAPER, points, find_contacts, no_contacts, paper_graph),
    "fignet": Family(FIGNET, vertices, face_pairs, _no_faces, fignet_graph),
    "fignet-star": Family(FIGNET_STAR, vertices, face_pairs, _no_faces, fignet_star_graph),
    "mgn": Family(MGN, vertices, node_pairs, _no_nodes, mgn_graph),
    "dpi": Family(DPI, particles, node_pairs, _no_nodes, dpi_graph),
}
