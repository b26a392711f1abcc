"""One step of simulation, top to bottom: lead what is scripted, solve contacts, let the network correct, move.

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
from sdfsim.dynamics.free_flight import ballistic, torque_free
from sdfsim.dynamics.model import Model
from sdfsim.dynamics.models.contact_graph import SUBSTEPS, ContactGraph, number_pairs
from sdfsim.dynamics.run_memory import Memory

if TYPE_CHECKING:
    from sdfsim.dynamics.models.families import Near
    from sdfsim.dynamics.solver import Acts

FreeFlight = Literal["exact", "learned"]
_POSE = ("position", "orientation", "velocity", "angular_velocity")


@dataclass(frozen=True)
class StepOptions:
    """What is in play during a run, in model units."""

    gravity: Tensor  # [3] float64
    dt: float  # the step
    substeps: int = SUBSTEPS  # inner steps of the solve in it
    falls: bool = True  # False where gravity is zero: free flight without acceleration
    contact: bool = True  # False leaves every body in free flight
    friction: bool = True  # False computes no tangential impulse
    restitution: bool = True  # False makes every contact one of restitution 0
    rotation: bool = True  # False lets bodies translate only
    # "exact", or "learned" where a network on surface nodes predicts all of every body's motion
    free_flight: FreeFlight = "exact"
    rows: int | None = None  # how many edges such a network works on at once; None for all
    sleep: bool = False  # whether the solve freezes what rests
    # by which all bodies but planes are larger for the solve than their distances say; adds: whether what it pushes out
    # adds to the speed of a rebound. Both are habits of the teacher, for comparisons with it.
    margin: float = 0.0
    adds: bool = False
    trust: float = 1.0  # in what the network adds to the solve; 0 where a scene is beyond its training


@torch.no_grad()
def step(
    model: Model, bodies: Bodies, state: State, rules: StepOptions, memory: Memory | None = None
) -> tuple[State, Near | None]:
    """Advance `state` by one step: the next state, and where a network on surface nodes saw bodies near each other,
    None for other models. Without the run's `memory` every step starts from nothing, with the same result."""
    memory = memory or Memory()
    memory.begin(bodies)
    state, contacts = drive(bodies, state, rules), None
    if model.on_surfaces:
        after, contacts = _surface_step(model, bodies, state, rules, memory)
    elif rules.contact:
        after = _solved_step(model, bodies, state, rules, memory)
    else:
        with memory.timed("flight_ms"):
            after = fly(bodies, state, rules)
    memory.end(bodies, after)
    return after, contacts


def drive(bodies: Bodies, state: State, rules: StepOptions) -> State:
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


def _solved_step(model: Model, bodies: Bodies, state: State, rules: StepOptions, memory: Memory) -> State:
    """What the contact solve makes of the step, and on top of it the network, where the model is one."""
    from sdfsim.dynamics.solver import held, solver_step  # numba takes its time to load

    # No network has seen forces in its training.
    on_top = model.kind == "impulse" and rules.trust > 0.0 and state.load is None
    solved, acts = solver_step(bodies, state, rules, memory, note=on_top)
    if not (on_top and len(acts)):
        return solved
    with memory.timed("network_ms"):
        if next(model.network.parameters()).device.type == "cpu":
            from sdfsim.dynamics.inference import corrected

            weights, world = memory.weights(model.network, rules), memory.compiled(bodies, state).world
            after = corrected(weights, world, state, solved, acts, rules, known=model.dt)
        else:
            after = correct(model, bodies, state, solved, acts, rules)
    memory.count(nodes=len(torch.unique(torch.cat([acts.first, acts.second]))), edges=len(acts))
    # The solve takes poses and velocities that it did not leave behind for changes from outside.
    assert after.touch is not None
    return replace(after, touch=replace(after.touch, held=held(after)))


def fly(bodies: Bodies, state: State, rules: StepOptions) -> State:
    """Free flight of every body that moves: exact, whatever the step. Scripted bodies go on along their paths."""
    rows = awake(bodies, state)
    now = {name: getattr(state, name) for name in _POSE}
    if len(rows):
        place, velocity = state.position[rows], state.velocity[rows]
        load = None if state.load is None else state.load[rows]
        if rules.falls or load is not None:
            pull = rules.gravity if load is None else rules.gravity + bodies.inverse_mass[rows, None] * load[:, :3]
            place, velocity = ballistic(place, velocity, pull, rules.dt)
        else:
            place = place + velocity * rules.dt
        if rules.rotation:
            turned = _turned(bodies, state, rows, rules.dt)
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


def _turned(bodies: Bodies, state: State, rows: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Orientation and angular velocity after free flight; a torque acts half before and half after it."""
    orientation, angular, inertia = state.orientation[rows], state.angular_velocity[rows], bodies.inertia[rows]
    if state.load is None:
        return torque_free(orientation, angular, inertia, dt)
    half = 0.5 * dt * state.load[rows, 3:, None]

    def twisted(orientation: Tensor) -> Tensor:
        axes = pose.to_matrix(orientation)
        return (axes @ torch.linalg.solve(inertia, axes.mT @ half))[..., 0]

    orientation, angular = torque_free(orientation, angular + twisted(orientation), inertia, dt)
    return orientation, angular + twisted(orientation)


def correct(model: Model, bodies: Bodies, state: State, solved: State, acts: Acts, rules: StepOptions) -> State:
    """What the network makes of the solve: only bodies that have met somebody are in its graph. `inference.corrected`
    is the same, compiled, for the CPU."""
    weight = next(model.network.parameters())
    active, graph = contact_graph(bodies, state, solved, acts, rules, model.dt, weight.dtype)
    predicted = model.network(graph.to(weight.device), friction=rules.friction, trust=rules.trust)
    # From the network's units of time and length back to those of the bodies.
    time = rules.dt / model.dt
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
    bodies: Bodies,
    state: State,
    solved: State,
    acts: Acts,
    rules: StepOptions,
    dt: float,
    dtype: torch.dtype = torch.float32,
) -> tuple[Tensor, ContactGraph]:
    """The bodies [A] that met somebody, and the graph among them in `dtype`.

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
    spin = state.angular_velocity[active]
    if rules.rotation:
        free = torque_free(state.orientation[active], spin, bodies.inertia[active], rules.dt)[1]
        spin = torch.where(moves[:, None], free, spin)
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
    given = {name: value.to(dtype) for name, value in values.items()}
    return active, ContactGraph(**given, first=first, second=second, pair=pair, pairs=pairs, dt=dt)


def _surface_step(
    model: Model, bodies: Bodies, state: State, rules: StepOptions, memory: Memory
) -> tuple[State, Near | None]:
    """A published step of the bodies that are near another; free flight, or its learned form, for the others."""
    from sdfsim.dynamics.models.families import FAMILIES
    from sdfsim.dynamics.models.surfaces import compact, predict

    family = FAMILIES[model.kind]
    with memory.timed("flight_ms"):
        free = fly(bodies, state, rules)
    learned = rules.free_flight == "learned"
    if not rules.contact and not learned:
        return free, None
    with memory.timed("contact_ms"):
        near = family.none(bodies.device)
        if rules.contact:
            near = family.near(bodies, state, rules.gravity, model.reach, rules.dt, memory)
    active = torch.cat([near.owner, near.body, *([awake(bodies, state)] if learned else [])])
    active = torch.unique(active)
    chosen = bodies.moves[active]
    memory.count(active=int(chosen.sum()), contacts=len(near))
    if not bool(chosen.any()):
        return free, near
    if not rules.friction:
        bodies = replace(bodies, friction=torch.zeros_like(bodies.friction))
    if not rules.restitution:
        bodies = replace(bodies, restitution=torch.zeros_like(bodies.restitution))
    with memory.timed("network_ms"):
        some, start, among = compact(bodies, state, near, active)
        graph = family.graph(some, start, among)
        predicted = predict(model.network, graph, some, start, rules.dt, rules.rows)  # type: ignore[arg-type]
    memory.count(nodes=len(graph), edges=graph.edge_count)
    rows = active[chosen]
    orientation, angular = predicted.orientation[chosen], predicted.angular_velocity[chosen]
    if not rules.rotation:
        orientation, angular = state.orientation[rows], torch.zeros_like(angular)
    now = {name: getattr(free, name) for name in _POSE}
    moved = (predicted.position[chosen], orientation, predicted.velocity[chosen], angular)
    return replace(free, **_put(now, rows, moved)), near


def _put(now: dict[str, Tensor], rows: Tensor, values: tuple[Tensor, ...]) -> dict[str, Tensor]:
    """The tensors of `now` with the given rows replaced."""
    return {name: now[name].index_copy(0, rows, value) for name, value in zip(_POSE, values, strict=True)}


def _shift(earlier: Tensor | None, now: Tensor) -> Tensor | None:
    return None if earlier is None else torch.stack([earlier[1], now])
