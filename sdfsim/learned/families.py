"""The networks on surface nodes by name: *sdf-sim* is SDF-Sim. Other networks, which differ in their graphs, may be
added (`benchmarks/baselines.py` does).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from torch import device

from sdfsim.learned.graphs import SDF_SIM, sdf_sim_graph
from sdfsim.learned.message_passing import Layout, MultiGraph
from sdfsim.learned.near import find_contacts, no_contacts
from sdfsim.learned.tensors import BodyTensors, StateTensors
from sdfsim.physics.solver.prepare import Compiled
from sdfsim.shape.shape import Shape


def points(shape: Shape, count: int | None) -> Shape:
    """The shape with the first `count` of its nodes (None: all): the outermost ones, then the most evenly spread."""
    return replace(shape, nodes=shape.nodes[:count])


@dataclass(frozen=True)
class Family:
    """Everything that is specific to one network, except its weights."""

    layout: Layout  # layout of its graphs
    # the shape with the nodes that the network uses (at most the given number, None for all)
    surface: Callable[[Shape, int | None], Shape]
    # finds the near parts of bodies, from bodies, state, gravity, reach, time step and the compiled scene of a run
    near: Callable[[BodyTensors, StateTensors, np.ndarray, float, float, Compiled | None], Any]
    none: Callable[[device], Any]  # the same for bodies that are near nothing
    graph: Callable[[BodyTensors, StateTensors, Any], MultiGraph]  # the graph of bodies, their state and near parts
    distances: bool = False  # whether `near` uses the compiled distances of a scene


FAMILIES = {"sdf-sim": Family(SDF_SIM, points, find_contacts, no_contacts, sdf_sim_graph, distances=True)}
