"""What a state and a scene must be for their motion to mean anything."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from sdfsim.dynamics.bodies import Bodies, State, Units
from sdfsim.dynamics.free_flight import MOST_TURN
from sdfsim.errors import SdfsimError
from sdfsim.scene.scene import Scene

# Of |q|^2 - 1. The matrix R of a quaternion that keeps to it has |R'R - I| below 1e-5, and a positive determinant.
UNIT = 2e-6
# Model lengths from the origin. Double precision places a body to a ten millionth of its size up to here.
FARTHEST = 1e9
# Model units. Faster, a body passes ten thousand of its own lengths in a step.
FASTEST = 1e6
# Of the nodes' largest extent: with a second one smaller than this they are a line.
LINE = 1e-5


def fault(
    state: State, dt: float, units: Units, rows: torch.Tensor | None = None, before: State | None = None
) -> tuple[int, str] | None:
    """The first of bodies `rows` [R] int64 (None: all) whose state cannot be, and what is wrong with it; None when all
    are sound. State and `dt` are in model units."""
    at = np.arange(len(state.position)) if rows is None else rows.cpu().numpy()

    def of(name: str, state: State = state) -> np.ndarray:
        return getattr(state, name).cpu().numpy()[at]

    turn, spin = of("orientation"), of("angular_velocity")
    limits = [
        ("position", of("position"), FARTHEST, units.length, "m from the origin, too far to be placed exactly"),
        ("velocity", of("velocity"), FASTEST, units.velocity, "m/s, too fast for any contact"),
        ("angular_velocity", spin, MOST_TURN / dt, 1.0 / units.time, "rad/s, too fast to be followed"),
    ]
    if before is not None:
        way = (of("position") - of("position", before)) / dt
        limits.append(("way", way, FASTEST, units.velocity, "m/s through the step, too fast for any contact"))
    with np.errstate(over="ignore"):  # no comparison holds for what is not a number
        bad = np.flatnonzero(~(np.abs(np.square(turn).sum(-1) - 1.0) <= UNIT))
        if len(bad):
            known = np.isfinite(turn[bad[0]]).all()
            return int(at[bad[0]]), "orientation is no rotation" if known else "orientation is not finite"
        for name, values, most, unit, what in limits:
            bad = np.flatnonzero(~(np.square(values).sum(-1) <= most * most))
            if len(bad) and not np.isfinite(values[bad[0]]).all():
                return int(at[bad[0]]), f"{name} is not finite"
            if len(bad):
                size = float(np.linalg.norm(values[bad[0]])) * unit
                return int(at[bad[0]]), f"{size:.3g} {what} (at most {most * unit:.3g})"
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
