"""Froude scaling: units in which a scene's bodies have the model's size and gravity the model's value."""

import math

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.physics.bodies import Units, largest_extent
from sdfsim.physics.options import GRAVITY, LENGTH, STEP, SUBSTEPS
from sdfsim.scene.scene import Scene

EARTH = 9.81  # m/s^2, sets the time scale of scenes without gravity
# How many times wider a body may be than most moving bodies. Their mean size sets the step, and a wider body makes it
# so long that the others spin too fast in their first contact.
MOST_WIDER = 1e4
# A tumbling stick moves by its length, and must not cross a distance of its thickness. So above this aspect ratio the
# inner steps of the solve get shorter, with its square root. Overlaps in a heap of 1:20 sticks then stay within 1 % of
# their thickness.
SLENDER, SHORTEST = 8.0, 4


def scene_units(
    scene: Scene,
    dt: float | None = None,
    *,
    step: float = STEP,
    gravity: float = GRAVITY,
    length: float = LENGTH,
    mean: bool = False,
) -> Units:
    """The units in which the smallest moving body (or their `mean`) has the size `length`, gravity is `gravity` and a
    step is `step`; the defaults are those of the contact solve. `dt` in s fixes the scale by the wanted step instead.
    Raises SdfsimError for a step that is not positive, or for bodies of sizes that no step suits."""
    if dt is not None and not 0.0 < dt < np.inf:
        raise SdfsimError(f"dt: must be > 0 s and finite (got {dt:g})")
    strength = float(np.linalg.norm(scene.gravity)) or EARTH
    moving = [b for b in scene.bodies if b.motion == "dynamic"]
    sizes = [largest_extent(scene.shapes[b.shape]) * b.scale for b in moving]
    if dt is not None:
        metres = (dt / step) ** 2 * strength / gravity
    elif sizes:
        _check_sizes([b.name for b in moving], np.array(sizes))
        metres = float(np.mean(sizes) if mean else np.min(sizes)) / length
    else:
        metres = 1.0
    mass = float(np.mean([b.mass for b in moving])) if moving else 1.0
    return Units(length=metres, time=float(np.sqrt(metres * gravity / strength)), mass=mass)


def inner_steps(scene: Scene) -> int:
    """Number of inner steps of the solve in a step of a scene: more if moving bodies are slender."""
    boxes = [np.sort(np.ptp(scene.shapes[b.shape].sdf.bounds, axis=0)) for b in scene.bodies if b.motion == "dynamic"]
    aspect = max((box[2] / max(box[0], 1e-300) for box in boxes), default=1.0)
    if aspect <= SLENDER:
        return SUBSTEPS
    return min(math.ceil(SUBSTEPS * math.sqrt(aspect / 5.0)), SHORTEST * SUBSTEPS)


def _check_sizes(names: list[str], sizes: np.ndarray) -> None:
    """Raises SdfsimError if a body of `sizes` [N] m is far wider than most. The message names the more unusual of the
    two bodies."""
    order = np.argsort(sizes, kind="stable")
    usual, widest = order[(len(order) - 1) // 2], order[-1]
    if not MOST_WIDER * sizes[usual] < sizes[widest] < np.inf:
        return
    absurd, other = sorted((usual, widest), key=lambda k: -abs(np.log10(sizes[k])))
    raise SdfsimError(
        f"body {names[absurd]!r}: {sizes[absurd]:.3g} m wide beside body {names[other]!r} of {sizes[other]:.3g} m "
        f"(at most {MOST_WIDER:g} times as wide)",
        "check its scale, and the size and units of its shape",
    )
