"""The unknown numbers of a scene: coefficients, masses, sizes, the lie of the ground, friction in joints."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sdfsim.apps.observed import Recording, movers
from sdfsim.base.errors import SdfsimError
from sdfsim.physics import pose
from sdfsim.physics.bodies import Bodies, State, Tracks, largest_extent
from sdfsim.physics.joint_columns import DAMPING, FRICTION
from sdfsim.physics.units import scene_units
from sdfsim.scene.scene import Body, Joint, Scene

WINDOW = 0.15  # model units of time, about seconds for bodies of a metre: length of short windows
GRAVITY = 9.81  # m/s^2, used for joints of scenes without gravity
HIGH = {"friction": 2.0, "restitution": 1.0}  # the largest products that are searched
STILL, JITTER = 1e-5, 6.0  # relative to a size (and rad), and to the noise: smaller changes are those of rest
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


class Problem:
    """A scene with its parameters: those of bodies that touch something in the recordings."""

    def __init__(self, recordings: Sequence[Recording], scene: Scene) -> None:
        self.scene, self.recordings = scene, list(recordings)
        self.moving, self.fixed = movers(scene), [b for b in scene.bodies if b.motion == "static"]
        self.led = [b for b in scene.bodies if b.motion == "kinematic"]
        self.bodies, self.units = [*self.moving, *self.led, *self.fixed], scene_units(scene)
        self.sizes = np.array([largest_extent(scene.shapes[b.shape]) * b.scale for b in self.moving])
        self.joints = scene.joints if scene.effects.joints != "off" else ()
        self.parameters: list[Parameter] = []
        self.ground: dict[int, Ground] = {}
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

    def choose(self, touched: list[tuple[int, int, int, np.ndarray, bool]]) -> None:
        """Set the parameters, by the pairs of bodies that touch; `touched` as from `residuals.Windows`."""
        many = len(self.moving)
        self.pairs = sorted({(a, b) for _, a, b, *_ in touched})
        self.hit = {k for _, *pair, _, impact in touched for k in pair if impact}
        groups: dict[str, list[int]] = {}
        for k, body in enumerate(self.bodies):
            groups.setdefault(entry_of(body), []).append(k)
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

    def displaced(self, values: np.ndarray, body: int) -> tuple[np.ndarray, np.ndarray]:
        """How a body on a path is displaced in its own axes, as a static one at its place in the scene would be: shift,
        model units, and rotation (a quaternion)."""
        (turn, shift), of = self.lie(values, body), self.bodies[body]
        back, place, centre = pose.conjugate(of.quat_xyzw), of.position / self.units.length, self.ground[body].centre
        way = pose.rotate(back, centre - place + pose.rotate(turn, place - centre) + shift)
        return way, pose.multiply(back, pose.multiply(turn, of.quat_xyzw))

    def rows(self, body: int, count: int) -> Any:
        """Where one of `bodies` is among those of `Copies`."""
        many, led = len(self.moving), len(self.led)
        if body < many:
            return slice(body, many * count, many)
        at = body * count
        return slice(at, at + count) if body < many + led else (many + led) * count + body - many - led

    def number(self, row: int, count: int) -> int:
        """Which of `bodies` is in this row of `Copies`."""
        many, led = len(self.moving), len(self.led)
        if row < many * count:
            return row % many
        return row // count if row < (many + led) * count else row - (many + led) * (count - 1)

    def applied(self, values: np.ndarray, bodies: Bodies, state: State, count: int) -> tuple[Bodies, State]:
        """The bodies of `count` `Copies` with these parameters."""
        names = (*HIGH, "scale", "com", "inertia", "mass", "inverse_mass", "bounds", "size", "radius")
        new = {name: getattr(bodies, name).copy() for name in names}
        position, orientation = state.position.copy(), state.orientation.copy()
        joints, tracks = bodies.joints, bodies.tracks
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
                rows = self.rows(k, count)
                if p.kind in HIGH:
                    new[p.kind][rows] = value
                for name, power in KINDS[p.kind].scales.items():
                    new[name][rows] *= math.exp(power * value)
        for body, ground in self.ground.items():
            rows, (turn, shift) = self.rows(body, count), self.lie(values, body)
            if body < len(self.moving) + len(self.led):
                tracks = _displaced(tracks, rows, *self.displaced(values, body))
                continue
            row = rows
            position[row] = ground.centre + pose.rotate(turn, position[row] - ground.centre) + shift
            orientation[row] = pose.multiply(turn, orientation[row])
        if tracks is not None:
            position[tracks.body], orientation[tracks.body] = tracks.at(0.0)
        return replace(bodies, tracks=tracks, **new), replace(state, position=position, orientation=orientation)


def _displaced(tracks: Any, rows: slice, way: np.ndarray, turn: np.ndarray) -> Tracks:
    """The tracks with the body in these rows displaced in its own axes."""
    some = np.flatnonzero((tracks.body >= rows.start) & (tracks.body < rows.stop))
    origin, orientation = tracks.origin.copy(), tracks.orientation.copy()
    origin[some] += pose.rotate(orientation[some], way)
    orientation[some] = pose.multiply(orientation[some], turn)
    return replace(tracks, origin=origin, orientation=orientation)


def entry_of(body: Body) -> str:
    """The name of a body's entry in the scene file: for copies, their common name."""
    return re.sub(r"\[\d+\]$", "", body.name)
