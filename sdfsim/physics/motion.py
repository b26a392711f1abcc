"""Where bodies are and how they move: one record for states, rollouts and recordings."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np


class Rows:
    """A frozen record of arrays with a row for each body."""

    def with_rows(self, rows: np.ndarray, changed: dict[str, np.ndarray], **others: Any) -> Self:
        """The record with other rows (ascending) in some arrays, and `others` in place of what else it holds.

        An array is put together when it is first asked for: what is not looked at costs the changed rows alone,
        however many bodies there are, and however often rows have been changed before.
        """
        before, known, values = self.parts or (self, rows, {})
        if rows is not known and not np.array_equal(rows, known):
            known = np.union1d(known, rows)
            values = {name: self.rows_of(name, known) for name in {**values, **changed}}
            place = np.searchsorted(known, rows)
            for name, value in changed.items():
                values[name][place] = value
        else:
            values = values | changed
        new = object.__new__(type(self))
        new.__dict__.update({name: value for name, value in vars(self).items() if name not in values}, **others)
        new.__dict__.update(_before=before, _rows=known, _changed=values)
        return new

    def rows_of(self, name: str, rows: np.ndarray) -> np.ndarray:
        """A copy of some rows of an array, which is not put together for them."""
        before, known, values = self.parts or (self, rows, {})
        if name not in values or not len(known):
            return getattr(self, name)[rows]
        found = getattr(before, name)[rows]
        place = np.minimum(np.searchsorted(known, rows), len(known) - 1)
        held = known[place] == rows
        found[held] = values[name][place[held]]
        return found

    @property
    def parts(self) -> tuple[Self, np.ndarray, dict[str, np.ndarray]] | None:
        """What `with_rows` has made it of: a record that is whole, the rows, and what they hold; None for a whole
        one."""
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
