"""MeshGraphNets (Pfaff et al., 2021, arXiv 2010.03409) for rigid bodies, as SDF-Sim's paper compares it.

Nodes are the vertices of meshes. Mesh edges join neighbours, world edges join vertices of different bodies within a
radius: a small one in *mgn*, a large one in *mgn-large*. There are no body nodes; shape matching makes motions rigid.

`families.py` lists what is not as in the networks' own papers.
"""

from __future__ import annotations

import torch

from sdfsim.learned.message_passing import EdgeKind, EdgeSet, Features, Layout, MultiGraph, both_ways
from sdfsim.learned.near import Pairs
from sdfsim.learned.surfaces import MESH, NODE, mesh_edges, motion_features
from sdfsim.learned.tensors import BodyTensors, StateTensors

WORLD = Features(4, (0,))
MGN = Layout({"node": NODE}, {"mesh": MESH, "world": EdgeKind("node", "node", WORLD)})


def mgn_graph(bodies: BodyTensors, state: StateTensors, pairs: Pairs) -> MultiGraph:
    """Of MeshGraphNets."""
    nodes = {"node": motion_features(bodies, state)["node"]}
    return MultiGraph(nodes, {"mesh": mesh_edges(bodies, state), "world": world_edges(pairs)})


def world_edges(pairs: Pairs) -> EdgeSet:
    """Edges both ways between nodes of different bodies: from sender to receiver, and how far."""
    length = pairs.way.norm(dim=-1, keepdim=True)
    forth, back = torch.cat([pairs.way, length], -1), torch.cat([-pairs.way, length], -1)
    return both_ways(forth, back, pairs.first, pairs.second)
