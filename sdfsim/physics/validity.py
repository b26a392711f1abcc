"""What a state and a scene must be for their motion to mean anything."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.physics.bodies import Bodies, Units
from sdfsim.physics.free_flight import MOST_TURN
from sdfsim.physics.motion import MOTION, Motion
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


def limits(dt: float) -> np.ndarray:
    """[5] what the compiled step lets a state be at most in steps of `dt`, see `survey.broken`; model units."""
    return np.array([UNIT, FARTHEST, FASTEST, MOST_TURN / dt, FASTEST])


NO_LIMITS = np.full(5, np.inf)


@dataclass(frozen=True)
class Fault:
    """A body whose state cannot be."""

    body: int
    wrong: int  # what is: see `survey.broken`
    value: np.ndarray  # of that, model units

    def described(self, units: Units, dt: float) -> str:
        """What is wrong, in SI units, after a step of `dt` model units."""
        name, unit, what = (
            ("orientation", 1.0, ""),
            ("position", units.length, "m from the origin, too far to be placed exactly"),
            ("velocity", units.velocity, "m/s, too fast for any contact"),
            ("angular_velocity", 1.0 / units.time, "rad/s, too fast to be followed"),
            ("way", units.velocity, "m/s through the step, too fast for any contact"),
        )[self.wrong]
        if not np.isfinite(self.value).all():
            return f"{name} is not finite"
        if not what:
            return "orientation is not a unit quaternion"
        return f"{float(np.linalg.norm(self.value)) * unit:.3g} {what} (at most {limits(dt)[self.wrong] * unit:.3g})"


def fault_of(body: int, wrong: int, state: Motion, before: np.ndarray, dt: float) -> Fault:
    """What the compiled check has found at a body that was at `before` [3] a step of `dt` earlier."""
    with np.errstate(over="ignore", invalid="ignore"):
        way = (state.position[body] - before) / dt
    values = (state.orientation, state.position, state.velocity, state.angular_velocity)
    return Fault(body, wrong, way if wrong == 4 else values[wrong][body])


def first_fault(state: Motion, dt: float, rows: np.ndarray | None = None, before: Motion | None = None) -> Fault | None:
    """The first of the bodies `rows` [A] int64 (None: all) whose state cannot be, a step of `dt` after `before`; None
    when all are sound. In model units."""
    from sdfsim.physics.solver import survey  # numba takes its time to load

    rows = np.arange(len(state.position)) if rows is None else rows
    found = Motion(*(np.ascontiguousarray(state.rows_of(name, rows)) for name in MOTION))
    earlier = found.position if before is None else np.ascontiguousarray(before.rows_of("position", rows))
    moved = (found.position, found.orientation, found.velocity, found.angular_velocity)
    row, wrong = survey.first_fault(np.ones(len(rows), bool), *moved, earlier, dt, limits(dt))
    return None if row < 0 else replace(fault_of(row, wrong, found, earlier[row], dt), body=int(rows[row]))


def check_sizes(bodies: Bodies, names: Sequence[str], metres: float) -> None:
    """Raises SdfsimError if a body that has an end is too large for its surface to keep to where points are placed
    exactly; a model unit is so many `metres`."""
    large = np.flatnonzero((bodies.size > FARTHEST) & np.isfinite(bodies.size))
    if len(large):
        size = float(bodies.size[large[0]]) * metres
        raise SdfsimError(
            f"body {names[int(large[0])]!r}: {size:.3g} m wide, too large to be placed exactly "
            f"(at most {FARTHEST * metres:.3g})",
            "look at its scale, and at the size and units of its shape",
        )


def check_nodes(scene: Scene) -> None:
    """Raises SdfsimError if a dynamic body's nodes are one place or one line, and do not tell how it is turned, or a
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
