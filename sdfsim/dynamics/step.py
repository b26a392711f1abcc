"""One step of simulation, top to bottom as in the paper: find contacts, fly, let the network act, move.

Each stage sees only what is in play: an effect that is off is not computed, a body without contact is not in the
network's graph, and what sleeps is not looked at until something moves beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Bodies, State, awake
from sdfsim.dynamics.contacts import Contacts, find_contacts, no_contacts
from sdfsim.dynamics.energy import Guard, hold_back
from sdfsim.dynamics.freeflight import ballistic, torque_free
from sdfsim.dynamics.graph import SUBSTEPS, ContactGraph, number_pairs
from sdfsim.dynamics.impulse import Velocities
from sdfsim.dynamics.memory import Memory
from sdfsim.dynamics.model import SOLVER, Model
from sdfsim.dynamics.overlap import parting
from sdfsim.dynamics.sleep import settle, stir, touched, wake
from sdfsim.dynamics.surfaces import compact, predict

FreeFlight = Literal["exact", "learned"]
_POSE = ("position", "orientation", "velocity", "angular_velocity")


@dataclass(frozen=True)
class Rules:
    """What is in play during a run, in model units.

    Attributes:
        gravity: [3] float64.
        dt: the step.
        substeps: inner steps of the engine whose motion is asked for.
        falls: False where gravity is zero: free flight without acceleration.
        contact: False leaves every body in free flight.
        friction: False computes no tangential impulse.
        restitution: False makes every contact one of restitution 0.
        rotation: False lets bodies translate only.
        free_flight: "exact", or "learned" where the *paper* network predicts all of every body's motion.
        rows: how many nodes or edges to work on at once; None for all.
        guard: "energy" holds back contact that makes energy.
        sleep: whether the solver freezes what rests; networks have it in the state.
        margin: by which all bodies but planes are larger for the solver than their distances say; adds: whether what
            it pushes out adds to the speed of a rebound. Both are habits of the teacher, for comparisons with it.
    """

    gravity: Tensor
    dt: float
    substeps: int = SUBSTEPS
    falls: bool = True
    contact: bool = True
    friction: bool = True
    restitution: bool = True
    rotation: bool = True
    free_flight: FreeFlight = "exact"
    rows: int | None = None
    guard: Guard = "none"
    sleep: bool = False
    margin: float = 0.0
    adds: bool = False


@torch.no_grad()
def step(
    model: Model, bodies: Bodies, state: State, rules: Rules, memory: Memory | None = None
) -> tuple[State, Contacts | None]:
    """Advance `state` by one step.

    Args:
        model: what predicts contact.
        bodies: N bodies.
        state: theirs.
        rules: what is in play.
        memory: of the run; without one every step starts from nothing, with the same result.

    Returns:
        The next state, and the contact edges that acted (None with contact off).
    """
    memory = memory or Memory()
    edited = memory.begin(bodies, state)
    state = stir(bodies, drive(bodies, state, rules), rules.gravity, edited=edited)
    if model.kind == SOLVER and rules.contact:
        from sdfsim.dynamics.solver import solver_step  # numba takes its time to load

        state = solver_step(bodies, state, rules, memory)
        memory.end(bodies, state)
        return state, None
    contacts = None
    if rules.contact:
        state, contacts = meet(model, bodies, state, rules, memory)
    with memory.timed("flight_ms"):
        after = flown = fly(bodies, state, rules)
    if contacts is not None or rules.free_flight == "learned":
        with memory.timed("network_ms"):
            after, contacts = respond(model, bodies, state, flown, contacts, rules, memory)
            after = hold_back(bodies, state, flown, after, contacts, rules.gravity, rules.dt, rules.guard, memory)
    if contacts is not None and after.sleep is not None:
        with memory.timed("sleep_ms"):
            after = settle(bodies, after, contacts, rules.gravity)
    memory.end(bodies, after)
    return after, contacts


def drive(bodies: Bodies, state: State, rules: Rules) -> State:
    """Scripted bodies take the velocities that lead them along their paths in the coming step."""
    if bodies.tracks is None:
        return state
    velocity, angular = bodies.tracks.velocity(state.time, rules.dt)
    rows = bodies.tracks.body
    return replace(
        state,
        velocity=state.velocity.index_copy(0, rows, velocity),
        angular_velocity=state.angular_velocity.index_copy(0, rows, angular),
    )


def meet(model: Model, bodies: Bodies, state: State, rules: Rules, memory: Memory) -> tuple[State, Contacts]:
    """Contact edges; what sleeps beside something that moves wakes, and is looked at in turn."""
    while True:
        thin = model.kind == "impulse"
        contacts = find_contacts(bodies, state, rules.gravity, model.reach, rules.dt, memory, rules.rows, thin=thin)
        islands = touched(state, contacts)
        if not len(islands):
            return state, parting(bodies, state, contacts, memory)
        state = wake(state, islands)


def fly(bodies: Bodies, state: State, rules: Rules) -> State:
    """Free flight of every body that moves: exact, whatever the step. Scripted bodies go on along their paths."""
    rows = awake(bodies, state)
    now = {name: getattr(state, name) for name in _POSE}
    if len(rows):
        place, velocity = state.position[rows], state.velocity[rows]
        if rules.falls:
            place, velocity = ballistic(place, velocity, rules.gravity, rules.dt)
        else:
            place = place + velocity * rules.dt
        if rules.rotation:
            turned = torque_free(state.orientation[rows], state.angular_velocity[rows], bodies.inertia[rows], rules.dt)
        else:
            turned = (state.orientation[rows], torch.zeros_like(velocity))
        now = _put(now, rows, (place, turned[0], velocity, turned[1]))
    if bodies.tracks is not None:
        place, orientation = bodies.tracks.at(state.time + rules.dt)
        at = bodies.tracks.body
        now = _put(now, at, (place, orientation, state.velocity[at], state.angular_velocity[at]))
    return replace(
        state,
        **now,
        earlier_position=_shift(state.earlier_position, state.position),
        earlier_orientation=_shift(state.earlier_orientation, state.orientation),
        time=state.time + rules.dt,
    )


def respond(
    model: Model, bodies: Bodies, state: State, free: State, contacts: Contacts | None, rules: Rules, memory: Memory
) -> tuple[State, Contacts]:
    """What contacts make of free flight; only bodies with a contact edge are in the network's graph."""
    contacts = no_contacts(bodies) if contacts is None else contacts
    active = torch.cat([contacts.owner, contacts.body])
    if rules.free_flight == "learned":
        active = torch.cat([active, awake(bodies, state)])
    active = torch.unique(active)
    moved = int(bodies.moves[active].sum())
    memory.count(active=moved)
    if not moved:
        return free, contacts
    if model.kind == "paper":
        return _paper_step(model, bodies, state, free, contacts, active, rules, memory), contacts
    graph = contact_graph(bodies, state, free, contacts, rules)[1]
    memory.count(nodes=len(active), edges=len(contacts))
    predicted = model.network(graph, friction=rules.friction, rows=rules.rows)
    return _move(bodies, state, free, active, graph, predicted, rules), contacts


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
    turn = pose.to_rotvec(pose.multiply(free.orientation[active], pose.conjugate(state.orientation[active])))
    nothing = torch.zeros_like(contacts.distance)
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
        arm_first=contacts.arm.float(),
        arm_second=contacts.foot.float(),
        gap=contacts.distance.float(),
        substeps=torch.full_like(contacts.distance, rules.substeps).float(),
        friction=(_product(bodies.friction, contacts) if rules.friction else nothing).float(),
        restitution=(_product(bodies.restitution, contacts) if rules.restitution else nothing).float(),
        dt=rules.dt,
    )


def _move(
    bodies: Bodies, state: State, free: State, active: Tensor, graph: ContactGraph, predicted: Velocities, rules: Rules
) -> State:
    """Bodies in contact move by the predicted mean velocities and leave with the predicted end velocities."""
    chosen = bodies.moves[active]
    rows = active[chosen]

    def change(now: Tensor, flown: Tensor) -> Tensor:
        # What contact adds, so that single precision rounds that and not the motion that goes on.
        return (now - flown)[chosen].double()

    place = free.position[rows] + change(predicted.mean_velocity, graph.mean_velocity) * rules.dt
    velocity = free.velocity[rows] + change(predicted.velocity, graph.free_velocity)
    orientation, angular = state.orientation[rows], free.angular_velocity[rows]
    if rules.rotation:
        turn = pose.from_rotvec(predicted.mean_angular[chosen].double() * rules.dt)
        orientation = pose.normalise(pose.multiply(turn, orientation))
        angular = angular + change(predicted.angular, graph.free_angular)
    now = {name: getattr(free, name) for name in _POSE}
    return replace(free, **_put(now, rows, (place, orientation, velocity, angular)))


def _paper_step(
    model: Model,
    bodies: Bodies,
    state: State,
    free: State,
    contacts: Contacts,
    active: Tensor,
    rules: Rules,
    memory: Memory,
) -> State:
    """The published step of the bodies `active` [A] alone."""
    if not rules.friction:
        bodies = replace(bodies, friction=torch.zeros_like(bodies.friction))
    if not rules.restitution:
        bodies = replace(bodies, restitution=torch.zeros_like(bodies.restitution))
    some = compact(bodies, state, contacts, active)
    memory.count(nodes=len(active) + len(some[0].node), edges=2 * (len(some[0].node) + len(contacts)))
    predicted = predict(model.network, *some, rules.dt, rules.rows)  # type: ignore[arg-type]
    chosen = bodies.moves[active]
    rows = active[chosen]
    orientation, angular = predicted.orientation[chosen], predicted.angular_velocity[chosen]
    if not rules.rotation:
        orientation, angular = state.orientation[rows], torch.zeros_like(angular)
    now = {name: getattr(free, name) for name in _POSE}
    return replace(
        free, **_put(now, rows, (predicted.position[chosen], orientation, predicted.velocity[chosen], angular))
    )


def _put(now: dict[str, Tensor], rows: Tensor, values: tuple[Tensor, ...]) -> dict[str, Tensor]:
    """The tensors of `now` with the given rows replaced."""
    return {name: now[name].index_copy(0, rows, value) for name, value in zip(_POSE, values, strict=True)}


def _product(coefficient: Tensor, contacts: Contacts) -> Tensor:
    return coefficient[contacts.owner] * coefficient[contacts.body]


def _shift(earlier: Tensor | None, now: Tensor) -> Tensor | None:
    return None if earlier is None else torch.stack([earlier[1], now])
