"""`identify`: finds coefficients, sizes, masses and the height and tilt of the ground from recorded motions.

Recordings are cut into windows, short ones everywhere and long ones from their starts. The contact solve runs all of
them side by side, each from the recorded state, and a fit changes the parameters until the windows agree with the
recordings. Whole motions that the fit has not seen then show how good the result is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, cast

import numpy as np

from sdfsim.apps.identify.parameters import HIGH, KINDS, OF_JOINTS, Problem
from sdfsim.apps.identify.report import (
    ENOUGH,
    WEAK,
    Identified,
    estimated,
    file_values,
    notes_on,
    profiled,
)
from sdfsim.apps.identify.residuals import Windows, covered, short, whole
from sdfsim.apps.observed import Recording
from sdfsim.base.parallel import Progress, silent
from sdfsim.scene.scene import Scene

WHOLE = 8  # least number of long windows for a final fit to them: a few chaotic ones tell less than many short ones
HELD = 6  # every sixth recording is kept out of the fit, if there are at least `ENOUGH`
TRIES = 15, 15, 8  # largest numbers of iterations of the fits to short windows, and to long ones
DRAWS = 400  # random draws of recordings, for intervals
CROWD, ROUNDS, AROUND = 24, 14, 0.15  # the search for long windows: points, rounds, and range, in widths


def identify(
    recordings: Sequence[Recording], scene: Scene, *, profiles: bool = False, on_progress: Progress = silent
) -> Identified:
    """Find the parameters with which the contact solve reproduces recordings, and their intervals; with `profiles` also
    the loss as a function of each.

    The coefficients of the static body that is touched most are taken from the scene, as contacts show products only.
    Raises SdfsimError for recordings that are too short, or in which nothing touches.
    """
    from scipy.optimize import least_squares

    problem = Problem(recordings, scene)
    held = [k for k in range(len(recordings)) if k % HELD == HELD - 1 or HELD > len(recordings) == k + 1 >= ENOUGH]
    fit = [k for k in range(len(recordings)) if k not in held]
    pieces = short(problem, fit)
    start, width = problem.start, problem.width
    low, high = problem.bounds

    def alike(**given: float) -> np.ndarray:
        """All coefficients of moving bodies set to give these products, the other parameters as in the scene."""
        values = [given[p.kind] if p.kind in given else p.start for p in problem.parameters]
        return np.clip(values, low, high)

    # A sweep over common coefficients finds the valley; the fit descends in it.
    tried = [start, *(alike(friction=f, restitution=e) for f in (0.2, 0.5, 0.9) for e in (0.1, 0.4, 0.7, 0.95))]
    costs = []
    for k, trial in enumerate(tried):
        costs.append(float(np.minimum(np.abs(pieces.errors(trial)), 10.0).sum()))
        on_progress(0.2 * k / len(tried), "a first sweep over friction and restitution")
    count = [0]

    def errors_of(windows: Windows, values: np.ndarray) -> np.ndarray:
        count[0] += 1
        on_progress(min(0.95, 0.2 + 0.002 * count[0]), f"fit, run {count[0]} of all windows")
        return np.concatenate([windows.errors(values), WEAK * (values - start) / width])

    nudge = width * [KINDS[p.kind].nudge for p in problem.parameters]

    def slope(windows: Windows, values: np.ndarray, free: np.ndarray) -> np.ndarray:
        """[R, F] derivatives by central differences (see `Kind.nudge`), one-sided at the bounds."""
        columns = []
        for k in free:
            one, other = values.copy(), values.copy()
            one[k], other[k] = min(one[k] + nudge[k], high[k]), max(other[k] - nudge[k], low[k])
            columns.append((errors_of(windows, one) - errors_of(windows, other)) / (one[k] - other[k]))
        return np.stack(columns, 1)

    def settled(windows: Windows, values: np.ndarray, free: np.ndarray, most: int) -> np.ndarray:
        values = np.clip(values, low + 1e-9, high - 1e-9)

        def with_all(some: np.ndarray) -> np.ndarray:
            made = values.copy()
            made[free] = some
            return made

        of: Any = lambda some: errors_of(windows, with_all(some))  # noqa: E731
        by: Any = lambda some: slope(windows, with_all(some), free)  # noqa: E731
        limits = low[free], high[free]
        found = least_squares(of, values[free], by, limits, x_scale=width[free], loss="soft_l1", max_nfev=most)
        return with_all(found.x)

    # First fit the contacts, with bodies and ground as in the scene; then everything.
    every = np.arange(len(width))
    usual = np.flatnonzero([p.kind in (*HIGH, "mass", *OF_JOINTS) for p in problem.parameters])
    best = settled(pieces, tried[int(np.argmin(costs))], usual, TRIES[0])
    best = settled(pieces, best, every, TRIES[1])
    last, longer, scatter = pieces, whole(problem, fit), np.zeros((len(best), len(best)))
    if len(longer.begin) >= WHOLE:
        near, scatter = _searched(longer, best, (low, high), width)
        last, best = longer, settled(longer, near, every, TRIES[2])
    motions = whole(problem, held or fit)
    before, after = (motions.off(values) for values in (start, best))
    confirmed: dict[str, Any] = {
        "recordings": len(held), "before": before.mean(0).tolist(), "after": after.mean(0).tolist(),
        "covered": covered(problem, motions),
    }  # fmt: skip
    error = float(np.sqrt(np.nanmean(np.concatenate([e[..., :3].ravel() for e in pieces.run(best)]) ** 2)))
    by, there = slope(last, best, every), errors_of(last, best)
    found = estimated(problem, best, last.group, by, there, scatter)
    drawn = profiled(problem, best, by, there, partial(errors_of, last), found) if profiles else []
    return Identified(
        found, len(pieces.begin),
        error * math.sqrt(3.0) * problem.units.length, confirmed, notes_on(recordings, confirmed["covered"]),
        *file_values(problem, best), drawn,
    )  # fmt: skip


def _searched(
    windows: Windows, best: np.ndarray, bounds: tuple[np.ndarray, np.ndarray], width: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The parameters near `best` with the lowest cost (for long motions the cost has so many minima that slopes lead
    into the nearest one), and the covariance, in widths, of the best tries over random draws of the same recordings."""
    from scipy.optimize import differential_evolution

    tries: list[np.ndarray] = []
    losses: list[np.ndarray] = []

    def cost(values: np.ndarray) -> float:
        tries.append(values.copy())
        losses.append(np.bincount(windows.group, np.sqrt(1.0 + windows.errors(values) ** 2) - 1.0))
        return float(losses[-1].sum())

    rng = np.random.default_rng(0)
    crowd = best + AROUND * width * rng.standard_normal((CROWD, len(best)))
    crowd[0] = best
    limits, begun = list(zip(*bounds, strict=True)), cast("Any", np.clip(crowd, *bounds))
    found = differential_evolution(cost, limits, init=begun, maxiter=ROUNDS, tol=0.0, polish=False, rng=0).x
    costs = np.array(losses)[:, np.unique(windows.group)]
    drawn = rng.multinomial(costs.shape[1], np.full(costs.shape[1], 1.0 / costs.shape[1]), DRAWS)
    best_of = np.array(tries)[np.argmin(costs @ drawn.T, axis=0)] / width
    return found, np.cov(best_of.T).reshape(len(best), len(best))
