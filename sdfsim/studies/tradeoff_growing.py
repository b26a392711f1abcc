"""The scenes that growth is measured on: boxes in columns, balls in a bowl, few or many, of few or many nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdfsim.scene.types import Body, Scene
from sdfsim.shape.asset import analytic_shape, with_nodes
from sdfsim.shape.cache import shape_from_primitive

BALL, BOX = 0.7, 0.6  # m: radius, side
GAP = 0.02  # m between neighbours at the start: they are within reach of each other
WALL = 0.12  # of the bowl primitive, relative to its outer radius
GRID = 48  # samples along each side of the bowl's distances
HIGH, APART = 100.0, 5.0  # m above the floor, and times as far from each other: where nothing touches
NAMES = {"pile": "boxes in columns on a floor", "bowl": "balls in a bowl"}


@dataclass(frozen=True)
class Growing:
    """One scene of the study.

    Attributes:
        kind: of `NAMES`.
        bodies: how many move.
        nodes: N of the N^3 grid that a body's nodes are sampled from; None for its own (98 or 128).
        flying: high above what it would touch.
    """

    kind: str
    bodies: int
    nodes: int | None = None
    flying: bool = False

    @property
    def key(self) -> str:
        """A file name."""
        tail = "" if self.nodes is None else f"__nodes-{self.nodes}"
        return f"{self.kind}__{self.bodies}{tail}{'__flying' if self.flying else ''}"


def scenes(*, quick: bool) -> list[Growing]:
    """The scenes of a study: by bodies, by nodes of 16 bodies, and without contact."""
    counts = (1, 4, 16, 64) if quick else (1, 2, 4, 8, 16, 32, 64, 128, 256, 512)
    grids = (3, 6, 12, 24) if quick else (3, 4, 6, 8, 12, 16, 24, 48, 96)
    found = [Growing(kind, count) for kind in NAMES for count in counts]
    found += [Growing(kind, 16, grid) for kind in NAMES for grid in grids]
    return found + [Growing("pile", count, flying=True) for count in counts]


def build(one: Growing) -> Scene:
    """The scene, in metres, at 9.81 m/s^2."""
    shapes, held = [analytic_shape("plane")], [_body("floor", 0, np.zeros(3), 0.0)]
    if one.kind == "pile":
        shape, places = analytic_shape("box", size=(BOX, BOX, BOX)), _columns(one.bodies)
    else:
        shape, (places, outer) = analytic_shape("sphere", radius=BALL), _in_bowl(one.bodies)
        shapes.append(shape_from_primitive("bowl", 2 * outer, sdf="grid", resolution=GRID))
        held.append(_body("bowl", 1, np.array([0.0, 0.0, outer]), 0.0))
    shapes.append(shape if one.nodes is None else with_nodes(shape, one.nodes))
    if one.flying:
        places = APART * places + np.array([0.0, 0.0, HIGH])
    moving = [_body(f"body{k}", len(shapes) - 1, place, 1.0) for k, place in enumerate(places)]
    return Scene(tuple(shapes), (*held, *moving), np.array([0.0, 0.0, -9.81]), duration=1.0)


def _columns(count: int) -> np.ndarray:
    """[count, 3] m: boxes in columns of four, the lowest on the floor."""
    column, level = np.divmod(np.arange(count), 4)
    side = int(np.ceil((count / 4) ** 0.5))
    return np.stack([*np.divmod(column, side), level], 1) * (BOX + GAP) + np.array([0.0, 0.0, 0.5 * BOX])


def _in_bowl(count: int) -> tuple[np.ndarray, float]:
    """[count, 3] m: balls in the lowest layers of a bowl that stands on the floor; and its outer radius m."""
    step, inner = 2 * BALL + GAP, 2.0 * BALL
    while True:
        reach = int(inner / step) + 1
        axis = np.arange(-reach, reach + 1) * step
        lattice = np.stack(np.meshgrid(axis, axis, axis - 0.5 * step, indexing="ij"), -1).reshape(-1, 3)
        inside = lattice[(np.linalg.norm(lattice, axis=1) <= inner - BALL) & (lattice[:, 2] <= 0)]
        if len(inside) >= count:
            order = np.lexsort((np.hypot(inside[:, 0], inside[:, 1]).round(6), inside[:, 2].round(6)))
            outer = inner / (1 - WALL)
            return inside[order[:count]] + np.array([0.0, 0.0, outer]), outer
        inner *= 1.1


def _body(name: str, shape: int, position: np.ndarray, mass: float) -> Body:
    return Body(
        name=name,
        shape=shape,
        motion="dynamic" if mass else "static",
        scale=1.0,
        position=np.asarray(position, dtype=float),
        quat_xyzw=np.array([0.0, 0.0, 0.0, 1.0]),
        velocity=np.zeros(3),
        angular_velocity=np.zeros(3),
        mass=mass,
        friction=0.5,
        restitution=0.3,
    )
