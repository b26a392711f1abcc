"""One step of simulation, top to bottom as in the paper: fly, find contacts, let the network act, move."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.contacts import Contacts, find_contacts, thin_contacts
from sdfsim.dynamics.freeflight import ballistic, torque_free
from sdfsim.dynamics.graph import ContactGraph, number_pairs
from sdfsim.dynamics.impulse import Velocities
from sdfsim.dynamics.model import Model
from sdfsim.dynamics.surfaces import predict

FreeFlight = Literal["exact", "learned"]


@dataclass(frozen=True)
class Rules:
    """What is in play during a run, in model units.

    Attributes:
        gravity: [3] float64.
        dt: the step.
        contact: False leaves every body in free flight.
        friction: False computes no tangential impulse.
        restitution: False makes every contact one of restitution 0.
        rotation: False lets bodies translate only.
        free_flight: "exact", or "learned" where the *paper* network predicts all of every body's motion.
    """

    gravity: Tensor
    dt: float
    contact: bool = True
    friction: bool = True
    restitution: bool = True
    rotation: bool = True
    free_flight: FreeFlight = "exact"


@torch.no_grad()
def step(model: Model, bodies: Bodies, state: State, rules: Rules) -> tuple[State, Contacts | None]:
    """Advance `state` by one step.

    Returns:
        The next state, and the contact edges that acted (None with contact off).
    """
    free = fly(bodies, state, rules)
    if not rules.contact and rules.free_flight == "exact":
        return free, None
    if not rules.contact:
        bodies = replace(
            bodies, may_touch=torch.zeros(len(bodies), len(bodies), dtype=torch.bool, device=bodies.device)
        )
    contacts = find_contacts(bodies, state, rules.gravity, model.reach, rules.dt)
    if model.kind == "paper":
        return _paper_step(model, bodies, state, free, contacts, rules), contacts
    if len(contacts) == 0:
        return free, contacts
    contacts = thin_contacts(bodies, contacts)
    active, graph = contact_graph(bodies, state, free, contacts, rules)
    predicted = model.network(graph, friction=rules.friction)
    return _move(bodies, state, free, active, predicted, rules), contacts


def fly(bodies: Bodies, state: State, rules: Rules) -> State:
    """Free flight of every body that moves: exact, whatever the step."""
    position, velocity = ballistic(state.position, state.velocity, rules.gravity, rules.dt)
    moves = bodies.moves
    orientation, angular = state.orientation.clone(), state.angular_velocity.clone()
    if rules.rotation:
        turned = torque_free(orientation[moves], angular[moves], bodies.inertia[moves], rules.dt)
        orientation[moves], angular[moves] = turned
    else:
        angular = torch.zeros_like(angular)
    return replace(
        state,
        position=torch.where(moves[:, None], position, state.position),
        orientation=orientation,
        velocity=torch.where(moves[:, None], velocity, state.velocity),
        angular_velocity=angular,
        earlier_position=_shift(state.earlier_position, state.position),
        earlier_orientation=_shift(state.earlier_orientation, state.orientation),
    )


def contact_graph(
    bodies: Bodies, state: State, free: State, contacts: Contacts, rules: Rules
) -> tuple[Tensor, ContactGraph]:
    """The bodies [A] that have a contact edge, and the graph among them in single precision."""
    active, index = torch.unique(torch.cat([contacts.owner, contacts.body]), return_inverse=True)
    first, second = index.chunk(2)
    pair, pairs = number_pairs(first, second, len(active))
    rotation = pose.to_matrix(state.orientation[active])
    inverse_inertia = rotation @ torch.linalg.inv(bodies.inertia[active]) @ rotation.mT
    turns = bodies.moves[active] if rules.rotation else torch.zeros_like(bodies.moves[active])
    inverse_inertia = inverse_inertia * turns[:, None, None]
    point = contacts.arm - 0.5 * contacts.distance[:, None] * contacts.normal
    between = state.position[contacts.owner] - state.position[contacts.body]
    turn = pose.to_rotvec(pose.multiply(free.orientation[active], pose.conjugate(state.orientation[active])))
    bounce = bodies.restitution if rules.restitution else torch.zeros_like(bodies.restitution)
    # Masses enter as ratios only; relative to the heaviest they stay within single precision.
    heaviest = bodies.mass[active].max()
    return active, ContactGraph(
        inverse_mass=(bodies.inverse_mass[active] * heaviest).float(),
        inverse_inertia=(inverse_inertia * heaviest).float(),
        velocity=state.velocity[active].float(),
        angular=state.angular_velocity[active].float(),
        free_velocity=free.velocity[active].float(),
        free_angular=free.angular_velocity[active].float(),
        mean_velocity=((free.position - state.position)[active] / rules.dt).float(),
        mean_angular=(turn / rules.dt).float(),
        first=first,
        second=second,
        pair=pair,
        pairs=pairs,
        normal=contacts.normal.float(),
        arm_first=point.float(),
        arm_second=(point + between).float(),
        gap=contacts.distance.float(),
        friction=(bodies.friction[contacts.owner] * bodies.friction[contacts.body]).float(),
        restitution=(bounce[contacts.owner] * bounce[contacts.body]).float(),
        dt=rules.dt,
    )


def _move(bodies: Bodies, state: State, free: State, active: Tensor, predicted: Velocities, rules: Rules) -> State:
    """Bodies in contact move by the predicted mean velocities and leave with the predicted end velocities."""
    active, chosen = active[bodies.moves[active]], bodies.moves[active]
    now = {k: getattr(free, k).clone() for k in ("position", "orientation", "velocity", "angular_velocity")}
    now["velocity"][active] = predicted.velocity[chosen].double()
    now["position"][active] = state.position[active] + predicted.mean_velocity[chosen].double() * rules.dt
    if rules.rotation:
        turn = pose.from_rotvec(predicted.mean_angular[chosen].double() * rules.dt)
        now["angular_velocity"][active] = predicted.angular[chosen].double()
        now["orientation"][active] = pose.normalise(pose.multiply(turn, state.orientation[active]))
    return replace(free, **now)


def _paper_step(model: Model, bodies: Bodies, state: State, free: State, contacts: Contacts, rules: Rules) -> State:
    """The published step; with exact free flight only bodies with a contact edge follow the network."""
    if rules.free_flight == "exact" and len(contacts) == 0:
        return free
    if not rules.friction:
        bodies = replace(bodies, friction=torch.zeros_like(bodies.friction))
    if not rules.restitution:
        bodies = replace(bodies, restitution=torch.zeros_like(bodies.restitution))
    predicted = predict(model.network, bodies, state, contacts, rules.dt)  # type: ignore[arg-type]
    if not rules.rotation:
        still = torch.zeros_like(state.angular_velocity)
        predicted = replace(predicted, orientation=state.orientation, angular_velocity=still)
    if rules.free_flight == "learned":
        follows = bodies.moves.clone()
    else:
        follows = torch.zeros_like(bodies.moves)
        follows[contacts.owner] = follows[contacts.body] = True
    names = ("position", "orientation", "velocity", "angular_velocity")
    chosen = {k: torch.where(follows[:, None], getattr(predicted, k), getattr(free, k)) for k in names}
    return replace(free, **chosen)


def _shift(earlier: Tensor | None, now: Tensor) -> Tensor | None:
    return None if earlier is None else torch.stack([earlier[1], now])
