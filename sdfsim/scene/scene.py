"""What a scene file becomes: plain immutable data, everything resolved to SI units."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

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
class Limits:
    """What a run must keep to: `memory_gib`, GiB that one step may take for distances and edges; None for no limit."""

    memory_gib: float | None = None


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
        effects: what the file asked for.
        limits: what a run must keep to.
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
    limits: Limits = Limits()
    path: Path | None = None
    missed: tuple[str, ...] = ()
    caveats: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
