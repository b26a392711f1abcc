"""What is in play during a run."""

from typing import NamedTuple

import numpy as np

STEP, GRAVITY, LENGTH = 0.02, 10.0, 1.4  # the contact solve's step in s, for bodies of so many m under so many m/s^2
SUBSTEPS = 5  # inner steps in one step of the engine that the training data come from; some recordings have fewer


class Options(NamedTuple):
    """What is in play during a run, in model units; compiled code reads it as it is."""

    gravity: np.ndarray  # [3] float64
    dt: float  # the step
    substeps: int = SUBSTEPS  # inner steps of the solve in it
    friction: bool = True  # False computes no tangential impulse
    restitution: bool = True  # False makes every contact one of restitution 0
    rotation: bool = True  # False lets bodies translate only
    sleep: bool = False  # whether the solve freezes what rests
    record: bool = False  # whether the solve records what contacts did in the course of a step
    # by which all bodies but planes are larger for the solve than their distances say; adds: whether what it pushes out
    # adds to the speed of a rebound. Both are habits of the teacher, for comparisons with it.
    margin: float = 0.0
    adds: bool = False
    cone: bool = True  # whether friction is bounded by a cone; the teacher bounds it along two axes, each by itself
