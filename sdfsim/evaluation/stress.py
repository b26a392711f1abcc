"""Runs the hard cases with models and the teacher; their table, plots and report, and the ratchet."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import sdfsim
from sdfsim.data.public_shapes import public_folder
from sdfsim.data.pybullet_sim import DT, SUBSTEPS, TEACHER_VERSION, engine_settings, import_pybullet
from sdfsim.dynamics.model import SOLVER, Model, load_model, model_names
from sdfsim.dynamics.ranges import constant_in_training
from sdfsim.dynamics.rollout import Rollout
from sdfsim.dynamics.simulator import SimulationError, Simulator, pick_device
from sdfsim.errors import SdfsimError
from sdfsim.evaluation.engines import bullet, shape_urdf, start_of_scene
from sdfsim.evaluation.hard_cases import GROUPS, Case, Figure, Run, cases, ran_away
from sdfsim.evaluation.harness import Job, Line, Panel, Progress, Results, check_matplotlib, draw, markdown, measure
from sdfsim.files import locked, read_json, write_json, write_text
from sdfsim.scene.scene import Scene
from sdfsim.shape.sdf import PlaneSdf

VERSION = 2  # counts up when what is measured changes, so that kept results are measured again
TEACHER = "teacher"
OUTSIDE = "†"
WATCHED = 10.0  # s of a recording
SPREADS = 3.0  # so many standard deviations are noise
SHARE = 0.05  # of a figure: what another machine's rounding may change where repetitions agree
LEGEND = (
    "bold: beyond what is wanted, or the motion blew up",
    "italic: worse than the teacher by more than both spreads, where nothing else is wanted",
    f"{OUTSIDE}: outside of what the model has seen in training",
    "±: standard deviation over repetitions, started slightly off or with other random scenes",
)

Record = Callable[[Scene, Rollout, Path], None]


@dataclass(frozen=True)
class Study:
    """All results of the hard cases.

    Attributes:
        cases: what was run, in order.
        who: models, then the teacher where PyBullet is installed.
        results: (case, who) -> figures (name -> a value a repetition), broke and outside (lines), curve ([2, K]) and
            recording (a path in the folder, or None); nothing for a case that one cannot take part in.
        quick: whether it is the short form.
    """

    cases: list[Case]
    who: list[str]
    results: Results
    quick: bool


def stress(
    out: Path,
    *,
    models: Sequence[str] = (),
    quick: bool = False,
    shapes: Path | None = None,
    device: str = "cpu",
    record: Record | None = None,
    on_progress: Progress | None = None,
) -> Study:
    """Run every case that `out` does not hold the result of yet.

    Args:
        out: folder for results/, recordings/ and the engine's files.
        models: names or paths; none for the solver and all bundled networks.
        quick: fewer and shorter cases.
        shapes: folder of meshes that are to rest on the floor too, or name of a public set (see `public_folder`).
        device: cpu, cuda or auto.
        record: writes a motion of each case that is not as wanted into a file; None for no recordings.
        on_progress: called with (fraction, message).

    Raises:
        SdfsimError: no such model or device, two models of one name, unusable shapes or none to be fetched, another run
            in the folder, or a folder that cannot be written.
    """
    device = str(pick_device(device))
    tested = [load_model(name) for name in models or model_names()]
    who = [model.name for model in tested]
    if twice := {name for name in who if who.count(name) > 1}:
        raise SdfsimError(f"two models are called {min(twice)!r}", "rename a file: results are kept by name")
    found = cases(quick=quick, shapes=shapes and public_folder(shapes, on_progress))
    with_teacher = _teacher_is_here()
    jobs, cut = [], {}
    for case in found:
        repeats = [case.scenes(repeat) for repeat in range(case.repeats)]
        weight = _weight(case, repeats)
        content = [VERSION, case.seconds, case.steps, case.cuda, [figure.name for figure in case.figures], repeats]
        for model in tested:
            arguments = (case, model, device, out, record)
            if _takes_part(case, model):
                jobs.append(Job(case.name, model.name, [content, model, device], _tried, arguments, weight))
        if with_teacher and case.teacher:
            settings, arguments = [TEACHER_VERSION, engine_settings(DT, SUBSTEPS)], (case, None, "", out, None)
            jobs.append(Job(case.name, TEACHER, [content, settings], _tried, arguments, 0.05 * weight))
            cut |= {id(shape): shape for scene in repeats[0] for shape in scene.shapes}
    with locked(out):
        for shape in cut.values():  # before the work is split up, so that no two processes cut one mesh into pieces
            if not isinstance(shape.sdf, PlaneSdf):
                shape_urdf(shape, out / "engine")
        results = measure(jobs, out / "results", where="cores", on_progress=on_progress)
    if failed := [f"{case} with {one}: {r['failed']}" for (case, one), r in results.items() if "failed" in r]:
        raise SdfsimError(failed[0])
    return Study(found, [*who, TEACHER] if with_teacher else who, results, quick)


def _takes_part(case: Case, model: Model) -> bool:
    """Another device is for networks: the solver has none."""
    return not case.cuda or (model.kind != SOLVER and torch.cuda.is_available())


def _teacher_is_here() -> bool:
    try:
        import_pybullet()
    except SdfsimError:
        return False
    return True


def _weight(case: Case, repeats: list[list[Scene]]) -> float:
    """About how long a model takes, in no unit; a step has its price without bodies too."""
    seconds = case.seconds if case.steps is None else 0.02 * case.steps
    work = sum(10 + len(scene.bodies) for scenes in repeats for scene in scenes)
    return seconds * work * (2 if case.cuda else 1)


def _tried(case: Case, model: Model | None, device: str, out: Path, record: Record | None) -> dict[str, Any]:
    """All repetitions of a case with one model, or with the teacher: see `Study.results`."""
    figures: dict[str, list[float]] = {figure.name: [] for figure in case.figures}
    result: dict[str, Any] = {"figures": figures, "broke": [], "outside": [], "curve": [], "recording": None}
    if model and (about := GROUPS[case.group].about) in constant_in_training(model):
        result["outside"].append(f"{about} was constant in training, so it was not learned")
    for repeat in range(case.repeats):
        scenes = case.scenes(repeat)
        if model is None:
            runs = [_checked(scene, taught(scene, out / "engine", case.seconds, case.steps)) for scene in scenes]
        else:
            runs = simulated(case, scenes, model, device)
            result["outside"] += [line for run in runs for line in run.rollout.meta["outside_training"]]
        measured, curve = case.measure(runs)
        for name, values in figures.items():
            values.append(float(measured[name]))
        result["broke"] += [run.broke for run in runs if run.broke]
        if repeat == 0:
            result["curve"] = curve.tolist()
        missed = any(f.limit is not None and measured[f.name] > f.limit for f in case.figures)
        if record and model and result["recording"] is None and (result["broke"] or missed):
            shown = next((run for run in runs if run.broke), runs[0])
            path = Path("recordings") / model.name / f"{case.name}.rrd"
            (out / path).parent.mkdir(parents=True, exist_ok=True)
            record(shown.scene, shown.rollout.frames(0, int((shown.rollout.time <= WATCHED).sum())), out / path)
            result["recording"] = str(path)
    result["outside"] = list(dict.fromkeys(result["outside"]))
    return result


def simulated(case: Case, scenes: list[Scene], model: Model, device: str) -> list[Run]:
    """Every scene once; where the case is about another device, then once more there."""
    used = [(model, device)]
    if case.cuda:
        used.append((model, "cuda"))
    runs = []
    for one, place in used:
        for scene in scenes:
            try:
                runs.append(_checked(scene, Simulator(scene, one, place).run(seconds=case.seconds, steps=case.steps)))
            except SimulationError as error:
                runs.append(Run(scene, error.rollout, error.message))
    return runs


def taught(scene: Scene, folder: Path, seconds: float, steps: int | None = None) -> Rollout:
    """The teacher's motion of a scene, as a rollout of all its bodies without contact points. It has no sleep.

    Args:
        scene: see `start_of_scene`, which says what is refused.
        folder: of the engine's files.
        seconds: how long.
        steps: or so many steps of the teacher's own length.
    """
    start, rows = start_of_scene(scene, folder)
    motion, _ = bullet(start, steps or max(1, round(seconds / DT)))
    frames = len(motion.position)
    position, velocity, angular = np.zeros((3, frames, len(scene.bodies), 3))
    turn = np.tile([0.0, 0.0, 0.0, 1.0], (frames, len(scene.bodies), 1))
    position[:, rows], turn[:, rows] = motion.position, motion.quat_xyzw
    velocity[:, rows], angular[:, rows] = motion.velocity, motion.angular_velocity
    return Rollout(
        time=np.arange(frames) * DT,
        position=position,
        orientation=turn,
        velocity=velocity,
        angular_velocity=angular,
        contact_count=np.zeros(frames, dtype=np.int64),
        contact_point=np.zeros((0, 3)),
        contact_body=np.zeros((0, 2), dtype=np.int64),
        names=tuple(b.name for b in scene.bodies),
        meta={"model": TEACHER, "dt": DT},
    )


def _checked(scene: Scene, rollout: Rollout) -> Run:
    """A complete motion; one that ran away counts as broken."""
    run = Run(scene, rollout)
    return replace(run, broke=ran_away(run))


# --- what came out ---


def value(result: dict[str, Any], figure: Figure) -> float:
    """The mean of the repetitions, or the largest where that is what counts."""
    values = result["figures"][figure.name]
    return max(values) if figure.largest else statistics.fmean(values)


def noise(result: dict[str, Any], figure: Figure) -> float:
    """Standard deviation over the repetitions, 0 for a single one."""
    values = result["figures"][figure.name]
    return statistics.stdev(values) if len(values) > 1 else 0.0


def cell(study: Study, case: Case, figure: Figure, who: str) -> tuple[str, str]:
    """A figure with its spread, and its state: "missed" what is wanted, "behind" the teacher, "fine", or "told"."""
    result, teacher = study.results.get((case.name, who)), study.results.get((case.name, TEACHER))
    if result is None:
        return "-", "told"
    now, spread = value(result, figure), noise(result, figure)
    shown = f"{round(now, figure.digits) + 0.0:.{figure.digits}f}"  # no minus before a zero
    if float(f"{spread:.{figure.digits}f}") > 0:
        shown += f" ± {spread:.{figure.digits}f}"
    shown += f" {figure.unit}"
    if result["broke"]:
        shown = f"blew up: {result['broke'][0]} ({len(result['broke'])} in all); until then {shown}"
    elif result["outside"]:
        shown += f" {OUTSIDE}"
    if not figure.judged:
        return shown, "told"
    if result["broke"] or (figure.limit is not None and now > figure.limit):
        return shown, "missed"
    if figure.limit is None and teacher and who != TEACHER and not teacher["broke"]:
        gap = now - value(teacher, figure)
        if (-gap if figure.longer else gap) > max(spread + noise(teacher, figure), 10.0**-figure.digits):
            return shown, "behind"
    return shown, "fine"


def rows(study: Study, marks: dict[str, str]) -> list[tuple[str, ...]]:
    """The table, its head first, a row a figure; `marks` (state -> text) stand around what is missed or behind."""
    table: list[tuple[str, ...]] = [("case", "figure", "wanted", *study.who)]
    for case in study.cases:
        for k, figure in enumerate(case.figures):
            found = [cell(study, case, figure, who) for who in study.who]
            wanted = "" if figure.limit is None else f"at most {figure.limit:g}"
            cells = (f"{marks.get(state, '')}{text}{marks.get(state, '')}" for text, state in found)
            table.append(("" if k else case.title, figure.name, wanted, *cells))
    return table


def losses(study: Study) -> dict[str, dict[str, int]]:
    """For each model how many judged figures there are, and how many are missed, behind the teacher, or blew up."""
    found = {}
    for who in study.who:
        mine = [case for case in study.cases if (case.name, who) in study.results]
        states = [cell(study, case, figure, who)[1] for case in mine for figure in case.figures]
        found[who] = {
            "figures": sum(state != "told" for state in states),
            "missed": states.count("missed"),
            "behind the teacher": states.count("behind"),
            "cases that blew up": sum(bool(study.results[case.name, who]["broke"]) for case in mine),
        }
    return found


def table(study: Study) -> str:
    """The whole study in Markdown: what was lost, the legend, and a table for each group."""
    lines = [
        f"- {who}: {', '.join(f'{n} {what}' for what, n in found.items())}" for who, found in losses(study).items()
    ]
    lines += [f"- {line}" for line in LEGEND]
    parts = ["\n".join(lines) + "\n"]
    for name, group in groups(study).items():
        part = replace(study, cases=[case for case in study.cases if case.group == name])
        parts += [f"**{group.title}**\n", markdown(rows(part, {"missed": "**", "behind": "*"}))]
    return "\n".join(parts)


def groups(study: Study) -> dict[str, Any]:
    """The groups that a study has cases of, in order."""
    return {name: GROUPS[name] for name in dict.fromkeys(case.group for case in study.cases)}


def draw_group(study: Study, name: str, path: Path) -> bool:
    """Write one group's plots: the first figure along the cases, then what each case draws; False if there are none."""
    group, members = GROUPS[name], [case for case in study.cases if case.group == name]
    along = [case for case in members if case.x is not None]
    panels = []
    if len(along) > 1:
        figure, lines = along[0].figures[0], []
        for who in study.who:
            done = [case for case in along if (case.name, who) in study.results]
            found = [study.results[case.name, who] for case in done]
            level, spread = ([f(result, figure) for result in found] for f in (value, noise))
            lines.append(Line(who, [case.x or 0.0 for case in done], level, spread))
        places = [case.x or 0.0 for case in along]
        log = "x" if min(places) > 0 and max(places) > 20 * min(places) else ""
        panels.append(Panel("all", group.axis, f"{figure.name} ({figure.unit})", lines, log, figure.limit))
    for case in members:
        curves = {who: study.results[case.name, who]["curve"] for who in study.who if (case.name, who) in study.results}
        lines = [Line(who, *curve) for who, curve in curves.items() if curve and curve[0]]
        if lines:
            panels.append(Panel(case.title, *group.curve, lines))
    if panels:
        draw(panels, path)
    return bool(panels)


def write_report(study: Study, out: Path) -> dict[str, Any]:
    """Write stress.md, its plots and report.json into the folder of a study.

    Returns:
        The content of report.json: `models` (see `losses`), `figures` by model, `recordings`, and `failed_checks`, a
        line for each case that blew up.
    """
    check_matplotlib()
    drawn = [name for name in groups(study) if draw_group(study, name, out / "plots" / f"{name}.png")]
    form = "the short form" if study.quick else "the long form"
    head = f"# Hard cases\n\nsdfsim {sdfsim.__version__}, {form}. Teacher: PyBullet as it made the training data.\n\n"
    plots = "\n".join(f"![{GROUPS[name].title}](plots/{name}.png)" for name in drawn)
    told = [
        f"- {who}, {case}: {line}"
        for (case, who), result in study.results.items()
        for line in [*result["broke"], *result["outside"]]
    ]
    write_text(
        out / "stress.md",
        f"{head}{table(study)}\n{plots}\n\n## Blew up, or outside of training\n\n" + "\n".join(told) + "\n",
    )
    recordings = {str(out / r["recording"]) for r in study.results.values() if r["recording"]}
    report = {
        "folder": str(out),
        "table": str(out / "stress.md"),
        "quick": study.quick,
        "models": losses(study),
        "figures": figures(study),
        "recordings": sorted(recordings),
        "failed_checks": [
            f"{case} with {who} blew up: {result['broke'][0]}"
            for (case, who), result in study.results.items()
            if result["broke"] and who != TEACHER
        ],
    }
    write_json(out / "report.json", report)
    return report


# --- the ratchet ---


def figures(study: Study) -> dict[str, dict[str, dict[str, float]]]:
    """By model or teacher, then CASE/FIGURE: value and noise of every judged figure."""
    found: dict[str, dict] = {who: {} for who in study.who}
    for case in study.cases:
        for who in study.who:
            for figure in case.figures:
                if figure.judged and (result := study.results.get((case.name, who))):
                    entry = {"value": value(result, figure), "noise": noise(result, figure)}
                    found[who][f"{case.name}/{figure.name}"] = entry
    return found


def accepted(study: Study) -> dict[str, Any]:
    """What the ratchet file holds: each model's figures, and the cases in which it blew up."""
    models = {}
    for who, found in figures(study).items():
        if who != TEACHER:
            blown = [case for (case, one), result in study.results.items() if one == who and result["broke"]]
            models[who] = {"figures": found, "blew_up": blown}
    return {"quick": study.quick, "models": models}


def slipped_back(study: Study, file: Path) -> list[str]:
    """One line for every figure that is clearly worse than accepted, and for every case that blows up now and did not.

    Raises:
        SdfsimError: the file is unreadable, of the other form, or does not know a model of the study.
    """
    ratchet, now = read_json(file, "write it with benchmarks/hard_cases.py"), accepted(study)
    if ratchet["quick"] != study.quick:
        raise SdfsimError(f"{file}: made with the {'short' if ratchet['quick'] else 'long'} form of the cases")
    worse = []
    for who, entry in now["models"].items():
        if who not in ratchet["models"]:
            raise SdfsimError(f"{file}: knows no model {who!r}", "write it anew with benchmarks/hard_cases.py")
        was = ratchet["models"][who]
        worse += [f"{who}: {case}: blew up" for case in entry["blew_up"] if case not in was["blew_up"]]
        for case in study.cases:
            for figure in case.figures:
                key = f"{case.name}/{figure.name}"
                before, after = was["figures"].get(key), entry["figures"].get(key)
                if before is None or after is None:
                    continue
                slack = max(SPREADS * before["noise"], SHARE * abs(before["value"]), 10.0**-figure.digits)
                gap = after["value"] - before["value"]
                if (-gap if figure.longer else gap) > slack:
                    accepted_was = f"accepted {before['value']:.4g} ± {before['noise']:.2g}"
                    worse.append(f"{who}: {key} {after['value']:.4g} {figure.unit}, {accepted_was}")
    return worse
