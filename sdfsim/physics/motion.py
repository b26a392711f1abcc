"""Where bodies are and how they move: one record for states, rollouts and recordings."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np


class Rows:
    """A frozen record of arrays with a row for each body."""

    def with_rows(self, rows: np.ndarray, changed: dict[str, np.ndarray], **others: Any) -> Self:
        """The record with other rows in some arrays, and `others` in place of what else it holds.

        An array is put together when it is first asked for: what is not looked at costs the changed rows alone,
        however many bodies there are.
        """
        new = object.__new__(type(self))
        new.__dict__.update({name: value for name, value in vars(self).items() if name not in changed}, **others)
        new.__dict__.update(_before=self, _rows=rows, _changed=changed)
        return new

    @property
    def parts(self) -> tuple[Self, np.ndarray, dict[str, np.ndarray]] | None:
        """What `with_rows` has made it of: the other record, the rows, and what they hold; None for one made whole."""
        known = vars(self)
        return (known["_before"], known["_rows"], known["_changed"]) if "_before" in known else None

    def __getattr__(self, name: str) -> np.ndarray:  # of what `with_rows` has left out
        if name.startswith("_") or name not in self._changed:
            raise AttributeError(name)
        whole = getattr(self._before, name).copy()
        whole[self._rows] = self._changed[name]
        self.__dict__[name] = whole
        return whole


@dataclass(frozen=True)
class Motion(Rows):
    """Poses and velocities of N bodies, [N, ...] at one instant or [T, N, ...] at several, float64.

    In metres and seconds, or in the units of a model. Nobody writes to the arrays.
    """

    position: np.ndarray  # [..., N, 3] centres of mass
    orientation: np.ndarray  # [..., N, 4] xyzw, shape axes -> world
    velocity: np.ndarray  # [..., N, 3] of the centres of mass
    angular_velocity: np.ndarray  # [..., N, 3] rad per unit of time, world frame


MOTION = ("position", "orientation", "velocity", "angular_velocity")
