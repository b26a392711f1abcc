"""What `identify` tells: values with intervals, profiles of the loss, a picture, and a scene with the values."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.apps.identify.parameters import HIGH, KINDS, OF_JOINTS, Parameter, Problem, entry_of
from sdfsim.apps.observed import Recording
from sdfsim.base.files import replacing
from sdfsim.base.lazy import NotInstalled, pyplot
from sdfsim.physics import pose
from sdfsim.scene.builder import SceneBuilder

WEAK = 1e-3  # weight that keeps parameters that nothing shows at the scene's values
SURE = 1.96  # half of an interval of 95 %, in standard deviations
SHOWN = 0.25  # relative to its width: how precisely windows must determine a parameter, with noise of `OUTLIER`
ENOUGH = 4
COVERED = 0.8  # of the recorded way: if whole motions have less, that is said
POINTS, BEYOND = 4, 2.0  # points of a profile on each side, and their farthest distance, in half intervals
HEADS = {name: kind.head for name, kind in KINDS.items()}
HEADS |= {"own_friction": "friction of its own", "own_restitution": "restitution of its own"}
# Units for hinges and balls, and for sliders.
OF_TURNS = {"joint_friction": (" N m", " N"), "joint_damping": (" N m s", " N s/m")}
PLACE = ("position", "quat_xyzw", "quat_wxyz", "euler_xyz_deg")
INSTEAD = {"mass": ("density",), "quat_xyzw": PLACE[2:], "path": PLACE}
ACROSS = 4  # panels in a row
PANEL = (3.0, 2.2)  # inches


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
    held_out: dict[
        str, Any
    ]  # errors of whole motions that the fit has not seen; of all motions if `recordings` is 0; empty for films
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
    h = found.held_out
    if not h:  # of films, whose notes say how far they are off
        return [*lines, *found.notes]
    lines.append(f"{found.windows} windows, repeated with an error of {found.error_m:.2g} m")
    who = f"{h['recordings']} whole motions that the fit has not seen" if h["recordings"] else "the same motions, whole"
    lines.append(
        "{}: {:.2g} % of the size and {:.2g} degrees off; as the scene was, {:.2g} % and {:.2g}".format(
            who, *h["after"], *h["before"]
        )
    )
    return [*lines, *found.notes]


def estimated(
    problem: Problem, values: np.ndarray, group: np.ndarray, slope: np.ndarray, errors: np.ndarray, scatter: np.ndarray
) -> list[Estimate]:
    """Values with their intervals, from the curvature of the robust cost and the scatter between recordings, or windows
    if recordings are few (a sandwich estimator). No value if noise of `OUTLIER` per number would leave it
    undetermined."""
    width = problem.width
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
    return estimates_of(problem, values, covariance, shown)


def estimates_of(problem: Problem, values: np.ndarray, covariance: np.ndarray, shown: np.ndarray) -> list[Estimate]:
    """Values with their intervals, from their covariance in widths; no value if it is not `shown` [P]."""
    parameters, width = problem.parameters, problem.width
    shown = shown & [p.kind != "restitution" or bool(problem.hit & set(p.bodies)) for p in parameters]

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


def profiled(
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


def notes_on(recordings: Sequence[Recording], covered: float) -> list[str]:
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


def file_values(problem: Problem, values: np.ndarray) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Any]]]:
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
        entry = found.setdefault(entry_of(b), {})
        if p.kind in HIGH:
            entry[p.kind] = value
        elif key := KINDS[p.kind].key:
            own = {"mass": b.mass, "scale": b.scale, "inertia_factor": problem.inertia_factor(p.bodies[0])}
            entry[key] = own[key] * math.exp(value)
        if p.bodies[0] < many:
            entry.setdefault("mass", b.mass)  # with a density another size would mean another mass
    for body, ground in problem.ground.items():
        b, (turn, shift) = problem.bodies[body], problem.lie(values, body)
        if b.path is not None:
            way, turn = problem.displaced(values, body)
            origin = b.path.position + pose.rotate(b.path.quat_xyzw, way * length)
            poses = zip(
                b.path.time.tolist(), _rounded(origin), _rounded(pose.multiply(b.path.quat_xyzw, turn)), strict=True
            )
            path = [{"time": t, "position": p, "quat_xyzw": q} for t, p, q in poses]
            found.setdefault(b.name, {}).update(motion="kinematic", path=path)
            continue
        centre = ground.centre * length
        position = centre + pose.rotate(turn, b.position - centre) + shift * length
        found.setdefault(b.name, {}).update(
            position=position.tolist(), quat_xyzw=pose.normalise(pose.multiply(turn, b.quat_xyzw)).tolist()
        )
    # A scene has no restitution above 1; as contacts show products, the static body can have more of it.
    moving = {entry_of(b) for b in problem.moving}
    most = max((entry.get("restitution", 0.0) for name, entry in found.items() if name in moving), default=0.0)
    if most > 1.0:
        for b in problem.fixed:
            found.setdefault(entry_of(b), {}).setdefault("restitution", b.restitution)
        for name, entry in found.items():
            if "restitution" in entry:
                entry["restitution"] = min(1.0, entry["restitution"] * (1.0 / most if name in moving else most))
    return found, joints


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
            entry[key] = value if key in ("motion", "path") else _rounded(value)
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
