"""Bodies and their state as torch tensors, on the device of a network on surface nodes."""

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from sdfsim.physics.bodies import Bodies, State
from sdfsim.physics.motion import Motion


@dataclass(frozen=True)
class BodyTensors:
    """The fields of `Bodies` that such a network needs, for N bodies with M surface nodes."""

    inverse_mass: Tensor  # [N] float64
    friction: Tensor  # [N] float64
    restitution: Tensor  # [N] float64
    moves: Tensor  # [N] bool
    size: Tensor  # [N] float64
    node: Tensor  # [M, 3] float64
    node_start: Tensor  # [N + 1] int64

    def __len__(self) -> int:
        return len(self.moves)

    @property
    def device(self) -> torch.device:
        return self.moves.device


@dataclass(frozen=True)
class StateTensors:
    """Poses and velocities of N bodies, float64; see `State`."""

    position: Tensor  # [N, 3]
    orientation: Tensor  # [N, 4]
    velocity: Tensor  # [N, 3]
    angular_velocity: Tensor  # [N, 3]
    earlier_position: Tensor | None = None  # [2, N, 3]
    earlier_orientation: Tensor | None = None  # [2, N, 4]


def body_tensors(bodies: Bodies, device: torch.device) -> BodyTensors:
    return BodyTensors(**{f.name: torch.from_numpy(getattr(bodies, f.name)).to(device) for f in fields(BodyTensors)})


def state_tensors(state: Motion, device: torch.device) -> StateTensors:
    arrays = {f.name: getattr(state, f.name, None) for f in fields(StateTensors)}
    return StateTensors(**{k: torch.from_numpy(v).to(device) for k, v in arrays.items() if v is not None})


def state_arrays(state: StateTensors) -> State:
    tensors: dict[str, Any] = {f.name: getattr(state, f.name) for f in fields(state)}
    return State(**{k: v.cpu().numpy() for k, v in tensors.items() if v is not None})
