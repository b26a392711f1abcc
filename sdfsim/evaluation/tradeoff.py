"""Error against time: our models with their settings, and other engines."""

import csv
import io
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import locked, write_json, write_text
from sdfsim.base.parallel import StageProgress
from sdfsim.base.version import __version__
from sdfsim.data.batching import every, first_frames, roll_out, scene_of
from sdfsim.data.dataset import Trajectory, at_instants, check_alike, conditions_of, engine_substep
from sdfsim.data.pybullet_sim import DT, SUBSTEP
from sdfsim.evaluation.engines import Engine, Start, Timing, bullet, dataset_urdf, start_of_scene, timed
from sdfsim.evaluation.evaluate import load_recorded, penetration, perturbed
from sdfsim.evaluation.harness import Job, Line, Panel, draw, front, machine, measure, number, one_thread, peak_memory
from sdfsim.evaluation.laws.hard_cases import tossed
from sdfsim.evaluation.metrics import energy_gain, errors
from sdfsim.learned.model import SOLVER, Model, load_model
from sdfsim.physics.options import SUBSTEPS
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Scene
from sdfsim.sdf.closed_forms import ClosedForm
from sdfsim.sdf.grid import sample_grid
from sdfsim.sdf.reference import MeshDistance, PiecesDistance
from sdfsim.shape.shape import Shape, centred, own_pieces, with_nodes, with_sdf
from sdfsim.shape.surface_nodes import hull_nodes
from sdfsim.simulate.simulator import Simulator
from sdfsim.simulate.steppers import stepper_of

VERSION = 2  # increase it when the measurements change, so that kept results are measured again
REPEATS = 7
MOST, MOST_QUICK = 20, 8  # trajectories
STEPS, STEPS_QUICK = 100, 50
TIMED = 80  # largest number of steps that are timed
EXPLODED = 1.0  # energy gain relative to the energy at the start, beyond which a motion blew up
OFF = 1e-3  # m/s: difference of the chaos floor's starts from the recorded ones
HORIZON = 50  # steps over which the drawn errors are taken
FAR = 4.0  # times our largest time or error: points farther away are not drawn
# Engines by name, with steps of the engine in a recorded step.
INNER = {"PyBullet": (5, 4, 3, 2, 1), "MuJoCo": (10, 5, 2), "MuJoCo mesh SDF": (5, 2)}
INNER_QUICK = {"PyBullet": (5, 1), "MuJoCo": (5,)}
TRUTH = f"PyBullet {1e3 * SUBSTEP:.3g} ms"  # it made the recordings, so it has no error of its own
FLOOR_LABEL = "chaos floor: PyBullet 4 ms, starts 1 mm per s off"
GRIDS = (32, 64, 128, 256)
PHYSICAL = ("contact", "friction", "restitution", "rotation")  # effects that the engines always have
Rows = list[tuple[str, ...]]


# --- what all are compared on ---


@dataclass(frozen=True)
class Cases:
    """The scenes that every model and engine simulates."""

    recorded: list[Trajectory]  # as PyBullet moved the bodies, from their first frames on
    starts: list[Trajectory]  # with velocities at the instants of the positions: the starts of our models
    shapes: dict[str, Shape]  # by name, with origins at the centres of mass
    urdfs: dict[str, Path]  # the engines' files, by name; missing ones are left out
    floor: tuple[float, float]  # friction and restitution
    own_inertia: bool = False  # see `Start`
    length: float = 1.0  # m of the scene in one unit of these; 1 for recordings
    time: float = 1.0  # s

    @property
    def steps(self) -> int:
        """Number of steps that are simulated."""
        return len(self.recorded[0].position) - 1

    @property
    def timed(self) -> int:
        """The trajectory that is timed: the median one by number of bodies."""
        return int(np.argsort([len(t.mass) for t in self.recorded], kind="stable")[len(self.recorded) // 2])


def load_cases(data: Path, *, quick: bool) -> Cases:
    """The trajectories of a dataset's test split, at most `MOST`; a quick study takes fewer and shorter ones. Raises
    SdfsimError as `load_recorded` does, or for recordings of different gravities."""
    most = MOST_QUICK if quick else MOST
    # The engine starts again from its own velocities, our models from those at the instants of the positions.
    recorded, shapes = load_recorded(data, "test", most=most, as_recorded=True)
    check_alike(str(data), recorded)
    longest = min(STEPS_QUICK if quick else STEPS, *(len(t.position) - 1 for t in recorded))
    recorded, substep = [first_frames(t, longest + 1) for t in recorded], engine_substep(data)
    urdfs = {}
    for name in shapes:
        with suppress(SdfsimError):  # the points of the engines then report it
            urdfs[name] = dataset_urdf(data, name)
    conditions = conditions_of(data)
    return Cases(
        recorded=recorded,
        starts=[at_instants(t, substep) for t in recorded],
        shapes={name: replace(shape, com=np.zeros(3)) for name, shape in shapes.items()},
        urdfs=urdfs,
        floor=conditions.floor,
    )


def cases_of_scene(scene: Scene, model: str, folder: Path, *, quick: bool) -> Cases:
    """The single case of a scene: PyBullet simulates it, and its motion is the reference for all.

    Lengths, times and masses are those of `model` (Froude scaling), so that PyBullet, whose steps and margins are meant
    for bodies of about a metre, serves scenes of any size. The engines' files are written to `folder`. Raises
    SdfsimError if PyBullet is not installed, or if the scene has anything but bodies that may all touch each other, on
    one level plane.
    """
    units = stepper_of(load_model(model, weights=False)).units(scene)
    start = start_of_scene(scene, folder, units)
    problems = {
        "bodies that may not touch all others are not measured": any(b.collides_with is not None for b in scene.bodies),
        "effects that are off are not measured": any(getattr(scene.effects, name) == "off" for name in PHYSICAL),
        "nothing moves in it": not any(b.motion == "dynamic" for b in scene.bodies),
        "needs one level plane as its floor": start.floor is None,
    }
    if start.floor is None or any(problems.values()):
        raise SdfsimError(f"{scene.path}: {next(problem for problem, there in problems.items() if there)}")
    shapes = {name: replace(centred(scene.shapes[int(name)]), name=name) for name in start.urdfs}
    t = start.motion
    # The engine's bodies fly as if their velocities were ahead by half an inner step of gravity.
    lead = 0.5 * SUBSTEP * t.gravity * ~t.static[:, None]
    steps = max(2, min(STEPS_QUICK if quick else STEPS, round(scene.duration / units.time / DT)))
    recorded, _ = bullet(replace(start, motion=replace(t, velocity=t.velocity - lead)), steps)
    return Cases([recorded], [t], shapes, start.urdfs, start.floor, True, units.length, units.time)


# --- models and engines ---


@dataclass(frozen=True)
class Variant:
    """One way to simulate; the defaults are those of `sdfsim evaluate`."""

    model: str  # name or path
    # "own": the shapes' own; "thin K": K of them, outermost first; "grid N": new samples from N^3 points
    nodes: str = "own"
    # "own": convex pieces if the shape has some; "mlp": its network alone; "grid N": samples of the exact distance, N
    # along each side; "mesh": the distance to the shown mesh
    sdf: str = "own"
    stride: int = 1  # recorded steps in a step
    substeps: int = SUBSTEPS  # inner steps of the solve in a step, if the model does not give their number
    contact: bool = True  # False is the ballistic baseline

    @property
    def label(self) -> str:
        """The model, and every setting that is not the default."""
        if not self.contact:
            return "ballistic"
        usual, path = Variant(self.model), Path(self.model)
        name = path.parent.name if path.name == "model.safetensors" else path.name.removesuffix(".safetensors")
        return ", ".join([name, *(f"{k} {v}" for k, v in asdict(self).items() if v != getattr(usual, k))])

    @property
    def family(self) -> str:
        """The name shared by variants that differ in one setting only."""
        if not self.contact:
            return "all contact ignored"
        usual, name = Variant(self.model), self.label.partition(",")[0]
        knobs = {"nodes": "nodes", "sdf": "distances", "stride": "step", "substeps": "step"}
        return next((f"{name}: {what}" for k, what in knobs.items() if getattr(self, k) != getattr(usual, k)), name)


def variants(models: Sequence[str], *, quick: bool, nodes: bool = True) -> list[Variant]:
    """Each model with each of its settings changed separately, and two useful combinations; without `nodes`, those of
    nodes are left out."""
    chosen = []
    for name in models:
        knobs: list[dict[str, Any]] = [{}]
        if nodes:
            knobs += [{"nodes": f"thin {k}"} for k in ((64,) if quick else (32, 64, 128, 256))]
            knobs += [{"nodes": f"grid {k}"} for k in ((7,) if quick else (5, 7, 10))]
        if not stepper_of(load_model(name, weights=False)).network:
            knobs += [{"substeps": k} for k in ((2, 10) if quick else (1, 2, 3, 10, 20))]
            knobs += [{"sdf": kind} for kind in (() if quick else ("mlp", *(f"grid {k}" for k in GRIDS), "mesh"))]
            knobs += [{"stride": 2, "substeps": k} for k in ((1,) if quick else (1, 2, 4))]
        chosen += [Variant(name, **knob) for knob in knobs]
    return [*chosen, Variant(models[0], contact=False)]


def arranged(variant: Variant, cases: Cases) -> dict[str, Shape]:
    """The shapes with the nodes and distances of a variant."""
    shapes = {}
    kind, _, count = variant.nodes.partition(" ")
    for name, shape in cases.shapes.items():
        if variant.sdf != "own" and not isinstance(shape.sdf, ClosedForm):
            way, _, cells = variant.sdf.partition(" ")
            if way == "grid":
                pieces = own_pieces(shape)
                exact = PiecesDistance(pieces) if pieces else MeshDistance(shape.mesh)
                shape = replace(shape, pieces=(), sdf=sample_grid(exact, exact.bounds, int(cells)))
            else:
                shape = with_sdf(replace(shape, pieces=()), way)  # type: ignore[arg-type]
        if kind == "thin":
            shape = replace(shape, nodes=hull_nodes(shape.nodes, int(count)))
        elif kind == "grid":
            shape = with_nodes(shape, int(count))
        shapes[name] = shape
    return shapes


# --- measuring ---


def measure_ours(variant: Variant, cases: Cases) -> dict[str, Any]:
    """Errors and times of our simulator for one variant: see `_judged` and `_times`."""
    with peak_memory() as memory:
        began = time.perf_counter()
        model, shapes = load_model(variant.model), arranged(variant, cases)
        prepared = time.perf_counter() - began
        starts, steps = [every(t, variant.stride) for t in cases.starts], cases.steps // variant.stride
        motions = roll_out(
            model, starts, shapes, steps, contact=variant.contact, floor=cases.floor, substeps=variant.substeps
        )  # fmt: skip
    result = _judged(motions, cases, variant.stride) | {"prepare_s": prepared, "peak_mib": memory["mib"]}
    if result["exploded"]:
        return result
    return result | _times(lambda: _time_simulator(variant, model, shapes, cases), cases)


def _time_simulator(variant: Variant, model: Model, shapes: dict[str, Shape], cases: Cases) -> Timing:
    """One scene of the cases on its own, as `sdfsim simulate` runs it."""
    start = every(cases.starts[cases.timed], variant.stride)
    scene = scene_of([start], [0], shapes, cases.floor)[0]
    effects = replace(scene.effects, sleep="off", contact="auto" if variant.contact else "off")
    simulator = Simulator(replace(scene, effects=effects), model, dt=start.dt)
    simulator.options = simulator.options._replace(substeps=variant.substeps)
    steps = min(TIMED, cases.steps // variant.stride)
    taken = timed(lambda count: deque(simulator.steps(count), maxlen=0), steps)
    return Timing(taken.first_ms, taken.wall_ms / variant.stride, taken.cpu_ms / variant.stride)


def measure_engine(name: str, run: Engine, substeps: int, off: float, cases: Cases) -> dict[str, Any]:
    """Errors and times of an engine with `substeps` steps in a recorded step; starts differ by `off` m/s."""
    if abs(cases.recorded[0].dt - DT) > 1e-9:
        raise SdfsimError(f"recorded with another step than {DT} s")
    if lacking := sorted({str(n) for t in cases.recorded for n in t.shape} - set(cases.urdfs)):
        raise SdfsimError(f"no engine file of {', '.join(lacking)}")
    starts = []
    for k, t in enumerate(cases.recorded if name == "PyBullet" else cases.starts):
        motion = perturbed(t, off, [0, k])
        scene = scene_of([motion], [0], cases.shapes, cases.floor)[0]
        starts.append(Start(motion, cases.urdfs, cases.floor, cases.own_inertia, scene=scene))
    with peak_memory() as memory:
        motions = [run(start, cases.steps, substeps)[0] for start in starts]
    times = _times(lambda: run(starts[cases.timed], min(TIMED, cases.steps), substeps)[1], cases)
    return _judged(motions, cases) | {"peak_mib": memory["mib"]} | times


def _judged(motions: list[Trajectory], cases: Cases, stride: int = 1) -> dict[str, Any]:
    """Errors of motions in the scene's metres, penetration, energy gain, and whether they blew up."""
    if not all(np.isfinite(m.position).all() and np.isfinite(m.orientation).all() for m in motions):
        raise SdfsimError("a state is not finite")
    horizons = sorted({min(HORIZON, cases.steps), cases.steps})
    recorded = [every(first_frames(t, cases.steps + 1), stride) for t in cases.recorded]
    there = errors(motions, recorded, [h // stride for h in horizons])
    found = {str(h): there[str(h // stride)] for h in horizons}
    gain = energy_gain([first_frames(m, cases.steps + 1) for m in motions])
    depth = penetration(motions, cases.shapes)["percentile_95"]
    return {
        "translation_rmse": {h: cases.length * error["translation_rmse"] for h, error in found.items()},
        "translation_rmse_95": {
            h: [cases.length * end for end in error["translation_rmse_95"]] for h, error in found.items()
        },
        "rotation_error": {h: error["rotation_error"] for h, error in found.items()},
        "penetration_p95": None if depth is None else cases.length * depth,
        "energy_gain": gain["worst"],
        "exploded": gain["worst"] is not None and gain["worst"] > EXPLODED,
    }


def _times(run: Callable[[], Timing], cases: Cases) -> dict[str, Any]:
    """The time of a run relative to our default's, measured alternately with it, and the default's milliseconds per
    simulated second. A shared machine slows both alike. All runs use one thread and count processor time: wall time on
    a shared core depends on other processes.
    """
    model = load_model(SOLVER)
    repeats, usual = zip(
        *((run(), _time_simulator(Variant(SOLVER), model, cases.shapes, cases)) for _ in range(REPEATS)), strict=True
    )
    taken, default = (np.array([r.cpu_ms for r in part]) for part in (repeats, usual))
    return {
        "of_default": float(np.median(taken / default)),
        "of_default_p95": float(np.percentile(taken / default, 95)),
        "default_ms": float(np.median(default)) / (cases.recorded[0].dt * cases.time),
        "first_step_ms": float(np.median([r.first_ms for r in repeats])),
        "clock_over_processor": float(np.median([r.wall_ms / max(r.cpu_ms, 1e-9) for r in repeats])),
    }


# --- the study ---


def tradeoff(
    source: Path | None, out: Path, *, models: Sequence[str] = (), quick: bool = False,
    engines: Mapping[str, Engine], on_progress: StageProgress,
) -> dict[str, Any]:  # fmt: skip
    """Measure all contenders on recorded scenes and write tradeoff.csv, tradeoff.png and report.json.

    Args:
        source: dataset folder, or a scene file, which PyBullet then simulates; None: a random scene of boxes and balls.
        out: folder to write; results in it are kept.
        models: names or paths (empty: the solver).
        quick: fewer variants on fewer, shorter scenes.
        engines: those of `INNER` besides PyBullet, which is always there.

    Returns:
        The content of report.json: `points`, each with its label, its kind ("ours", "engine", "floor", "baseline"),
        the measurements, or why it `failed`; and `front`, the labels of our points that no other of ours beats, by
        time.

    Raises:
        SdfsimError: bad input, none of our variants could be measured, or another study writes to the same folder.
    """
    if source and not source.exists():
        raise SdfsimError(f"{source}: no such file or folder", "give a dataset or a scene.yaml")
    names = list(models) or [SOLVER]
    with locked(out), one_thread():
        on_progress("scenes", 0.0, "reading scenes and shapes")
        if source and source.is_dir():
            cases = load_cases(source, quick=quick)
        else:
            scene = load_scene(source, lambda f, m: on_progress("shapes", f, m)) if source else tossed((1,))
            cases = cases_of_scene(scene, names[0], out / "engine", quick=quick)
        kinds, families, jobs = {FLOOR_LABEL: "floor"}, {}, []
        content = [VERSION, machine(), replace(cases, urdfs={})]
        by_nodes = not all(own_pieces(shape) for shape in cases.shapes.values())  # convex pieces need no nodes
        for variant in variants(names, quick=quick, nodes=by_nodes):
            kinds[variant.label] = "ours" if variant.contact else "baseline"
            families[variant.label] = variant.family
            weights = load_model(variant.model) if variant.contact else None
            jobs.append(Job("cases", variant.label, [content, variant, weights], measure_ours, (variant, cases)))
        known = {"PyBullet": bullet, **engines}
        for name, run in known.items():
            for substeps in (INNER_QUICK if quick else INNER).get(name, ()):
                label = f"{name} {1e3 * DT / substeps:.3g} ms"
                kinds[label], families[label] = "engine", f"{name}: step"
                jobs.append(Job("cases", label, [content, label], measure_engine, (name, run, substeps, 0.0, cases)))
        jobs.append(Job("cases", FLOOR_LABEL, [content, OFF], measure_engine, ("PyBullet", bullet, 5, OFF, cases)))
        results = measure(jobs, out / "results", on_progress=lambda f, m: on_progress("measure", f, m))
        points = [{"label": label, "kind": kinds[label], **result} for (_, label), result in results.items()]
        usual = float(np.median([p["default_ms"] for p in points if "default_ms" in p] or [np.nan]))
        for point in points:
            if "of_default" in point:
                point |= {"ms": usual * point["of_default"], "ms_p95": usual * point["of_default_p95"]}
            if point.get("exploded"):
                point["failed"] = f"gains {point['energy_gain']:.1f} times its energy"
        steps = str(min(HORIZON, cases.steps))
        fine = [p for p in points if "failed" not in p]
        ours = [p for p in fine if p["kind"] == "ours"]
        if not ours:
            raise SdfsimError(f"none of our variants could be measured: {points[0]['failed']}")
        best = [ours[k] for k in front([p["ms"] for p in ours], [p["translation_rmse"][steps] for p in ours])]
        report = {
            "source": str(source or "a random scene"),
            "quick": quick,
            "sdfsim": __version__,
            "trajectories": len(cases.recorded),
            "bodies": int(sum((~t.static).sum() for t in cases.recorded)),
            "horizon_steps": int(steps),
            "points": points,
            "front": [p["label"] for p in best],
            "folder": str(out),
        }
        write_json(out / "report.json", report)
        write_text(out / "tradeoff.csv", table(points))
        picture(fine, families, report["front"], int(steps), out / "tradeoff.png")
        return report


def picture(
    points: Sequence[dict[str, Any]], families: dict[str, str], best: Sequence[str], steps: int, out: Path
) -> None:
    """Error against time, with a line for each family of labels. Families far from ours are named in the title and not
    drawn, as our points would otherwise be squeezed into a corner."""
    error = {p["label"]: p["translation_rmse"][str(steps)] for p in points}

    def along(name: str, points: Sequence[dict[str, Any]]) -> Line:
        points = sorted(points, key=lambda p: p["ms"])
        return Line(name, [p["ms"] for p in points], [error[p["label"]] for p in points])

    drawn: dict[str, list[dict[str, Any]]] = {}
    for point in points:
        if point["label"] != TRUTH and point["kind"] != "floor":
            drawn.setdefault(families[point["label"]], []).append(point)
    lines = [along(name, of) for name, of in drawn.items()]
    ours = [p for p in points if p["kind"] == "ours"]
    slowest, worst = FAR * max(p["ms"] for p in ours), FAR * max(error[p["label"]] for p in ours)
    beyond = [line.name for line in lines if min(line.x) > slowest or min(line.y) > worst]
    title = "lower left is better; dotted: the engine from starts 1 mm/s off"
    if beyond:
        title += f"\nnot drawn, beyond {FAR:g} times our largest time or error: {', '.join(beyond)}"
    axes = ("ms of computing per simulated second", f"translation RMSE over {steps} steps, m")
    front = along("our front", [p for p in ours if p["label"] in best])
    shown = [front, *(line for line in lines if line.name not in beyond)]
    draw([Panel(title, *axes, shown, "xy", error.get(FLOOR_LABEL))], out, size=(8.0, 4.5))


def table(points: list[dict[str, Any]]) -> str:
    """All points as CSV; errors have a column for each horizon."""
    rows = []
    for point in points:
        row: dict[str, Any] = {}
        for name, value in point.items():
            columns = (
                {f"{name}_{steps}": one for steps, one in value.items()} if isinstance(value, dict) else {name: value}
            )
            row |= {name: one for name, one in columns.items() if not isinstance(one, list)}
        rows.append({name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()})
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(name for row in rows for name in row)), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def report_table(report: dict[str, Any]) -> tuple[Rows, list[str]]:
    """The report as text: a row for each point, by time, and the places of the files."""
    steps, best = str(report["horizon_steps"]), set(report["front"])
    rows: Rows = [("", "ms / s", "p95", "m", "degrees", "penetration m", "MiB")]
    for p in sorted(report["points"], key=lambda p: p.get("ms", float("inf"))):
        if "failed" in p:
            rows.append((f"{p['label']}: {p['failed']}", *[""] * 6))
            continue
        values = (p["ms"], p["ms_p95"], p["translation_rmse"][steps], p["rotation_error"][steps])
        cells = map(number, (*values, p["penetration_p95"], p["peak_mib"]))
        rows.append((f"{p['label']} *" if p["label"] in best else p["label"], *cells))
    notes = [
        "milliseconds per simulated second: the ratio to our default, which ran in turn with each, times its median; "
        f"errors over {steps} steps; * is on the front of ours"
    ]
    return rows, [*notes, f"wrote {report['folder']}"]
