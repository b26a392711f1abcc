"""A scene as immutable data in SI units: what loading a scene file gives."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sdfsim.base.files import digest
from sdfsim.sdf.closed_forms import ClosedForm
from sdfsim.shape.shape import Shape

Motion = Literal["static", "dynamic", "kinematic"]
Switch = Literal["auto", "on", "off"]
JointKind = Literal["hinge", "slider", "ball", "fixed", "distance"]
WORLD = "world"  # what joints call the fixed world


@dataclass(frozen=True)
class Effects:
    """The switches of effects in the file; with `auto` the plan decides."""

    contact: Switch = "auto"
    friction: Switch = "auto"
    restitution: Switch = "auto"
    rotation: Switch = "auto"
    sleep: Switch = "auto"
    joints: Switch = "auto"


@dataclass(frozen=True)
class Waypoints:
    """The poses that a kinematic body passes through. In between it moves straight and turns evenly; before the first
    and after the last it rests.

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
        stiffness: N/m of its contacts; those of the two bodies act in series, and rigid bodies have infinity.
        damping: N s/m of its contacts, if it is not rigid.
        inertia: [3, 3] kg m^2 about the centre of mass, shape axes; None means mass / volume times the shape's own.
        friction: Coulomb coefficient (a contact has the product of the two bodies').
        restitution: coefficient of restitution (likewise the product).
        collides_with: names of the bodies it may touch, or None for all.
        path: the waypoints of a kinematic body, else None.
        color: RGB from 0 to 255 where its mesh has none of its own; None: by its motion, see `body_colors`.
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
    stiffness: float = math.inf
    damping: float = 0.0
    inertia: np.ndarray | None = None
    collides_with: tuple[str, ...] | None = None
    path: Waypoints | None = None
    color: tuple[int, ...] | None = None


@dataclass(frozen=True)
class Spring:
    """The spring of a joint: stiffness in N m/rad for a hinge, else N/m, about `rest` in rad or m."""

    stiffness: float
    rest: float = 0.0


@dataclass(frozen=True)
class Motor:
    """The motor of a hinge (rad, N m) or a slider (m, N). It keeps `speed`, or goes to `position`, with at most the
    torque or force `max_force`. The distance to the position shrinks by a factor e in `time` s. Without either it does
    nothing until a target is set. With a `gain` the torque or force is gain * (position - now - time * its rate of
    change), in N m/rad or N/m, or gain * (speed - now), in N m s/rad or N s/m; without, as much as that takes."""

    max_force: float
    speed: float | None = None
    position: float | None = None
    time: float = 0.1
    gain: float | None = None


@dataclass(frozen=True)
class Joint:
    """Holds two bodies together. `joints.held` makes one from points and axes in the world.

    Each of the two bodies has a frame fixed to it, whose x axis is the joint's axis. A hinge keeps the origins and the
    x axes of the two frames together; its angle is the turn about x from the second body's frame to the first's. A
    slider keeps the frames parallel; its position is the distance along x from the second frame's origin to the
    first's. A ball keeps the origins together; its limit is the angle between the x axes. A fixed joint keeps the
    frames together. A distance joint is about the distance between the origins.

    Attributes:
        name: unique among the joints of the scene.
        kind: "hinge", "slider", "ball", "fixed" or "distance".
        bodies: indices into `Scene.bodies`; the second is -1 for the world. The second body holds the first.
        anchor: [2, 3] float64 m, the frames' origins relative to the shapes' origins, in body axes, with the bodies'
            scale applied (for the world: world coordinates).
        quat_xyzw: [2, 4] float64 unit quaternions, the frames' axes -> the bodies' axes.
        start: rad or m, the angle of a hinge or the position of a slider at the start. Poses show it only up to full
            turns.
        limits: the least and the largest angle (rad), position (m), angle between the axes of a ball (rad; the least is
            0), or distance (m; for a rope the least is 0); None if nothing bounds it.
        length: m, length of a rod; None for any other joint.
        restitution: coefficient with which limits rebound.
        damping: N m s/rad for hinges and balls, else N s/m.
        friction: N m for hinges and balls, N for sliders.
        armature: kg m^2 for hinges and balls, kg for sliders: inertia against changes of the joint's speed.
        spring, motor: None if it has none.
        breaks_force, breaks_torque: N and N m; beyond either the joint breaks.
        collides: whether its bodies may touch each other.
    """

    name: str
    kind: JointKind
    bodies: tuple[int, int]
    anchor: np.ndarray
    quat_xyzw: np.ndarray
    start: float = 0.0
    limits: tuple[float, float] | None = None
    length: float | None = None
    restitution: float = 0.0
    damping: float = 0.0
    friction: float = 0.0
    armature: float = 0.0
    spring: Spring | None = None
    motor: Motor | None = None
    breaks_force: float = math.inf
    breaks_torque: float = math.inf
    collides: bool = False


@dataclass(frozen=True)
class Frame:
    """A named pose that moves with a body, such as the point between a gripper's fingers.

    Attributes:
        name: unique among the frames of the scene.
        body: index into `Scene.bodies`; -1 for the world.
        position: [3] m, of its origin from the origin of the body's shape, along the body's axes.
        quat_xyzw: [4] unit quaternion, the frame's axes -> the body's.
    """

    name: str
    body: int
    position: np.ndarray
    quat_xyzw: np.ndarray


@dataclass(frozen=True)
class Keyframe:
    """A named pose of a scene.

    Attributes:
        joints: the angle of hinges (rad), the position of sliders (m) and the quaternion [4] xyzw of balls, see
            `JointHandle.quat_xyzw`, by names of joints; others stay as at the start.
        bodies: position [3] m, quaternion [4] xyzw, velocity [3] m/s of the centre of mass and angular velocity [3]
            rad/s of bodies that no joint holds, by their names.
        speeds: rad/s and m/s of hinges and sliders, and [3] rad/s of balls, as `Simulator.joint_velocities` has them;
            others are at rest.
        targets: of motors, by names of joints: rad or m, or rad/s or m/s if the motor keeps a speed. Other motors that
            go to a position aim at that of their joint.
    """

    joints: Mapping[str, Any]
    bodies: Mapping[str, tuple[np.ndarray, ...]]
    speeds: Mapping[str, Any] = field(default_factory=dict)
    targets: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Coupling:
    """Keeps the coordinate of one joint at `ratio` times that of another plus `offset`.

    Attributes:
        joints: indices into `Scene.joints`, hinges or sliders; the first follows the second.
        ratio: rad or m of the first for each rad or m of the second.
        offset: rad or m.
    """

    joints: tuple[int, int]
    ratio: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Scene:
    """A complete scene.

    Attributes:
        shapes: the shapes in use.
        bodies: every body, planes included, in file order.
        joints: the joints between bodies, in file order.
        frames: named poses on bodies.
        keyframes: named poses of all joints, for `Simulator.reset`.
        couplings: joints that follow others.
        gravity: [3] float64 m/s^2.
        duration: s.
        step: s, None if it follows the size of what moves.
        seed: random seed of the run.
        model: bundled model name or path, None for the default.
        effects: the switches of the file.
        path: the file it came from, if any.
        missed: fitted shapes of this scene that are not usable, with the reason, one line each.
        caveats: fitted shapes that are usable, but not as exact as fits can be; one line each.
        notes: what was done to meshes on reading, and sizes that may be a mistake; one line each.
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
    step: float | None = None
    frames: tuple[Frame, ...] = ()
    keyframes: Mapping[str, Keyframe] = field(default_factory=dict)
    couplings: tuple[Coupling, ...] = ()


def fingerprints(scene: Scene) -> dict[str, str]:
    """Digests that tell a scene from others with bodies of the same names: one of its `shapes` (the bodies' shapes,
    sizes and kinds of motion), one of the other properties of its `bodies` (except paths and collision lists), and one
    of `gravity`. Only six digits of numbers count, and of fitted shapes only the mesh. So a repeated fit, or rounding
    on another machine, gives the same digests."""
    bodies = scene.bodies

    def numbers(*names: str) -> list[np.ndarray]:
        return [_six_digits([getattr(body, name) for body in bodies]) for name in names]

    inertia = [(k, body.inertia) for k, body in enumerate(bodies) if body.inertia is not None]
    held = [_six_digits([k for k, _ in inertia]), _six_digits([own for _, own in inertia])]
    # Left out if all are rigid, so that such scenes keep their digests.
    soft = [(k, b.stiffness, b.damping) for k, b in enumerate(bodies) if math.isfinite(b.stiffness)]
    moving = numbers("position", "quat_xyzw", "velocity", "angular_velocity")
    which = [[f"{body.motion} {body.name}" for body in bodies], *numbers("shape", "scale")]
    return {
        "shapes": digest([_described(shape) for shape in scene.shapes], which),
        "bodies": digest(moving, numbers("mass", "friction", "restitution"), held, *soft, *_held(scene.joints)),
        "gravity": digest(_six_digits([scene.gravity])),
    }


def _held(joints: Sequence[Joint]) -> list:
    """The properties of joints for a digest; an empty list if there are no joints."""
    if not joints:
        return []
    kinds = [f"{j.kind} {j.bodies} {j.collides} {j.limits is None} {j.spring is None} {j.motor}" for j in joints]
    limits = _six_digits([j.limits or (0.0, 0.0) for j in joints])
    springs = _six_digits([(j.spring.stiffness, j.spring.rest) if j.spring else (0.0, 0.0) for j in joints])
    known = [_six_digits([getattr(j, name) for j in joints]) for name in ("anchor", "quat_xyzw", "restitution")]
    drags = _six_digits([(j.damping, j.friction, j.length or 0.0) for j in joints])
    rotors = [_six_digits([j.armature for j in joints])] if any(j.armature for j in joints) else []
    turns = [round(j.start / (2.0 * math.pi)) for j in joints if j.kind == "hinge"]
    bears = _six_digits([[min(most, 1e30) for most in (j.breaks_force, j.breaks_torque)] for j in joints])
    return [kinds, limits, springs, *known, drags, bears, turns, *rotors]


def _described(shape: Shape) -> list:
    if isinstance(shape.sdf, ClosedForm):
        form = [shape.sdf.KIND, _six_digits([shape.sdf.sizes])]
    else:
        form = [_six_digits(shape.mesh.vertices), shape.mesh.faces.astype(np.int64)]
    return [*form, str(shape.source.get("wall"))]


def _six_digits(values: Sequence | np.ndarray) -> np.ndarray:
    """Rows of numbers [N, K], rounded to 2^-20 of the largest in the row."""
    rows = np.asarray(values, np.float64)
    rows = rows.reshape(len(rows), math.prod(rows.shape[1:]))
    # A number just below a power of two counts as that power: rounding must not separate the two.
    unit = np.ldexp(1.0, np.frexp(np.abs(rows).max(1, initial=0.0) * (1.0 + 1e-9))[1] - 20)[:, None]
    return np.round(rows / unit) * unit + 0.0  # no negative zeros
