"""What a state and a scene must be for their motion to mean anything."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from sdfsim.dynamics.bodies import Bodies, State, Units
from sdfsim.dynamics.free_flight import MOST_TURN
from sdfsim.errors import SdfsimError
from sdfsim.scene.scene import Scene

QUANTITIES = ("position", "orientation", "velocity", "angular_velocity")
# Of |q|^2 - 1. The matrix R of a quaternion that keeps to it has |R'R - I| below 1e-5, and a positive determinant.
UNIT = 2e-6
# Model lengths from the origin. Double precision places a body to a ten millionth of its size up to here.
FARTHEST = 1e9
# Model units. Faster, a body passes ten thousand of its own lengths in a step.
FASTEST = 1e6
# Of the nodes' largest extent: with a second one smaller than this they are a line.
LINE = 1e-5


def fault(
    state: State, rows: torch.Tensor, dt: float, units: Units, before: State | None = None
) -> tuple[int, str] | None:
    """The first of bodies `rows` [R] int64 whose state cannot be, and what is wrong with it; None when all are sound.
    State and `dt` are in model units."""
    at = rows.cpu().numpy()
    found = {name: getattr(state, name).cpu().numpy()[at] for name in QUANTITIES}  # numpy: half of the time
    with np.errstate(over="ignore"):
        off = np.abs(np.square(found["orientation"]).sum(-1) - 1.0)
    limits = [
        (found["position"], FARTHEST, units.length, "m from the origin, too far to be placed exactly"),
        (found["velocity"], FASTEST, units.velocity, "m/s, too fast for any contact"),
        (found["angular_velocity"], MOST_TURN / dt, 1.0 / units.time, "rad/s, too fast to be followed"),
    ]
    if before is not None:
        way = (found["position"] - before.position.cpu().numpy()[at]) / dt
        limits.append((way, FASTEST, units.velocity, "m/s on its way through the step, too fast for any contact"))
    with np.errstate(over="ignore"):  # no comparison holds for what is not a number
        if (off <= UNIT).all() and all((np.square(v).sum(-1) <= most * most).all() for v, most, *_ in limits):
            return None
    for name in QUANTITIES:
        bad = ~np.isfinite(found[name]).all(-1)
        if bad.any():
            return int(at[bad][0]), f"{name} is not finite"
    if (bad := off > UNIT).any():
        return int(at[bad][0]), "orientation is no rotation"
    for values, most, unit, what in limits:
        with np.errstate(over="ignore"):
            size = np.linalg.norm(values, axis=-1)
        bad = ~(size <= most)
        if bad.any():
            return int(at[bad][0]), f"{float(size[bad][0]) * unit:.3g} {what} (at most {most * unit:.3g})"
    return None


def check_sizes(bodies: Bodies, names: Sequence[str], metres: float) -> None:
    """Raises SdfsimError where a body that has an end is too large for its surface to keep to where points are placed
    exactly; a model unit is so many `metres`."""
    large = ((bodies.size > FARTHEST) & bodies.size.isfinite()).nonzero()[:, 0]
    if len(large):
        size = float(bodies.size[large[0]]) * metres
        raise SdfsimError(
            f"body {names[int(large[0])]!r}: {size:.3g} m wide, too large to be placed exactly "
            f"(at most {FARTHEST * metres:.3g})",
            "look at its scale, and at the size and units of its shape",
        )


def check_nodes(scene: Scene) -> None:
    """Raises SdfsimError where a dynamic body's nodes are one place or one line, and do not tell how it is turned."""
    told = set()
    for body in scene.bodies:
        if body.motion != "dynamic" or body.shape in told:
            continue
        told.add(body.shape)
        nodes = scene.shapes[body.shape].nodes
        extents = np.linalg.svd(nodes - nodes.mean(0), compute_uv=False) if len(nodes) > 1 else np.zeros(2)
        if extents[0] == 0 or len(extents) < 2 or extents[1] <= LINE * extents[0]:
            where = "in one place" if extents[0] == 0 else "on one line"
            raise SdfsimError(
                f"body {body.name!r} moves: its {len(nodes)} surface nodes are {where}, which tells no turn",
                "sample nodes anew: nodes: 7 at its shape in the scene file",
            )
