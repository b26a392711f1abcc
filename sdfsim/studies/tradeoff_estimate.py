"""How long a run will take, told from its first steps, from when its bodies will land, and from the cost model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from sdfsim.dynamics.contacts import find_contacts
from sdfsim.dynamics.simulator import Simulator
from sdfsim.studies.tradeoff_cost import CostModel, Load

LOOKS = 16  # instants at which free flights are looked at


def landings(simulator: Simulator, steps: int) -> np.ndarray:
    """[N] share of the next steps that each body is past its first contact, if all fly freely until then.

    Bodies that never touch anything, and those that do not move, have 0.
    """
    bodies, state, rules = simulator.bodies, simulator.state, simulator.rules
    first = torch.full((len(bodies),), float("inf"), dtype=torch.float64)
    if not rules.contact:
        return np.zeros(len(bodies))
    length = steps * rules.dt
    for share in (np.arange(LOOKS) / LOOKS) ** 2:
        t = share * length
        falling = rules.gravity * bodies.moves[:, None]
        then = replace(
            state,
            position=state.position + state.velocity * t + 0.5 * falling * t * t,
            velocity=state.velocity + falling * t,
        )
        contacts = find_contacts(
            bodies, then, rules.gravity, simulator.model.reach, rules.dt, rows=rules.rows, thin=True
        )
        met = torch.unique(torch.cat([contacts.owner, contacts.body])).cpu()
        first[met] = first[met].clamp_max(float(share))
    first[~bodies.moves.cpu()] = float("inf")
    return (1.0 - first.clamp_max(1.0)).numpy()


def roundness(simulator: Simulator) -> float:
    """Share of the moving bodies' nodes around which the surface is smooth; of no account where nothing may touch."""
    bodies = simulator.bodies
    if not simulator.rules.contact:
        return 0.0
    known = simulator.memory.curvature(bodies)
    of_shape = [
        part.double().mean() if len(part) else 0.0 for part in known.smooth.tensor_split(known.start[1:-1].cpu())
    ]
    count = (bodies.node_start[1:] - bodies.node_start[:-1])[bodies.moves].double()
    share = torch.tensor(of_shape, dtype=torch.float64, device=bodies.device)[bodies.shape[bodies.moves]]
    return float((share * count).sum() / count.sum().clamp_min(1))


def estimate(
    cost: CostModel, simulator: Simulator, counters: dict[str, np.ndarray], landed: np.ndarray, steps: int
) -> dict[str, Any]:
    """Time of a run.

    Args:
        cost: fitted on whatever machine: only its ratios are used.
        simulator: of the scene.
        counters: of the first steps, which were timed here; their first entry and first step do not count.
        landed: see `landings`, from before them.
        steps: of the whole run.

    Returns:
        `step_ms` and `seconds`; `in_contact`, bodies in contact in the mean; `edges`, likewise.
    """
    moving = float(simulator.bodies.moves.sum())
    own = float((simulator.bodies.node_start[1:] - simulator.bodies.node_start[:-1])[simulator.bodies.moves].sum())
    own /= max(1.0, moving)
    edges, active = counters["edges"][2:], counters["active"][2:]
    trial = Load(moving, float((edges > 0).mean()), own * float(active.mean()), float(edges.mean()))
    whole = Load(
        bodies=moving,
        touching=max(float(landed.max(initial=0.0)), trial.touching),
        nodes=own * max(float(landed.sum()), float(active.mean())),
        edges=max(cost.edges(float(landed.sum()), roundness(simulator)), trial.edges),
    )
    step_ms = float(np.median(counters["step_ms"][2:])) * cost(whole) / max(cost(trial), 1e-9)
    return {
        "step_ms": step_ms,
        "seconds": 1e-3 * step_ms * steps,
        "in_contact": max(float(landed.sum()), float(active.mean())),
        "edges": whole.edges,
    }
