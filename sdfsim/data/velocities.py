"""Velocities at the instants of positions: what a recording engine's own velocities lack of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from sdfsim.data.dataset import Trajectory, home_of, read_info
from sdfsim.errors import SdfsimError

LONGEST = 1.0  # s, an engine's inner step
MARGIN = 1e-3  # m, around the convex pieces of every body that the teacher loads from a file (Bullet's default)
EXACTLY = 1e-3  # part of what gravity adds in a step, by which a free flight may miss it


def engine_substep(data: Path) -> float:
    """The engine's inner step in s, where the dataset (a folder or one of its splits) tells it; 0 elsewhere.

    Raises:
        SdfsimError: what is told is no such step.
    """
    home = home_of(data)
    if home is None:
        return 0.0
    settings = read_info(home).get("engine_settings") or {}
    found = settings.get("timeStep", 0.0) if isinstance(settings, dict) else settings
    if isinstance(found, bool) or not isinstance(found, int | float) or not 0.0 <= found <= LONGEST:
        where = f"{home / 'dataset.json'}: engine_settings.timeStep"
        raise SdfsimError(f"{where}: must be 0 (unknown) to {LONGEST:g} s (got {found!r})")
    return float(found)


def at_instants(trajectory: Trajectory, substep: float) -> Trajectory:
    """The trajectory with velocities at the instants of its positions.

    The recording engine's position step already uses the new velocity (symplectic Euler): its flights are exact
    parabolas, but of bodies that are half an inner step `substep` s of gravity faster than recorded. Bodies that fly
    before or after an instant get the velocity of their parabola; those that lie or slide keep the recorded one.
    """
    added = np.diff(trajectory.velocity, axis=0) - trajectory.gravity * trajectory.dt
    flies = np.linalg.norm(added, axis=-1) < EXACTLY * np.linalg.norm(trajectory.gravity) * trajectory.dt
    airborne = np.zeros(trajectory.velocity.shape[:2], dtype=bool)
    airborne[:-1] |= flies
    airborne[1:] |= flies
    airborne &= ~trajectory.static
    lead = 0.5 * substep * trajectory.gravity * airborne[..., None]
    return replace(trajectory, velocity=trajectory.velocity + lead)
