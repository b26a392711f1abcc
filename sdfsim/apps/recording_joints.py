"""How recordings show joints: lines that stay with their bodies, so that they are logged once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sdfsim.physics import pose
from sdfsim.scene.scene import Joint, Scene

MOST_SHOWN = 256  # joints of a scene, beyond which none is shown: each takes bodies out of the crowds
SIZE = 0.4  # of marks, relative to the smaller of the two bodies
AROUND = 24  # points on a full circle
UNKNOWN = 0.1  # m, of marks between things without an end
AXIS_COLOR, LIMIT_COLOR = (255, 140, 0), (255, 210, 90)


@dataclass(frozen=True)
class Mark:
    """What is drawn of a joint in one of its bodies."""

    body: int  # -1: the world
    strips: list[np.ndarray]  # [P, 3] m, from the body's centre of mass in its axes; in the world as they are
    color: tuple[int, int, int]


def shown_joints(scene: Scene) -> tuple[Joint, ...]:
    return scene.joints if len(scene.joints) <= MOST_SHOWN else ()


def marks(scene: Scene, joint: Joint) -> list[Mark]:
    """The axis in the second body, beside the limits: of a hinge an arc, along which a needle in the first body goes;
    of a slider the way of its point; of a ball the rim of its cone. A fixed joint, and the ends of a distance, are a
    small cross each."""
    smaller = min(_extent(scene, k) for k in joint.bodies)
    size = SIZE * smaller if np.isfinite(smaller) else UNKNOWN
    axis, limits, needle = [], [], []
    x, y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    if joint.kind == "hinge":
        axis = [np.stack([-size * x, size * x])]
        low, high = joint.limits if joint.limits is not None else (0.0, 0.0)
        high = min(high, low + 2.0 * np.pi)
        turns = np.linspace(low, high, 2 + int(AROUND * (high - low) / (2.0 * np.pi)))
        arc = 0.8 * size * np.stack([0.0 * turns, np.cos(turns), np.sin(turns)], 1)
        limits = [np.concatenate([np.zeros((1, 3)), arc, np.zeros((1, 3))])] if joint.limits is not None else []
        needle = [np.stack([0.0 * y, size * y])]
    elif joint.kind == "slider":
        low, high = joint.limits if joint.limits is not None else (-size, size)
        axis = [np.stack([low * x, high * x])]
        limits = [np.stack([e * x - 0.3 * size * y, e * x + 0.3 * size * y]) for e in (joint.limits or ())]
        needle = [np.stack([-0.2 * size * y, 0.2 * size * y])]
    elif joint.kind == "ball" and joint.limits is not None:
        turns, lean = np.linspace(0.0, 2.0 * np.pi, AROUND + 1), joint.limits[1]
        rim = np.stack([np.full_like(turns, np.cos(lean)), *(np.sin(lean) * f(turns) for f in (np.cos, np.sin))], 1)
        limits, needle = [size * rim], [np.stack([0.0 * x, size * x])]
    else:
        needle = [0.2 * size * np.stack([-side, side]) for side in np.eye(3)]
        axis = needle if joint.kind == "distance" else []
    made = [(1, axis, AXIS_COLOR), (1, limits, LIMIT_COLOR), (0, needle, AXIS_COLOR)]
    return [_placed(scene, joint, side, strips, color) for side, strips, color in made if strips]


def ends(joints: Sequence[Joint], place: np.ndarray, turn: np.ndarray, scene: Scene) -> np.ndarray:
    """[T, J, 2, 3] m: the ends of distances, of bodies whose centres of mass are at `place` [T, N, 3] with the
    orientations `turn` [T, N, 4]."""
    found = np.zeros((len(place), len(joints), 2, 3))
    for j, joint in enumerate(joints):
        for side, k in enumerate(joint.bodies):
            offset = _from_com(scene, joint, side)
            found[:, j, side] = offset if k < 0 else place[:, k] + pose.rotate(turn[:, k], offset)
    return found


def _placed(scene: Scene, joint: Joint, side: int, strips: list[np.ndarray], color: tuple[int, int, int]) -> Mark:
    frame, origin = joint.quat_xyzw[side], _from_com(scene, joint, side)
    return Mark(joint.bodies[side], [pose.rotate(frame, strip) + origin for strip in strips], color)


def _from_com(scene: Scene, joint: Joint, side: int) -> np.ndarray:
    """[3] m, the joint's end from the centre of mass of the body, in its axes."""
    k = joint.bodies[side]
    if k < 0:
        return joint.anchor[side]
    return joint.anchor[side] - scene.bodies[k].scale * scene.shapes[scene.bodies[k].shape].com


def _extent(scene: Scene, k: int) -> float:
    """m, of a body; infinite of the world and of planes."""
    if k < 0:
        return np.inf
    box = np.ptp(scene.shapes[scene.bodies[k].shape].sdf.bounds, axis=0).max() * scene.bodies[k].scale
    return float(box)
