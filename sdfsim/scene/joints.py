"""Joints of a scene: from points and axes in the world, or in a body, to a frame in each of the two bodies."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sdfsim.scene.document import Loc
from sdfsim.scene.scene import WORLD, Body, Joint, JointKind, Motor, Spring
from sdfsim.scene.schema import JointTable

NEAR = 1e-3  # relative: by how much a rod's length may differ from the distance of its ends at the start


def joint_axes(axis: np.ndarray | None) -> Any:
    """The axes of a joint's frame in the world at the start, as a `Rotation`: x is the `axis` [3], a unit vector;
    without an axis they are those of the world."""
    from scipy.spatial.transform import Rotation  # slow to import

    if axis is None:
        return Rotation.identity()
    side = np.eye(3)[np.argmin(np.abs(axis))]
    side = np.cross(axis, side) / np.linalg.norm(np.cross(axis, side))
    return Rotation.from_matrix(np.stack([axis, side, np.cross(axis, side)], 1))


def held(
    name: str,
    kind: JointKind,
    bodies: tuple[int, int],
    known: Sequence[Body],
    *,
    anchor: np.ndarray,
    axis: np.ndarray | None = None,
    to: np.ndarray | None = None,
    start: float = 0.0,
    **others: Any,
) -> Joint:
    """A joint between bodies in their poses at the start.

    Args:
        bodies: indices into `known`, the second -1 for the world.
        anchor: [3] m, world; for a distance, its end at the first body.
        axis: [3] unit vector, world; None if the joint has no axis.
        to: [3] m, world, the end of a distance at the second body.
        start: the angle (rad) of a hinge, or the position (m) of a slider.
        others: further fields of `Joint`.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    frame = joint_axes(axis)
    turned = frame * Rotation.from_rotvec([start, 0.0, 0.0]) if kind == "hinge" else frame
    other = np.asarray(anchor if to is None else to, np.float64)
    other = other - start * np.asarray(axis) if kind == "slider" else other
    anchors, frames = [], []
    for body, point, axes in zip(bodies, (np.asarray(anchor, np.float64), other), (turned, frame), strict=True):
        place, back = np.zeros(3), Rotation.identity()
        if body >= 0:
            place, back = known[body].position, Rotation.from_quat(known[body].quat_xyzw).inv()
        anchors.append(back.apply(point - place))
        frames.append((back * axes).as_quat())
    return Joint(name, kind, bodies, np.stack(anchors), np.stack(frames), start, **others)


def joints_of(
    tables: Sequence[JointTable], bodies: Sequence[Body], wrong: Callable[[Loc, str], None]
) -> tuple[Joint, ...]:
    """The joints of a scene file. Calls `wrong` for points that do not fit the joint."""
    number = {body.name: k for k, body in enumerate(bodies)}
    return tuple(
        _joint(table, bodies, number, lambda key, message, i=i: wrong(("joints", i, key), message))
        for i, table in enumerate(tables)
    )


def _joint(
    table: JointTable, bodies: Sequence[Body], number: dict[str, int], wrong: Callable[[str, str], None]
) -> Joint:
    from scipy.spatial.transform import Rotation  # slow to import

    first, second = (number.get(name, -1) for name in table.bodies)
    place, turn = np.zeros(3), Rotation.identity()
    if table.frame != WORLD:
        place = bodies[number[table.frame]].position
        turn = Rotation.from_quat(bodies[number[table.frame]].quat_xyzw)
    anchor = bodies[first].position if table.anchor is None else place + turn.apply(table.anchor)
    to = None if table.to is None else place + turn.apply(table.to)
    if to is not None:
        apart = float(np.linalg.norm(anchor - to))
        if table.rod is not None and not abs(apart - table.rod) <= NEAR * table.rod:
            wrong("rod", f"must be the distance of its ends at the start, {apart:.6g} m (got {table.rod:g} m)")
        if table.rope is not None and apart > table.rope * (1.0 + NEAR):
            wrong(
                "rope", f"must be at least the distance of its ends at the start, {apart:.6g} m (got {table.rope:g} m)"
            )
    hinge, spring, motor, breaks = table.type == "hinge", table.spring, table.motor, table.breaks_at
    ends = table.limits
    if table.limits_deg is not None:
        ends = [math.radians(end) for end in table.limits_deg]
    if table.cone_deg is not None:
        ends = [0.0, math.radians(table.cone_deg)]
    if table.rope is not None:
        ends = [0.0, table.rope]
    place_of = None if motor is None else motor.position
    if motor is not None and motor.position_deg is not None:
        place_of = math.radians(motor.position_deg)
    return held(
        table.name,
        table.type,
        (first, second),
        bodies,
        anchor=anchor,
        axis=None if table.axis is None else turn.apply(table.axis),
        to=to,
        start=math.radians(table.start_deg) if hinge else table.start,
        limits=None if ends is None else (float(ends[0]), float(ends[1])),
        length=table.rod,
        restitution=table.restitution,
        damping=table.damping,
        friction=table.friction,
        armature=table.armature,
        spring=spring and Spring(spring.stiffness, math.radians(spring.rest_deg) if hinge else spring.rest),
        motor=motor and Motor(motor.max_force, motor.speed, place_of, motor.time, motor.gain),
        breaks_force=math.inf if breaks is None or breaks.force is None else breaks.force,
        breaks_torque=math.inf if breaks is None or breaks.torque is None else breaks.torque,
        collides=table.collide == "on",
    )
