"""The *impulse* network in a simulation: the graph of a solved step, and the step with the network's corrections."""

from copy import deepcopy

import numpy as np
import torch
from torch import Tensor

from sdfsim.learned.contact_graph import ContactGraph, number_pairs
from sdfsim.learned.impulse import ImpulseNetwork, Velocities
from sdfsim.physics import pose
from sdfsim.physics.bodies import Bodies, State
from sdfsim.physics.free_flight import torque_free
from sdfsim.physics.motion import MOTION
from sdfsim.physics.options import Options
from sdfsim.physics.solver.record import APART, ARM, AXIS, GIVEN, OTHER, WHEN, Edges


def doubled(network: ImpulseNetwork) -> ImpulseNetwork:
    """A copy in double precision: its impulses then conserve momentum to the last digits of a state."""
    return deepcopy(network).cpu().double()


def step_graph(
    bodies: Bodies, before: State, solved: State, edges: Edges, options: Options, known: float,
    rows: np.ndarray | None = None,
) -> tuple[np.ndarray, ContactGraph]:  # fmt: skip
    """The bodies `rows` [A] int64 (None: those that met another in a solved step with these `edges`), and their graph
    in double precision. Units are such that the step is `known`, the only step that the network was trained with, and
    gravity keeps its value; masses are relative to the heaviest."""
    rows = np.unique(edges.pair) if rows is None else rows
    inside = np.searchsorted(rows, edges.pair)
    time = options.dt / known
    length, moves = time * time, bodies.moves[rows]
    heaviest = float(bodies.mass[rows].max()) or 1.0
    (place, start, speed, spin), (later, turned, solved_speed, solved_spin) = (
        [state.rows_of(name, rows) for name in MOTION] for state in (before, solved)
    )
    turn, still = pose.to_matrix(start), ~moves[:, None]
    inertia = bodies.inertia[rows]
    inverse = turn @ np.linalg.inv(inertia) @ turn.swapaxes(-1, -2) * (moves & options.rotation)[:, None, None]
    free = np.where(still, spin, torque_free(start, spin, inertia, options.dt)[1]) if options.rotation else spin
    fall = options.dt * np.asarray(options.gravity) * moves[:, None]
    turned = pose.to_rotvec(pose.multiply(turned, pose.conjugate(start)))

    def tensor(values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values))

    def edge(column: int) -> Tensor:
        return tensor(edges.value[:, column : column + 3])

    def product(own: np.ndarray, there: bool) -> Tensor:
        return tensor(own[edges.pair].prod(1) * there)

    first, second = torch.from_numpy(np.ascontiguousarray(inside.T))
    pair, pairs = number_pairs(first, second, len(rows))
    return rows, ContactGraph(
        inverse_mass=tensor(bodies.inverse_mass[rows] * heaviest),
        inverse_inertia=tensor(inverse * (heaviest * length**2)),
        velocity=tensor(speed / time),
        angular=tensor(spin * time),
        free_velocity=tensor((speed + fall) / time),
        free_angular=tensor(free * time),
        solved_velocity=tensor(solved_speed / time),
        solved_angular=tensor(solved_spin * time),
        mean_velocity=tensor((later - place) / (options.dt * time)),
        mean_angular=tensor(turned * (time / options.dt)),
        first=first,
        second=second,
        pair=pair,
        pairs=pairs,
        normal=edge(AXIS),
        arm_first=edge(ARM) / length,
        arm_second=edge(OTHER) / length,
        impulse=edge(GIVEN) / (heaviest * time),
        gap=tensor(edges.value[:, APART] / length),
        when=tensor(edges.value[:, WHEN]),
        friction=product(bodies.friction, options.friction),
        restitution=product(bodies.restitution, options.restitution),
        dt=known,
    )


def corrected(
    network: ImpulseNetwork, bodies: Bodies, before: State, solved: State, edges: Edges, options: Options,
    known: float, trust: float = 1.0,
) -> State:  # fmt: skip
    """The state after a step of the solve with these `edges` (at least one), corrected by a network that was trained on
    steps of `known`; `trust` (0 to 1) scales the correction."""
    rows, graph = step_graph(bodies, before, solved, edges, options, known)
    with torch.no_grad():
        made = network(graph, friction=options.friction, trust=trust)
    return changed(bodies, solved, rows, graph, made, options)


def changed(
    bodies: Bodies, solved: State, rows: np.ndarray, graph: ContactGraph, made: Velocities, options: Options
) -> State:
    """The solved step with the velocities `made` by a network for the bodies `rows`."""
    time, moves = options.dt / graph.dt, bodies.moves[rows]
    rows = rows[moves]
    change = {
        name: (getattr(made, name) - getattr(graph, of)).numpy()[moves].astype(np.float64)
        for name, of in (
            ("velocity", "solved_velocity"), ("angular", "solved_angular"),
            ("mean_velocity", "mean_velocity"), ("mean_angular", "mean_angular"),
        )
    }  # fmt: skip
    moved = {name: solved.rows_of(name, rows) for name in MOTION}
    moved["position"] += change["mean_velocity"] * time * options.dt
    moved["velocity"] += change["velocity"] * time
    if options.rotation:
        turn = pose.from_rotvec(change["mean_angular"] * graph.dt)
        moved["orientation"] = pose.normalise(pose.multiply(turn, moved["orientation"]))
        moved["angular_velocity"] += change["angular"] / time
    return solved.with_rows(rows, moved)
