"""Options of a run: gravity, the step, and which effects are on."""

from typing import NamedTuple

import numpy as np

STEP, GRAVITY, LENGTH = 0.02, 10.0, 1.4  # the contact solve's step in s, for bodies of LENGTH m under GRAVITY m/s^2
SUBSTEPS = 5  # inner steps in one step of PyBullet in the training data; some recordings have fewer


class Options(NamedTuple):
    """Options of a run, in model units; compiled code reads this record directly."""

    gravity: np.ndarray  # [3] float64
    dt: float  # the step
    substeps: int = SUBSTEPS  # inner steps of the solve in a step
    friction: bool = True  # False computes no tangential impulse
    restitution: bool = True  # False gives every contact restitution 0
    rotation: bool = True  # False lets bodies translate only
    sleep: bool = False  # whether the solve freezes bodies at rest
