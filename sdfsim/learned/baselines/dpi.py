"""DPI (Li et al., 2019, arXiv 1810.01566) for rigid bodies: particles, and a hierarchy of one root for each body.

Particles are joined to their body's root both ways, and to particles of different bodies within a radius. Here they lie
on the surface (the paper's fill the body), and all kinds of edges pass messages at once in every step, with weights of
that step (there one after the other, in every round with the same).
"""

from __future__ import annotations

from sdfsim.learned.baselines.mgn import WORLD, world_edges
from sdfsim.learned.message_passing import EdgeKind, Layout, MultiGraph
from sdfsim.learned.near import Pairs
from sdfsim.learned.surfaces import NODES, STAR, motion_features, star
from sdfsim.learned.tensors import BodyTensors, StateTensors

DPI = Layout(NODES, STAR | {"contact": EdgeKind("node", "node", WORLD)})


def dpi_graph(bodies: BodyTensors, state: StateTensors, pairs: Pairs) -> MultiGraph:
    """Of DPI."""
    return MultiGraph(motion_features(bodies, state), star(bodies, state) | {"contact": world_edges(pairs)})
