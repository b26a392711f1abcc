"""Many worlds in one call, compiled: each makes the steps of `run_steps`, and stays as it was if it fails."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit, typeof, types
from numba.core import cgutils
from numba.extending import NativeValue, intrinsic, typeof_impl, unbox
from numba.typed.typedlist import List

from sdfsim.base.compiling import cache_of, kept
from sdfsim.physics.solver.code_cache import sources
from sdfsim.physics.solver.references import Reference
from sdfsim.physics.solver.run import Script, run_steps
from sdfsim.physics.solver.survey import touching
from sdfsim.physics.solver.tolerances import REPORTED
from sdfsim.physics.solver.vectors import BARE, ENTRY, FAST
from sdfsim.physics.solver.world import COLUMNS, POINTS, Manifolds


class Stored:
    """NamedTuples of one type, one after the other as compiled code has them, for it to read by reference. Arrays are
    not copied."""

    def __init__(self, values: list[Any]) -> None:
        self.values = values  # keeps the arrays alive
        self.words = np.array([_words(value) for value in values], np.int64)
        self.type, self.address = Reference(typeof(values[0])), self.words.ctypes.data

    def put(self, place: int, value: Any) -> None:
        self.values[place], self.words[place] = value, _words(value)


def _words(value: Any) -> list[int]:
    """A NamedTuple of arrays and whole numbers in memory. Without an owner (the first word of an array) numba does not
    count references, so whoever stores it keeps the arrays."""
    if isinstance(value, np.ndarray):
        return [0, 0, value.size, value.itemsize, value.ctypes.data, *value.shape, *value.strides]
    return [word for part in value for word in _words(part)] if isinstance(value, tuple) else [int(value)]


@typeof_impl.register(Stored)
def _type_of(stored: Stored, context: Any) -> Reference:
    return stored.type


@unbox(Reference)
def _address_of(kind: Reference, stored: Any, c: Any) -> NativeValue:
    held = c.pyapi.object_getattr_string(stored, "address")
    address = c.pyapi.long_as_longlong(held)
    c.pyapi.decref(held)
    return NativeValue(c.builder.inttoptr(address, cgutils.voidptr_t))


@intrinsic
def _nth(typing: Any, stored: Any, place: types.Type) -> Any:

    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        first = builder.bitcast(given[0], context.get_value_type(stored.of).as_pointer())
        return builder.bitcast(builder.gep(first, [given[1]]), cgutils.voidptr_t)

    return stored(stored, types.int64), code


nth: Any = _nth  # a reference to one of the NamedTuples that are stored


class Told(NamedTuple):
    """What goes in and out of W worlds of N bodies."""

    fresh: np.ndarray  # [W] bool, whether contacts are forgotten
    changed: np.ndarray  # [W, N] bool, bodies on which forces or motors have changed
    number: np.ndarray  # [W] int64, steps since the start
    force: np.ndarray  # [W, N, 3] out: the sum of the impulses of contacts in the last inner step
    failed: np.ndarray  # [W] bool, out: whether a state became invalid; such worlds make no steps


with kept(cache_of([*sources(), Path(__file__)])):

    @njit(**ENTRY)
    def untouched(count):
        """`Manifolds` without contacts, for each of `count` worlds."""
        held = List()
        for _ in range(count):
            held.append(_none())
        return held

    @njit(**FAST)
    def _none():
        return Manifolds(np.zeros((0, 2), np.int64), np.zeros(0, np.int64), np.zeros((0, POINTS, COLUMNS)))

    @njit(**ENTRY, nogil=True)
    def run_worlds(shapes, worlds, works, joints, motions, rules, held, pieces, script, most, kept, told, rows, steps):
        """Advance the worlds `rows` [R] int64 by `steps`; the structures of each are at its place in `worlds`, `works`,
        `motions` and `joints`, its contacts in `held`."""
        for w in rows:
            motion, each = nth(motions, w), nth(joints, w).each
            if told.fresh[w]:
                held[w] = _none()
            manifolds = held[w]
            _disturb(motion, manifolds, told.changed[w])
            told.fresh[w], told.changed[w] = False, False
            if told.failed[w]:
                continue
            position, orientation, state = motion.position.copy(), motion.orientation.copy(), each.state.copy()
            velocity, angular = motion.velocity.copy(), motion.angular.copy()
            last = max(len(script.pose) - steps, 0)  # after it the paths have ended
            k = min(told.number[w], last)
            part = Script(script.body, script.pose[k : k + steps], script.velocity[k : k + steps])
            manifolds, _, _, broken, _, _, _, _, _ = run_steps(
                nth(shapes, 0), nth(worlds, w), nth(works, w), motion, rules, manifolds, nth(joints, w), pieces, part,
                most, kept, REPORTED, steps,
            )  # fmt: skip
            if broken >= 0:
                told.failed[w] = True
                motion.position[:] = position
                motion.orientation[:] = orientation
                motion.velocity[:] = velocity
                motion.angular[:] = angular
                each.state[:] = state
                continue
            held[w] = manifolds
            told.number[w] += steps
            told.force[w] = 0.0
            found = touching(manifolds, motion.position, motion.orientation, REPORTED)
            for e in range(len(found.pair)):
                for x in range(3):
                    told.force[w, found.pair[e, 0], x] += found.impulse[e, x]
                    told.force[w, found.pair[e, 1], x] -= found.impulse[e, x]

    @njit(**BARE)
    def _disturb(motion, manifolds, changed):
        """Wake the bodies `changed` [N] and those that slept with them or on them, as `prepare.disturbed` does."""
        for b in range(len(changed)):
            if changed[b]:
                _wake(motion, b)
                motion.quiet[b] = 0
                for m in range(len(manifolds.pair)):
                    for s in range(2):
                        if manifolds.count[m] > 0 and manifolds.pair[m, s] == b:
                            _wake(motion, manifolds.pair[m, 1 - s])

    @njit(**BARE)
    def _wake(motion, b):
        island = motion.island[b]
        for c in range(len(motion.island)):
            if island >= 0 and motion.island[c] == island:
                motion.island[c], motion.quiet[c] = -1, 0
