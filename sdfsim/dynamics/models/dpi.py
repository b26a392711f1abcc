"""DPI (Li et al., 2019, arXiv 1810.01566) for rigid bodies: particles, and a hierarchy of one root for each body.

Particles and their root are joined both ways, particles of different bodies within a radius of each other too.

Different from the paper, as far as its text says:

- Particles lie on the surface, where SDF-Sim has its nodes; the paper's fill the body.
- Particles and roots have the features of SDF-Sim's nodes, so that the networks differ in their graphs alone.
- All kinds of edges pass messages at once in every step, with weights of that step. The paper passes them from leaves
  to roots, among roots and back one after the other, in every round with the same weights.
- Contact edges reach farther by what their ends close in during a step; the infinite floor is one particle, below
  whatever is near it.
"""

from __future__ import annotations

from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.models.message_passing import EdgeKind, Graph, Layout
from sdfsim.dynamics.models.mgn import WORLD, world_edges
from sdfsim.dynamics.models.near_pairs import Pairs
from sdfsim.dynamics.models.surfaces import INTRA, NODE, motion_features, star

LAYOUT = Layout(
    nodes={"body": NODE, "node": NODE},
    edges={
        "intra_up": EdgeKind("node", "body", INTRA),
        "intra_down": EdgeKind("body", "node", INTRA),
        "contact": EdgeKind("node", "node", WORLD),
    },
)


def graph(bodies: Bodies, state: State, pairs: Pairs) -> Graph:
    """The graph for a state that carries its two earlier poses."""
    return Graph(motion_features(bodies, state), star(bodies, state) | {"contact": world_edges(pairs)})
