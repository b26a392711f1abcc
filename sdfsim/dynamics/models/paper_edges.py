"""Contact edges of the *paper* network: surface nodes within reach of another body's surface (paper, section 3)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.models.surfaces import Near
from sdfsim.dynamics.run_memory import Memory
from sdfsim.dynamics.solver import compiled_rules, taken_up


@dataclass(frozen=True)
class Contacts:
    """E contact edges, each from a surface node to the closest point on another body; model units, world frame."""

    owner: Tensor  # [E] int64, the body whose node it is
    node: Tensor  # [E] int64, index into `Bodies.node`
    body: Tensor  # [E] int64, the body it meets
    seen: Tensor  # [E, 3] float64, the node from the centre of mass of `body`
    distance: Tensor  # [E] float64, signed distance of the node from `body`
    normal: Tensor  # [E, 3] float64, unit outward normal of `body` at the closest point
    queries: int = 0  # how many signed distances were evaluated to find them

    def __len__(self) -> int:
        return len(self.owner)

    def renumbered(self, body: Tensor, node: Tensor) -> Contacts:
        """The same among other bodies: `body` [N] and `node` [M] give their new numbers."""
        return replace(self, owner=body[self.owner], body=body[self.body], node=node[self.node])


def no_contacts(device: torch.device) -> Contacts:
    """None at all."""
    nobody = torch.zeros(0, dtype=torch.int64, device=device)
    nothing = torch.zeros(0, 3, dtype=torch.float64, device=device)
    return Contacts(nobody, nobody, nobody, nothing, nothing[:, 0], nothing)


def find_contacts(
    bodies: Bodies, state: State, gravity: Tensor, reach: float, dt: float, memory: Memory | None = None
) -> Contacts:
    """All contact edges of a state within `reach`, the contact radius D, under gravity [3]; all in model units.

    An edge exists where d + min(0, closing velocity * dt) <= reach: a fixed threshold would let a fast body bounce
    inside one step without ever having had an edge.
    """
    from sdfsim.dynamics.kernels.nodes import nodes_within

    scene = (memory or Memory()).compiled(bodies, state)
    rules = compiled_rules(gravity.cpu().numpy(), dt, 1)._replace(reach=reach)
    motion, _ = taken_up(bodies, state, scene, rules)
    start = bodies.node_start.cpu().numpy()
    index, value, queries = nodes_within(
        scene.shapes, scene.world, scene.work, motion, rules, bodies.node.cpu().numpy(), start
    )
    index, value = torch.from_numpy(index).to(bodies.device), torch.from_numpy(value).to(bodies.device)
    return Contacts(
        owner=index[:, 0],
        node=index[:, 1],
        body=index[:, 2],
        seen=value[:, 4:],
        distance=value[:, 0],
        normal=value[:, 1:4],
        queries=queries,
    )


def where(state: State, bodies: Bodies, contacts: Near) -> Tensor:
    """[E, 3] where the nodes of contact edges are in a state, world."""
    turned = pose.rotate(state.orientation[contacts.owner], bodies.node[contacts.node])
    return state.position[contacts.owner] + turned
