"""FIGNet (Allen et al., 2023, arXiv 2212.03574) and FIGNet* (Lopez-Guevara et al., 2024, arXiv 2401.11985).

Nodes are the vertices of meshes and one node a body. Edges join neighbours on a mesh, vertices and their body's node
(both ways), and the faces of two bodies that are near each other. A face edge knows the closest points of the two
faces; its message has a part for each of the receiving face's three vertices. FIGNet* is FIGNet without mesh edges.

Different from the papers, as far as their texts say:

- Vertices and bodies have the features of SDF-Sim's nodes, so that the networks differ in their graphs alone.
- The corners of a face are told in the order of their distance to its closest point; the papers do not say theirs.
- Faces are near within a radius plus what they close in during a step, as for SDF-Sim's edges.
- The infinite floor is one vertex whose face lies below whatever is near it, not two triangles as large as the scene.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.models.message_passing import EdgeKind, Features, Graph, Layout, both_ways
from sdfsim.dynamics.models.near_pairs import Pairs
from sdfsim.dynamics.models.surfaces import INTRA, NODE, mesh_edges, motion_features, star

FACE = Features(34, (0, 4, 7, 10, 16, 19, 22, 28, 31))
STAR = Layout(
    nodes={"body": NODE, "node": NODE},
    edges={
        "intra_up": EdgeKind("node", "body", INTRA),
        "intra_down": EdgeKind("body", "node", INTRA),
        "face": EdgeKind("node", "node", FACE, corners=3),
    },
)
LAYOUT = Layout(STAR.nodes, STAR.edges | {"mesh": EdgeKind("node", "node", INTRA)})


def star_graph(bodies: Bodies, state: State, pairs: Pairs) -> Graph:
    """FIGNet*'s graph for a state that carries its two earlier poses."""
    p = pairs
    forth = _features(p.way, p.from_first, p.from_second, p.normal_first, p.normal_second)
    back = _features(-p.way, p.from_second, p.from_first, p.normal_second, p.normal_first)
    face = {"face": both_ways(forth, back, p.first, p.second)}
    return Graph(motion_features(bodies, state), star(bodies, state) | face)


def graph(bodies: Bodies, state: State, pairs: Pairs) -> Graph:
    """FIGNet's graph for a state that carries its two earlier poses."""
    made = star_graph(bodies, state, pairs)
    return Graph(made.nodes, made.edges | {"mesh": mesh_edges(bodies, state)})


def _features(way: Tensor, sending: Tensor, receiving: Tensor, normal: Tensor, other: Tensor) -> Tensor:
    """[E, 34]: between the closest points, from these to the corners of both faces, with lengths; both normals."""
    corners = [part for face in (sending, receiving) for part in (face.flatten(1), face.norm(dim=-1))]
    return torch.cat([way, way.norm(dim=-1, keepdim=True), *corners, normal, other], -1)
