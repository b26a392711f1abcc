"""The two earlier poses that networks on surface nodes read velocities from."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.step import StepOptions, fly


def with_history(state: State, bodies: Bodies, rules: StepOptions) -> State:
    """The same state with the two poses that it would have come from in free flight."""
    position, orientation = _flown_back(state, bodies, rules)
    return replace(state, earlier_position=position, earlier_orientation=orientation)


def history_told(state: State, before: State, bodies: Bodies, rules: StepOptions) -> State:
    """A state from outside, with earlier poses that go with it.

    Those that it shares with the state `before` are of that one's motion: bodies that were changed since get the poses
    that their velocities lead from. A state with earlier poses of its own, such as a restored one, keeps them.
    """
    if state.earlier_position is None or state.earlier_orientation is None:
        return with_history(state, bodies, rules)
    if state.earlier_position is not before.earlier_position:
        return state
    changed = torch.zeros_like(bodies.moves)
    for name in ("position", "orientation", "velocity", "angular_velocity"):
        changed |= (getattr(state, name) != getattr(before, name)).any(-1)
    position, orientation = _flown_back(state, bodies, rules)
    return replace(
        state,
        earlier_position=torch.where(changed[:, None], position, state.earlier_position),
        earlier_orientation=torch.where(changed[:, None], orientation, state.earlier_orientation),
    )


def _flown_back(state: State, bodies: Bodies, rules: StepOptions) -> tuple[Tensor, Tensor]:
    """Positions [2, N, 3] and orientations [2, N, 4] two steps and one step before, in free flight."""
    back = replace(rules, dt=-rules.dt)
    one = fly(bodies, state, back)
    two = fly(bodies, one, back)
    return torch.stack([two.position, one.position]), torch.stack([two.orientation, one.orientation])
