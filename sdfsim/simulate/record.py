"""Recordings of steps that somebody makes one by one, see `Simulator.record`."""

import numpy as np

from sdfsim.physics.motion import MOTION
from sdfsim.physics.rollout import Rollout, join

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
