"""A scene as immutable data in SI units: what a scene file becomes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from sdfsim.base.files import digest
from sdfsim.sdf.closed_forms import ClosedForm
from sdfsim.shape.shape import Shape

Motion = Literal["static", "dynamic", "kinematic"]
Switch = Literal["auto", "on", "off"]


@dataclass(frozen=True)
class Effects:
    """Which effects the file asks for; `auto` lets the plan decide."""

    contact: Switch = "auto"
    friction: Switch = "auto"
    restitution: Switch = "auto"
    rotation: Switch = "auto"
    sleep: Switch = "auto"


@dataclass(frozen=True)
class Waypoints:
    """The poses that a kinematic body passes through: straight and at an even turn in between, at rest outside.

    Attributes:
        time: [K] s, increasing.
        position: [K, 3] m, of the shape's own origin.
        quat_xyzw: [K, 4] unit quaternions.
    """

    time: np.ndarray
    position: np.ndarray
    quat_xyzw: np.ndarray


@dataclass(frozen=True)
class Body:
    """One body of a scene. A plane is a static body whose shape's SDF is `PlaneSdf` (z = 0 in its own frame).

    Attributes:
        name: unique in the scene.
        shape: index into `Scene.shapes`.
        motion: "static", "dynamic", or "kinematic": on its `path`, whatever it meets.
        scale: uniform factor on the shape.
        position: [3] float64 m, of the shape's own origin (not its centre of mass).
        quat_xyzw: [4] float64 unit quaternion, shape frame -> world.
        velocity: [3] m/s, of the centre of mass.
        angular_velocity: [3] rad/s, world frame.
        mass: kg (already resolved from a density; bodies that are not dynamic have 0).
        inertia: [3, 3] kg m^2 about the centre of mass, shape axes; None means mass / volume times the shape's own.
        friction: Coulomb coefficient (the product of the two bodies' counts).
        restitution: likewise.
        collides_with: names of the bodies it may touch, or None for all.
        path: of a kinematic body.
    """

    name: str
    shape: int
    motion: Motion
    scale: float
    position: np.ndarray
    quat_xyzw: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    mass: float
    friction: float
    restitution: float
    inertia: np.ndarray | None = None
    collides_with: tuple[str, ...] | None = None
    path: Waypoints | None = None


@dataclass(frozen=True)
class Scene:
    """A complete scene.

    Attributes:
        shapes: the shapes in use.
        bodies: every body, planes included, in file order.
        gravity: [3] float64 m/s^2.
        duration: s.
        seed: random seed of the run.
        model: bundled model name or path, None for the default.
        effects: the switches of the file.
        path: the file it came from, if any.
        missed: shapes fitted for this scene that are not usable, with the reason, one line each.
        caveats: those that are, but are not as exact as fits can be; one line each.
        notes: what was done to meshes on reading, and sizes that may be mistaken; one line each.
    """

    shapes: tuple[Shape, ...]
    bodies: tuple[Body, ...]
    gravity: np.ndarray
    duration: float
    seed: int = 0
    model: str | None = None
    effects: Effects = Effects()
    path: Path | None = None
    missed: tuple[str, ...] = ()
    caveats: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def fingerprints(scene: Scene) -> dict[str, str]:
    """Tell a scene from others with bodies of the same names: a digest each of its `shapes` (which bodies have
    which, how large, and how they move), of what else its `bodies` are (but for paths and who may touch whom), and of
    `gravity`. Six digits count, and of fitted shapes the mesh, so that a fit that is made again, or the last digits of
    another machine, make no other scene of it."""
    bodies = scene.bodies

    def numbers(*names: str) -> list[np.ndarray]:
        return [_six_digits([getattr(body, name) for body in bodies]) for name in names]

    inertia = [(k, body.inertia) for k, body in enumerate(bodies) if body.inertia is not None]
    held = [_six_digits([k for k, _ in inertia]), _six_digits([own for _, own in inertia])]
    moving = numbers("position", "quat_xyzw", "velocity", "angular_velocity")
    which = [[f"{body.motion} {body.name}" for body in bodies], *numbers("shape", "scale")]
    return {
        "shapes": digest([_described(shape) for shape in scene.shapes], which),
        "bodies": digest(moving, numbers("mass", "friction", "restitution"), held),
        "gravity": digest(_six_digits([scene.gravity])),
    }


def _described(shape: Shape) -> list:
    if isinstance(shape.sdf, ClosedForm):
        form = [shape.sdf.KIND, _six_digits([shape.sdf.sizes])]
    else:
        form = [_six_digits(shape.mesh.vertices), shape.mesh.faces.astype(np.int64)]
    return [*form, str(shape.source.get("wall"))]


def _six_digits(values: Sequence | np.ndarray) -> np.ndarray:
    """[N, K] rows of numbers, rounded to 2^-20 of the largest of the row."""
    rows = np.asarray(values, np.float64)
    rows = rows.reshape(len(rows), math.prod(rows.shape[1:]))
    # Just below a power of two counts as that power: rounding must not separate the two.
    unit = np.ldexp(1.0, np.frexp(np.abs(rows).max(1, initial=0.0) * (1.0 + 1e-9))[1] - 20)[:, None]
    return np.round(rows / unit) * unit + 0.0  # no negative zeros
