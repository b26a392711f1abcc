"""Runs the hard cases with models, PyBullet (the teacher) and other engines; makes their table, plots and report."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from sdfsim.apps.recording import save_rollout
from sdfsim.base.devices import pick_device
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import locked, write_json, write_text
from sdfsim.base.parallel import Progress, silent
from sdfsim.base.version import __version__
from sdfsim.data.public_shapes import public_folder
from sdfsim.data.pybullet_sim import DT, SUBSTEPS, TEACHER_VERSION, engine_settings, import_pybullet
from sdfsim.evaluation.engines import Engine, Ran, TooSlow, bullet, by_engine, by_model, shape_urdf, still
from sdfsim.evaluation.hard_cases import GROUPS, Case, Figure, cases, ran_away
from sdfsim.evaluation.harness import Job, Line, Panel, Results, draw, markdown, measure
from sdfsim.learned.model import SOLVER, Model, load_model
from sdfsim.physics.instruments import judged
from sdfsim.scene.scene import Scene
from sdfsim.sdf.closed_forms import PlaneSdf

VERSION = 5  # increase it when the measurements change, so that kept results are measured again
TEACHER = "teacher"
USUAL = {TEACHER: bullet}
OUTSIDE = "†"
WATCHED = 10.0  # s of a recording
OWN = 1e4  # estimated cost of a case that makes its own scenes, in the unit of `work`
LOOKED_AT = 20  # frames of a motion, evenly spaced, in which surfaces are measured
LEGEND = (
    "bold: beyond what is wanted, or the motion blew up",
    "italic: worse than the teacher by more than both spreads, where nothing else is wanted",
    f"{OUTSIDE}: outside of what the model has seen in training",
    "±: standard deviation over repetitions, started slightly off or with other random scenes",
)


@dataclass(frozen=True)
class Study:
    """All results of the hard cases."""

    cases: list[Case]
    models: list[str]
    engines: list[str]  # the teacher, if PyBullet is installed
    # (case, who) -> figures (name -> one value per repetition); lines of broke, outside and laws (which a motion of
    # ours breaks, by instruments that do not use the solve); recording (a path in the folder, or None). If a model or
    # engine does not take part in a case, there is no entry.
    results: Results
    quick: bool  # whether it is the short form

    @property
    def who(self) -> list[str]:
        """Models, then engines."""
        return [*self.models, *self.engines]


def stress(
    out: Path,
    *,
    models: Sequence[str] = (),
    quick: bool = False,
    shapes: Path | None = None,
    device: str = "cpu",
    engines: Mapping[str, Engine] = USUAL,
    on_progress: Progress = silent,
) -> Study:
    """Run every case for which `out` has no result yet. `out` gets results/, the engine's files, and in recordings/ a
    motion of each case that is not as wanted.

    Args:
        models: names or paths; none for the solver and the bundled networks on it.
        quick: fewer and shorter cases.
        shapes: folder of more meshes to rest on the floor, or name of a public set (see `public_folder`).
        engines: by name; the teacher is `TEACHER`.

    Raises:
        SdfsimError: no such model or device, two models with the same name, shapes that are unusable or cannot be
            fetched, another run in the folder, or a folder that cannot be written.
    """
    device = str(pick_device(device))
    tested = [load_model(name) for name in models or [SOLVER]]
    names, others = [model.name for model in tested], list(engines)
    if twice := {name for name in names if names.count(name) > 1}:
        raise SdfsimError(f"two models are called {min(twice)!r}", "rename a file: results are kept by name")
    found = cases(quick=quick, shapes=shapes and public_folder(shapes, on_progress))
    try:
        import_pybullet()
    except SdfsimError:
        others = [name for name in others if name != TEACHER]
    scenes = {case.name: [case.scenes(repeat) for repeat in range(case.repeats)] for case in found}

    def work(case: Case) -> float:
        """Estimated cost of a model, without a unit; a step costs time even without bodies."""
        if case.own:
            return OWN
        return case.seconds * sum(10 + len(scene.bodies) for repeat in scenes[case.name] for scene in repeat)

    jobs, cut = [], {}
    for case in sorted(found, key=work, reverse=True):
        figures = [figure.name for figure in case.figures]
        content = [VERSION, case.seconds, figures, scenes[case.name]]
        for model in tested:
            jobs.append(Job(case.name, model.name, [content, model, device], _tried, (case, model, device, out)))
        for name in others if case.engines else []:
            settings = [TEACHER_VERSION, engine_settings(DT, SUBSTEPS)]
            jobs.append(Job(case.name, name, [content, settings], _tried, (case, engines[name], device, out)))
            cut |= {id(shape): shape for scene in scenes[case.name][0] for shape in scene.shapes}
    with locked(out):
        for (
            shape
        ) in cut.values():  # before the work is split up, so that a mesh is not cut into pieces by two processes
            if not isinstance(shape.sdf, PlaneSdf):
                shape_urdf(shape, out / "engine")
        results = measure(jobs, out / "results", where="cores", on_progress=on_progress)
    if failed := [f"{case} with {one}: {r['failed']}" for (case, one), r in results.items() if "failed" in r]:
        raise SdfsimError(failed[0])
    return Study(found, names, others, results, quick)


def _tried(case: Case, model: Model | Engine, device: str, out: Path) -> dict[str, Any]:
    """All repetitions of a case with one model or engine: see `Study.results`."""
    figures: dict[str, list[float]] = {figure.name: [] for figure in case.figures}
    broke, outside, laws, recording = [], [], [], None
    for repeat in range(case.repeats):
        scenes = case.scenes(repeat)
        if case.own and isinstance(model, Model):
            for name, value in case.own(model).items():
                figures[name].append(value)
            continue
        runs = [ran(model, scene, case.seconds, device, out / "engine") for scene in scenes]
        measured = case.measure(runs)
        for name, values in figures.items():
            values.append(float(measured[name]))
        broke += [run.broke for run in runs if run.broke]
        for run in runs if isinstance(model, Model) else []:
            outside += run.rollout.meta["outside_training"]
            laws += judged(run.scene, run.rollout, every=max(1, len(run.rollout) // LOOKED_AT)).broken
        missed = any(f.limit is not None and measured[f.name] > f.limit for f in case.figures)
        shown = next((run for run in runs if run.broke), runs[0])
        if isinstance(model, Model) and not recording and (broke or missed):
            recording = f"recordings/{model.name}/{case.name}.rrd"
            (out / recording).parent.mkdir(parents=True, exist_ok=True)
            watched = shown.rollout.frames(0, int((shown.rollout.time <= WATCHED).sum()))
            save_rollout(shown.scene, watched, out / recording)
    lines = {"outside": list(dict.fromkeys(outside)), "laws": laws}
    return {"figures": figures, "broke": broke, "recording": recording, **lines}


def ran(who: Model | Engine, scene: Scene, seconds: float, device: str, folder: Path) -> Ran:
    """The motion of a scene by a model or by an engine; a motion that ran away or took too long counts as broken."""
    try:
        if isinstance(who, Model):
            run = by_model(scene, seconds, who, device)
        else:
            run = by_engine(scene, seconds, who, folder)
    except TooSlow as error:
        return still(scene, seconds, error.message)
    return run if run.broke else replace(run, broke=ran_away(run))


# --- what came out ---


def value(result: dict[str, Any], figure: Figure) -> float:
    """The mean of the repetitions, or the largest if that is what counts."""
    values = result["figures"][figure.name]
    return max(values) if figure.largest else statistics.fmean(values)


def noise(result: dict[str, Any], figure: Figure) -> float:
    """Standard deviation over the repetitions, 0 for a single one."""
    values = result["figures"][figure.name]
    return statistics.stdev(values) if len(values) > 1 else 0.0


def cell(study: Study, case: Case, figure: Figure, who: str) -> tuple[str, str]:
    """A figure with its spread, and its state: "missed" what is wanted, "behind" the teacher, "fine", or "shown"."""
    result, teacher = study.results.get((case.name, who)), study.results.get((case.name, TEACHER))
    if result is None:
        return "-", "shown"
    now, spread = value(result, figure), noise(result, figure)
    shown = f"{round(now, figure.digits) + 0.0:.{figure.digits}f}"  # avoids -0
    if float(f"{spread:.{figure.digits}f}") > 0:
        shown += f" ± {spread:.{figure.digits}f}"
    shown += f" {figure.unit}"
    if result["broke"]:
        shown = f"blew up: {result['broke'][0]} ({len(result['broke'])} in all); until then {shown}"
    elif result["outside"]:
        shown += f" {OUTSIDE}"
    if not figure.judged:
        return shown, "shown"
    if result["broke"] or (figure.limit is not None and now > figure.limit):
        return shown, "missed"
    if figure.limit is None and teacher and who != TEACHER and not teacher["broke"]:
        gap = now - value(teacher, figure)
        if (-gap if figure.longer else gap) > max(spread + noise(teacher, figure), 10.0**-figure.digits):
            return shown, "behind"
    return shown, "fine"


def rows(study: Study, marks: dict[str, str]) -> list[tuple[str, ...]]:
    """The table, its header first, with a row for each figure; `marks` (state -> text) surround those that are missed
    or behind."""
    table: list[tuple[str, ...]] = [("case", "figure", "wanted", *study.who)]
    for case in study.cases:
        for k, figure in enumerate(case.figures):
            found = [cell(study, case, figure, who) for who in study.who]
            wanted = "" if figure.limit is None else f"at most {figure.limit:g}"
            cells = (f"{marks.get(state, '')}{text}{marks.get(state, '')}" for text, state in found)
            table.append(("" if k else case.title, figure.name, wanted, *cells))
    return table


def losses(study: Study) -> dict[str, dict[str, int]]:
    """For each model the number of judged figures, and of those missed, behind the teacher, or blown up."""
    found = {}
    for who in study.who:
        mine = [case for case in study.cases if (case.name, who) in study.results]
        states = [cell(study, case, figure, who)[1] for case in mine for figure in case.figures]
        found[who] = {
            "figures": sum(state != "shown" for state in states),
            "missed": states.count("missed"),
            "behind the teacher": states.count("behind"),
            "cases that blew up": sum(bool(study.results[case.name, who]["broke"]) for case in mine),
        }
    return found


def loss_lines(study: Study) -> list[str]:
    return [f"{who}: {', '.join(f'{n} {what}' for what, n in lost.items())}" for who, lost in losses(study).items()]


def table(study: Study) -> str:
    """The whole study in Markdown: the losses, the legend, and a table for each group."""
    parts = ["\n".join(f"- {line}" for line in [*loss_lines(study), *LEGEND]) + "\n"]
    for name in dict.fromkeys(case.group for case in study.cases):
        part = replace(study, cases=[case for case in study.cases if case.group == name])
        parts += [f"**{GROUPS[name].title}**\n", markdown(rows(part, {"missed": "**", "behind": "*"}))]
    return "\n".join(parts)


def draw_group(study: Study, name: str, path: Path) -> bool:
    """Write a plot of one group's first figure along its cases. Returns False if these have no common axis."""
    group, along = GROUPS[name], [case for case in study.cases if case.group == name and case.x is not None]
    if len(along) < 2:
        return False
    figure, lines, places = along[0].figures[0], [], [case.x or 0.0 for case in along]
    for who in study.who:
        found = [study.results[case.name, who] for case in along]
        lines.append(Line(who, places, *([of(result, figure) for result in found] for of in (value, noise))))
    log = "x" if min(places) > 0 and max(places) > 20 * min(places) else ""
    draw([Panel(group.title, group.axis, f"{figure.name} ({figure.unit})", lines, log, figure.limit)], path)
    return True


def write_report(study: Study, out: Path) -> dict[str, Any]:
    """Write stress.md, its plots and report.json into the folder of a study.

    Returns:
        The content of report.json: `models` (see `losses`), `figures` by model, `broken_laws`, `recordings`, and
        `failed_checks`, a line for each case that blew up.
    """
    drawn = [name for name in GROUPS if draw_group(study, name, out / "plots" / f"{name}.png")]
    plots = "\n".join(f"![{GROUPS[name].title}](plots/{name}.png)" for name in drawn)
    outside = [
        f"- {who}, {case}: {line}"
        for (case, who), result in study.results.items()
        for line in [*result["broke"], *result["outside"]]
    ]
    broken = [(case, who, result["laws"]) for (case, who), result in study.results.items() if result["laws"]]
    parts = [
        "# Hard cases",
        f"sdfsim {__version__}. Teacher: PyBullet as it made the training data.",
        table(study),
        plots,
        "## Blew up, or outside of training",
        "\n".join(outside),
        "## Laws broken, by instruments that do not know the contacts",
        "\n".join(f"- {who}, {case}: {lines[0]} ({len(lines)} in all)" for case, who, lines in broken),
    ]
    write_text(out / "stress.md", "\n\n".join(parts) + "\n")
    report = {
        "folder": str(out),
        "table": str(out / "stress.md"),
        "quick": study.quick,
        "models": losses(study),
        "figures": figures(study),
        "broken_laws": [f"{case} with {who}: {line}" for case, who, lines in broken for line in lines],
        "recordings": sorted(str(out / r["recording"]) for r in study.results.values() if r["recording"]),
        "failed_checks": [
            f"{case} with {who} blew up: {result['broke'][0]}"
            for (case, who), result in study.results.items()
            if result["broke"] and who in study.models
        ],
    }
    write_json(out / "report.json", report)
    return report


def figures(study: Study) -> dict[str, dict[str, dict[str, float]]]:
    """By model or engine, then CASE/FIGURE: value and noise of every judged figure."""
    found: dict[str, dict] = {who: {} for who in study.who}
    judged = [(case.name, figure) for case in study.cases for figure in case.figures if figure.judged]
    for (case, figure), who in product(judged, study.who):
        if result := study.results.get((case, who)):
            found[who][f"{case}/{figure.name}"] = {"value": value(result, figure), "noise": noise(result, figure)}
    return found
