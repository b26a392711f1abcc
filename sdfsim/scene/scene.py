"""A scene as immutable data in SI units: what a scene file becomes."""

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
JointKind = Literal["hinge", "slider", "ball", "fixed", "distance"]
WORLD = "world"  # what joints call that which never moves


@dataclass(frozen=True)
class Effects:
    """Which effects the file asks for; `auto` lets the plan decide."""

    contact: Switch = "auto"
    friction: Switch = "auto"
    restitution: Switch = "auto"
    rotation: Switch = "auto"
    sleep: Switch = "auto"
    joints: Switch = "auto"


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
        restitution: likewise the product counts.
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
class Spring:
    """Of a joint: stiffness in N m/rad of a hinge, else N/m, about `rest` in rad or m."""

    stiffness: float
    rest: float = 0.0


@dataclass(frozen=True)
class Motor:
    """Of a hinge (rad, N m) or a slider (m, N): it keeps `speed`, or goes to `position`, of which one is None, with at
    most the torque or force `most`; what is left of the way shrinks by a factor e in `time` s."""

    most: float
    speed: float | None = None
    position: float | None = None
    time: float = 0.1


@dataclass(frozen=True)
class Joint:
    """Holds two bodies together. `joints.held` makes one from points and axes in the world.

    A frame is fixed to each of both bodies; the joint's axis is its x axis. A hinge keeps the origins and the x axes of
    both together, and its angle turns the second's frame about x to the first's. A slider keeps both parallel, and its
    position is how far the first's origin is from the second's along x. A ball keeps the origins together; its limit is
    the angle between the x axes. A fixed joint keeps both frames together. A distance is that of the origins.

    Attributes:
        name: unique among the joints of the scene.
        kind: "hinge", "slider", "ball", "fixed" or "distance".
        bodies: indices into `Scene.bodies`, the second -1 for the world; the first is held by the second.
        anchor: [2, 3] float64 m, the frames' origins, from the shapes' own origins in the axes of the bodies as large
            as they are (for the world, in the world).
        quat_xyzw: [2, 4] float64 unit quaternions, the frames' axes -> the bodies' axes.
        limits: the least and the largest angle (rad), position (m), angle between the axes of a ball (rad; the least is
            0), or distance (m; a rope, the least is 0); None where nothing bounds it.
        length: m, of a rod; None for any other joint.
        restitution: of limits.
        damping: N m s/rad of hinges and balls, else N s/m.
        friction: N m of hinges and balls, N of sliders.
        spring, motor: None where it has none.
        breaks_force, breaks_torque: N and N m, beyond which it breaks.
        collides: whether its bodies may touch each other.
    """

    name: str
    kind: JointKind
    bodies: tuple[int, int]
    anchor: np.ndarray
    quat_xyzw: np.ndarray
    limits: tuple[float, float] | None = None
    length: float | None = None
    restitution: float = 0.0
    damping: float = 0.0
    friction: float = 0.0
    spring: Spring | None = None
    motor: Motor | None = None
    breaks_force: float = math.inf
    breaks_torque: float = math.inf
    collides: bool = False


@dataclass(frozen=True)
class Scene:
    """A complete scene.

    Attributes:
        shapes: the shapes in use.
        bodies: every body, planes included, in file order.
        joints: what holds them together, in file order.
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
    joints: tuple[Joint, ...] = ()


def fingerprints(scene: Scene) -> dict[str, str]:
    """Distinguish a scene from others with bodies of the same names: a digest each of its `shapes` (which bodies have
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
        "bodies": digest(moving, numbers("mass", "friction", "restitution"), held, *_held(scene.joints)),
        "gravity": digest(_six_digits([scene.gravity])),
    }


def _held(joints: Sequence[Joint]) -> list:
    """What joints are; nothing where there are none."""
    if not joints:
        return []
    told = [f"{j.kind} {j.bodies} {j.collides} {j.limits is None} {j.spring is None} {j.motor}" for j in joints]
    limits = _six_digits([j.limits or (0.0, 0.0) for j in joints])
    springs = _six_digits([(j.spring.stiffness, j.spring.rest) if j.spring else (0.0, 0.0) for j in joints])
    known = [_six_digits([getattr(j, name) for j in joints]) for name in ("anchor", "quat_xyzw", "restitution")]
    drags = _six_digits([(j.damping, j.friction, j.length or 0.0) for j in joints])
    bears = _six_digits([[min(most, 1e30) for most in (j.breaks_force, j.breaks_torque)] for j in joints])
    return [told, limits, springs, *known, drags, bears]


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
