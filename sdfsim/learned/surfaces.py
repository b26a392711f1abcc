"""SDF-Sim's graph and step, as published (section 3 and appendix): features of nodes and edges, targets, and the step
to new poses.

Every body has one body node and its surface nodes, joined both ways (up: to the body node). A surface node near another
body is joined to that body's node both ways. Surface nodes are never joined to each other. A node is near if
d - (closing speed) dt <= reach: with a fixed threshold a fast body could bounce inside one step without ever having an
edge.

The network predicts an acceleration for every surface node; shape matching turns those of a body into its next pose.
"""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sdfsim.learned import pose
from sdfsim.learned.message_passing import EdgeKind, EdgeSet, Features, GraphNetwork, Layout, MultiGraph
from sdfsim.physics.bodies import Bodies, State
from sdfsim.physics.motion import Motion
from sdfsim.physics.solver.prepare import Compiled, nodes_near

NODE = Features(13, (0, 3, 6))  # features of surface nodes and of body nodes
INTRA = Features(8, (0, 4))  # features of edges within a body
CONTACT = Features(15, (0, 3, 6, 9))  # features of edges between bodies
SDF_SIM = Layout(
    {"body": NODE, "node": NODE},
    {
        "intra_up": EdgeKind("node", "body", INTRA), "intra_down": EdgeKind("body", "node", INTRA),
        "contact_up": EdgeKind("node", "body", CONTACT), "contact_down": EdgeKind("body", "node", CONTACT),
    },
)  # fmt: skip
TARGET = Features(3, (0,))  # accelerations
# Weight of staying at `start`, relative to the nodes' spread. It is far below the weight of any extent beyond rounding,
# so it decides only about rotations that the nodes do not define.
STAY = 1e-12
_NOT_PER_BODY = ("node", "node_start")


@dataclass(frozen=True)
class BodyTensors:
    """The fields of `Bodies` that such a network needs, for N bodies with M surface nodes."""

    inverse_mass: Tensor  # [N] float64
    friction: Tensor  # [N] float64
    restitution: Tensor  # [N] float64
    moves: Tensor  # [N] bool
    size: Tensor  # [N] float64
    node: Tensor  # [M, 3] float64
    node_start: Tensor  # [N + 1] int64

    def __len__(self) -> int:
        return len(self.moves)

    @property
    def device(self) -> torch.device:
        return self.moves.device


@dataclass(frozen=True)
class StateTensors:
    """Poses and velocities of N bodies, float64; see `State`."""

    position: Tensor  # [N, 3]
    orientation: Tensor  # [N, 4]
    velocity: Tensor  # [N, 3]
    angular_velocity: Tensor  # [N, 3]
    earlier_position: Tensor | None = None  # [2, N, 3]
    earlier_orientation: Tensor | None = None  # [2, N, 4]


def body_tensors(bodies: Bodies, device: torch.device) -> BodyTensors:
    return BodyTensors(**{f.name: torch.from_numpy(getattr(bodies, f.name)).to(device) for f in fields(BodyTensors)})


def state_tensors(state: Motion, device: torch.device) -> StateTensors:
    arrays = {f.name: getattr(state, f.name, None) for f in fields(StateTensors)}
    return StateTensors(**{k: torch.from_numpy(v).to(device) for k, v in arrays.items() if v is not None})


def state_arrays(state: StateTensors) -> State:
    tensors: dict[str, Any] = {f.name: getattr(state, f.name) for f in fields(state)}
    return State(**{k: v.cpu().numpy() for k, v in tensors.items() if v is not None})


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


def node_owner(bodies: BodyTensors) -> Tensor:
    """[M] int64, the body of every surface node."""
    count = bodies.node_start[1:] - bodies.node_start[:-1]
    return torch.repeat_interleave(torch.arange(len(bodies), device=bodies.device), count)


def compact(
    bodies: BodyTensors, state: StateTensors, contacts: Contacts, rows: Tensor
) -> tuple[BodyTensors, StateTensors, Contacts]:
    """Only the bodies `rows` [A], in ascending order, with their states and all contacts, which must be among them."""
    if len(rows) == len(bodies):
        return bodies, state, contacts
    owner, node = expanded(bodies.node_start[rows], bodies.node_start[rows + 1])
    number = _numbers(rows, len(bodies))
    place = _numbers(node, len(bodies.node))
    ends = torch.bincount(owner, minlength=len(rows)).cumsum(0)
    start = torch.cat([ends.new_zeros(1), ends])
    per_body = [f.name for f in fields(bodies) if f.name not in _NOT_PER_BODY]
    per_row = {k: getattr(bodies, k)[rows] for k in per_body}
    some = replace(bodies, **per_row, node=bodies.node[node], node_start=start)
    earlier_position, earlier_orientation = _history(state)
    moved = StateTensors(
        *(v[rows] for v in (state.position, state.orientation, state.velocity, state.angular_velocity)),
        earlier_position=earlier_position[:, rows],
        earlier_orientation=earlier_orientation[:, rows],
    )
    among = replace(
        contacts, owner=number[contacts.owner], body=number[contacts.body], node=place[contacts.node]
    )  # fmt: skip
    return some, moved, among


def _numbers(kept: Tensor, count: int) -> Tensor:
    """[count] int64, the index of each of `count` entries among the `kept` ones; -1 for the others."""
    number = torch.full((count,), -1, dtype=torch.int64, device=kept.device)
    number[kept] = torch.arange(len(kept), device=kept.device)
    return number


def expanded(start: Tensor, stop: Tensor) -> tuple[Tensor, Tensor]:
    """For ranges start[k] : stop[k], the range index and the value of every element, in order."""
    count = stop - start
    which = torch.repeat_interleave(torch.arange(len(count), device=count.device), count)
    first = torch.repeat_interleave(count.cumsum(0) - count, count)
    return which, start[which] + torch.arange(len(which), device=count.device) - first


def motion_features(bodies: BodyTensors, state: StateTensors) -> dict[str, Tensor]:
    """Features of body nodes [N, 13] and surface nodes [M, 13].

    Displacement over each of the last two steps, displacement of the body's centre over the last step, inverse mass,
    friction, restitution, and whether the body is static. Displacements are differences of float64 poses, never of
    large float32 positions.
    """
    earlier_position, earlier_orientation = _history(state)
    owner = node_owner(bodies)
    turns = [pose.to_matrix(q) for q in (*earlier_orientation, state.orientation)]
    places = [*earlier_position, state.position]

    def moved(k: int) -> Tensor:
        """[M, 3] displacement of nodes from pose k to pose k + 1."""
        return pose.apply((turns[k + 1] - turns[k])[owner], bodies.node) + (places[k + 1] - places[k])[owner]

    travel = [places[1] - places[0], places[2] - places[1]]
    fixed = (~bodies.moves).to(bodies.friction.dtype)
    material = torch.stack([bodies.inverse_mass, bodies.friction, bodies.restitution, fixed], -1)
    body = torch.cat([travel[1], travel[0], travel[1], material], -1)
    node = torch.cat([moved(1), moved(0), travel[1][owner], material[owner]], -1)
    return {"body": body.float(), "node": node.float()}


def star(bodies: BodyTensors, state: StateTensors) -> dict[str, EdgeSet]:
    """Edges between the surface nodes and their body's node, up and down: the node relative to the centre, now (world
    axes) and at rest (body axes), each with its length."""
    owner, rest = node_owner(bodies), bodies.node
    now = pose.apply(pose.to_matrix(state.orientation)[owner], rest)
    features = torch.cat([now, now.norm(dim=-1, keepdim=True), rest, rest.norm(dim=-1, keepdim=True)], -1).float()
    node = torch.arange(len(owner), device=owner.device)
    return {"intra_up": EdgeSet(features, node, owner), "intra_down": EdgeSet(features, owner, node)}


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


def advance(bodies: BodyTensors, state: StateTensors, acceleration: Tensor, dt: float) -> StateTensors:
    """The next state if every node of a body accelerates by `acceleration` [M, 3] (change of displacement per step)."""
    earlier_position, earlier_orientation = _history(state)
    owner = node_owner(bodies)
    now, before = pose.to_matrix(state.orientation), pose.to_matrix(earlier_orientation[1])
    # Relative to each body's own centre, so that precision does not suffer far from the origin.
    step = (state.position - earlier_position[1])[owner] + pose.apply((now - before)[owner], bodies.node)
    moved = pose.apply(now[owner], bodies.node) + step + acceleration
    offset, orientation = match_shapes(bodies.node, moved, owner, state.orientation)
    still = ~bodies.moves[:, None]
    offset = torch.where(still, torch.zeros_like(offset), offset)
    orientation = torch.where(still, state.orientation, orientation)
    turn = pose.to_rotvec(pose.multiply(orientation, pose.conjugate(state.orientation)))
    return StateTensors(
        position=state.position + offset,
        orientation=orientation,
        velocity=offset / dt,
        angular_velocity=turn / dt,
    )


def predict(
    network: GraphNetwork, graph: MultiGraph, bodies: BodyTensors, state: StateTensors, dt: float
) -> StateTensors:
    return advance(bodies, state, network.target.undo(network(graph)).double(), dt)


def target_acceleration(bodies: BodyTensors, state: StateTensors, position: Tensor, orientation: Tensor) -> Tensor:
    """[M, 3] accelerations that would take `state` to the poses `position` [N, 3], `orientation` [N, 4]."""
    earlier_position, earlier_orientation = _history(state)
    owner = node_owner(bodies)
    turns = [pose.to_matrix(q) for q in (earlier_orientation[1], state.orientation, orientation)]
    curl = pose.apply((turns[2] - 2 * turns[1] + turns[0])[owner], bodies.node)
    return (position - 2 * state.position + earlier_position[1])[owner] + curl


def _history(state: StateTensors) -> tuple[Tensor, Tensor]:
    if state.earlier_position is None or state.earlier_orientation is None:
        raise ValueError("a network on surface nodes needs the two earlier poses")
    return state.earlier_position, state.earlier_orientation


# --- shape matching: the rigid motion that best explains displaced nodes (Müller et al., 2005), as SDF-Sim has it ---


def match_shapes(rest: Tensor, moved: Tensor, owner: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """Best rigid pose of every body from its nodes: position [N, 3] of the centres of mass and orientation [N, 4] xyzw,
    on the same side as `start`; NaN for a body with a node that is not finite.

    Nodes were at `rest` [M, 3] about each body's centre of mass, body axes; the network `moved` them, [M, 3] world.
    Rotations that the nodes do not define (about a line of nodes, or any for a single node) stay as in `start` [N, 4].

    The rotation q with the largest sum of moved . (q rest) is the main eigenvector of a symmetric 4 x 4 matrix (Horn,
    1987). So the result is always a rotation, even for nodes that are flat, mirrored by noise, or all in one place.
    """
    bodies = len(start)

    def mean(values: Tensor) -> Tensor:
        total = torch.zeros(bodies, *values.shape[1:], dtype=values.dtype, device=values.device)
        return total.index_add_(0, owner, values) / count.reshape(-1, *[1] * (values.dim() - 1))

    count = torch.zeros(bodies, dtype=rest.dtype, device=rest.device).index_add_(0, owner, torch.ones_like(rest[:, 0]))
    count = count.clamp_min(1.0)
    rest_mean, moved_mean = mean(rest), mean(moved)
    spread = mean((moved - moved_mean[owner])[:, :, None] * (rest - rest_mean[owner])[:, None])
    orientation, rotation = _main_turn(spread, start)
    position = moved_mean - (rotation @ rest_mean[..., None])[..., 0]
    return position, orientation


def _main_turn(spread: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternion [N, 4] and matrix [N, 3, 3] of the rotation nearest to `spread` [N, 3, 3] (moved times rest)."""
    a, before = spread.double(), start.double()
    known = a.isfinite().all(-1).all(-1)
    a = torch.where(known[:, None, None], a, 0.0)  # decomposing a NaN would raise an exception for all bodies
    a = a / a.norm(dim=(-2, -1), keepdim=True).clamp_min(torch.finfo(a.dtype).tiny)
    trace = a.diagonal(dim1=-2, dim2=-1).sum(-1)
    curl = torch.stack([a[:, 2, 1] - a[:, 1, 2], a[:, 0, 2] - a[:, 2, 0], a[:, 1, 0] - a[:, 0, 1]], -1)
    even = a + a.mT - trace[:, None, None] * torch.eye(3, dtype=a.dtype, device=a.device)
    upper = torch.cat([even, curl[..., None]], -1)
    lower = torch.cat([curl, trace[:, None]], -1)[:, None]
    stay = STAY * before[:, :, None] * before[:, None]
    best = torch.linalg.eigh(torch.cat([upper, lower], -2) + stay).eigenvectors[..., -1]
    best = torch.where((best * before).sum(-1, keepdim=True) < 0, -best, best)
    best = torch.where(known[:, None], best, torch.nan).to(start.dtype)
    return best, pose.to_matrix(best).to(spread.dtype)
