"""SDF-Sim's graph, as published (section 3 and appendix): every body has one body node and its surface nodes, joined
both ways (up: to the body node). A surface node within the contact radius of another body is joined to that body's node
both ways. Surface nodes are never joined to each other.
"""

from dataclasses import replace

import torch
from torch import Tensor

from sdfsim.learned.message_passing import EdgeKind, EdgeSet, Features, Layout, MultiGraph
from sdfsim.learned.near import Contacts
from sdfsim.learned.surfaces import NODES, STAR, motion_features, star
from sdfsim.learned.tensors import BodyTensors, StateTensors
from sdfsim.shape.shape import Shape

CONTACT = Features(15, (0, 3, 6, 9))
SDF_SIM = Layout(
    NODES,
    STAR | {"contact_up": EdgeKind("node", "body", CONTACT), "contact_down": EdgeKind("body", "node", CONTACT)},
)


def points(shape: Shape, count: int | None) -> Shape:
    """The shape with the first `count` of its nodes (None: all): the outermost ones, then the most evenly spread."""
    return replace(shape, nodes=shape.nodes[:count])


def sdf_sim_graph(bodies: BodyTensors, state: StateTensors, contacts: Contacts) -> MultiGraph:
    features = _contact_features(bodies, state, contacts).float()
    node, body = contacts.node, contacts.body
    edges = {"contact_up": EdgeSet(features, node, body), "contact_down": EdgeSet(features, body, node)}
    return MultiGraph(motion_features(bodies, state), star(bodies, state) | edges)


def _contact_features(bodies: BodyTensors, state: StateTensors, contacts: Contacts) -> Tensor:
    """[E, 15]: node to closest point, normal, both relative to the other body's centre, and distances. An infinite
    floor has no centre: the closest point takes its place."""
    c = contacts
    to_closest = -c.distance[:, None] * c.normal
    bounded = bodies.size[c.body].isfinite()[:, None]
    seen = torch.where(bounded, c.seen, -to_closest)
    closest = seen + to_closest
    lengths = [c.distance, seen.norm(dim=-1), closest.norm(dim=-1)]
    return torch.cat([to_closest, c.normal, seen, closest, torch.stack(lengths, -1)], -1)
