"""Poses and velocities of bodies: one record for states, rollouts and recordings."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np


class Rows:
    """A frozen record of arrays with one row for each body."""

    def with_rows(self, rows: np.ndarray, changed: dict[str, np.ndarray], **others: Any) -> Self:
        """A copy of the record with other rows (ascending) in some arrays, and `others` in place of further fields.

        An array is assembled on first access. Until then a change costs only the changed rows, however many bodies
        there are, and however often rows have been changed before.
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
        """A copy of some rows of an array, without assembling the array."""
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
        """What `with_rows` was given: a complete record, the rows, and their values; None for a complete record."""
        known = vars(self)
        return (known["_before"], known["_rows"], known["_changed"]) if "_before" in known else None

    def __getattr__(self, name: str) -> np.ndarray:  # for arrays that `with_rows` has not assembled
        if name.startswith("_") or name not in self._changed:
            raise AttributeError(name)
        whole = getattr(self._before, name).copy()
        whole[self._rows] = self._changed[name]
        self.__dict__[name] = whole
        return whole


@dataclass(frozen=True)
class Motion(Rows):
    """Poses and velocities of N bodies, [N, ...] at one instant or [T, N, ...] at several, float64.

    In metres and seconds, or in the units of a model. The arrays must not be written to.
    """

    position: np.ndarray  # [..., N, 3] centres of mass
    orientation: np.ndarray  # [..., N, 4] xyzw, shape axes -> world
    velocity: np.ndarray  # [..., N, 3] of the centres of mass
    angular_velocity: np.ndarray  # [..., N, 3] rad per unit of time, world frame


MOTION = ("position", "orientation", "velocity", "angular_velocity")
