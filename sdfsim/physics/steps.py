"""The result of several steps, and what a recording keeps of each."""

from dataclasses import dataclass

import numpy as np

from sdfsim.physics.bodies import State
from sdfsim.physics.motion import Motion
from sdfsim.physics.validity import Fault

COUNTS = {
    "pairs": "pairs of bodies that the broad phase let through",
    "contacts": "contact points in the solve",
    "nodes": "nodes in the network's graph",
    "edges": "edges in that graph",
    "free": "dynamic bodies in free flight",
    "active": "dynamic bodies awake that contacts moved",
    "asleep": "dynamic bodies asleep",
}
PHASES = {"flight_ms": "free flight", "contact_ms": "contact solve", "network_ms": "network"}


@dataclass(frozen=True)
class Frames(Motion):
    """The data that a recording keeps of each of K steps, model units."""

    energy: np.ndarray  # [K, 3] kinetic and potential energy; work of pulls in the step
    depth: np.ndarray  # [K] the deepest penetration
    touching: np.ndarray  # [K] int64, number of points where bodies touch
    pair: np.ndarray  # [sum(touching), 2] int64, the bodies that touch there
    point: np.ndarray  # [sum(touching), 3]
    counts: dict[str, np.ndarray]  # [K] each, see `COUNTS` and `PHASES`
    # [K, J, 7] for each joint its angle, position or length; force and torque on its first body, at its anchor
    joint: np.ndarray


@dataclass(frozen=True)
class Steps:
    """The result of several steps, model units."""

    state: State  # the last good one
    done: int  # how many steps led there
    fault: Fault | None  # fault of the state after it, which is not kept
    given: float  # work of pulls in these steps
    counts: dict[str, float]  # of the last of these steps, see `COUNTS` and `PHASES`; empty if there are none
    frames: Frames | None  # the frames of these steps, if they were asked for
