"""The graphs of networks on surface nodes: SDF-Sim's, and those of the networks in its paper's comparison.

**SDF-Sim** as published (section 3 and appendix): every body has one body node and its surface nodes, joined both ways
(up: to the body node). A surface node within the contact radius of another body is joined to that body's node both
ways. Surface nodes are never joined to each other.

**FIGNet** (Allen et al., 2023, arXiv 2212.03574) and **FIGNet*** (Lopez-Guevara et al., 2024, arXiv 2401.11985): nodes
are the vertices of meshes and one node a body. Edges join neighbours on a mesh, vertices and their body's node, and the
faces of two bodies that are near each other. The features of a face edge include the closest points of the two faces;
its message has a part for each of the receiving face's three vertices, in the order of their distance to its closest
point. FIGNet* is FIGNet without mesh edges.

**MeshGraphNets** (Pfaff et al., 2021, arXiv 2010.03409) for rigid bodies, as SDF-Sim's paper compares it: mesh edges
join neighbours, world edges join vertices of different bodies within a radius, a small one in *mgn*, a large one in
*mgn-large*. There are no body nodes; shape matching makes motions rigid.

**DPI** (Li et al., 2019, arXiv 1810.01566) for rigid bodies: particles are joined to their body's root both ways, and
to particles of different bodies within a radius. Here they lie on the surface (in the paper they fill the body), and in
every step all kinds of edges pass messages at once, with weights of that step (in the paper one after the other, with
the same weights in every round).

`families.py` lists other differences from the networks' own papers.
"""

import torch
from torch import Tensor

from sdfsim.learned.message_passing import EdgeKind, EdgeSet, Features, Layout, MultiGraph, both_ways
from sdfsim.learned.near import Contacts, Pairs
from sdfsim.learned.surfaces import MESH, NODE, NODES, STAR, mesh_edges, motion_features, star
from sdfsim.learned.tensors import BodyTensors, StateTensors

CONTACT = Features(15, (0, 3, 6, 9))
SDF_SIM = Layout(
    NODES,
    STAR | {"contact_up": EdgeKind("node", "body", CONTACT), "contact_down": EdgeKind("body", "node", CONTACT)},
)
FACE = Features(34, (0, 4, 7, 10, 16, 19, 22, 28, 31))
FIGNET_STAR = Layout(NODES, STAR | {"face": EdgeKind("node", "node", FACE, corners=3)})
FIGNET = Layout(NODES, FIGNET_STAR.edges | {"mesh": MESH})
WORLD = Features(4, (0,))
MGN = Layout({"node": NODE}, {"mesh": MESH, "world": EdgeKind("node", "node", WORLD)})
DPI = Layout(NODES, STAR | {"contact": EdgeKind("node", "node", WORLD)})


def sdf_sim_graph(bodies: BodyTensors, state: StateTensors, contacts: Contacts) -> MultiGraph:
    features = _contact_features(bodies, state, contacts).float()
    node, body = contacts.node[:, None], contacts.body[:, None]
    edges = {"contact_up": EdgeSet(features, node, body), "contact_down": EdgeSet(features, body, node)}
    return MultiGraph(motion_features(bodies, state), star(bodies, state) | edges)


def _contact_features(bodies: BodyTensors, state: StateTensors, contacts: Contacts) -> Tensor:
    """[E, 15]: node to closest point, normal, both relative to the other body's centre, and distances. An infinite
    floor has no centre: the closest point takes its place."""
    c = contacts
    to_closest = -c.distance[:, None] * c.normal
    bounded = bodies.size[c.body].isfinite()[:, None]
    seen = torch.where(bounded, c.seen, -to_closest)
    closest = seen + to_closest
    lengths = [c.distance, seen.norm(dim=-1), closest.norm(dim=-1)]
    return torch.cat([to_closest, c.normal, seen, closest, torch.stack(lengths, -1)], -1)


def fignet_star_graph(bodies: BodyTensors, state: StateTensors, pairs: Pairs) -> MultiGraph:
    p = pairs
    forth = _face_features(p.way, p.from_first, p.from_second, p.normal_first, p.normal_second)
    back = _face_features(-p.way, p.from_second, p.from_first, p.normal_second, p.normal_first)
    face = {"face": both_ways(forth, back, p.first, p.second)}
    return MultiGraph(motion_features(bodies, state), star(bodies, state) | face)


def fignet_graph(bodies: BodyTensors, state: StateTensors, pairs: Pairs) -> MultiGraph:
    made = fignet_star_graph(bodies, state, pairs)
    return MultiGraph(made.nodes, made.edges | {"mesh": mesh_edges(bodies, state)})


def _face_features(way: Tensor, sending: Tensor, receiving: Tensor, normal: Tensor, other: Tensor) -> Tensor:
    """[E, 34]: vectors between the closest points and from these to the corners of both faces, with lengths; both
    normals."""
    corners = [part for face in (sending, receiving) for part in (face.flatten(1), face.norm(dim=-1))]
    return torch.cat([way, way.norm(dim=-1, keepdim=True), *corners, normal, other], -1)


def mgn_graph(bodies: BodyTensors, state: StateTensors, pairs: Pairs) -> MultiGraph:
    nodes = {"node": motion_features(bodies, state)["node"]}
    return MultiGraph(nodes, {"mesh": mesh_edges(bodies, state), "world": world_edges(pairs)})


def world_edges(pairs: Pairs) -> EdgeSet:
    """Edges both ways between nodes of different bodies: vector from sender to receiver, and its length."""
    length = pairs.way.norm(dim=-1, keepdim=True)
    forth, back = torch.cat([pairs.way, length], -1), torch.cat([-pairs.way, length], -1)
    return both_ways(forth, back, pairs.first, pairs.second)


def dpi_graph(bodies: BodyTensors, state: StateTensors, pairs: Pairs) -> MultiGraph:
    return MultiGraph(motion_features(bodies, state), star(bodies, state) | {"contact": world_edges(pairs)})
