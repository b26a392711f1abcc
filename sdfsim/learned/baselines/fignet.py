"""FIGNet (Allen et al., 2023, arXiv 2212.03574) and FIGNet* (Lopez-Guevara et al., 2024, arXiv 2401.11985).

Nodes are the vertices of meshes and one node a body. EdgeSet join neighbours on a mesh, vertices and their body's node,
and the faces of two bodies that are near each other. A face edge knows the closest points of the two faces; its message
has a part for each of the receiving face's three vertices, in the order of their distance to its closest point. FIGNet*
is FIGNet without mesh edges.

`families.py` lists what is not as in the networks' own papers.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sdfsim.learned.message_passing import EdgeKind, Features, Layout, MultiGraph, both_ways
from sdfsim.learned.near import Pairs
from sdfsim.learned.surfaces import MESH, NODES, STAR, mesh_edges, motion_features, star
from sdfsim.learned.tensors import BodyTensors, StateTensors

FACE = Features(34, (0, 4, 7, 10, 16, 19, 22, 28, 31))
FIGNET_STAR = Layout(NODES, STAR | {"face": EdgeKind("node", "node", FACE, corners=3)})
FIGNET = Layout(NODES, FIGNET_STAR.edges | {"mesh": MESH})


def fignet_star_graph(bodies: BodyTensors, state: StateTensors, pairs: Pairs) -> MultiGraph:
    """Of FIGNet*."""
    p = pairs
    forth = _features(p.way, p.from_first, p.from_second, p.normal_first, p.normal_second)
    back = _features(-p.way, p.from_second, p.from_first, p.normal_second, p.normal_first)
    face = {"face": both_ways(forth, back, p.first, p.second)}
    return MultiGraph(motion_features(bodies, state), star(bodies, state) | face)


def fignet_graph(bodies: BodyTensors, state: StateTensors, pairs: Pairs) -> MultiGraph:
    """Of FIGNet."""
    made = fignet_star_graph(bodies, state, pairs)
    return MultiGraph(made.nodes, made.edges | {"mesh": mesh_edges(bodies, state)})


def _features(way: Tensor, sending: Tensor, receiving: Tensor, normal: Tensor, other: Tensor) -> Tensor:
    """[E, 34]: between the closest points, from these to the corners of both faces, with lengths; both normals."""
    corners = [part for face in (sending, receiving) for part in (face.flatten(1), face.norm(dim=-1))]
    return torch.cat([way, way.norm(dim=-1, keepdim=True), *corners, normal, other], -1)
