"""The networks on surface nodes by name: SDF-Sim (*paper*) and the baselines of its paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from torch import Tensor, device

from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.models import dpi, fignet, mgn, nodes, paper
from sdfsim.dynamics.models.message_passing import Graph, Layout
from sdfsim.dynamics.models.near_pairs import face_pairs, no_pairs, node_pairs
from sdfsim.dynamics.models.paper_edges import find_contacts, no_contacts
from sdfsim.dynamics.models.surfaces import Near
from sdfsim.dynamics.run_memory import Memory
from sdfsim.shape.shape import Shape


@dataclass(frozen=True)
class Family:
    """What is a network's own beside its weights."""

    layout: Layout  # of its graphs
    # a shape, with the nodes (at most so many, None for all) that the network works on
    surface: Callable[[Shape, int | None], Shape]
    # what of the bodies is near what, for bodies, state, gravity, reach, time step and what the run remembers
    near: Callable[[Bodies, State, Tensor, float, float, Memory], Near]
    none: Callable[[device], Near]  # the same of bodies that are near nothing
    graph: Callable[[Bodies, State, Any], Graph]  # the graph of bodies, their state and what is near


_no_faces, _no_nodes = partial(no_pairs, corners=3), partial(no_pairs, corners=1)

FAMILIES = {
    "paper": Family(paper.LAYOUT, nodes.points, find_contacts, no_contacts, paper.graph),
    "fignet": Family(fignet.LAYOUT, nodes.vertices, face_pairs, _no_faces, fignet.graph),
    "fignet-star": Family(fignet.STAR, nodes.vertices, face_pairs, _no_faces, fignet.star_graph),
    "mgn": Family(mgn.LAYOUT, nodes.vertices, node_pairs, _no_nodes, mgn.graph),
    "dpi": Family(dpi.LAYOUT, nodes.particles, node_pairs, _no_nodes, dpi.graph),
}
