"""What is in play during a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

SUBSTEPS = 5  # inner steps in one step of the engine that the training data come from; some recordings have fewer
FreeFlight = Literal["exact", "learned"]


@dataclass(frozen=True)
class StepOptions:
    """What is in play during a run, in model units."""

    gravity: Tensor  # [3] float64
    dt: float  # the step
    substeps: int = SUBSTEPS  # inner steps of the solve in it
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
    cone: bool = True  # whether friction is bounded by a cone; the teacher bounds it along two axes, each by itself
    trust: float = 1.0  # in what the network adds to the solve; 0 where a scene is beyond its training
