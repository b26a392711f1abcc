"""Froude scaling: the units in which a scene has bodies of the model's size at the model's gravity."""

from __future__ import annotations

import numpy as np

from sdfsim.dynamics.bodies import Units, largest_extent
from sdfsim.dynamics.model import Model
from sdfsim.errors import SdfsimError
from sdfsim.scene.types import Scene

EARTH = 9.81  # m/s^2, sets the time scale of scenes without gravity


def scene_units(scene: Scene, model: Model, dt: float | None = None) -> Units:
    """Model units for a scene: bodies of the model's size, at the model's gravity (Froude scaling).

    Args:
        scene: what is to be simulated.
        model: knows the size and gravity it was trained at.
        dt: s, fixes the scale by the wanted step instead of by the bodies' size.

    Raises:
        SdfsimError: a step that is no positive number.
    """
    if dt is not None and not 0.0 < dt < np.inf:
        raise SdfsimError(f"dt: must be > 0 s and finite (got {dt:g})")
    strength = float(np.linalg.norm(scene.gravity)) or EARTH
    moving = [b for b in scene.bodies if b.motion == "dynamic"]
    sizes = [largest_extent(scene.shapes[b.shape]) * b.scale for b in moving]
    if dt is not None:
        length = (dt / model.dt) ** 2 * strength / model.gravity
    else:
        length = float(np.mean(sizes)) / model.length if sizes else 1.0
    mass = float(np.mean([b.mass for b in moving])) if moving else 1.0
    return Units(length=length, time=float(np.sqrt(length * model.gravity / strength)), mass=mass)
