"""One step of simulation, top to bottom: lead what is scripted, solve contacts, let the network correct, move.

Each stage sees only what is in play: an effect that is off is not computed, a body without contact is not in the
network's graph, and what sleeps is not looked at until something moves beside it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from sdfsim.learned.model import Model
from sdfsim.physics import pose
from sdfsim.physics.bodies import Bodies, State, awake
from sdfsim.physics.free_flight import ballistic, torque_free
from sdfsim.physics.options import StepOptions
from sdfsim.simulate.run_memory import Memory

if TYPE_CHECKING:
    from sdfsim.learned.near import Contacts, Pairs

_POSE = ("position", "orientation", "velocity", "angular_velocity")


@torch.no_grad()
def step(
    model: Model, bodies: Bodies, state: State, rules: StepOptions, memory: Memory | None = None
) -> tuple[State, Contacts | Pairs | None]:
    """Advance `state` by one step: the next state, and where a network on surface nodes saw bodies near each other,
    None for other models. Without the run's `memory` every step starts from nothing, with the same result."""
    memory = memory or Memory()
    memory.begin()
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
    from sdfsim.physics.solver.prepare import held, solver_step  # numba takes its time to load

    # No network has seen forces in its training.
    on_top = model.kind == "impulse" and rules.trust > 0.0 and state.load is None
    solved, edges = solver_step(bodies, state, rules, memory, note=on_top)
    if not (on_top and len(edges.pair)):
        return solved
    from sdfsim.learned.inference import corrected

    with memory.timed("network_ms"):
        weights, world = memory.weights(model.network, rules), memory.compiled(bodies, state).world
        after = corrected(weights, world, state, solved, edges, rules, known=model.dt)
    memory.count(nodes=len(np.unique(edges.pair)), edges=len(edges.pair))
    # The solve takes poses and velocities that it did not leave behind for changes from outside.
    assert after.touch is not None
    return replace(after, touch=replace(after.touch, held=held(after)))


def fly(bodies: Bodies, state: State, rules: StepOptions) -> State:
    """Free flight of every body that moves: exact, whatever the step. Scripted bodies go on along their paths."""
    rows = awake(bodies, state)
    now = {name: getattr(state, name) for name in _POSE}
    if len(rows):
        pull = rules.gravity
        if state.load is not None:
            pull = pull + bodies.inverse_mass[rows, None] * state.load[rows, :3]
        place, velocity = ballistic(state.position[rows], state.velocity[rows], pull, rules.dt)
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


def _surface_step(
    model: Model, bodies: Bodies, state: State, rules: StepOptions, memory: Memory
) -> tuple[State, Contacts | Pairs | None]:
    """A published step of the bodies that are near another; free flight, or its learned form, for the others."""
    from sdfsim.learned.families import FAMILIES
    from sdfsim.learned.surfaces import compact, predict

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
