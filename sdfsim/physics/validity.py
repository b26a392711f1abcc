"""Limits within which states and scenes are valid."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.physics.bodies import Bodies, Units
from sdfsim.physics.free_flight import MOST_TURN
from sdfsim.physics.motion import MOTION, Motion
from sdfsim.scene.scene import Scene
from sdfsim.shape.contact_geometry import check_pieces

# Largest |q|^2 - 1. Up to it the matrix R of a quaternion has |R'R - I| below 1e-5, and a positive determinant.
UNIT = 2e-6
# Model lengths from the origin. Up to here double precision places a body to a ten millionth of its size.
FARTHEST = 1e9
# Model units. A faster body moves by more than ten thousand of its own lengths in a step.
FASTEST = 1e6
# Relative to the nodes' largest extent: if the second extent is smaller, they are a line.
LINE = 1e-5


def limits(dt: float) -> np.ndarray:
    """[5] the largest values that the compiled step accepts in steps of `dt`, see `survey.broken`; model units."""
    return np.array([UNIT, FARTHEST, FASTEST, MOST_TURN / dt, FASTEST])


NO_LIMITS = np.full(5, np.inf)


@dataclass(frozen=True)
class Fault:
    """A body with an invalid state."""

    body: int
    wrong: int  # which part of the state is invalid: see `survey.broken`
    value: np.ndarray  # its value, model units

    def described(self, units: Units, dt: float) -> str:
        """The fault in words, in SI units, after a step of `dt` model units."""
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
    """The fault that the compiled check has found for a body that was at `before` [3] a step of `dt` earlier."""
    with np.errstate(over="ignore", invalid="ignore"):
        way = (state.position[body] - before) / dt
    values = (state.orientation, state.position, state.velocity, state.angular_velocity)
    return Fault(body, wrong, way if wrong == 4 else values[wrong][body])


def first_fault(state: Motion, dt: float, rows: np.ndarray | None = None, before: Motion | None = None) -> Fault | None:
    """The first of the bodies `rows` [A] int64 (None: all) with an invalid state, a step of `dt` after `before`; None
    if all are valid. In model units."""
    from sdfsim.physics.solver import survey  # numba is slow to load

    rows = np.arange(len(state.position)) if rows is None else rows
    found = Motion(*(np.ascontiguousarray(state.rows_of(name, rows)) for name in MOTION))
    earlier = found.position if before is None else np.ascontiguousarray(before.rows_of("position", rows))
    moved = (found.position, found.orientation, found.velocity, found.angular_velocity)
    row, wrong = survey.first_fault(np.ones(len(rows), bool), *moved, earlier, dt, limits(dt))
    return None if row < 0 else replace(fault_of(row, wrong, found, earlier[row], dt), body=int(rows[row]))


def check_sizes(bodies: Bodies, names: Sequence[str], metres: float) -> None:
    """Raises SdfsimError if a finite body is so large that points on its surface cannot be placed exactly; a model unit
    of length has `metres` m."""
    large = np.flatnonzero((bodies.size > FARTHEST) & np.isfinite(bodies.size))
    if len(large):
        size = float(bodies.size[large[0]]) * metres
        raise SdfsimError(
            f"body {names[int(large[0])]!r}: {size:.3g} m wide, too large to be placed exactly "
            f"(at most {FARTHEST * metres:.3g})",
            "look at its scale, and at the size and units of its shape",
        )


def check_nodes(scene: Scene) -> None:
    """Raises SdfsimError if a dynamic body's nodes are one point or one line, so that they do not define its rotation,
    or if a shape has more convex pieces than contacts can distinguish."""
    seen = set()
    for shape in scene.shapes:
        check_pieces(f"shape {shape.name!r}", shape.pieces)
    for body in scene.bodies:
        if body.motion != "dynamic" or body.shape in seen:
            continue
        seen.add(body.shape)
        nodes = scene.shapes[body.shape].nodes
        extents = np.linalg.svd(nodes - nodes.mean(0), compute_uv=False) if len(nodes) > 1 else np.zeros(2)
        if extents[0] == 0 or len(extents) < 2 or extents[1] <= LINE * extents[0]:
            where = "in one place" if extents[0] == 0 else "on one line"
            raise SdfsimError(
                f"body {body.name!r} moves: its {len(nodes)} surface nodes are {where}, so its rotation is not defined",
                "sample its nodes: give nodes: 7 at its shape in the scene file",
            )
