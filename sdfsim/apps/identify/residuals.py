"""Residuals: how far the contact solve is from windows of recordings with given parameters."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any, cast

import numpy as np

from sdfsim.apps.identify.parameters import WINDOW, Problem
from sdfsim.apps.observed import Recording
from sdfsim.base.errors import SdfsimError
from sdfsim.base.parallel import threads
from sdfsim.physics import pose
from sdfsim.physics.motion import MOTION
from sdfsim.physics.options import Options
from sdfsim.physics.solver.world import FIRST
from sdfsim.physics.steps import Frames
from sdfsim.scene.scene import Scene
from sdfsim.simulate.batch import Copies, inner_of_frame

EVERY, LONG = 0.06, 1.85  # model units of time: spacing of short windows, and length of long ones
MOST = 250  # largest number of short windows; of more, an evenly spaced subset is used
OUTLIER = 2e-3  # model lengths: larger errors of windows count less than squared
FAR = 0.3  # relative to a body's size: bound of the error of a motion
IMPACT = 3.0  # times the change of velocity by gravity in a frame: larger changes do not come from weight and friction


class Windows:
    """Windows of `length` model times that begin in these recordings at these frames, side by side as a few sets of
    bodies, one per core; each window is a world of its own."""

    def __init__(self, problem: Problem, length: float, begin: Sequence[tuple[int, int]]) -> None:
        self.problem, parts = problem, []
        spacing = {k: problem.recordings[k].dt for k, _ in begin}
        begin = sorted(begin, key=lambda window: spacing[window[0]])
        cuts = [i + 1 for i, (a, b) in enumerate(pairwise(begin)) if spacing[b[0]] > 1.0001 * spacing[a[0]]]
        cores = os.cpu_count() or 1
        for a, b in pairwise([0, *cuts, len(begin)]):
            size = max(1, -(-(b - a) // cores))
            parts += [begin[c : min(c + size, b)] for c in range(a, b, size)]
        self.begin = begin
        self.parts = [_Part(problem, length, part) for part in parts if part]
        self.recording = np.array([k for k, _ in begin])

    def run(self, values: np.ndarray) -> list[np.ndarray]:
        """For every part [L, W, D, 6] the differences from the recording in model lengths: of positions, and of
        rotations times half of a body's size; NaN if there is no recorded pose."""
        jobs = [(part, values) for part in self.parts]
        done = dict(threads(_Part.errors, jobs)) if len(jobs) > 1 else {0: self.parts[0].errors(values)}
        return [done[k] for k in range(len(jobs))]

    def errors(self, values: np.ndarray) -> np.ndarray:
        """[R] differences for a fit, in units of `OUTLIER`; 0 if there is no recorded pose."""
        found = []
        for part, off in zip(self.parts, self.run(values), strict=True):
            most = FAR * part.size[None, None, :, None]
            off = np.clip(off, -1e3, 1e3)
            way = np.square(off).sum(-1, keepdims=True) / most**2
            found.append(np.nan_to_num(off / np.sqrt(1.0 + way), nan=0.0).ravel())
        return np.concatenate(found) / OUTLIER

    @cached_property
    def group(self) -> np.ndarray:
        """[R] the recording of each error; its window, if there are few recordings."""
        few, at, found = len(set(self.recording.tolist())) < 8, 0, []
        for part in self.parts:
            count = len(part.begin)
            own = np.arange(at, at + count) if few else self.recording[at : at + count]
            found.append(np.broadcast_to(own[None, :, None, None], part.shape).ravel())
            at += count
        return np.concatenate(found)

    def off(self, values: np.ndarray) -> np.ndarray:
        """[W, 2] for each window: root mean square distance in % of the size, and mean rotation error in degrees."""
        found = []
        for part, off in zip(self.parts, self.run(values), strict=True):
            way = np.linalg.norm(off[..., :3], axis=-1) / part.size
            turn = np.linalg.norm(off[..., 3:], axis=-1) / (0.5 * part.size)
            found.append(
                np.stack([100.0 * np.sqrt(np.nanmean(way**2, (0, 2))), np.degrees(np.nanmean(turn, (0, 2)))], 1)
            )
        return np.concatenate(found)

    def touched(self) -> list[tuple[int, int, int, np.ndarray, bool]]:
        """Window, pair of bodies and points [P, 3] of all contacts, and whether one was an impact; static bodies are
        numbered after the moving ones."""
        found, at = [], 0
        for part in self.parts:
            found += [(at + w, *rest) for w, *rest in part.touched()]
            at += len(part.begin)
        return found


class _Part:
    """Windows of one frame spacing as one set of bodies."""

    def __init__(self, problem: Problem, length: float, begin: Sequence[tuple[int, int]]) -> None:
        self.problem, self.begin, u = problem, begin, problem.units
        some = [problem.recordings[k] for k, _ in begin]
        dt = some[0].dt / u.time
        self.length = max(3, round(length / dt))
        ends = [min(self.length, len(r.known) - 1 - t) for r, (_, t) in zip(some, begin, strict=True)]
        self.length = max(ends)
        many, count = len(problem.moving), len(begin)
        copies = Copies(problem.scene, count, [r.dt * t for r, (_, t) in zip(some, begin, strict=True)])
        self.bodies, self.solver = copies.bodies, copies.solver
        first = [
            np.concatenate([getattr(r, name)[t] for r, (_, t) in zip(some, begin, strict=True)]) for name in MOTION
        ]
        self.start = copies.begun(*first)
        self.options = Options(np.asarray(problem.scene.gravity) / u.acceleration, dt, inner_of_frame(dt))
        self.goal = np.full((self.length, count, many, 7), np.nan)
        for w, (r, (_, t), n) in enumerate(zip(some, begin, ends, strict=True)):
            rows = slice(t + 1, t + 1 + n)
            both = np.concatenate([r.goal[0][rows] / u.length, r.goal[1][rows]], -1)
            there = r.seen[rows] & problem.tells[begin[w][0]][rows, None]
            self.goal[:n, w] = np.where(there[..., None], both, np.nan)
        self.shape = (self.length, count, many, 6)
        self.size = self.bodies.size[:many].copy()
        self.carry = self.solver.init(self.bodies, self.start, self.options)

    def frames(self, values: np.ndarray) -> Frames:
        compiled = cast("Any", self.carry.scene)
        compiled.bodies, start = self.problem.applied(values, self.bodies, self.start, len(self.begin))
        compiled.place(start)
        return cast("Frames", self.solver.advance(start, self.carry, self.length, keep=True).frames)

    def errors(self, values: np.ndarray) -> np.ndarray:
        frames = self.frames(values)
        total = self.shape[1] * self.shape[2]
        place = frames.position[:, :total].reshape(*self.shape[:3], 3)
        turn = frames.orientation[:, :total].reshape(*self.shape[:3], 4)
        away = pose.to_rotvec(pose.multiply(turn, pose.conjugate(self.goal[..., 3:])))
        off = np.concatenate([place - self.goal[..., :3], 0.5 * self.size[:, None] * away], -1)
        return np.where(np.isnan(self.goal[..., :1]), np.nan, np.nan_to_num(off, nan=1e3))

    def touched(self) -> list[tuple[int, int, int, np.ndarray, bool]]:
        """See `Windows.touched`. Inner steps are made one by one, as a rebounding body may have left again at the end
        of a frame."""
        many, inner = self.shape[2], self.options.substeps
        there = np.asarray(~np.isnan(self.goal[..., 0]).all(-1))
        fine = self.options._replace(dt=self.options.dt / inner, substeps=1)
        state, carry = self.start, self.solver.init(self.bodies, self.start, fine)
        pull = self.options.dt * self.options.gravity
        found: dict[tuple[int, int, int], list[np.ndarray]] = {}
        impacts = set()
        for t in range(self.length):
            before, now = state.velocity, set()
            for _ in range(inner):
                state = self.solver.advance(state, carry).state
                touch = cast("Any", state.touch)
                for (a, b), count, points in zip(touch.pair.tolist(), touch.count.tolist(), touch.point, strict=True):
                    if count and there[t:, a // many].any():
                        low, high = sorted(self.problem.number(k, len(self.begin)) for k in (a, b))
                        at = pose.rotate(state.orientation[a], points[:count, FIRST : FIRST + 3]) + state.position[a]
                        if high < many + len(self.problem.led) and high >= many:  # as where it is in the scene
                            of, where = self.problem.bodies[high], (state.position[b], state.orientation[b])
                            own = pose.rotate(pose.conjugate(where[1]), at - where[0]) + self.bodies.com[b]
                            at = pose.rotate(of.quat_xyzw, own) + of.position / self.problem.units.length
                        found.setdefault((a // many, low, high), []).append(at)
                        now.add((a, (a // many, low, high)))
            # A change in the first frame may come from a slightly wrong start.
            change = np.square(state.velocity - before - pull).sum(-1)
            sudden = set(np.flatnonzero(change > IMPACT**2 * (pull @ pull)).tolist())
            impacts |= {key for a, key in now if t and a in sudden}
        return [(*key, np.concatenate(points), key in impacts) for key, points in sorted(found.items())]


def short(problem: Problem, chosen: Sequence[int]) -> Windows:
    """The short windows of these recordings in which something touches; this also sets the parameters, by the pairs
    that touch."""
    begin = []
    for k in chosen:
        r = problem.recordings[k]
        every = max(1, round(EVERY * problem.units.time / r.dt))
        last = len(r.known) - max(3, round(WINDOW * problem.units.time / r.dt))
        near = np.flatnonzero((r.known & problem.tells[k])[: max(0, last)])
        begin += [(k, int(rows[0])) for rows in _groups(near, every)]
    if not begin:
        hint = "give longer ones, of more frames a second"
        raise SdfsimError("the recordings are too short, or never smooth", hint)
    windows = Windows(problem, WINDOW, begin[:: -(-len(begin) // (2 * MOST))])
    touched = windows.touched()
    if not touched and not problem.joints:
        raise SdfsimError("nothing touches in the recordings", "friction and restitution show in contacts only")
    problem.choose(touched)
    # Joints act all the time.
    rows = range(len(windows.begin)) if problem.joints else sorted({w for w, *_ in touched})
    return Windows(problem, WINDOW, [windows.begin[w] for w in rows[:: -(-len(rows) // MOST)]])


def whole(problem: Problem, chosen: Sequence[int]) -> Windows:
    """Consecutive long windows of these recordings, from the first frame with known velocities up to rest; the last
    one is at least half as long."""
    begin = []
    for k in chosen:
        r, t = problem.recordings[k], 0
        frames, end = LONG * problem.units.time / r.dt, 1 + int(np.flatnonzero(problem.tells[k])[-1])
        while t == 0 or end - t > 0.5 * frames:
            t += int(r.known[t:].argmax())
            if not r.known[t] or end - t < 4:
                break
            begin.append((k, t))
            t += max(4, round(frames))
    return Windows(problem, LONG, begin)


def covered(problem: Problem, windows: Windows) -> float:
    """The share of the recorded way, and of the turns, in these windows."""
    ways, there = [], []
    for k in np.unique(windows.recording).tolist():
        r = problem.recordings[k]
        turn = pose.to_rotvec(pose.multiply(r.goal[1][1:], pose.conjugate(r.goal[1][:-1])))
        step = np.linalg.norm(np.diff(r.goal[0], axis=0), axis=2) + 0.5 * problem.sizes * np.linalg.norm(turn, axis=2)
        step = np.where(r.seen[1:] & r.seen[:-1] & problem.tells[k][1:, None], step, 0.0).sum(1)
        inside = np.zeros(len(step), bool)
        for part in windows.parts:
            for of, t in part.begin:
                if of == k:
                    inside[t : t + part.length] = True
        ways.append(step.sum())
        there.append(step[inside].sum())
    return float(sum(there) / sum(ways)) if sum(ways) > 0.0 else 1.0


def _groups(frames: np.ndarray, every: int) -> list[np.ndarray]:
    """Frames in groups of `every`."""
    return [rows for rows in np.split(frames, np.flatnonzero(np.diff(frames // every)) + 1) if len(rows)]


def repeated(recordings: Sequence[Recording], scene: Scene, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """The solve's motion of a scene from the start of each recording: positions [K, T, D, 3] m of the centres of mass,
    and orientations [K, T, D, 4], in the T = `frames` frames after the first."""
    problem = Problem(recordings, scene)
    windows = Windows(problem, frames * recordings[0].dt / problem.units.time, [(k, 0) for k in range(len(recordings))])
    found = []
    for part in windows.parts:
        _, count, many, _ = part.shape
        kept = part.frames(np.zeros(0))
        both = (kept.position, kept.orientation)
        found.append([poses[:, : count * many].reshape(-1, count, many, poses.shape[-1]) for poses in both])
    place, turn = (np.concatenate(parts, 1).swapaxes(0, 1) for parts in zip(*found, strict=True))
    return place * problem.units.length, turn
