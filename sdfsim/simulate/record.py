"""Recordings of steps that somebody makes one by one, see `Simulator.record`."""

import math
from dataclasses import replace

import numpy as np

from sdfsim.physics import pose
from sdfsim.physics.motion import MOTION
from sdfsim.physics.rollout import Rollout, join
from sdfsim.scene.scene import Scene

TOGETHER = 256  # so many parts are joined: each has some thirty arrays


class Recording:
    """The frames of a simulator since it began; `rollout` has them, with the forces of contacts and the efforts of
    motors (`contact_force`, `joint_effort`). Its counters have for each hinge and slider what it was told to do:
    `target_NAME` and `effort_NAME`, see `JointHandle`, NaN where there is none. `sdfsim.save_run` writes a recording as
    a run folder."""

    def __init__(self, first: Rollout) -> None:
        self.begin(first)

    @property
    def rollout(self) -> Rollout:
        """All frames so far, the first is the state at the beginning."""
        return join([*self._parts, *self._fresh])

    def begin(self, first: Rollout) -> None:
        """Forget everything, and begin with one frame."""
        self._parts: list[Rollout] = []
        self._fresh = [first]

    def add(self, part: Rollout) -> None:
        """Append frames."""
        self._fresh.append(part)
        if len(self._fresh) >= TOGETHER:
            self._parts.append(join(self._fresh))
            self._fresh = []

    def since(self, time: float) -> Rollout:
        """The frames from `time` s on, at least one."""
        parts = [*self._parts, *self._fresh]
        first = len(parts) - 1
        while first > 0 and (not len(parts[first].time) or parts[first].time[0] > time):
            first -= 1
        found = join(parts[first:])
        return found.frames(min(int(np.searchsorted(found.time, time)), len(found)), len(found.time))

    def cut(self, now: Rollout) -> None:
        """Forget all frames after a moment, given as a rollout of one frame; begin with it if it is in none of them."""
        known = self.rollout
        for k in np.flatnonzero(np.abs(known.time - now.time[0]) < 0.5 * known.meta["dt"]):
            if all(np.array_equal(getattr(known, name)[k], getattr(now, name)[0]) for name in MOTION):
                self.begin(known.frames(0, int(k) + 1))
                return
        self.begin(now)

    def shorten(self, most: int) -> None:
        """Forget the oldest frames, some hundreds at a time, until their arrays have at most `most` bytes."""

        def size(part: Rollout) -> int:
            return sum(v.nbytes for v in [*vars(part).values(), *part.counters.values()] if isinstance(v, np.ndarray))

        while len(self._parts) > 1 and sum(map(size, self._parts)) > most:
            del self._parts[0]


def at_frame(scene: Scene, frame: Rollout) -> Scene:
    """The scene with its bodies, joints and targets of motors as in the first frame of a recorded rollout. Paths of
    kinematic bodies go on from there."""
    bodies, joints = [], []
    for k, body in enumerate(scene.bodies):
        turn = frame.orientation[0, k]
        place = frame.position[0, k] - pose.rotate(turn, scene.shapes[body.shape].com * body.scale)
        path = body.path
        if path is not None:
            ahead = path.time > frame.time[0]
            path = replace(
                path, time=np.r_[0.0, path.time[ahead] - frame.time[0]],
                position=np.r_[place[None], path.position[ahead]],
                quat_xyzw=np.r_[turn[None], path.quat_xyzw[ahead]],
            )  # fmt: skip
        speeds = {"velocity": frame.velocity[0, k], "angular_velocity": frame.angular_velocity[0, k]}
        bodies.append(replace(body, position=place, quat_xyzw=turn, path=path, **speeds))
    for k, joint in enumerate(scene.joints):
        if frame.joint_names and joint.kind in ("hinge", "slider"):
            low, high = joint.limits or (-math.inf, math.inf)  # a limit gives a little
            joint = replace(joint, start=float(np.clip(frame.joint_position[0, k], low, high)))
        aim = float(frame.counters.get(f"target_{joint.name}", [math.nan])[0])
        if joint.motor is not None and math.isfinite(aim):
            which = "position" if joint.motor.speed is None else "speed"
            joint = replace(joint, motor=replace(joint.motor, **{which: aim}))
        joints.append(joint)
    return replace(scene, bodies=tuple(bodies), joints=tuple(joints))
