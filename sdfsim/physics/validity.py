"""What a state and a scene must be for their motion to mean anything."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.physics.bodies import Bodies, State, Units
from sdfsim.physics.free_flight import MOST_TURN
from sdfsim.scene.scene import Scene
from sdfsim.shape.contact_geometry import check_pieces

# Of |q|^2 - 1. The matrix R of a quaternion that keeps to it has |R'R - I| below 1e-5, and a positive determinant.
UNIT = 2e-6
# Model lengths from the origin. Double precision places a body to a ten millionth of its size up to here.
FARTHEST = 1e9
# Model units. Faster, a body passes ten thousand of its own lengths in a step.
FASTEST = 1e6
# Of the nodes' largest extent: with a second one smaller than this they are a line.
LINE = 1e-5


def fault(
    state: State, dt: float, units: Units, rows: np.ndarray | None = None, before: State | None = None
) -> tuple[int, str] | None:
    """The first of the bodies in `rows` [N] bool (None: all) whose state cannot be, and what is wrong with it; None
    when all are sound. State and `dt` are in model units."""
    from sdfsim.physics.solver.survey import first_fault  # numba takes its time to load

    rows = np.ones(len(state.position), bool) if rows is None else rows
    place, orientation, velocity, spin = (
        t.cpu().numpy() for t in (state.position, state.orientation, state.velocity, state.angular_velocity)
    )
    earlier = place if before is None else before.position.cpu().numpy()
    most = np.array([1.0, FARTHEST, FASTEST, MOST_TURN / dt, FASTEST])
    body, wrong = first_fault(rows, place, orientation, velocity, spin, earlier, dt, UNIT, most)
    if body < 0:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        way = (place[body] - earlier[body]) / dt
        name, value, unit, what = (
            ("orientation", orientation[body], 1.0, ""),
            ("position", place[body], units.length, "m from the origin, too far to be placed exactly"),
            ("velocity", velocity[body], units.velocity, "m/s, too fast for any contact"),
            ("angular_velocity", spin[body], 1.0 / units.time, "rad/s, too fast to be followed"),
            ("way", way, units.velocity, "m/s through the step, too fast for any contact"),
        )[wrong]
    if not np.isfinite(value).all():
        return body, f"{name} is not finite"
    if not what:
        return body, "orientation is not a unit quaternion"
    return body, f"{float(np.linalg.norm(value)) * unit:.3g} {what} (at most {most[wrong] * unit:.3g})"


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
    """Raises SdfsimError where a dynamic body's nodes are one place or one line, and do not tell how it is turned, or a
    shape has more convex pieces than contacts can tell apart."""
    told = set()
    for shape in scene.shapes:
        check_pieces(f"shape {shape.name!r}", shape.pieces)
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
