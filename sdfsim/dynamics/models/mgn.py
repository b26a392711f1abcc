"""MeshGraphNets (Pfaff et al., 2021, arXiv 2010.03409) for rigid bodies, as SDF-Sim's paper compares it.

Nodes are the vertices of meshes. Mesh edges join neighbours, world edges join vertices of different bodies within a
radius: a small one in *mgn*, a large one in *mgn-large*. There are no body nodes; shape matching makes motions rigid.

Different from the paper, as far as its text says:

- Vertices have the features of SDF-Sim's nodes, so that the networks differ in their graphs alone.
- World edges join different bodies only, and reach farther by what their ends close in during a step.
- The infinite floor is one vertex, below whatever is near it, not a mesh.
"""

from __future__ import annotations

import torch

from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.models.message_passing import EdgeKind, Edges, Features, Graph, Layout, both_ways
from sdfsim.dynamics.models.near_pairs import Pairs
from sdfsim.dynamics.models.surfaces import INTRA, NODE, mesh_edges, motion_features

WORLD = Features(4, (0,))
LAYOUT = Layout(
    nodes={"node": NODE}, edges={"mesh": EdgeKind("node", "node", INTRA), "world": EdgeKind("node", "node", WORLD)}
)


def graph(bodies: Bodies, state: State, pairs: Pairs) -> Graph:
    """The graph for a state that carries its two earlier poses."""
    nodes = {"node": motion_features(bodies, state)["node"]}
    return Graph(nodes, {"mesh": mesh_edges(bodies, state), "world": world_edges(pairs)})


def world_edges(pairs: Pairs) -> Edges:
    """Edges both ways between nodes of different bodies: from sender to receiver, and how far."""
    length = pairs.way.norm(dim=-1, keepdim=True)
    forth, back = torch.cat([pairs.way, length], -1), torch.cat([-pairs.way, length], -1)
    return both_ways(forth, back, pairs.first, pairs.second)
