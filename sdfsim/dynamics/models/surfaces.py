"""Features of the *paper* network, and its step from node accelerations to poses."""

from __future__ import annotations

from dataclasses import fields, replace

import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.contacts import Contacts
from sdfsim.dynamics.models.matching import match_shapes
from sdfsim.dynamics.models.paper import PaperNetwork, SurfaceGraph

_NOT_PER_BODY = ("pieces", "node", "node_start", "allowed", "sdfs", "tracks")


def node_owner(bodies: Bodies) -> Tensor:
    """[M] int64, the body of every surface node."""
    count = bodies.node_start[1:] - bodies.node_start[:-1]
    return torch.repeat_interleave(torch.arange(len(bodies), device=bodies.device), count)


def compact(bodies: Bodies, state: State, contacts: Contacts, rows: Tensor) -> tuple[Bodies, State, Contacts]:
    """The bodies `rows` [A] alone, in ascending order, with their states and all the contacts, which are among them."""
    if len(rows) == len(bodies):
        return bodies, state, contacts
    owner, node = _expanded(bodies.node_start[rows], bodies.node_start[rows + 1])
    number = torch.full((len(bodies),), -1, dtype=torch.int64, device=bodies.device)
    number[rows] = torch.arange(len(rows), device=bodies.device)
    ends = torch.bincount(owner, minlength=len(rows)).cumsum(0)
    start = torch.cat([ends.new_zeros(1), ends])
    per_body = [f.name for f in fields(bodies) if f.name not in _NOT_PER_BODY]
    some = replace(
        bodies, **{k: getattr(bodies, k)[rows] for k in per_body}, node=bodies.node[node], node_start=start, tracks=None
    )
    earlier_position, earlier_orientation = _history(state)
    moved = State(
        *(v[rows] for v in (state.position, state.orientation, state.velocity, state.angular_velocity)),
        earlier_position=earlier_position[:, rows],
        earlier_orientation=earlier_orientation[:, rows],
    )
    mine = number[contacts.owner]
    place = contacts.node - bodies.node_start[contacts.owner] + start[mine]
    return some, moved, replace(contacts, owner=mine, body=number[contacts.body], node=place)


def _expanded(start: Tensor, stop: Tensor) -> tuple[Tensor, Tensor]:
    """For ranges start[k] : stop[k], the range index and the value of every element, in order."""
    count = stop - start
    which = torch.repeat_interleave(torch.arange(len(count), device=count.device), count)
    first = torch.repeat_interleave(count.cumsum(0) - count, count)
    return which, start[which] + torch.arange(len(which), device=count.device) - first


def surface_graph(bodies: Bodies, state: State, contacts: Contacts) -> SurfaceGraph:
    """The published graph for a state that carries its two earlier poses.

    Node features: displacement over each of the last two steps, displacement of the body's centre over the last,
    inverse mass, friction, restitution, and whether the body is static. Displacements are
    differences of poses in float64, never of large float32 positions.
    """
    earlier_position, earlier_orientation = _history(state)
    owner = node_owner(bodies)
    turns = [pose.to_matrix(q) for q in (*earlier_orientation, state.orientation)]
    places = [*earlier_position, state.position]

    def moved(k: int) -> Tensor:
        """[M, 3] displacement of nodes from pose k to pose k + 1."""
        return _apply((turns[k + 1] - turns[k])[owner], bodies.node) + (places[k + 1] - places[k])[owner]

    travel = [places[1] - places[0], places[2] - places[1]]
    material = torch.stack(
        [
            bodies.inverse_mass,
            bodies.friction,
            bodies.restitution,
            (~bodies.moves).to(bodies.friction.dtype),
        ],
        -1,
    )
    arm = _apply(turns[2][owner], bodies.node)
    intra = torch.cat([arm, arm.norm(dim=-1, keepdim=True), bodies.node, bodies.node.norm(dim=-1, keepdim=True)], -1)
    return SurfaceGraph(
        body=torch.cat([travel[1], travel[0], travel[1], material], -1).float(),
        node=torch.cat([moved(1), moved(0), travel[1][owner], material[owner]], -1).float(),
        owner=owner,
        intra=intra.float(),
        contact_node=contacts.node,
        contact_body=contacts.body,
        contact=_contact_features(bodies, state, contacts).float(),
    )


def _contact_features(bodies: Bodies, state: State, contacts: Contacts) -> Tensor:
    """[E, CONTACT_FEATURES]: node to closest point, normal, both seen from the other body's centre, distances.

    An infinite floor has no centre: its body node stands in for the closest point.
    """
    c = contacts
    to_closest = -c.distance[:, None] * c.normal
    bounded = bodies.size[c.body].isfinite()[:, None]
    seen = torch.where(bounded, c.seen, -to_closest)
    closest = seen + to_closest
    lengths = [c.distance, seen.norm(dim=-1), closest.norm(dim=-1)]
    return torch.cat([to_closest, c.normal, seen, closest, torch.stack(lengths, -1)], -1)


def advance(bodies: Bodies, state: State, acceleration: Tensor, dt: float) -> State:
    """The next state when every node of a body accelerates by `acceleration` [M, 3] (displacement a step, twice)."""
    earlier_position, earlier_orientation = _history(state)
    owner = node_owner(bodies)
    now, before = pose.to_matrix(state.orientation), pose.to_matrix(earlier_orientation[1])
    # Relative to each body's own centre, so that a far origin costs no precision.
    step = (state.position - earlier_position[1])[owner] + _apply((now - before)[owner], bodies.node)
    moved = _apply(now[owner], bodies.node) + step + acceleration
    offset, orientation = match_shapes(bodies.node, moved, owner, state.orientation)
    still = ~bodies.moves[:, None]
    offset = torch.where(still, torch.zeros_like(offset), offset)
    orientation = torch.where(still, state.orientation, orientation)
    turn = pose.to_rotvec(pose.multiply(orientation, pose.conjugate(state.orientation)))
    return State(
        position=state.position + offset,
        orientation=orientation,
        velocity=offset / dt,
        angular_velocity=turn / dt,
    )


def predict(
    network: PaperNetwork, bodies: Bodies, state: State, contacts: Contacts, dt: float, rows: int | None = None
) -> State:
    """One step of the published simulator, its network working on at most `rows` edges at once."""
    graph = surface_graph(bodies, state, contacts)
    return advance(bodies, state, network.target.undo(network(graph, rows=rows)).double(), dt)


def target_acceleration(bodies: Bodies, state: State, position: Tensor, orientation: Tensor) -> Tensor:
    """[M, 3] accelerations that would take `state` to the poses `position` [N, 3], `orientation` [N, 4]."""
    earlier_position, earlier_orientation = _history(state)
    owner = node_owner(bodies)
    turns = [pose.to_matrix(q) for q in (earlier_orientation[1], state.orientation, orientation)]
    curl = _apply((turns[2] - 2 * turns[1] + turns[0])[owner], bodies.node)
    return (position - 2 * state.position + earlier_position[1])[owner] + curl


def _history(state: State) -> tuple[Tensor, Tensor]:
    if state.earlier_position is None or state.earlier_orientation is None:
        raise ValueError("the paper network needs the two earlier poses")
    return state.earlier_position, state.earlier_orientation


def _apply(m: Tensor, v: Tensor) -> Tensor:
    return (m @ v[..., None])[..., 0]
