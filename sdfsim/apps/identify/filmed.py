"""Parameters from recordings whose poses each have an uncertainty: those of films.

A film shows some ways of a body well (across the picture) and others badly (towards the camera). So differences count
by the uncertainty of each pose, and no velocity is taken from the poses: the start of each window is fitted with the
parameters. What the camera is not known to is fitted too, and so is in the intervals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from sdfsim.apps.identify.parameters import Problem
from sdfsim.apps.identify.report import SHOWN, Identified, estimates_of, file_values
from sdfsim.apps.identify.residuals import Windows
from sdfsim.apps.observed import Recording
from sdfsim.base.errors import SdfsimError
from sdfsim.base.parallel import Progress, silent
from sdfsim.physics import pose
from sdfsim.physics.options import Options
from sdfsim.physics.steps import Frames
from sdfsim.scene.scene import Scene
from sdfsim.simulate.batch import Copies, inner_of_frame

SHORT, LONG = 0.4, 1.3  # s of windows for bodies of ten centimetres: the first fit, and the last
FINE = 4  # times as many inner steps as usual: poses of films show an impact to less than one
ROUNDS = 10
LAGS = 12  # frames over which errors may be alike
ODD = 3.0  # standard deviations beyond which a pose counts less
BRAKED = 4.0  # m/s^2, by which friction usually slows
LYING = 1.3  # rise of the cost up to which it does
SEATED = 10.0  # standard deviations within which a body that seems to lie on something does
WORSE = 3.0  # how much larger the remaining differences of long windows may be than those of short ones
STILL = 1e6  # times slower, of bodies on paths that stand still
SIZE = 0.1  # m, of the bodies for which windows are as long as said
STARTS = 12  # numbers of a body's start: place, rotation, velocity, spin
# What is known without the film, standard deviations, in the units of `Parameter`.
KNOWN = {"inertia": 0.05, "size": 0.01, "tilt": math.radians(1.0), "mass": 1.0}
LEVEL = 0.005  # m, of heights
PATH = math.radians(0.4)  # tilts of bodies on paths: they are seen
# Of coefficients, which no film is expected to show better: what rendered films were off by, beyond their poses.
SLACK = {"friction": 0.01, "restitution": 0.0065}
LED = {"friction": 0.04}  # if a support is moved along: its path has errors, too
LIKELY = 6.0  # rise of the cost beyond which a value is unlikely
UNLIKE = 10.0  # standard deviations, of most poses, that no motion explains
WORST = 4  # frames that are named
TOLD = 0.7  # share of what was known before: a film that leaves more does not show it
TYPICAL = 0.45  # median of a mean of squares of six standard normal numbers, of which some are unseen
TRIED = [(0.3, 0.15), (0.3, 0.5), (0.3, 0.8), (0.8, 0.65)]


@dataclass
class _Starts:
    """States [W, D, *] in which windows begin, SI units."""

    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray

    def moved(self, by: np.ndarray) -> _Starts:
        """After changes [W, D, 12]."""
        turned = pose.multiply(pose.from_rotvec(by[..., 3:6]), self.orientation)
        return _Starts(self.position + by[..., :3], turned, self.velocity + by[..., 6:9], self.spin + by[..., 9:])


class Shots:
    """Windows of films: pieces of these recordings that begin at these frames and last up to `length` frames."""

    def __init__(self, problem: Problem, begin: Sequence[tuple[int, int]], length: int) -> None:
        self.problem, self.begin = problem, list(begin)
        self.many, self.dt = len(problem.moving), problem.recordings[0].dt
        ends = [min(length, len(problem.recordings[k].known) - 1 - t) for k, t in begin]
        self.length = max(ends)
        shape = (len(begin), self.length + 1, self.many)
        self.place, self.turn, self.root = np.zeros((*shape, 3)), np.zeros((*shape, 4)), np.zeros((*shape, 6, 6))
        self.turn[..., 3] = 1.0
        films = cast("list[Any]", problem.recordings)
        ways = np.cumsum([0, *(r.camera.shape[-1] for r in films)])  # each film has its own camera
        self.rest, self.camera, self.late = np.zeros((*shape, 6)), np.zeros((*shape, 6, ways[-1])), np.zeros(shape[:2])
        for w, ((k, t), n) in enumerate(zip(begin, ends, strict=True)):
            r, rows = films[k], slice(t, t + n + 1)
            for mine, of in ((self.place, r.goal[0]), (self.turn, r.goal[1]), (self.root, r.root), (self.rest, r.rest),
                             (self.camera[..., ways[k] : ways[k + 1]], r.camera), (self.late, r.late)):  # fmt: skip
                mine[w, : n + 1] = of[rows]
        share = np.zeros((len(problem.recordings), max(len(r.known) for r in problem.recordings)))
        for (k, t), n in zip(begin, ends, strict=True):
            share[k, t : t + n + 1] += 1.0
        for w, ((k, t), n) in enumerate(zip(begin, ends, strict=True)):  # frames of two windows count once
            weight = np.sqrt(1.0 / share[k, t : t + n + 1])[:, None, None]
            self.rest[w, : n + 1] *= weight
            self.root[w, : n + 1] *= weight[..., None]
            self.camera[w, : n + 1] *= weight[..., None]
        self._copies: dict[tuple[int, float], Copies] = {}
        size = problem.sizes
        speed = np.sqrt(9.81 * size)
        one = np.ones((self.many, 3))
        self.scale = np.concatenate(
            [one * size[:, None], one, one * speed[:, None], one * (speed / size)[:, None]], 1
        )  # [D, 12] what is large for a start

    def run(self, starts: _Starts, values: np.ndarray, slower: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """[C, L + 1, D, 3] and [C, L + 1, D, 4] from C starts, which are windows times variants. Bodies on paths may
        move many times `slower`: then they stay where they are when a window begins."""
        count, u = len(starts.position), self.problem.units
        if (count, slower) not in self._copies:
            scene, begin = self.problem.scene, [slower * self.dt * t for _, t in self.begin]
            led = (b.path and replace(b.path, time=slower * b.path.time) for b in scene.bodies)
            bodies = tuple(replace(b, path=path) for b, path in zip(scene.bodies, led, strict=True))
            copies = Copies(replace(scene, bodies=bodies), count, begin * (count // len(begin)))
            self._copies[count, slower] = copies
        copies, dt = self._copies[count, slower], self.dt / u.time
        first = [
            a.reshape(count * self.many, -1)
            for a in (starts.position, starts.orientation, starts.velocity, starts.spin)
        ]
        bodies, state = self.problem.applied(values, copies.bodies, copies.begun(*first), count)
        options = Options(np.asarray(self.problem.scene.gravity) / u.acceleration, dt, FINE * inner_of_frame(dt))
        frames = cast(
            "Frames",
            copies.solver.advance(state, copies.solver.init(bodies, state, options), self.length, keep=True).frames,
        )
        total = count * self.many
        kept = [np.nan_to_num(a[:, :total].reshape(self.length, count, self.many, -1).swapaxes(0, 1), nan=1e3)
                for a in (frames.position, frames.orientation, frames.velocity)]  # fmt: skip
        place = np.concatenate([starts.position[:, None], kept[0] * u.length], 1)
        turn = np.concatenate([starts.orientation[:, None], kept[1]], 1)
        speed = np.concatenate([starts.velocity[:, None], kept[2] * u.velocity], 1)
        late = np.tile(self.late, (count // len(self.begin), 1))
        return place + late[..., None, None] * speed, turn

    def off(self, starts: _Starts, values: np.ndarray) -> np.ndarray:
        """[V, W, L + 1, D, 6] differences in standard deviations, for V variants of the starts of windows."""
        place, turn = self.run(starts, values)
        shape = (-1, *self.place.shape[:3])
        away = np.concatenate(
            [place.reshape(*shape, 3) - self.place,
             pose.to_rotvec(pose.multiply(turn.reshape(*shape, 4), pose.conjugate(self.turn)))], -1
        )  # fmt: skip
        return np.einsum("wtdij,vwtdj->vwtdi", self.root, away) + self.rest

    def begun(self) -> _Starts:
        """First guesses: parabolas through the first frames, by gravity or by friction, by the poses' uncertainty."""
        count = len(self.begin)
        found = _Starts(
            np.zeros((count, self.many, 3)), np.zeros((count, self.many, 4)), *np.zeros((2, count, self.many, 3))
        )
        g = np.asarray(self.problem.scene.gravity)
        for w in range(count):
            for d in range(self.many):
                rows = np.flatnonzero(np.abs(self.root[w, :, d]).sum((1, 2)) > 0)[:6]
                time = self.dt * rows + self.late[w, rows]
                best = None
                for some in (rows, rows[:4]):
                    for pull, braked in ((g, 1e-6), (0.0 * g, BRAKED)):
                        t = time[: len(some), None, None]
                        root, rest = self.root[w, some, d][:, :, :3], self.rest[w, some, d]
                        level = self.place[w, some, d] - 0.5 * t[:, 0] ** 2 * pull
                        matrix = np.concatenate([root, root * t, 0.5 * root * t**2], 2).reshape(-1, 9)
                        right = (np.einsum("tij,tj->ti", root, level) - rest).ravel()
                        weak = np.diag(np.r_[np.full(6, 1e-6 * np.linalg.norm(matrix)), np.full(3, 1.0 / braked)])
                        guess = np.linalg.lstsq(np.r_[matrix, weak], np.r_[right, np.zeros(9)], rcond=None)[0]
                        chi = float(np.square(matrix @ guess - right).sum()) / len(some)
                        if best is None or chi < 0.5 * best[0]:
                            best = chi, guess
                assert best is not None
                found.position[w, d], found.velocity[w, d] = best[1][:3], best[1][3:6]
                some, t = rows[:4], (time - time[0])[:4]
                first = self.turn[w, rows[0], d]
                way = pose.to_rotvec(pose.multiply(self.turn[w, some, d], pose.conjugate(first)))
                root = self.root[w, some, d][:, :, 3:]  # nothing, about the axis of what is round
                matrix = np.concatenate([root, root * t[:, None, None]], 2).reshape(-1, 6)
                right = (np.einsum("tij,tj->ti", root, way) - self.rest[w, some, d]).ravel()
                guess = np.linalg.lstsq(matrix, right, rcond=0.01)[0]
                found.orientation[w, d] = pose.multiply(pose.from_rotvec(guess[:3]), first)
                found.spin[w, d] = guess[3:]
        return found

    def seated(self, starts: _Starts, values: np.ndarray) -> list[_Starts]:
        """The starts, and others in which bodies that seem to lie on something do: in the pose in which they come to
        rest if they begin at rest, as long as what was seen is not far from it. They move as before, or level."""
        resting = replace(starts, velocity=0.0 * starts.velocity, spin=0.0 * starts.spin)
        place, turn = (of[:, -1] for of in self.run(resting, values, STILL))
        rotated = pose.to_rotvec(pose.multiply(turn, pose.conjugate(starts.orientation)))
        away = np.concatenate([place - starts.position, rotated], -1)
        off = np.einsum("wdij,wdj->wdi", self.root[:, 0], away)
        near = np.square(off).mean(-1, keepdims=True) < SEATED**2
        lying = replace(
            starts,
            position=np.where(near, place, starts.position),
            orientation=np.where(near, turn, starts.orientation),
            spin=np.where(near, 0.0, starts.spin),
        )
        gravity = np.asarray(self.problem.scene.gravity)
        up = gravity / max(float(np.linalg.norm(gravity)), 1e-9)
        level = starts.velocity - near * (starts.velocity @ up)[..., None] * up
        return [starts, lying, replace(lying, velocity=level)]

    def priors(self, starts: _Starts) -> tuple[np.ndarray, np.ndarray]:
        """Rows [W, D * 12] that keep what nothing shows, and their slopes [D * 12]: spins are about zero."""
        weight = np.full((self.many, STARTS), 1e-3)
        weight[:, 9:] = 0.5
        off = np.zeros((len(self.begin), self.many, STARTS))
        off[..., 9:] = starts.spin / self.scale[:, 9:]
        return (off * weight).reshape(len(self.begin), -1), weight.ravel()


@dataclass
class _Fit:
    values: np.ndarray
    camera: np.ndarray
    starts: _Starts
    cost: float = math.inf
    mean: float = math.inf  # standard deviations, of the differences


def known_before(problem: Problem) -> np.ndarray:
    """[P] what is known of parameters without a film, standard deviations; infinite if nothing is."""
    known = KNOWN | {"height": LEVEL / problem.units.length}
    led = [p.bodies and problem.bodies[p.bodies[0]].motion == "kinematic" for p in problem.parameters]
    return np.array([
        PATH if on_path and p.kind == "tilt" else known.get(p.kind, math.inf)
        for p, on_path in zip(problem.parameters, led, strict=True)
    ])  # fmt: skip


class Fitting:
    """Least squares of the parameters, the camera, and the starts of windows."""

    def __init__(self, shots: Shots, moved: np.ndarray | float = 0.0) -> None:
        self.shots, self.problem, self.moved = shots, shots.problem, moved
        width = self.problem.width
        known = known_before(self.problem)
        self.sure = 1.0 / np.maximum(known, 1e-9) * np.isfinite(known) + 1e-3 / width
        self.mean = self.problem.start.copy()

    def errors(self, fit: _Fit) -> tuple[np.ndarray, np.ndarray, float, float]:
        """Differences [W, L + 1, D, 6], their weights, the cost, and the mean."""
        off = self.shots.off(fit.starts, fit.values)[0] + self.shots.camera @ fit.camera
        square = np.square(off).mean(-1, keepdims=True)
        seen = np.abs(self.shots.root).sum((-1, -2)) > 0
        prior, _ = self.shots.priors(fit.starts)
        own = self.sure * (fit.values - self.mean)
        cost = 6.0 * ODD**2 * float(np.log1p(square / ODD**2).sum()) + float(
            (prior**2).sum() + (own**2).sum() + ((fit.camera + self.moved) ** 2).sum()
        )
        mean = float(np.sqrt(np.median(square[seen])))
        return off, 1.0 / np.sqrt(1.0 + square / ODD**2), cost, mean

    def first(self, fit: _Fit) -> _Fit:
        """The fit, in which what seems to lie on something does, unless that explains much less."""
        found, *lying = [replace(fit, starts=one) for one in self.shots.seated(fit.starts, fit.values)]
        for one in (found, *lying):
            *_, one.cost, one.mean = self.errors(one)
        best = min(lying, key=lambda one: one.cost)
        return best if best.cost < LYING * found.cost else found

    def slopes(self, fit: _Fit, off: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives [W, R, D * 12] by the starts, in `scale`, and [W, R, P + K] by parameters and camera."""
        shots, count = self.shots, len(self.shots.begin)
        step, many = 3e-3, shots.many
        base = np.zeros((many * STARTS, 1, many, STARTS))
        for n in range(many * STARTS):
            base[n, 0, n // STARTS, n % STARTS] = step * shots.scale.ravel()[n]
        both = np.concatenate([base, -base])
        by = np.broadcast_to(both, (len(both), count, many, STARTS)).reshape(-1, many, STARTS)
        tiled = _Starts(*(np.tile(a, (len(both), *[1] * (a.ndim - 1))) for a in vars(fit.starts).values()))
        ends = shots.off(tiled.moved(by), fit.values)
        own = (ends[: len(base)] - ends[len(base) :]) / (2.0 * step)
        own = np.moveaxis(own.reshape(len(base), count, -1), 0, -1)
        shared, (low, high) = [], self.problem.bounds
        for k, width in enumerate(self.problem.width):
            one, other = fit.values.copy(), fit.values.copy()
            nudge = width * 0.02
            one[k], other[k] = min(one[k] + nudge, high[k]), max(other[k] - nudge, low[k])
            ends = [shots.off(fit.starts, v)[0] for v in (one, other)]
            shared.append((ends[0] - ends[1]).reshape(count, -1) / (one[k] - other[k]))
        camera = shots.camera.reshape(count, own.shape[1], shots.camera.shape[-1])
        return own, np.concatenate([np.stack(shared, -1), camera], -1)

    def solved(self, fit: _Fit, rounds: int, on_progress: Progress, say: str) -> _Fit:
        damping, (low, high), many = 1e-2, self.problem.bounds, self.shots.many
        off, weight, fit.cost, fit.mean = self.errors(fit)
        for turn in range(rounds):
            on_progress(min(0.95, turn / rounds), f"{say}, round {turn + 1}")
            own, shared = self.slopes(fit, off)
            blocks = self.blocks(fit, off, weight, own, shared)
            better = False
            while damping < 1e5:
                by_shared, by_own = self.step(fit, *blocks, damping)
                count = len(fit.values)
                by = (by_own.reshape(-1, many, STARTS)) * self.shots.scale
                trial = _Fit(
                    np.clip(fit.values + by_shared[:count], low, high),
                    fit.camera + by_shared[count:],
                    fit.starts.moved(by),
                )
                off_then, weight_then, trial.cost, trial.mean = self.errors(trial)
                if trial.cost < fit.cost:
                    better = fit.cost - trial.cost > 1e-4 * fit.cost
                    fit, off, weight, damping = trial, off_then, weight_then, damping / 5.0
                    break
                damping *= 6.0
            if not better:
                break
        return fit

    def blocks(self, fit: _Fit, off, weight, own, shared) -> tuple[np.ndarray, ...]:
        """Weighted rows: [W, R + 12 D] differences and their slopes by starts and by what is shared."""
        count = len(off)
        w = np.broadcast_to(weight, off.shape).reshape(count, -1, 1)
        prior, weak = self.shots.priors(fit.starts)
        rest = np.concatenate([off.reshape(count, -1) * w[..., 0], prior], 1)
        own = np.concatenate([own * w, np.broadcast_to(np.diag(weak), (count, len(weak), len(weak)))], 1)
        shared = np.concatenate([shared * w, np.zeros((count, len(weak), shared.shape[-1]))], 1)
        return rest, own, shared

    def sureness(self, fit: _Fit) -> tuple[np.ndarray, np.ndarray]:
        """What is known of shared numbers without the film: weights, and how far they are off."""
        weight = np.r_[self.sure, np.ones(len(fit.camera))]
        return weight, np.r_[fit.values - self.mean, fit.camera + self.moved]

    def step(self, fit: _Fit, rest, own, shared, damping: float) -> tuple[np.ndarray, np.ndarray]:
        ato = np.einsum("wri,wrj->wij", own, own)
        ato = ato + damping * np.einsum("wii->wi", ato)[:, :, None] * np.eye(ato.shape[-1])
        cross, pull = np.einsum("wri,wrj->wij", own, shared), np.einsum("wri,wr->wi", own, rest)
        weight, away = self.sureness(fit)
        normal = np.einsum("wri,wrj->ij", shared, shared) + np.diag(weight**2)
        normal = normal + damping * np.diag(np.diag(normal))
        right = np.einsum("wri,wr->i", shared, rest) + weight**2 * away
        inner = np.linalg.solve(ato, np.concatenate([cross, pull[..., None]], -1))
        normal = normal - np.einsum("wij,wik->jk", cross, inner[..., :-1])
        right = right - np.einsum("wij,wi->j", cross, inner[..., -1])
        by = -np.linalg.lstsq(normal, right, rcond=1e-12)[0]
        return by, -(inner[..., -1] + inner[..., :-1] @ by)


def first_frames(r: Recording, length: int) -> list[int]:
    """Frames where windows of `length` frames begin: every half of it, from where all bodies are seen."""
    seen = np.flatnonzero(r.seen.all(1))
    found, t = [], 0
    while t + max(4, length // 3) < len(r.known):
        later = seen[seen >= t]
        if len(later) < 4:
            break
        t = int(later[0])
        if r.seen[t : t + length].sum() >= 5 * r.seen.shape[1]:
            found.append(t)
        t += max(2, length // 2)
    return found


@dataclass(frozen=True)
class Filmed:
    """A fit of films."""

    fitting: Fitting
    fit: _Fit  # its `camera` [C]: how the cameras of all films were changed, in standard deviations
    values: list[dict[tuple[str, str], float]]  # of parameters, by kind and name, with each of the cameras so far

    def shown(self) -> Identified:
        """Values with their intervals."""
        return _reported(self.fitting, self.fit, self.values)

    def motion(self) -> dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]:
        """(recording, row) -> the fit's centres of mass [D, 3] and orientations [D, 4]; of windows that overlap, the
        one that began first."""
        shots = self.fitting.shots
        place, turn = shots.run(self.fit.starts, self.fit.values)
        found: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
        for w, (k, t) in enumerate(shots.begin):
            for row in range(min(shots.length + 1, len(shots.problem.recordings[k].known) - t)):
                found.setdefault((k, t + row), (place[w, row], turn[w, row]))
        return found


def identify_films(
    recordings: Sequence[Recording], scene: Scene, *, near: Filmed | None = None, moved: np.ndarray | float = 0.0,
    on_progress: Progress = silent,
) -> Filmed:  # fmt: skip
    """As `identify`, for recordings with `root`; `near`: what was found with cameras that were about right, and `moved`
    [C]: how far they have been changed since they were known from the film, in standard deviations.

    Raises SdfsimError for recordings that are too short, or in which nothing touches.
    """
    problem = Problem(recordings, scene)
    if near is None:
        fitting, best = _from_nothing(problem, on_progress)
    else:
        before = near.fitting.shots
        shots = Shots(problem, before.begin, before.length)
        shift = shots.place[:, 0] - before.place[:, 0]
        starts = replace(near.fit.starts, position=near.fit.starts.position + shift)
        problem.choose(_touched(problem, shots, starts))
        known = zip(problem.parameters, problem.start, strict=True)
        values = np.array([near.values[-1].get((p.kind, p.name), value) for p, value in known])
        fitting = Fitting(shots, moved)
        best = _Fit(values, np.zeros(shots.camera.shape[-1]), starts)
        best = fitting.solved(best, ROUNDS, on_progress, "another camera")
    now = {(p.kind, p.name): float(v) for p, v in zip(problem.parameters, best.values, strict=True)}
    every = [*(near.values if near else []), now]
    return Filmed(fitting, best, every)


def _from_nothing(problem: Problem, on_progress: Progress) -> tuple[Fitting, _Fit]:
    """The fit of short windows, from several first guesses; then that of long ones."""
    recordings, dt = problem.recordings, problem.recordings[0].dt
    if max(abs(r.dt - dt) for r in recordings) > 1e-3 * dt:
        raise SdfsimError("the films have different numbers of frames a second", "identify from each alone")
    scale = math.sqrt(float(np.max(problem.sizes)) / SIZE)
    lengths = [max(8, round(span * min(2.0, max(0.6, scale)) / dt)) for span in (SHORT, LONG)]
    begin = [(k, t) for k, r in enumerate(recordings) for t in first_frames(r, lengths[0])]
    if not begin:
        raise SdfsimError(
            "the films are too short, or the bodies are seen too seldom", "film longer, at more frames a second"
        )
    shots = Shots(problem, begin, lengths[0])
    starts = shots.begun()
    problem.choose(_touched(problem, shots, starts))
    fitting, low, high = Fitting(shots), *problem.bounds
    best = fitting.first(_Fit(problem.start.copy(), np.zeros(shots.camera.shape[-1]), starts))
    tries = [best]
    for f, e in TRIED:  # a few rounds each: starts are known too badly to tell before they are fitted
        alike = [{"friction": f, "restitution": e}.get(p.kind, p.start) for p in problem.parameters]
        trial = replace(best, values=np.clip(alike, low, high))
        tries.append(fitting.solved(trial, 3, on_progress, "a first sweep over friction and restitution"))
    best = min(tries, key=lambda one: one.cost)
    best = fitting.solved(best, ROUNDS, on_progress, "short windows")
    long_begin = [(k, t) for k, r in enumerate(recordings) for t in first_frames(r, lengths[1])]
    if lengths[1] > lengths[0] and long_begin:
        longer = Shots(problem, long_begin, lengths[1])
        rows = [min((abs(t - u) + 1e6 * (j != k), w) for w, (j, u) in enumerate(begin))[1] for k, t in long_begin]
        same = [begin[w] == one for w, one in zip(rows, long_begin, strict=True)]
        guess = longer.begun()
        for w, (row, alike) in enumerate(zip(rows, same, strict=True)):
            for name in vars(guess) if alike else ():
                getattr(guess, name)[w] = getattr(best.starts, name)[row]
        final = Fitting(longer)
        last = final.first(replace(best, starts=guess))
        last = final.solved(last, ROUNDS, on_progress, "long windows")
        if last.mean < WORSE * best.mean:
            fitting, best = final, last
    return fitting, best


def _touched(problem: Problem, shots: Shots, starts: _Starts) -> list:
    """What touches in the windows, as `Problem.choose` wants it."""
    recordings = list(problem.recordings)
    for w, (k, t) in enumerate(shots.begin):
        r = recordings[k]
        for name, of in (("position", starts.position), ("orientation", starts.orientation),
                         ("velocity", starts.velocity), ("angular_velocity", starts.spin)):  # fmt: skip
            getattr(r, name)[t] = of[w]
    windows = Windows(problem, shots.length * shots.dt / problem.units.time, shots.begin)
    touched = windows.touched()
    if not touched:
        raise SdfsimError(
            "nothing touches in the films", "friction and restitution show in contacts only; check the scene"
        )
    return touched


def persistence(shots: Shots, off: np.ndarray) -> float:
    """How many frames tell as much as one whose error is its own: errors of neighbouring frames are alike (Newey and
    West 1987). For differences [W, L + 1, D, 6]."""
    seen, alike = np.abs(shots.root).sum((-1, -2)) > 0, np.zeros(LAGS + 1)
    for w, d in np.ndindex(off.shape[0], off.shape[2]):
        rest = np.clip(off[w, seen[w, :, d], d], -ODD, ODD)
        alike += [float((rest[: max(0, len(rest) - lag)] * rest[lag:]).sum()) for lag in range(LAGS + 1)]
    share = 1.0 - np.arange(1, LAGS + 1) / (LAGS + 1)
    return 1.0 + 2.0 * max(0.0, float(share @ alike[1:]) / max(alike[0], 1e-9))


def _reported(fitting: Fitting, fit: _Fit, every: Sequence[dict[tuple[str, str], float]]) -> Identified:
    """Values with intervals: starts and camera are fitted again for each value of a parameter. `every`: what was found
    with other cameras."""
    problem = fitting.problem
    off, weight, _, _ = fitting.errors(fit)
    own, shared = fitting.slopes(fit, off)
    rest, own, shared = fitting.blocks(fit, off, weight, own, shared)
    count, ways = len(fit.values), len(fit.camera)
    # What starts can take up is taken out of each window's differences and slopes.
    basis = np.linalg.qr(own)[0]
    rest = rest - np.einsum("wri,wi->wr", basis, np.einsum("wri,wr->wi", basis, rest))
    shared = shared - basis @ np.einsum("wri,wrj->wij", basis, shared)
    weights, away = fitting.sureness(fit)
    rows = np.concatenate([shared.reshape(-1, count + ways), np.diag(weights)])
    right = np.r_[rest.ravel(), weights * away]
    if ways:  # likewise what the camera can
        basis = np.linalg.qr(rows[:, count:])[0]
        right, rows = right - basis @ (basis.T @ right), rows - basis @ (basis.T @ rows)
    slope, width = rows[:, :count] * problem.width, problem.width
    seen = np.abs(off).sum(-1) > 0
    spread = max(1.0, float(np.median(np.square(off).mean(-1)[seen])) / TYPICAL)
    normal = slope.T @ slope + 1e-9 * np.eye(count)
    covariance = spread * persistence(fitting.shots, off) * np.linalg.inv(normal)
    # What the laws of contact do not say (restitution that changes with speed) shows in how windows differ.
    size = len(own[0])
    if len(own) > 2:
        left = []
        for w in range(len(own)):
            part, some = slope[w * size : (w + 1) * size], right[w * size : (w + 1) * size]
            left.append(np.linalg.solve(normal - part.T @ part + 1e-3 * np.diag(np.diag(normal)), part.T @ some))
        covariance = covariance + (len(own) - 1) * np.cov(np.array(left).T, bias=True).reshape(count, count)
    slack = SLACK | (LED if problem.led else {})
    exact = np.array([slack.get(p.kind, 0.0) for p in problem.parameters]) / width
    names = [(p.kind, p.name) for p in problem.parameters]
    rounds = np.array([[found.get(name, v) for name, v in zip(names, fit.values, strict=True)] for found in every])
    covariance = covariance + np.diag(exact**2 + np.square(rounds.std(0) / width))
    before = known_before(problem) / width
    shown = np.sqrt(np.diag(covariance)) < np.minimum(SHOWN, TOLD * before)
    for k, p in enumerate(problem.parameters):
        if p.kind == "friction" and shown[k]:
            shown[k] = all(_worse(fitting, fit, k, share, spread) for share in (0.6, 1.7))
    estimates = estimates_of(problem, fit.values, covariance, shown)
    pixels = np.sqrt(np.square(off).mean(-1))
    notes = [
        f"poses are off by {fit.mean:.2g} standard deviations (median) in {len(off)} windows"
        + (": the motion found is not that of the film" if fit.mean > UNLIKE else ""),
        *_worst(fitting.shots, pixels),
    ]
    return Identified(estimates, len(off), 0.0, {}, notes, *file_values(problem, fit.values))


def _worse(fitting: Fitting, fit: _Fit, k: int, share: float, spread: float) -> bool:
    """Whether a film shows that a coefficient is not this share of what was found: what sticks, sticks with any larger
    friction, which slopes do not tell."""
    sure, mean, start = fitting.sure.copy(), fitting.mean.copy(), fit.values.copy()
    start[k] = np.clip(share * fit.values[k], *(bound[k] for bound in fitting.problem.bounds))
    fitting.sure[k], fitting.mean[k] = 1e5, start[k]
    tried = fitting.solved(replace(fit, values=start), 3, silent, "")
    fitting.sure, fitting.mean = sure, mean
    return tried.cost - fit.cost > LIKELY * spread


def _worst(shots: Shots, off: np.ndarray) -> list[str]:
    """The frames that the fit is farthest from, for differences [W, L + 1, D]."""
    found = []
    for w, t, d in zip(*np.unravel_index(np.argsort(-off, axis=None)[:WORST], off.shape), strict=True):
        _, first = shots.begin[w]
        time, name = shots.dt * (first + t) + shots.late[w, t], shots.problem.moving[d].name
        found.append(f"{name} at {time:.2f} s by {off[w, t, d]:.1f}")
    return ["worst frames, standard deviations: " + ", ".join(dict.fromkeys(found))]
