"""Whether everything has come to rest."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sdfsim.dynamics.bodies import Bodies, State

STEPS = 25  # for so many steps a body has to stay
STRAY = 0.05  # model lengths: within so much of where it was, its farthest point included


@dataclass(frozen=True)
class Rest:
    """For how long everything has rested: no point of a dynamic body has gone beyond `STRAY` of where it was."""

    # [D, 7] float64, the poses of the dynamic bodies that they have stayed near; None before the first state
    anchor: np.ndarray | None = None
    quiet: int = 0  # for how many steps

    @property
    def settled(self) -> bool:
        """Whether that is long enough."""
        return self.quiet >= STEPS

    def after(self, bodies: Bodies, state: State) -> Rest:
        """What is so with `state`, the one that follows."""
        moves = bodies.moves.cpu().numpy()
        pose = np.concatenate([state.position.cpu().numpy(), state.orientation.cpu().numpy()], -1)[moves]
        if self.anchor is None or (_strayed(self.anchor, pose, bodies.radius.cpu().numpy()[moves]) >= STRAY).any():
            return Rest(pose)
        return replace(self, quiet=self.quiet + 1)


def _strayed(before: np.ndarray, now: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Upper bound [A] on how far any point within `radius` [A] is from where it was, for poses [A, 7]."""
    cosine = (before[:, 3:] * now[:, 3:]).sum(-1)
    chord = 2.0 * np.sqrt(np.maximum(1.0 - cosine * cosine, 0.0))
    return np.sqrt(np.square(now[:, :3] - before[:, :3]).sum(-1)) + chord * radius
