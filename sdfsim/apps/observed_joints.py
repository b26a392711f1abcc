"""Recordings of scenes with joints: poses and velocities that these allow, near those that were seen."""

from __future__ import annotations

import numpy as np

from sdfsim.apps.export_joints import Held, trees
from sdfsim.physics import pose
from sdfsim.scene.scene import Scene

Frames = tuple[
    np.ndarray, np.ndarray, np.ndarray, np.ndarray
]  # position of the centre of mass, orientation, velocity, spin


def jointed(scene: Scene) -> list[bool]:
    """Of the bodies that move, whether a joint holds one: such do not fly freely."""
    rows = {k for joint in scene.joints for k in joint.bodies}
    return [k in rows for k, body in enumerate(scene.bodies) if body.motion == "dynamic"]


def held_together(seen: Frames, scene: Scene) -> Frames:
    """Poses and velocities [T, D, *] of the bodies that move, as the joints of trees let them be: each as it was seen
    against that which holds it, but for what the joint does not allow. Loops and distances are left as they are."""
    tree = trees(scene)
    number = {k: d for d, k in enumerate(k for k, b in enumerate(scene.bodies) if b.motion == "dynamic")}
    arrays = [array.copy() for array in seen]
    count = len(arrays[0])

    def of(k: int) -> Frames:
        if k in number:
            return tuple(array[:, number[k]] for array in arrays)  # type: ignore[return-value]
        body = scene.bodies[k] if k >= 0 else None
        place = np.zeros(3) if body is None else body.position + pose.rotate(body.quat_xyzw, _com(scene, k))
        turn = np.array([0.0, 0.0, 0.0, 1.0]) if body is None else body.quat_xyzw
        rest = np.zeros((count, 3))
        return np.tile(place, (count, 1)), np.tile(turn, (count, 1)), rest, rest

    for k in tree.order:
        if k in tree.above and k in number:
            made = _allowed(
                tree.above[k], of(k), of(tree.above[k].parent), _com(scene, k), _com_of(scene, tree.above[k])
            )
            for array, values in zip(arrays, made, strict=True):
                array[:, number[k]] = values
    place, turn, speed, spin = arrays
    return place, turn, speed, spin


def _com(scene: Scene, k: int) -> np.ndarray:
    return scene.bodies[k].scale * scene.shapes[scene.bodies[k].shape].com


def _com_of(scene: Scene, one: Held) -> np.ndarray:
    return np.zeros(3) if one.parent < 0 else _com(scene, one.parent)


def _allowed(one: Held, child: Frames, parent: Frames, com: np.ndarray, com_of_parent: np.ndarray) -> Frames:
    """Pose and velocities of a child, by its joint with a parent."""
    (place, turn, speed, spin), (base, lie, carried, turned) = child, parent
    own, theirs = one.frame.as_quat(), one.parent_frame.as_quat()
    frame = pose.multiply(lie, np.tile(theirs, (len(lie), 1)))
    axis = pose.rotate(frame, np.array([1.0, 0.0, 0.0]))
    kind = one.joint.kind
    seen = pose.multiply(pose.conjugate(frame), pose.multiply(turn, np.tile(own, (len(turn), 1))))
    twist = np.zeros_like(seen)
    twist[:, 3] = 1.0
    if kind == "hinge":
        twist = pose.normalise(seen * np.array([1.0, 0.0, 0.0, 1.0]))
    elif kind == "ball":
        twist = seen
    orientation = pose.multiply(pose.multiply(frame, twist), np.tile(pose.conjugate(own), (len(turn), 1)))
    relative = spin - turned
    if kind == "hinge":
        relative = axis * (relative * axis).sum(-1, keepdims=True)
    elif kind != "ball":
        relative = np.zeros_like(relative)
    rate = turned + relative
    arm = pose.rotate(lie, np.tile(one.parent_anchor - com_of_parent, (len(lie), 1)))
    anchor = base + arm
    # From the child's anchor to its centre of mass, as it was seen and as it is.
    was, lever = (pose.rotate(q, np.tile(com - one.anchor, (len(q), 1))) for q in (turn, orientation))
    along, sliding = np.zeros_like(anchor), np.zeros_like(anchor)
    if kind == "slider":
        along = axis * ((place - was - anchor) * axis).sum(-1, keepdims=True)
        there = carried + np.cross(turned, arm + along)
        here = speed - np.cross(spin, was)
        sliding = axis * ((here - there) * axis).sum(-1, keepdims=True)
    velocity = carried + np.cross(turned, arm + along) + sliding + np.cross(rate, lever)
    return anchor + along + lever, orientation, velocity, rate
