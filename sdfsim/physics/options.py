"""Options of a run: gravity, the step, and which effects are on."""

from typing import NamedTuple

import numpy as np

STEP, GRAVITY, LENGTH = 0.02, 10.0, 1.4  # the contact solve's step in s, for bodies of LENGTH m under GRAVITY m/s^2
SUBSTEPS = 5  # inner steps in one step of PyBullet in the training data; some recordings have fewer

# Tolerances of the contact solve that depend on a run's options; the others are fields of `solver.world.Rules`.
# Penetration that is not resolved, so that contacts of bodies at rest persist: at most SLOP model lengths, and less in
# inner steps shorter than the usual 4 ms, which scenes of slender bodies have: SLOP_A_TIME times the inner step.
SLOP, SLOP_A_TIME = 1e-4, 0.025
SLOW = 2.0  # inner steps: an approach no faster than what gravity gives in this time ends without a rebound
ROUNDS = 100  # largest number of sweeps of sequential impulses in an inner step


class Options(NamedTuple):
    """Options of a run, in model units; compiled code reads this record directly."""

    gravity: np.ndarray  # [3] float64
    dt: float  # the step
    substeps: int = SUBSTEPS  # inner steps of the solve in a step
    friction: bool = True  # False computes no tangential impulse
    restitution: bool = True  # False gives every contact restitution 0
    rotation: bool = True  # False lets bodies translate only
    sleep: bool = False  # whether the solve freezes bodies at rest
