"""Friction, restitution and mass ratios from a recorded motion: what `sdfsim identify` does.

The recording is cut into short windows. The contact solve runs all of them side by side, each from where the recording
has the bodies, and a least-squares fit moves the coefficients until the windows end as recorded. Windows are short, so
that chaos has no time to grow, and long enough to tell a rebound from a slide.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from sdfsim.apps.run import read_run
from sdfsim.base.errors import SdfsimError
from sdfsim.base.parallel import Progress, silent
from sdfsim.learned.model import load_model
from sdfsim.physics import pose
from sdfsim.physics.options import STEP, SUBSTEPS, Options
from sdfsim.physics.units import scene_units
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Scene
from sdfsim.simulate.batch import placed, side_by_side
from sdfsim.simulate.steppers import Frames, stepper_of

if TYPE_CHECKING:
    from sdfsim.physics.solver.prepare import Compiled

WINDOW, EVERY = 0.15, 0.06  # model units of time, about seconds for bodies of a metre: length and spacing of windows
SMOOTH = 4.0  # times gravity: a recording of poses tells no velocity where it accelerates more than that
START = 0.5  # of every coefficient
WEAK = 1e-3  # how strongly coefficients that nothing shows are held to it
OUTLIER = 2e-3  # model lengths: errors of windows that count less than squared, beyond
NUDGE = 0.02  # of a coefficient, for differences: contacts come and go, so that smaller ones tell nothing
SURE = 1.96  # standard deviations in an interval of 95 %
HIGH = {"friction": 2.0, "restitution": 1.0}  # the largest products that are looked for
RATIO = 7.0  # the largest logarithm of a mass ratio
COLUMNS = ("time", "body", "x", "y", "z", "qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class Recording:
    """T poses of D bodies, evenly spaced in time."""

    dt: float  # s
    position: np.ndarray  # [T, D, 3] m, of the centres of mass
    orientation: np.ndarray  # [T, D, 4] xyzw
    # velocity, angular_velocity: [T, D, 3] m/s and rad/s
    velocity: np.ndarray
    angular_velocity: np.ndarray
    known: np.ndarray  # [T] bool, whether the velocities are to be trusted


def load_recording(
    path: Path, scene_file: Path | None = None, *, allow_outside: bool = False, on_progress: Progress = silent
) -> tuple[Recording, Scene]:
    """A recording of the bodies of a scene that move, and the scene: of a run folder or a `rollout.npz`, whose scene is
    known; or a CSV of poses (`COLUMNS`), whose positions are those of the shapes' own origins, as in a scene file.
    Raises SdfsimError for no scene, unreadable files, or a recording that is not of this scene."""
    if path.suffix == ".csv":
        if scene_file is None:
            raise SdfsimError(f"{path}: a recording without its scene", "give it: --scene scene.yaml")
        scene = load_scene(scene_file, on_progress, allow_outside=allow_outside)
        return _from_poses(path, scene), scene
    scene, rollout = read_run(path, scene_file, allow_outside=allow_outside, on_progress=on_progress)
    rows = [k for k, b in enumerate(scene.bodies) if b.motion == "dynamic"]
    moving = ("position", "orientation", "velocity", "angular_velocity")
    dt = float(np.diff(rollout.time).mean()) if len(rollout) else 0.0
    motion = {name: getattr(rollout, name)[:, rows] for name in moving}
    return Recording(dt, **motion, known=np.ones(len(rollout.time), dtype=bool)), scene


def _read_csv(path: Path, moving: list[str]) -> tuple[float, np.ndarray]:
    """Spacing s and poses [T, D, 7] of the bodies, positions [m] before quaternions."""
    rows: dict[float, dict[str, list[float]]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if tuple(reader.fieldnames or ()) != COLUMNS:
                raise SdfsimError(f"{path}:1: columns must be {','.join(COLUMNS)}")
            for row in reader:
                if row["body"] in moving:
                    time, *values = (float(row[c] or "") for c in ("time", *COLUMNS[2:]))
                    if not np.isfinite([time, *values]).all() or not any(values[3:]):
                        raise ValueError("must be finite, with a quaternion that is not 0")
                    rows.setdefault(time, {})[row["body"]] = values
    except ValueError as error:
        raise SdfsimError(f"{path}:{reader.line_num}: {error}") from error
    except (OSError, csv.Error) as error:
        raise SdfsimError(f"{path}: not a CSV of poses ({error})") from error
    times = np.array(sorted(rows))
    if len(times) < 4:
        raise SdfsimError(f"{path}: {len(times)} times of {moving} (at least 4)")
    gaps = np.diff(times)
    if np.ptp(gaps) > 0.02 * gaps.mean():
        told = f"they are {gaps.min():.4g} to {gaps.max():.4g} s apart"
        raise SdfsimError(f"{path}: times must be evenly spaced ({told})")
    for time in times:
        if missing := set(moving) - set(rows[time]):
            raise SdfsimError(f"{path}: no pose of body {min(missing)!r} at time {time:g}")
    return float(gaps.mean()), np.array([[rows[time][name] for name in moving] for time in times])


def _from_poses(path: Path, scene: Scene) -> Recording:
    """Velocities by central differences, which are exact in free flight, where no impact is near."""
    bodies = [b for b in scene.bodies if b.motion == "dynamic"]
    dt, poses = _read_csv(path, [b.name for b in bodies])
    turn = pose.normalise(poses[..., 3:])
    com = np.array([scene.shapes[b.shape].com * b.scale for b in bodies])
    position = poses[..., :3] + pose.rotate(turn, com)
    velocity, angular = np.zeros_like(position), np.zeros_like(position)
    velocity[1:-1] = (position[2:] - position[:-2]) / (2.0 * dt)
    angular[1:-1] = pose.to_rotvec(pose.multiply(turn[2:], pose.conjugate(turn[:-2]))) / (2.0 * dt)
    bend = np.linalg.norm(position[2:] - 2.0 * position[1:-1] + position[:-2], axis=-1) / dt**2
    smooth = np.all(bend < SMOOTH * max(float(np.linalg.norm(scene.gravity)), 1.0), axis=-1)
    return Recording(dt, position, turn, velocity, angular, np.pad(smooth, 1))


def identify(recording: Recording, scene: Scene, *, on_progress: Progress = silent) -> dict[str, Any]:
    """Find the coefficients and masses with which the contact solve repeats a recording; those of bodies that do not
    move are taken from the scene.

    Returns `value` and `interval` (of 95 %; both None where the motion does not show it) of: `friction` and
    `restitution`, by "BODY / BODY", the product of both bodies' coefficients; `own_friction` and `own_restitution`, by
    body, where the scene gives that of what it touched; `mass` in kg, relative to the first body that another one
    touched. And `error_m`, the root mean square error of the `windows` that are left. Raises SdfsimError for bodies on
    paths, a recording too short, or one in which nothing touches.
    """
    from scipy.optimize import least_squares

    if any(b.motion == "kinematic" for b in scene.bodies):
        raise SdfsimError("bodies on paths: identify works on bodies that move freely and those that are static")
    windows = Windows(recording, scene)
    # A sweep over all coefficients alike finds the valley; the fit goes down in it.
    tried = [windows.start(f, e) for f in (0.2, 0.5, 0.9) for e in (0.1, 0.4, 0.7, 0.95)]
    costs = []
    for k, trial in enumerate(tried):
        costs.append(float(np.minimum(np.abs(windows.errors(trial)), 10.0).sum()))
        on_progress(0.3 * k / len(tried), "a first sweep over friction and restitution")
    start, count = windows.start(START, START), [0]

    def errors(parameters: np.ndarray) -> np.ndarray:
        count[0] += 1
        on_progress(min(0.95, 0.3 + 0.005 * count[0]), f"fit, run {count[0]} of all windows")
        return np.concatenate([windows.errors(parameters), WEAK * (parameters - start)])

    slope: Any = lambda parameters: windows.jacobian(parameters, errors)  # noqa: E731
    best = tried[int(np.argmin(costs))]
    found = least_squares(errors, best, slope, windows.bounds, x_scale=0.1, loss="soft_l1", max_nfev=25)
    return windows.report(found.x, windows.jacobian(found.x, errors), errors(found.x))


def report_lines(report: dict[str, Any]) -> list[str]:
    """`identify`'s report for people."""
    heads = {"friction": "friction, product", "restitution": "restitution, product"}
    heads |= {"own_friction": "friction of the body's own", "own_restitution": "restitution of the body's own"}
    lines = []
    for kind, head in (heads | {"mass": "mass, kg"}).items():
        for name, told in report[kind].items():
            seen = "not shown by this motion"
            if told["interval"]:
                seen = "{:.3f} ({:.3f} to {:.3f})".format(told["value"], *told["interval"])
            lines.append(f"{head}: {name}: {seen}")
    return [*lines, f"{report['windows']} windows, repeated with an error of {report['error_m']:.2g} m"]


class Windows:
    """All windows of a recording as one set of bodies, each window a world of its own. Parameters are friction and
    restitution of every body that touches another, then the logarithms of mass ratios."""

    def __init__(self, recording: Recording, scene: Scene) -> None:
        self.scene, self.recording = scene, recording
        self.units, self.solver = scene_units(scene), stepper_of(load_model())
        self.moving = [b for b in scene.bodies if b.motion == "dynamic"]
        self.fixed = [b for b in scene.bodies if b.motion != "dynamic"]
        if recording.dt == 0.0:
            raise SdfsimError("the recording is a single frame")
        self.length = max(3, round(WINDOW * self.units.time / recording.dt))
        every = max(1, round(EVERY * self.units.time / recording.dt))
        begin = np.arange(0, len(recording.position) - self.length, every)
        begin = begin[recording.known[begin]]
        if not len(begin):
            told = f"give at least {self.length + 1} frames"
            raise SdfsimError("the recording is too short, or nowhere smooth", told)
        dt = recording.dt / self.units.time
        inner = max(1, int(np.ceil(dt / (STEP / SUBSTEPS) - 0.01)))
        gravity = np.asarray(scene.gravity) / self.units.acceleration
        self.options = Options(gravity, dt, inner)
        self._build(begin)
        touched = self._touched()
        if not touched:
            raise SdfsimError("nothing touches in the recording", "friction and restitution show in contacts only")
        self._build(begin[sorted({w for w, _, _ in touched})])
        self.pairs = sorted({(a, b) for _, a, b in touched})
        many = len(self.moving)
        self.seen = sorted({k for pair in self.pairs for k in pair if k < many})
        beside = [pair for pair in self.pairs if pair[1] < many]
        self.weighed = sorted({k for pair in beside for k in pair})[1:]
        ratios = np.full(len(self.weighed), RATIO)
        high = [self._most(name, k) for name in HIGH for k in self.seen]
        self.bounds = np.concatenate([np.zeros(len(high)), -ratios]), np.concatenate([high, ratios])

    def _build(self, begin: np.ndarray) -> None:
        """Bodies and start states of the windows that begin at frames `begin`."""
        whole = replace(self.scene, bodies=tuple(self.moving * len(begin) + self.fixed))
        world = [*np.repeat(np.arange(len(begin)), len(self.moving)), *[-1] * len(self.fixed)]
        r, u = self.recording, self.units
        given = (r.position / u.length, r.orientation, r.velocity / u.velocity, r.angular_velocity * u.time)
        self.bodies, start = side_by_side(whole, world, u)
        self.start_state = placed(start, *(values[begin].reshape(-1, values.shape[-1]) for values in given))
        frames = begin[None] + 1 + np.arange(self.length)[:, None]
        self.goal = r.position[frames] / u.length, r.orientation[frames]
        self.carry, self.count = self.solver.init(self.bodies, self.start_state, self.options), len(begin)
        self.world = cast("Compiled", self.carry.scene).world
        self.given = {name: getattr(self.world, name).copy() for name in ("inverse_mass", "inertia", "inverse_inertia")}

    def _run(self) -> Frames:
        _, carry = self.solver.advance(self.start_state, self.carry, self.length, keep=True)
        return cast("Frames", carry.frames)

    def _touched(self) -> set[tuple[int, int, int]]:
        """Window and pair of bodies of every contact; static ones count on from those that move."""
        many = len(self.moving)
        total, found = many * self.count, set()
        state = self.start_state
        for _ in range(self.length):
            state, _ = self.solver.advance(state, self.carry)
            assert state.touch is not None
            for a, b in state.touch.pair[state.touch.count > 0].tolist():
                other = b % many if b < total else many + b - total
                found.add((a // many, *sorted((a % many, other))))
        return found

    def _most(self, name: str, body: int) -> float:
        """What a body's own coefficient may be at most, given those of the static bodies that it touched."""
        many = len(self.moving)
        others = [getattr(self.fixed[b - many], name) for a, b in self.pairs if a == body and b >= many]
        return HIGH[name] / max([v for v in others if v > 0.0], default=1.0)

    def start(self, friction: float, restitution: float) -> np.ndarray:
        """Parameters with one coefficient for all, and the masses of the scene."""
        count = len(self.seen)
        return np.concatenate([np.full(count, friction), np.full(count, restitution), np.zeros(len(self.weighed))])

    def errors(self, parameters: np.ndarray) -> np.ndarray:
        """Differences of all windows from the recording, in units of `OUTLIER`; turns at half of a body's size."""
        count, many = len(self.seen), len(self.moving)
        total = self.count * many
        for k, friction, restitution in zip(self.seen, parameters[:count], parameters[count : 2 * count], strict=True):
            self.world.friction[k:total:many] = friction
            self.world.restitution[k:total:many] = restitution
        for k, ratio in zip(self.weighed, np.exp(parameters[2 * count :]), strict=True):
            for name, power in (("inverse_mass", -1), ("inertia", 1), ("inverse_inertia", -1)):
                getattr(self.world, name)[k:total:many] = self.given[name][k:total:many] * ratio**power
        size = self.bodies.size[:total, None]
        frames = self._run()
        place, turn = (values.reshape(self.length, total, -1) for values in self.goal)
        away = pose.multiply(frames.orientation[:, :total], pose.conjugate(turn))
        errors = np.stack([frames.position[:, :total] - place, 0.5 * size * pose.to_rotvec(away)], 1)
        return np.nan_to_num(errors.ravel(), nan=1e3) / OUTLIER

    def jacobian(self, parameters: np.ndarray, errors: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """[R, P] by central differences of `NUDGE`, one-sided at the bounds."""
        low, high = self.bounds
        columns = []
        for k in range(len(parameters)):
            one, other = parameters.copy(), parameters.copy()
            one[k], other[k] = min(one[k] + NUDGE, high[k]), max(other[k] - NUDGE, low[k])
            columns.append((errors(one) - errors(other)) / (one[k] - other[k]))
        return np.stack(columns, 1)

    def report(self, parameters: np.ndarray, jacobian: np.ndarray, errors: np.ndarray) -> dict[str, Any]:
        """What `identify` returns. Intervals are from the curvature of the robust cost, and how windows pull apart (a
        sandwich)."""
        data, slope = errors[: -len(parameters)], jacobian[: -len(parameters)]
        weight = (1.0 + data**2) ** -0.5  # of the soft L1 loss
        curvature = (slope * weight[:, None]).T @ slope + WEAK**2 * np.eye(len(parameters))
        # Errors within a window go together: windows, not single poses, are what is independent.
        window = np.tile(np.repeat(np.arange(self.count), 3 * len(self.moving)), 2 * self.length)
        pull = np.zeros((self.count, len(parameters)))
        np.add.at(pull, window, (weight * data)[:, None] * slope)
        inverse = np.linalg.inv(curvature)
        spread = max(1.0, self.count / max(1, self.count - len(parameters)))
        covariance = spread * inverse @ (pull.T @ pull) @ inverse
        shown = np.square(slope).sum(0) > 1.0

        def estimate(value: float, gradient: dict[int, float]) -> dict[str, Any]:
            """Of a value with these derivatives by parameters; the fit left one that is not shown where it began."""
            which, by = list(gradient), np.array(list(gradient.values()))
            if not shown[which][by != 0.0].all():
                return {"value": None, "interval": None}
            half = SURE * float(np.sqrt(by @ covariance[np.ix_(which, which)] @ by))
            return {"value": float(value), "interval": (max(0.0, float(value) - half), float(value) + half)}

        many, bodies = len(self.moving), [*self.moving, *self.fixed]
        rms = float(np.sqrt(np.mean((data * OUTLIER) ** 2))) * self.units.length
        found: dict[str, Any] = {"error_m": rms, "windows": self.count}
        for offset, kind in ((0, "friction"), (len(self.seen), "restitution")):
            found[kind], found[f"own_{kind}"] = {}, {}
            for a, b in self.pairs:
                i, name = offset + self.seen.index(a), f"{bodies[a].name} / {bodies[b].name}"
                if b < many:
                    j = offset + self.seen.index(b)
                    gradient = {i: parameters[j], j: parameters[i]}
                    found[kind][name] = estimate(parameters[i] * parameters[j], gradient)
                else:
                    other = getattr(bodies[b], kind)
                    found[kind][name] = estimate(parameters[i] * other, {i: other})
                    found[f"own_{kind}"][bodies[a].name] = estimate(parameters[i], {i: 1.0})
        found["mass"] = {}
        for i, k in enumerate(self.weighed, 2 * len(self.seen)):
            value = self.moving[k].mass * float(np.exp(parameters[i]))
            found["mass"][self.moving[k].name] = estimate(value, {i: value})
        return found
