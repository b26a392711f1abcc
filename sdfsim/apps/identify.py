"""`identify`: finds coefficients, sizes, masses and the height and tilt of the ground from recorded motions.

Recordings are cut into windows, short ones everywhere and long ones from their starts. The contact solve runs all of
them side by side, each from the recorded state, and a fit changes the parameters until the windows agree with the
recordings. Whole motions that the fit has not seen then show how good the result is.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np

from sdfsim.apps.observed import Recording, movers
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import replacing
from sdfsim.base.lazy import NotInstalled, pyplot
from sdfsim.base.parallel import Progress, silent, threads
from sdfsim.physics import pose
from sdfsim.physics.bodies import Bodies, State, largest_extent
from sdfsim.physics.joint_columns import DAMPING, FRICTION
from sdfsim.physics.motion import MOTION
from sdfsim.physics.options import Options
from sdfsim.physics.solver.world import FIRST
from sdfsim.physics.steps import Frames
from sdfsim.physics.units import scene_units
from sdfsim.scene.builder import SceneBuilder
from sdfsim.scene.scene import Body, Joint, Scene
from sdfsim.simulate.batch import Copies, inner_of_frame

# Model units of time, about seconds for bodies of a metre: length and spacing of short windows, and length of long
# ones.
WINDOW, EVERY, LONG = 0.15, 0.06, 1.85
MOST = 250  # largest number of short windows; of more, an evenly spaced subset is used
WHOLE = 8  # least number of long windows for a final fit to them: a few chaotic ones tell less than many short ones
OUTLIER = 2e-3  # model lengths: larger errors of windows count less than squared
FAR = 0.3  # relative to a body's size: bound of the error of a motion
WEAK = 1e-3  # weight that keeps parameters that nothing shows at the scene's values
GRAVITY = 9.81  # m/s^2, used for joints of scenes without gravity
SURE = 1.96  # half of an interval of 95 %, in standard deviations
SHOWN = 0.25  # relative to its width: how precisely windows must determine a parameter, with noise of `OUTLIER`
IMPACT = 3.0  # times the change of velocity by gravity in a frame: larger changes do not come from weight and friction
HIGH = {"friction": 2.0, "restitution": 1.0}  # the largest products that are searched
STILL, JITTER = 1e-5, 6.0  # relative to a size (and rad), and to the noise: smaller changes are those of rest
HELD = 6  # every sixth recording is kept out of the fit, if there are at least `ENOUGH`
ENOUGH = 4
COVERED = 0.8  # of the recorded way: if whole motions have less, that is said
TRIES = 15, 15, 8  # largest numbers of iterations of the fits to short windows, and to long ones
DRAWS = 400  # random draws of recordings, for intervals
POINTS, BEYOND = 4, 2.0  # points of a profile on each side, and their farthest distance, in half intervals
CROWD, ROUNDS, AROUND = 24, 14, 0.15  # the search for long windows: points, rounds, and range, in widths
SHELL = 5.0 / 3.0  # inertia of a hollow cube or ball over that of a solid one: the most that such a body can have
# Columns of joints; the parameters are in units of `heft`.
OF_JOINTS = {"joint_friction": FRICTION, "joint_damping": DAMPING}


@dataclass(frozen=True)
class Kind:
    """A kind of parameters. Those of factors are logarithms."""

    head: str  # what reports call it
    width: float  # of the search around the scene's value: logarithms of factors, model lengths, rad
    # Step for finite differences, relative to the width: contacts come and go, and impacts are resolved to an inner
    # step, so smaller differences tell nothing.
    nudge: float
    farthest: float = 0.0  # the largest change
    unit: str = ""  # in reports
    key: str = ""  # of the scene file, for factors
    scales: dict[str, float] = field(default_factory=dict)  # array of `Bodies` -> power of a factor that scales it


SIZES = {"scale": 1.0, "com": 1.0, "bounds": 1.0, "size": 1.0, "radius": 1.0, "inertia": 2.0}
KINDS = {
    "friction": Kind("friction, product", 1.0, 0.02),
    "restitution": Kind("restitution, product", 1.0, 0.02),
    "mass": Kind("mass", 3.0, 0.02, 7.0, " kg", "mass", {"mass": 1.0, "inverse_mass": -1.0, "inertia": 1.0}),
    "inertia": Kind("inertia, factor", 0.5, 0.1, 0.5, "", "inertia_factor", {"inertia": 1.0}),
    "size": Kind("size, factor", 0.1, 0.2, 0.15, "", "scale", SIZES),
    "height": Kind("shift along its normal", 0.05, 0.2, 0.15, " m"),
    "tilt": Kind("tilted", 0.05, 0.1, 0.15, " degrees"),
    "joint_friction": Kind("friction of a joint", 0.05, 0.05, 0.5),
    "joint_damping": Kind("damping of a joint", 0.05, 0.05, 0.5),
}
HEADS = {name: kind.head for name, kind in KINDS.items()}
HEADS |= {"own_friction": "friction of its own", "own_restitution": "restitution of its own"}
# Units for hinges and balls, and for sliders.
OF_TURNS = {"joint_friction": (" N m", " N"), "joint_damping": (" N m s", " N s/m")}


@dataclass(frozen=True)
class Parameter:
    """One unknown number: of one body, or of all copies of one."""

    kind: str  # key of `KINDS`
    bodies: tuple[int, ...]  # indices: moving bodies first, then static ones
    name: str
    start: float = 0.0  # value in the scene; logarithms for factors
    low: float = -math.inf
    high: float = math.inf
    axis: int = 0  # axis of a tilt; or the number of a joint


@dataclass(frozen=True)
class Ground:
    """The place where a static body is touched, model units."""

    centre: np.ndarray  # [3]
    axes: np.ndarray  # [3, 3] rows: two tangents, about which it is tilted, and the normal, along which it is moved


@dataclass(frozen=True)
class Estimate:
    kind: str  # key of `HEADS`
    name: str
    unit: str
    value: float | None  # None if the recordings do not show it
    interval: tuple[float, float] | None

    def lines(self) -> tuple[str, str]:
        """What it is, and its value with the interval."""
        shown, digits = "not shown by these recordings", 5 if self.kind == "height" or self.kind in OF_JOINTS else 3
        if self.interval:
            low, high = (f"{end:.{digits}f}" for end in self.interval)
            shown = f"{self.value:.{digits}f}{self.unit} ({low} to {high})"
        return f"{HEADS[self.kind]}: {self.name}", shown


@dataclass(frozen=True)
class Profile:
    """The loss as a function of one parameter; the others are fitted again for each value."""

    estimate: Estimate
    best: float  # the value with the lowest loss, in the estimate's unit
    x: list[float]
    loss: list[float]  # loss relative to that of `best`


@dataclass(frozen=True)
class Identified:
    """The result of `identify`. `scene_values`: body -> key of the scene file -> its value."""

    estimates: list[Estimate]
    windows: int
    error_m: float  # root mean square over short windows
    held_out: dict[str, Any]  # errors of whole motions that the fit has not seen; of all motions if `recordings` is 0
    notes: list[str]
    scene_values: dict[str, dict[str, Any]] = field(default_factory=dict)
    joint_values: dict[str, dict[str, Any]] = field(default_factory=dict)  # joint -> key -> value
    profiles: list[Profile] = field(default_factory=list)  # if they are asked for

    def report(self) -> dict[str, Any]:
        kinds = ("friction", "restitution", "own_friction", "own_restitution", *list(KINDS)[2:])
        values: dict[str, Any] = {kind: {} for kind in kinds}
        for e in self.estimates:
            values[e.kind][e.name] = {"value": e.value, "interval": e.interval}
        return values | {
            "windows": self.windows, "error_m": self.error_m, "held_out": self.held_out, "notes": self.notes,
            "scene": self.scene_values, "joints": self.joint_values,
        }  # fmt: skip


def report_lines(found: Identified) -> list[str]:
    lines = [": ".join(e.lines()) for e in found.estimates]
    lines.append(f"{found.windows} windows, repeated with an error of {found.error_m:.2g} m")
    h = found.held_out
    who = f"{h['recordings']} whole motions that the fit has not seen" if h["recordings"] else "the same motions, whole"
    lines.append(
        "{}: {:.2g} % of the size and {:.2g} degrees off; as the scene was, {:.2g} % and {:.2g}".format(
            who, *h["after"], *h["before"]
        )
    )
    return [*lines, *found.notes]


# --- the model ---


class Problem:
    """A scene with its parameters: those of bodies that touch something in the recordings."""

    def __init__(self, recordings: Sequence[Recording], scene: Scene) -> None:
        self.scene, self.recordings = scene, list(recordings)
        self.moving, self.fixed = movers(scene), [b for b in scene.bodies if b.motion == "static"]
        self.bodies, self.units = [*self.moving, *self.fixed], scene_units(scene)
        self.sizes = np.array([largest_extent(scene.shapes[b.shape]) * b.scale for b in self.moving])
        self.joints = scene.joints if scene.effects.joints != "off" else ()
        self.parameters: list[Parameter] = []
        self.ground: dict[int, Ground] = {}
        if any(b.motion == "kinematic" for b in scene.bodies):
            raise SdfsimError("bodies on paths: identify supports free and static bodies only")
        if any(r.dt == 0.0 for r in recordings):
            raise SdfsimError("a recording has a single frame")
        self.tells = [self._telling(r) for r in recordings]

    def _telling(self, r: Recording) -> np.ndarray:
        """[T] bool, the frames that are compared: all but rest, of which only the first `WINDOW` says anything new. A
        long rest would outweigh the motion before it."""
        span = max(1, round(0.5 * WINDOW * self.units.time / r.dt))
        frames = np.arange(len(r.known))
        around = np.clip(frames[:, None] + np.arange(-span, span + 1), 0, len(frames) - 1)
        moves = np.zeros(len(frames), bool)
        for d, size in enumerate(self.sizes):
            ways = np.linalg.norm(r.goal[0][around, d] - r.goal[0][:, None, d], axis=2)
            turns = np.linalg.norm(
                pose.to_rotvec(pose.multiply(r.goal[1][around, d], pose.conjugate(r.goal[1][:, None, d]))), axis=2
            )
            for away, noise, least in ((ways, r.noise[0], STILL * size), (turns, r.noise[1], STILL)):
                far = away > max(JITTER * noise, least)
                moves |= (far & r.seen[around, d]).any(1) & r.seen[:, d]
        if not moves.any():
            return np.ones(len(frames), bool)
        last = np.maximum.accumulate(np.where(moves, frames, -len(frames)))
        return moves | (frames - last <= 2 * span)

    def short(self, chosen: Sequence[int]) -> Windows:
        """The short windows of these recordings in which something touches; this also sets the parameters, by the pairs
        that touch."""
        begin = []
        for k in chosen:
            r = self.recordings[k]
            every = max(1, round(EVERY * self.units.time / r.dt))
            last = len(r.known) - max(3, round(WINDOW * self.units.time / r.dt))
            near = np.flatnonzero((r.known & self.tells[k])[: max(0, last)])
            begin += [(k, int(rows[0])) for rows in _groups(near, every)]
        if not begin:
            hint = "give longer ones, of more frames a second"
            raise SdfsimError("the recordings are too short, or never smooth", hint)
        windows = Windows(self, WINDOW, begin[:: -(-len(begin) // (2 * MOST))])
        touched = windows.touched()
        if not touched and not self.joints:
            raise SdfsimError("nothing touches in the recordings", "friction and restitution show in contacts only")
        self._choose(touched)
        # Joints act all the time.
        rows = range(len(windows.begin)) if self.joints else sorted({w for w, *_ in touched})
        return Windows(self, WINDOW, [windows.begin[w] for w in rows[:: -(-len(rows) // MOST)]])

    def whole(self, chosen: Sequence[int]) -> Windows:
        """Consecutive long windows of these recordings, from the first frame with known velocities up to rest; the last
        one is at least half as long."""
        begin = []
        for k in chosen:
            r, t = self.recordings[k], 0
            frames, end = LONG * self.units.time / r.dt, 1 + int(np.flatnonzero(self.tells[k])[-1])
            while t == 0 or end - t > 0.5 * frames:
                t += int(r.known[t:].argmax())
                if not r.known[t] or end - t < 4:
                    break
                begin.append((k, t))
                t += max(4, round(frames))
        return Windows(self, LONG, begin)

    def covered(self, windows: Windows) -> float:
        """The share of the recorded way, and of the turns, in these windows."""
        ways, there = [], []
        for k in np.unique(windows.recording).tolist():
            r = self.recordings[k]
            turn = pose.to_rotvec(pose.multiply(r.goal[1][1:], pose.conjugate(r.goal[1][:-1])))
            step = np.linalg.norm(np.diff(r.goal[0], axis=0), axis=2) + 0.5 * self.sizes * np.linalg.norm(turn, axis=2)
            step = np.where(r.seen[1:] & r.seen[:-1] & self.tells[k][1:, None], step, 0.0).sum(1)
            inside = np.zeros(len(step), bool)
            for part in windows.parts:
                for of, t in part.begin:
                    if of == k:
                        inside[t : t + part.length] = True
            ways.append(step.sum())
            there.append(step[inside].sum())
        return float(sum(there) / sum(ways)) if sum(ways) > 0.0 else 1.0

    def _choose(self, touched: list[tuple[int, int, int, np.ndarray, bool]]) -> None:
        many = len(self.moving)
        self.pairs = sorted({(a, b) for _, a, b, *_ in touched})
        self.hit = {k for _, *pair, _, impact in touched for k in pair if impact}
        groups: dict[str, list[int]] = {}
        for k, body in enumerate(self.bodies):
            groups.setdefault(_entry(body), []).append(k)
        seen = {name: rows for name, rows in groups.items() if any(k in pair for k in rows for pair in self.pairs)}
        static = {name: rows for name, rows in seen.items() if rows[0] >= many}
        count = {name: sum(b in rows for _, _, b, *_ in touched) for name, rows in static.items()}
        reference = max(count, key=lambda name: count[name], default=None)
        beside = [name for name, rows in seen.items() if any(set(p) & set(rows) and max(p) < many for p in self.pairs)]
        for kind, high in HIGH.items():
            for name, rows in seen.items():
                if name != reference:
                    start = getattr(self.bodies[rows[0]], kind)
                    self._add(kind, name, rows, start, 0.0, max(start, self._most(kind, high, rows, static, reference)))
        for name in beside[1:]:
            self._add("mass", name, seen[name])
        for kind in ("inertia", "size"):
            for name, rows in seen.items():
                if rows[0] < many:
                    most = max(0.0, math.log(SHELL / self.inertia_factor(rows[0]))) if kind == "inertia" else None
                    self._add(kind, name, rows, high=most)
        for j, joint in enumerate(self.joints):
            for kind, start in (("joint_friction", joint.friction), ("joint_damping", joint.damping)):
                if joint.kind not in ("fixed", "distance"):
                    self._add(kind, joint.name, [], start / self.heft(joint, kind), 0.0, axis=j)
        for name, rows in static.items():
            if len(rows) == 1:  # copies are on a grid
                points = np.concatenate([p for _, _, b, p, _ in touched if b == rows[0]])
                self.ground[rows[0]] = self._touched_at(rows[0], points)
                self._add("height", name, rows)
                for axis, way in enumerate(self.ground[rows[0]].axes[:2]):
                    self._add("tilt", f"{name} about {'xyz'[np.abs(way).argmax()]}", rows, axis=axis)
        some = self.parameters
        self.bounds = np.array([p.low for p in some]), np.array([p.high for p in some])
        self.width = np.array([KINDS[p.kind].width for p in some])
        self.start = np.clip([p.start for p in some], *self.bounds)  # the values in the scene

    def _add(
        self, kind: str, name: str, rows: list[int], start: float = 0.0, low: float | None = None,
        high: float | None = None, axis: int = 0,
    ) -> None:  # fmt: skip
        most = KINDS[kind].farthest
        low, high = -most if low is None else low, most if high is None else high
        self.parameters.append(Parameter(kind, tuple(rows), name, start, low, high, axis))

    def _most(
        self, kind: str, high: float, rows: list[int], static: dict[str, list[int]], reference: str | None
    ) -> float:
        """Upper bounds of coefficients: for bodies on the reference body, such that its own coefficient is the
        scene's."""
        if rows[0] >= len(self.moving) or reference is None:
            return high
        known = getattr(self.bodies[static[reference][0]], kind)
        if kind == "restitution" and any(max(pair) < len(self.moving) for pair in self.pairs):
            return 1.0  # contacts between bodies determine each body's own coefficient, and a scene has none above 1
        return high / known if known > 0.0 else high

    def heft(self, joint: Joint, kind: str) -> float:
        """Unit of a joint's friction, N m or N: the weight of its lighter body, for torques times the body's size. For
        damping it is divided by the speed of a fall through that size. So parameters are at most about one."""
        bodies = [b for b in (self.scene.bodies[k] for k in joint.bodies if k >= 0) if b.motion == "dynamic"]
        body = min(bodies, key=lambda b: b.mass)
        size = largest_extent(self.scene.shapes[body.shape]) * body.scale
        pull = float(np.linalg.norm(self.scene.gravity)) or GRAVITY
        rate = math.sqrt(pull / size) if kind == "joint_damping" else 1.0
        if joint.kind in ("hinge", "ball"):
            return body.mass * pull * size / rate
        return body.mass * pull / (rate * size if kind == "joint_damping" else 1.0)

    def inertia_factor(self, body: int) -> float:
        """The inertia factor of a moving body in the scene."""
        b = self.bodies[body]
        shape = self.scene.shapes[b.shape]
        own = b.mass / shape.volume * shape.inertia * b.scale**2
        return 1.0 if b.inertia is None else float(np.trace(b.inertia) / np.trace(own))

    def _touched_at(self, body: int, points: np.ndarray) -> Ground:
        """The ground of a body that is touched at points [P, 3] in model units."""
        b, length = self.bodies[body], self.units.length
        points = points[:: -(-len(points) // 500)]
        own = pose.rotate(pose.conjugate(b.quat_xyzw), points * length - b.position) / b.scale
        slope = self.scene.shapes[b.shape].sdf(own)[1]
        normal = pose.rotate(b.quat_xyzw, np.asarray(slope, np.float64).mean(0))
        length_of = float(np.linalg.norm(normal))
        normal = normal / length_of if length_of > 0.1 else np.array([0.0, 0.0, 1.0])
        along = np.eye(3)[0] if abs(normal[0]) < 0.9 else np.eye(3)[1]
        first = along - normal * (normal @ along)
        first /= np.linalg.norm(first)
        return Ground(points.mean(0), np.stack([first, np.cross(normal, first), normal]))

    def lie(self, values: np.ndarray, body: int) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (a quaternion) of a static body about its ground's centre, and its shift, model units."""
        turn, shift = np.zeros(3), np.zeros(3)
        for p, value in zip(self.parameters, values, strict=True):
            if p.bodies == (body,) and p.kind in ("height", "tilt"):
                axis = self.ground[body].axes[2 if p.kind == "height" else p.axis]
                if p.kind == "height":
                    shift = value * axis
                else:
                    turn = turn + value * axis
        return pose.from_rotvec(turn), shift

    def applied(self, values: np.ndarray, bodies: Bodies, state: State, count: int) -> tuple[Bodies, State]:
        """`count` copies of the moving bodies, followed by the static ones, with these parameters."""
        many = len(self.moving)
        total = many * count
        names = (*HIGH, "scale", "com", "inertia", "mass", "inverse_mass", "bounds", "size", "radius")
        new = {name: getattr(bodies, name).copy() for name in names}
        position, orientation = state.position.copy(), state.orientation.copy()
        joints = bodies.joints
        dragged = [(p, v) for p, v in zip(self.parameters, values, strict=True) if p.kind in OF_JOINTS]
        if joints is not None and dragged:
            number, u = joints.number.copy(), self.units
            for p, value in dragged:
                turns = self.joints[p.axis].kind in ("hinge", "ball")
                unit, speed = (u.energy, 1.0) if turns else (u.mass * u.acceleration, u.length)
                unit *= u.time / speed if p.kind == "joint_damping" else 1.0
                found = value * self.heft(self.joints[p.axis], p.kind) / unit
                number[p.axis :: len(self.joints), OF_JOINTS[p.kind]] = found
            bodies = replace(bodies, joints=replace(joints, number=number))
        for p, value in zip(self.parameters, values, strict=True):
            for k in p.bodies:
                rows: Any = slice(k, total, many) if k < many else total + k - many
                if p.kind in HIGH:
                    new[p.kind][rows] = value
                for name, power in KINDS[p.kind].scales.items():
                    new[name][rows] *= math.exp(power * value)
        for body, ground in self.ground.items():
            row, (turn, shift) = total + body - many, self.lie(values, body)
            position[row] = ground.centre + pose.rotate(turn, position[row] - ground.centre) + shift
            orientation[row] = pose.multiply(turn, orientation[row])
        return replace(bodies, **new), replace(state, position=position, orientation=orientation)


def _groups(frames: np.ndarray, every: int) -> list[np.ndarray]:
    """Frames in groups of `every`."""
    return [rows for rows in np.split(frames, np.flatnonzero(np.diff(frames // every)) + 1) if len(rows)]


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
        copies = Copies(problem.scene, count)
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
        many, total, inner = self.shape[2], self.shape[1] * self.shape[2], self.options.substeps
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
                        low, high = sorted((a % many, b % many if b < total else many + b - total))
                        at = pose.rotate(state.orientation[a], points[:count, FIRST : FIRST + 3]) + state.position[a]
                        found.setdefault((a // many, low, high), []).append(at)
                        now.add((a, (a // many, low, high)))
            # A change in the first frame may come from a slightly wrong start.
            change = np.square(state.velocity - before - pull).sum(-1)
            sudden = set(np.flatnonzero(change > IMPACT**2 * (pull @ pull)).tolist())
            impacts |= {key for a, key in now if t and a in sudden}
        return [(*key, np.concatenate(points), key in impacts) for key, points in sorted(found.items())]


# --- the fit ---


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
    short = problem.short(fit)
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
        costs.append(float(np.minimum(np.abs(short.errors(trial)), 10.0).sum()))
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

        def whole(some: np.ndarray) -> np.ndarray:
            made = values.copy()
            made[free] = some
            return made

        of: Any = lambda some: errors_of(windows, whole(some))  # noqa: E731
        by: Any = lambda some: slope(windows, whole(some), free)  # noqa: E731
        limits = low[free], high[free]
        found = least_squares(of, values[free], by, limits, x_scale=width[free], loss="soft_l1", max_nfev=most)
        return whole(found.x)

    # First fit the contacts, with bodies and ground as in the scene; then everything.
    every = np.arange(len(width))
    usual = np.flatnonzero([p.kind in (*HIGH, "mass", *OF_JOINTS) for p in problem.parameters])
    best = settled(short, tried[int(np.argmin(costs))], usual, TRIES[0])
    best = settled(short, best, every, TRIES[1])
    last, longer, scatter = short, problem.whole(fit), np.zeros((len(best), len(best)))
    if len(longer.begin) >= WHOLE:
        near, scatter = _searched(longer, best, (low, high), width)
        last, best = longer, settled(longer, near, every, TRIES[2])
    whole = problem.whole(held or fit)
    before, after = (whole.off(values) for values in (start, best))
    confirmed: dict[str, Any] = {
        "recordings": len(held), "before": before.mean(0).tolist(), "after": after.mean(0).tolist(),
        "covered": problem.covered(whole),
    }  # fmt: skip
    error = float(np.sqrt(np.nanmean(np.concatenate([e[..., :3].ravel() for e in short.run(best)]) ** 2)))
    by, there = slope(last, best, every), errors_of(last, best)
    found = _estimates(problem, best, last.group, by, there, scatter)
    drawn = _profiles(problem, best, by, there, partial(errors_of, last), found) if profiles else []
    return Identified(
        found, len(short.begin),
        error * math.sqrt(3.0) * problem.units.length, confirmed, _notes(recordings, confirmed["covered"]),
        *_file_values(problem, best), drawn,
    )  # fmt: skip


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


def _estimates(
    problem: Problem, values: np.ndarray, group: np.ndarray, slope: np.ndarray, errors: np.ndarray, scatter: np.ndarray
) -> list[Estimate]:
    """Values with their intervals, from the curvature of the robust cost and the scatter between recordings, or windows
    if recordings are few (a sandwich estimator). No value if noise of `OUTLIER` per number would leave it
    undetermined."""
    parameters, width = problem.parameters, problem.width
    data, slope = errors[: -len(values)], slope[: -len(values)] * width
    weight = (1.0 + data**2) ** -0.5  # weights of the soft L1 loss
    curvature = (slope * weight[:, None]).T @ slope + WEAK**2 * np.eye(len(values))
    # Errors within a group are correlated: groups, not single poses, are independent.
    which, group = np.unique(group, return_inverse=True)
    pull = np.zeros((len(which), len(values)))
    np.add.at(pull, group, (weight * data)[:, None] * slope)
    inverse = np.linalg.inv(curvature)
    spread = max(1.0, len(which) / max(1, len(which) - len(values)))
    covariance = spread * inverse @ (pull.T @ pull) @ inverse + scatter
    noise = max(1.0, float(np.mean(np.abs(data))) ** 2)
    posterior = np.linalg.inv((slope.T @ slope) * len(which) / len(group) / noise + np.eye(len(values)))
    shown = np.sqrt(np.diag(posterior)) < SHOWN
    shown &= [p.kind != "restitution" or bool(problem.hit & set(p.bodies)) for p in parameters]

    def estimate(kind: str, name: str, value: float, gradient: dict[int, float]) -> Estimate:
        """The estimate of a value with these derivatives with respect to parameters."""
        at, by = list(gradient), np.array(list(gradient.values())) * width[list(gradient)]
        if not shown[at][by != 0.0].all():
            return Estimate(kind, name, "", None, None)
        half = SURE * float(np.sqrt(by @ covariance[np.ix_(at, at)] @ by))
        least = -math.inf if kind in ("height", "tilt") else 0.0
        return Estimate(kind, name, "", float(value), (max(least, float(value) - half), float(value) + half))

    found, number = [], {(p.kind, k): i for i, p in enumerate(parameters) for k in p.bodies}
    for kind in HIGH:
        for a, b in problem.pairs:
            gradient, product = {}, 1.0
            for one, other in ((a, b), (b, a)):
                of = values[number[kind, other]] if (kind, other) in number else getattr(problem.bodies[other], kind)
                product *= of
                if (i := number.get((kind, one))) is not None:
                    gradient[i] = gradient.get(i, 0.0) + of
            found.append(estimate(kind, f"{problem.bodies[a].name} / {problem.bodies[b].name}", product, gradient))
    for i, (p, value) in enumerate(zip(parameters, values, strict=True)):
        kind, unit, own = _own(problem, p, value)
        by = own if KINDS[p.kind].key else _own(problem, p, 1.0)[2]
        found.append(replace(estimate(kind, p.name, own, {i: by}), unit=unit))
    return found


def _own(problem: Problem, p: Parameter, value: float) -> tuple[str, str, float]:
    """Kind of the estimate, unit, and value in that unit, of a single parameter."""
    if p.kind in HIGH:
        return f"own_{p.kind}", "", value
    if p.kind in OF_JOINTS:
        joint = problem.joints[p.axis]
        unit = OF_TURNS[p.kind][0 if joint.kind in ("hinge", "ball") else 1]
        return p.kind, unit, value * problem.heft(joint, p.kind)
    unit = KINDS[p.kind].unit
    if KINDS[p.kind].key:
        return p.kind, unit, math.exp(value) * (problem.bodies[p.bodies[0]].mass if p.kind == "mass" else 1.0)
    return p.kind, unit, value * (problem.units.length if p.kind == "height" else math.degrees(1.0))


def _profiles(
    problem: Problem, best: np.ndarray, slope: np.ndarray, errors: np.ndarray,
    errors_of: Callable[[np.ndarray], np.ndarray], estimates: Sequence[Estimate],
) -> list[Profile]:  # fmt: skip
    """The loss along each parameter. The others are fitted in one step, by the slopes at the best point."""
    found, (low, high), width = [], problem.bounds, problem.width
    weight = (1.0 + errors**2) ** -0.25  # weights of the soft L1 loss
    weighted = slope * width * weight[:, None]

    def loss(values: np.ndarray) -> float:
        return float((np.sqrt(1.0 + errors_of(values) ** 2) - 1.0).sum())

    least = max(loss(best), 1e-12)  # for a recording that is reproduced exactly
    for k, p in enumerate(problem.parameters):
        kind, _, value = _own(problem, p, float(best[k]))
        own = next(e for e in estimates if (e.kind, e.name) == (kind, p.name))
        by = (_own(problem, p, best[k] + 1e-6 * width[k])[2] - value) / 1e-6  # units per width
        half = 0.5 * (own.interval[1] - own.interval[0]) / by if own.interval else 0.5 / BEYOND
        half = max(half, KINDS[p.kind].nudge / BEYOND)
        others = np.delete(np.arange(len(best)), k)
        along = np.zeros(len(best))
        along[k] = 1.0
        along[others] = np.linalg.lstsq(weighted[:, others], -weighted[:, k], rcond=1e-6)[0]
        x, y = [], []
        for step in np.linspace(-BEYOND, BEYOND, 2 * POINTS + 1):
            values = best + step * half * along * width
            if not low[k] <= values[k] <= high[k]:
                continue
            values = np.clip(values, low, high)
            x.append(_own(problem, p, float(values[k]))[2])
            y.append(loss(values) / least if step else 1.0)
        found.append(Profile(own, value, x, y))
    return found


def _notes(recordings: Sequence[Recording], covered: float) -> list[str]:
    """Notes on faults of trackers, and on what recordings lack."""
    lost, jumps = sum(r.lost for r in recordings), sum(r.jumps for r in recordings)
    notes = []
    if lost or jumps:
        worst = max(recordings, key=lambda r: r.lost + r.jumps)
        notes.append(f"left out: {lost} poses that are missing or not numbers, {jumps} jumps (most in {worst.name})")
    if noise := [r.noise for r in recordings if r.noise[0] > 0.0]:
        place, turn = np.median(noise, axis=0)
        notes.append(f"noise of the poses: {1e3 * place:.2g} mm and {math.degrees(turn):.2g} degrees")
    if still := [r.name for r in recordings if not r.known.any()]:
        notes.append(f"not used, as never smooth:  {', '.join(still[:3])}" + (" ..." if still[3:] else ""))
    if len(recordings) < ENOUGH:
        notes.append(f"with {ENOUGH} recordings or more, some are kept to confirm what the others show")
    if covered < COVERED:
        what = "earlier frames are not smooth enough to begin from"
        notes.append(f"these whole motions are {100.0 * covered:.2g} % of the recorded way: {what}")
    return notes


# --- the scene ---


def _entry(body: Body) -> str:
    """The name of a body's entry in the scene file: for copies, their common name."""
    return re.sub(r"\[\d+\]$", "", body.name)


def _file_values(problem: Problem, values: np.ndarray) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Any]]]:
    """For bodies and for joints: name of the entry -> key of the scene file -> value, for all parameters of the fit:
    parameters that are not determined one by one may be so together."""
    found: dict[str, dict[str, Any]] = {}
    joints: dict[str, dict[str, Any]] = {}
    many, length = len(problem.moving), problem.units.length
    for p, value in zip(problem.parameters, values.tolist(), strict=True):
        if p.kind in OF_JOINTS:
            number = value * problem.heft(problem.joints[p.axis], p.kind)
            joints.setdefault(p.name, {})[p.kind.removeprefix("joint_")] = number
            continue
        b = problem.bodies[p.bodies[0]]
        entry = found.setdefault(_entry(b), {})
        if p.kind in HIGH:
            entry[p.kind] = value
        elif key := KINDS[p.kind].key:
            own = {"mass": b.mass, "scale": b.scale, "inertia_factor": problem.inertia_factor(p.bodies[0])}
            entry[key] = own[key] * math.exp(value)
        if p.bodies[0] < many:
            entry.setdefault("mass", b.mass)  # with a density another size would mean another mass
    for body, ground in problem.ground.items():
        b, (turn, shift) = problem.bodies[body], problem.lie(values, body)
        centre = ground.centre * length
        position = centre + pose.rotate(turn, b.position - centre) + shift * length
        found.setdefault(b.name, {}).update(
            position=position.tolist(), quat_xyzw=pose.normalise(pose.multiply(turn, b.quat_xyzw)).tolist()
        )
    # A scene has no restitution above 1; as contacts show products, the static body can have more of it.
    moving = {_entry(b) for b in problem.moving}
    most = max((entry.get("restitution", 0.0) for name, entry in found.items() if name in moving), default=0.0)
    if most > 1.0:
        for b in problem.fixed:
            found.setdefault(_entry(b), {}).setdefault("restitution", b.restitution)
        for name, entry in found.items():
            if "restitution" in entry:
                entry["restitution"] = min(1.0, entry["restitution"] * (1.0 / most if name in moving else most))
    return found, joints


INSTEAD = {"mass": ("density",), "quat_xyzw": ("quat_wxyz", "euler_xyz_deg")}


def write_scene(found: Identified, scene_file: Path, out: Path) -> list[str]:
    """Write a copy of a scene file with the values that were found; everything else is as in the file, except comments.
    Returns notes."""
    scene = SceneBuilder.read(scene_file, allow_outside=True)
    for entry in scene.bodies:
        values = dict(found.scene_values.get(entry["name"], {}))
        if "plane" in entry and "position" in values:
            place, turn = np.array(values.pop("position")), np.array(values.pop("quat_xyzw"))
            normal = pose.rotate(turn, np.array([0.0, 0.0, 1.0]))
            entry["plane"] = {"normal": _rounded(normal), "offset": _rounded(normal @ place)}
        for key, value in values.items():
            for other in INSTEAD.get(key, ()):
                entry.pop(other, None)
            entry[key] = _rounded(value)
    for entry in scene.joints:
        entry |= {key: _rounded(value) for key, value in found.joint_values.get(entry["name"], {}).items()}
    scene.save(out)
    files = any({"mesh", "asset"} & shape.keys() for shape in scene.shapes.values())
    files |= str(scene.settings.get("model")).endswith(".safetensors")
    if files and out.resolve().parent != scene_file.resolve().parent:
        return [f"{out} names files outside its folder: simulate it with --allow-outside, or write it beside them"]
    return []


def _rounded(value: Any) -> Any:
    return np.vectorize(lambda number: float(f"{number:.9g}"))(value).tolist()


# --- the picture beside the scene: the loss against each parameter ---

ACROSS = 4  # panels in a row
PANEL = (3.0, 2.2)  # inches


def picture(found: Identified, path: Path) -> str:
    """Write a PNG with a panel for every parameter: the loss with the others fitted again, and the interval of 95 %.
    Returns what to install if matplotlib is missing, else an empty string."""
    try:
        plots = pyplot()
    except NotInstalled as error:
        return f"{error.message}: {error.hint}"
    across = min(ACROSS, max(1, len(found.profiles)))
    down = max(1, math.ceil(len(found.profiles) / across))
    figure, axes = plots.subplots(
        down, across, figsize=(PANEL[0] * across, PANEL[1] * down), layout="constrained", squeeze=False
    )
    for axis in axes.flat[len(found.profiles) :]:
        axis.axis("off")
    for axis, profile in zip(axes.flat, found.profiles, strict=False):
        interval = profile.estimate.interval
        if interval is not None:
            axis.axvspan(*interval, color="tab:blue", alpha=0.15, linewidth=0)
        axis.plot(profile.x, profile.loss, "o-", markersize=3, linewidth=1.2, color="tab:blue" if interval else "0.6")
        axis.axvline(profile.best, color="0.4", linewidth=0.8, linestyle=":")
        # A flat curve should look flat: the scale covers at least a tenth of the loss.
        low, high = axis.get_ylim()
        axis.set_ylim(min(low, 0.99), max(high, 1.1))
        axis.set_title("\n".join(profile.estimate.lines()), fontsize=8, color="black" if interval else "0.4")
        axis.set_xlabel(profile.estimate.unit.strip() or "no unit", fontsize=7)
        axis.set_ylabel("loss over the best", fontsize=7)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.3)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110, format="png")
    plots.close(figure)
    return ""
