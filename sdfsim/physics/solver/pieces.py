"""The pieces of the step, each compiled on its own and called by its address.

Numba compiles a function together with all that it calls. As one function, the step would be compiled as a whole for
every combination of features. Pieces are compiled side by side, each once, and a scene uses those that it needs: an
effect that is off is neither compiled nor run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from numba import cfunc, int64
from numba.core import config
from numba.core.caching import FunctionCache

from sdfsim.physics.solver.code_cache import kept_here
from sdfsim.physics.solver.internal_edges import heed_supports
from sdfsim.physics.solver.joints import assemble as assemble_joints
from sdfsim.physics.solver.narrow_phase import find_parts, narrow_phase
from sdfsim.physics.solver.solve import solve
from sdfsim.physics.solver.time_of_impact import time_of_impact


class Pieces(NamedTuple):
    """The pieces that a scene uses: addresses, or functions if numba does not compile."""

    near: Any  # parts of bodies that are near each other
    collide: Any  # contact points
    impact: Any  # time of impact
    assemble: Any  # rows of joints
    solve: Any  # impulses


class Piece:
    """A function of references and whole numbers that returns a whole number; `seconds` is how long it is compiled."""

    def __init__(self, function: Callable[..., int], seconds: int) -> None:
        self.py_func, self.seconds = function, seconds
        self._compiled: dict[tuple, Any] = {}

    def compile(self, arguments: tuple) -> Any:
        """The compiled function for these types of arguments: from numba's cache, else compiled now."""
        if arguments not in self._compiled:
            with kept_here():
                self._compiled[arguments] = cfunc(int64(*arguments), cache=True)(self.py_func)
        return self._compiled[arguments]

    def cache(self) -> FunctionCache:
        with kept_here():
            return FunctionCache(self.py_func)

    @property
    def signatures(self) -> list[tuple]:
        """The types of arguments for which it is compiled in this process."""
        return [*self._compiled]

    def address(self, arguments: tuple) -> Any:
        return self.py_func if vars(config)["DISABLE_JIT"] else self.compile(arguments).address


def _piece(seconds: int) -> Callable[[Callable[..., int]], Piece]:
    return lambda function: Piece(function, seconds)


@_piece(3)
def near_solids(shapes, world, work, motion, rules, parts):
    return find_parts(shapes, world, work, motion, rules, parts, None, None)


@_piece(5)
def near_surfaces(shapes, world, work, motion, rules, parts):
    return find_parts(shapes, world, work, motion, rules, parts, True, None)


@_piece(8)
def near_many(shapes, world, work, motion, rules, parts):
    return find_parts(shapes, world, work, motion, rules, parts, True, True)


@_piece(15)
def collide_solids(shapes, world, work, motion, rules, points, near):
    narrow_phase(shapes, world, work, motion, rules, points, near, None, None)
    heed_supports(shapes, world, work, motion, rules, points, near, work.scratch)
    return 0


@_piece(30)
def collide_surfaces(shapes, world, work, motion, rules, points, near):
    narrow_phase(shapes, world, work, motion, rules, points, near, True, None)
    heed_supports(shapes, world, work, motion, rules, points, near, work.scratch)
    return 0


@_piece(35)
def collide_many(shapes, world, work, motion, rules, points, near):
    narrow_phase(shapes, world, work, motion, rules, points, near, True, True)
    heed_supports(shapes, world, work, motion, rules, points, near, work.scratch)
    return 0


@_piece(10)
def impact_solids(shapes, world, work, motion, rules, points, near):
    time_of_impact(shapes, world, work, motion, rules, points, near, work.scratch, None)
    return 0


@_piece(12)
def impact_surfaces(shapes, world, work, motion, rules, points, near):
    time_of_impact(shapes, world, work, motion, rules, points, near, work.scratch, True)
    return 0


@_piece(10)
def assemble(world, work, motion, rules, joints, phase):
    assemble_joints(world, work, motion, rules, joints, phase)
    return 0


@_piece(6)
def solve_contacts(world, work, motion, rules, points, joints, phase):
    return solve(world, work, motion, rules, points, None, None, phase)


@_piece(10)
def solve_many(world, work, motion, rules, points, joints, phase):
    return solve(world, work, motion, rules, points, None, True, phase)


@_piece(20)
def solve_joints(world, work, motion, rules, points, joints, phase):
    return solve(world, work, motion, rules, points, joints, None, phase)


def chosen(*, surfaces: bool, threads: bool, joints: bool) -> dict[str, Piece]:
    """The pieces for scenes with these features, by the names of `Pieces`."""
    near, collide = (near_many, collide_many) if threads else (near_solids, collide_solids)
    if surfaces and not threads:
        near, collide = near_surfaces, collide_surfaces
    used = {"near": near, "collide": collide, "impact": impact_surfaces if surfaces else impact_solids}
    used["solve"] = solve_joints if joints else solve_many if threads else solve_contacts
    return used | {"assemble": assemble} if joints else used
