"""SDF-Sim's edges between bodies: where a surface node of one is near another.

A node is near if d - (closing speed) dt <= reach. With a fixed threshold a fast body could bounce inside one step
without ever having an edge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sdfsim.learned import pose
from sdfsim.learned.tensors import BodyTensors, StateTensors, state_arrays
from sdfsim.physics.solver.prepare import Compiled, nodes_near


@dataclass(frozen=True)
class Contacts:
    """E contact edges, each from a surface node to the closest point on another body; model units, world frame."""

    owner: Tensor  # [E] int64, the body whose node it is
    node: Tensor  # [E] int64, index into `Bodies.node`
    body: Tensor  # [E] int64, the body that it is near
    seen: Tensor  # [E, 3] float64, the node relative to the centre of mass of `body`
    distance: Tensor  # [E] float64, signed distance of the node from `body`
    normal: Tensor  # [E, 3] float64, unit outward normal of `body` at the closest point

    def __len__(self) -> int:
        return len(self.owner)

    def renumbered(self, body: Tensor, node: Tensor) -> Contacts:
        """The same among other bodies: `body` [N] and `node` [M] give their new numbers."""
        return replace(self, owner=body[self.owner], body=body[self.body], node=node[self.node])


def no_contacts(device: torch.device) -> Contacts:
    nobody = torch.zeros(0, dtype=torch.int64, device=device)
    nothing = torch.zeros(0, 3, dtype=torch.float64, device=device)
    return Contacts(nobody, nobody, nobody, nothing, nothing[:, 0], nothing)


def find_contacts(
    bodies: BodyTensors, state: StateTensors, gravity: np.ndarray, reach: float, dt: float, scene: Compiled | None
) -> Contacts:
    """All contact edges of a state within `reach` (the contact radius D) under gravity [3], found with the compiled
    `scene`; all in model units."""
    assert scene is not None
    found = nodes_near(scene, state_arrays(state), gravity, reach, dt)
    index, value = (torch.from_numpy(array).to(bodies.device) for array in found)
    owner, node, body = index.unbind(1)
    return Contacts(owner, node, body, seen=value[:, 4:], distance=value[:, 0], normal=value[:, 1:4])


def where(state: StateTensors, bodies: BodyTensors, contacts: Contacts) -> Tensor:
    """[E, 3] positions of the nodes of contact edges in a state, world."""
    turned = pose.rotate(state.orientation[contacts.owner], bodies.node[contacts.node])
    return state.position[contacts.owner] + turned
