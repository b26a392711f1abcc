"""The *impulse* network in a simulation: the graph of a step, and the step with the network's impulses."""

from copy import deepcopy

import numpy as np
import torch
from torch import Tensor

from sdfsim.learned.contact_graph import ContactGraph, number_pairs
from sdfsim.learned.impulse import ImpulseNetwork, Velocities
from sdfsim.physics import pose
from sdfsim.physics.bodies import Bodies, State
from sdfsim.physics.motion import MOTION
from sdfsim.physics.options import Options

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
    end, spin, mean, turn = (
        getattr(made, name).numpy()[moves] for name in ("velocity", "angular", "mean_velocity", "mean_angular")
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


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values))
