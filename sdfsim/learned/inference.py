"""The *impulse* network in a simulation: the graph of a step, and the step with the network's impulses."""

from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from sdfsim.base.compiling import cache_of, kept
from sdfsim.learned.contact_graph import REST_SPEED, ContactGraph, number_pairs
from sdfsim.learned.impulse import ImpulseNetwork, Velocities
from sdfsim.physics import pose
from sdfsim.physics.bodies import Bodies, State
from sdfsim.physics.motion import MOTION
from sdfsim.physics.options import Options

with kept(cache_of([Path(__file__).with_name("non_penetration.py")])):
    from sdfsim.learned.non_penetration import separated

# Fields of `Velocities`, and those of a graph that hold the same for free flight.
FREE = {
    "velocity": "free_velocity", "angular": "free_angular", "mean_velocity": "mean_velocity",
    "mean_angular": "mean_angular",
}  # fmt: skip
# Relative to `REST_SPEED`: contacts may give a body the energy of this speed, so that bodies that overlap come apart.
SPARE = 0.25

TOUCH = 1e-4  # model units: nearer surfaces touch

Edges = tuple[np.ndarray, np.ndarray]  # as `physics.solver.prepare.points_near` gives them


def doubled(network: ImpulseNetwork) -> ImpulseNetwork:
    """A copy in double precision: its impulses then conserve momentum to the last digits of a state."""
    return deepcopy(network).cpu().double()


def velocities(before: State, after: State, rows: np.ndarray, dt: float, known: float) -> Velocities:
    """How the bodies `rows` [A] int64 move in a step `dt` from one state to another, in units in which it lasts
    `known`."""
    time = dt / known
    start, end = ([state.rows_of(name, rows) for name in MOTION] for state in (before, after))
    turned = pose.to_rotvec(pose.multiply(end[1], pose.conjugate(start[1])))
    found = end[2] / time, end[3] * time, (end[0] - start[0]) / (dt * time), turned * (time / dt)
    return Velocities(*map(_tensor, found))


def step_graph(
    bodies: Bodies, before: State, free: State, edges: Edges, options: Options, known: float, rows: np.ndarray
) -> ContactGraph:
    """The graph of the bodies `rows` [A] int64, among them all of these `edges`, in double precision, with the state
    that free flight leads to. Units are such that the step is `known`, the only step that the network was trained with,
    and gravity keeps its value; masses are relative to the heaviest."""
    pair, value = edges
    inside = np.searchsorted(rows, pair)
    time = options.dt / known
    length, moves = time * time, bodies.moves[rows]
    heaviest = float(bodies.mass[rows].max()) or 1.0
    turn = pose.to_matrix(before.rows_of("orientation", rows))
    inverse = turn @ np.linalg.inv(bodies.inertia[rows]) @ turn.swapaxes(-1, -2)
    inverse = inverse * (moves & options.rotation)[:, None, None]
    flown = velocities(before, free, rows, options.dt, known)
    first, second = torch.from_numpy(np.ascontiguousarray(inside.T))
    of_pair, pairs = number_pairs(first, second, len(rows))
    return ContactGraph(
        inverse_mass=_tensor(bodies.inverse_mass[rows] * heaviest),
        inverse_inertia=_tensor(inverse * (heaviest * length**2)),
        velocity=_tensor(before.rows_of("velocity", rows) / time),
        angular=_tensor(before.rows_of("angular_velocity", rows) * time),
        free_velocity=flown.velocity,
        free_angular=flown.angular,
        mean_velocity=flown.mean_velocity,
        mean_angular=flown.mean_angular,
        first=first,
        second=second,
        pair=of_pair,
        pairs=pairs,
        arm_first=_tensor(value[:, :3] / length),
        arm_second=_tensor(value[:, 3:6] / length),
        normal=_tensor(value[:, 6:9]),
        gap=_tensor(value[:, 9] / length),
        when=_tensor(value[:, 10]),
        friction=_tensor(bodies.friction[pair].prod(1) * options.friction),
        restitution=_tensor(bodies.restitution[pair].prod(1) * options.restitution),
        dt=known,
    )


def stepped(
    network: ImpulseNetwork, bodies: Bodies, before: State, free: State, edges: Edges, options: Options, known: float
) -> State:
    """The state after a step: free flight, and the impulses of a network that was trained on steps of `known` at these
    `edges` (at least one)."""
    rows = np.unique(edges[0])
    graph = step_graph(bodies, before, free, edges, options, known, rows)
    with torch.no_grad():
        made = network(graph, friction=options.friction)
    time, moves = options.dt / known, bodies.moves[rows]
    rows = rows[moves]
    made = _apart(graph, made)
    share = _passive(graph, made, options.gravity)[moves, None]
    end, spin, mean, turn = (
        getattr(graph, of).numpy()[moves] + share * (getattr(made, name) - getattr(graph, of)).numpy()[moves]
        for name, of in FREE.items()
    )
    orientation = before.rows_of("orientation", rows)
    moved = {
        "position": before.rows_of("position", rows) + mean * (time * options.dt),
        "orientation": orientation,
        "velocity": end * time,
        "angular_velocity": np.zeros_like(spin),
    }
    if options.rotation:
        turned = pose.multiply(pose.from_rotvec(turn * known), orientation)
        moved |= {"orientation": pose.normalise(turned), "angular_velocity": spin / time}
    return free.with_rows(rows, moved)


def _passive(graph: ContactGraph, made: Velocities, gravity: np.ndarray) -> np.ndarray:
    """[A] the largest part, 0 to 1, of the changes of velocity with which contacts give no energy, except for `SPARE`:
    the same for all bodies of an island, so that momentum is kept."""
    inverse = graph.inverse_mass.numpy()
    ends = np.stack([graph.first.numpy(), graph.second.numpy()])
    both = ends[:, (inverse[ends] > 0).all(0)]
    count = len(inverse)
    joined = coo_matrix((np.ones(both.shape[1]), both), shape=(count, count))
    island = connected_components(joined, directed=False)[1]
    mass = np.divide(1.0, inverse, out=np.zeros(count), where=inverse > 0)
    inertia = np.linalg.pinv(graph.inverse_inertia.numpy(), hermitian=True)
    before = graph.free_velocity.numpy(), graph.free_angular.numpy()
    change = made.velocity.numpy() - before[0], made.angular.numpy() - before[1]
    momentum = mass[:, None] * change[0], (inertia @ change[1][..., None])[..., 0]
    linear, square = (
        np.bincount(island, sum((one * other).sum(-1) for one, other in zip(momentum, of, strict=True)))
        for of in (before, change)
    )
    lifted = graph.dt * (made.mean_velocity - graph.mean_velocity).numpy()
    linear = linear - np.bincount(island, mass * (lifted @ gravity))
    spare = np.bincount(island, 0.5 * mass * (SPARE * REST_SPEED) ** 2)
    # linear s + square s^2 / 2 <= spare
    root = np.sqrt(linear**2 + 2.0 * square * spare)
    most = np.divide(root - linear, square, out=np.ones(len(spare)), where=square > 0)
    return np.minimum(most, 1.0)[island]


def _apart(graph: ContactGraph, made: Velocities) -> Velocities:
    """Velocities with the impulses that keep bodies from sinking into each other. The mean motion makes no overlap
    deeper than it is; where that needs a push, surfaces do not approach each other at the end of the step either."""
    bodies = [getattr(graph, name).numpy() for name in ("inverse_mass", "inverse_inertia")]
    apart: Any = separated
    touching = graph.gap.numpy() + graph.when.numpy() <= TOUCH
    names = "first", "second", "normal", "arm_first", "arm_second"
    where = [getattr(graph, name).numpy()[touching] for name in names]
    moved = np.concatenate([made.mean_velocity.numpy(), made.mean_angular.numpy()], 1)
    pushed = apart(moved, *bodies, *where, np.zeros(len(where[0]))) > 0.0
    left = np.concatenate([made.velocity.numpy(), made.angular.numpy()], 1)
    apart(left, *bodies, *(array[pushed] for array in where), np.zeros(int(pushed.sum())))
    return Velocities(*(_tensor(values) for both in (left, moved) for values in (both[:, :3], both[:, 3:])))


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values))
