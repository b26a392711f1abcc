"""One step of simulation, top to bottom as in the paper: find contacts, fly, let the network act, move.

Each stage sees only what is in play: an effect that is off is not computed, a body without contact is not in the
network's graph, and what sleeps is not looked at until something moves beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Bodies, State, awake
from sdfsim.dynamics.contacts import Contacts, find_contacts, no_contacts
from sdfsim.dynamics.energy import Guard, hold_back
from sdfsim.dynamics.freeflight import ballistic, torque_free
from sdfsim.dynamics.graph import SUBSTEPS, ContactGraph, number_pairs
from sdfsim.dynamics.memory import Memory
from sdfsim.dynamics.model import Model
from sdfsim.dynamics.overlap import parting
from sdfsim.dynamics.sleep import settle, stir, touched, wake
from sdfsim.dynamics.surfaces import compact, predict

if TYPE_CHECKING:
    from sdfsim.dynamics.solver import Acts

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
        trust: in what the network adds to the solve; 0 where a scene is beyond its training.
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
    trust: float = 1.0


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
    if model.kind != "paper" and rules.contact:
        from sdfsim.dynamics.solver import held, solver_step  # numba takes its time to load

        on_top = model.kind == "impulse" and rules.trust > 0.0
        solved, acts = solver_step(bodies, state, rules, memory, note=on_top)
        if on_top and len(acts):
            with memory.timed("network_ms"):
                solved = correct(model, bodies, state, solved, acts, rules, memory)
                solved = replace(solved, touch=replace(solved.touch, held=held(solved)))
        memory.end(bodies, solved)
        return solved, None
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
    return _paper_step(model, bodies, state, free, contacts, active, rules, memory), contacts


def correct(
    model: Model, bodies: Bodies, state: State, solved: State, acts: Acts, rules: Rules, memory: Memory
) -> State:
    """What the network makes of the solve: only bodies that have met somebody are in its graph."""
    active, graph = contact_graph(bodies, state, solved, acts, rules, model.dt)
    device = next(model.network.parameters()).device
    predicted = model.network(graph.to(device), friction=rules.friction, rows=rules.rows, trust=rules.trust)
    # From the network's units of time and length back to those of the bodies.
    time = rules.dt / model.dt
    memory.count(nodes=len(active), edges=len(acts))
    chosen = (graph.inverse_mass > 0).cpu()
    rows = active.cpu()[chosen]

    def added(now: Tensor, before: Tensor) -> Tensor:
        # What the network adds, so that single precision rounds that and not the motion that goes on.
        return (now.cpu() - before)[chosen].double()

    turn = pose.from_rotvec(added(predicted.mean_angular, graph.mean_angular) * model.dt)
    place = solved.position[rows] + added(predicted.mean_velocity, graph.mean_velocity) * time * rules.dt
    velocity = solved.velocity[rows] + added(predicted.velocity, graph.solved_velocity) * time
    orientation, angular = solved.orientation[rows], solved.angular_velocity[rows]
    if rules.rotation:
        orientation = pose.normalise(pose.multiply(turn, orientation))
        angular = angular + added(predicted.angular, graph.solved_angular) / time
    now = {name: getattr(solved, name) for name in _POSE}
    return replace(solved, **_put(now, rows, (place, orientation, velocity, angular)))


def contact_graph(
    bodies: Bodies, state: State, solved: State, acts: Acts, rules: Rules, dt: float
) -> tuple[Tensor, ContactGraph]:
    """The bodies [A] that met somebody, and the graph among them in single precision.

    It is told in units in which the step lasts `dt` and gravity is what it is (Froude scaling): a network knows no
    other step, and takes a longer one for the same step of smaller bodies.
    """
    time = rules.dt / dt
    length = time**2
    active, index = torch.unique(torch.cat([acts.first, acts.second]), return_inverse=True)
    first, second = index.chunk(2)
    pair, pairs = number_pairs(first, second, len(active))
    rotation = pose.to_matrix(state.orientation[active])
    moves = bodies.moves[active]
    turns = (moves if rules.rotation else torch.zeros_like(moves))[:, None, None]
    inverse_inertia = rotation @ torch.linalg.inv(bodies.inertia[active]) @ rotation.mT * turns
    spin = torque_free(state.orientation[active], state.angular_velocity[active], bodies.inertia[active], rules.dt)[1]
    spin = torch.where(turns[..., 0], spin, state.angular_velocity[active])
    turned = pose.multiply(solved.orientation[active], pose.conjugate(state.orientation[active]))
    nothing = torch.zeros_like(acts.gap)
    # Masses enter as ratios only; relative to the heaviest they stay within single precision.
    heaviest = bodies.mass[active].max()

    def product(coefficient: Tensor) -> Tensor:
        return coefficient[acts.first] * coefficient[acts.second]

    values = {
        "inverse_mass": bodies.inverse_mass[active] * heaviest,
        "inverse_inertia": inverse_inertia * heaviest * length**2,
        "velocity": state.velocity[active] / time,
        "angular": state.angular_velocity[active] * time,
        "free_velocity": (state.velocity[active] + rules.gravity * rules.dt * moves[:, None]) / time,
        "free_angular": spin * time,
        "solved_velocity": solved.velocity[active] / time,
        "solved_angular": solved.angular_velocity[active] * time,
        "mean_velocity": (solved.position - state.position)[active] / rules.dt / time,
        "mean_angular": pose.to_rotvec(turned) / dt,
        "normal": acts.normal,
        "arm_first": acts.arm_first / length,
        "arm_second": acts.arm_second / length,
        "impulse": acts.impulse / heaviest / time,
        "gap": acts.gap / length,
        "when": acts.when,
        "friction": product(bodies.friction) if rules.friction else nothing,
        "restitution": product(bodies.restitution) if rules.restitution else nothing,
    }
    single = {name: value.float() for name, value in values.items()}
    return active, ContactGraph(**single, first=first, second=second, pair=pair, pairs=pairs, dt=dt)


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
