"""Runs the table of laws with models, PyBullet (the teacher) and other engines; makes its tables, plots and report."""

import inspect
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import isfinite
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
from sdfsim.evaluation import instruments
from sdfsim.evaluation.engines import Engine, Ran, TooSlow, bullet, by_engine, by_model, still
from sdfsim.evaluation.harness import Job, Line, Panel, Results, draw, markdown, measure
from sdfsim.evaluation.instruments import judged
from sdfsim.evaluation.laws import everyday, hard_cases, joints, scenes, textbook
from sdfsim.evaluation.laws.hard_cases import ran_away
from sdfsim.evaluation.laws.scenes import Check, Law
from sdfsim.evaluation.laws.table import GROUPS, laws, settings
from sdfsim.learned.model import SOLVER, Model, load_model
from sdfsim.scene.scene import Scene

MEASURED = (
    everyday,
    hard_cases,
    joints,
    scenes,
    textbook,
    instruments,
)  # if their source changes, kept results are not used
TEACHER = "teacher"
USUAL = {TEACHER: bullet}
OUTSIDE = "†"
WATCHED = 10.0  # s of a recording
LOOKED_AT = 20  # frames of a motion, evenly spaced, in which surfaces are measured
LEGEND = (
    "bold: beyond what is wanted, or the motion blew up",
    "italic: worse than the teacher by more than both spreads, where nothing else is wanted",
    f"{OUTSIDE}: outside of what the model has seen in training",
    "±: standard deviation over repetitions, started slightly off or with other random scenes",
)


@dataclass(frozen=True)
class Figure(Check):
    """A check with its values in several repetitions; `measured` is their mean, or the worst if that counts."""

    noise: float = 0.0  # standard deviation, 0 for a single repetition


@dataclass(frozen=True)
class Study:
    """All results of the table of laws."""

    laws: list[Law]
    models: list[str]
    engines: list[str]  # the teacher, if PyBullet is installed
    # (law, who) -> figures (one record each, as `Figure`); lines of broke, outside and broken_laws (which a motion of
    # ours breaks, by instruments that do not use the solve); recording (a path in the folder, or None). If a model or
    # engine does not take part in a law, there is no entry.
    results: Results
    quick: bool  # whether it is the short form

    @property
    def who(self) -> list[str]:
        """Models, then engines."""
        return [*self.models, *self.engines]

    def figures(self, law: Law, who: str) -> dict[str, Figure]:
        """By name."""
        found = self.results.get((law.name, who), {}).get("figures", ())
        return {known["name"]: Figure(**known) for known in found}


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
    """Check every law for which `out` has no result yet. `out` gets results/, the engines' files, and in recordings/ a
    motion of each law that is not as wanted.

    Args:
        models: names or paths; none for the solver.
        quick: fewer and shorter scenes.
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
    more = hard_cases.meshes(public_folder(shapes, on_progress)) if shapes else {}
    found = laws(quick=quick, shapes=more)
    try:
        import_pybullet()
    except SdfsimError:
        others = [name for name in others if name != TEACHER]
    content = [quick, more, *map(inspect.getsource, MEASURED)]
    teacher = [TEACHER_VERSION, engine_settings(DT, SUBSTEPS)]
    jobs = []
    for law in found:
        for model in tested:
            jobs.append(Job(law.name, model.name, [content, model, device], _tried, (law, model, device, out, quick)))
        for name in others if law.engines else []:
            jobs.append(Job(law.name, name, [content, teacher], _tried, (law, engines[name], device, out, quick)))
    with locked(out):
        results = measure(jobs, out / "results", where="cores", on_progress=on_progress)
    if failed := [f"{law} with {one}: {r['failed']}" for (law, one), r in results.items() if "failed" in r]:
        raise SdfsimError(failed[0])
    return Study(found, names, others, results, quick)


def _tried(law: Law, who: Model | Engine, device: str, out: Path, quick: bool) -> dict[str, Any]:
    """All repetitions of a law with one model or engine: see `Study.results`."""
    runs: list[Ran] = []

    def run(scene: Scene, seconds: float) -> Ran:
        # Engines have files of their own for each law: two processes must not cut one mesh into pieces at once.
        runs.append(ran(who, scene, seconds, device, out / "engine" / law.name))
        return runs[-1]

    if law.counted:
        held: list[bool] = []
        for at in settings(law, quick=quick):
            try:
                held += [check.holds for check in law.checks(replace(at, by=run))]
            except SdfsimError:  # what a model refuses is one check that does not hold
                held.append(False)
        fail = Figure("fail", float(held.count(False)), high=0.0, unit="checks", digits=0)
        found = [fail, Figure("checks", float(len(held)), unit="in all", digits=0, better=0)]
        return {"figures": list(map(_record, found)), "broke": [], "outside": [], "laws": [], "recording": None}
    repeats, outside, broken, recording = [], [], [], None
    for repeat in range(law.repeats):
        before = len(runs)
        repeats.append(list(law.checks(scenes.Setting(by=run, repeat=repeat))))
        shown = next((one for one in runs[before:] if one.broke), runs[before])
        if not isinstance(who, Model):
            continue
        for one in runs[before:]:
            outside += one.rollout.meta["outside_training"]
            broken += judged(one.scene, one.rollout, every=max(1, len(one.rollout) // LOOKED_AT)).broken
        if not recording and (shown.broke or not all(check.holds for check in repeats[-1])):
            recording = f"recordings/{who.name}/{law.name}.rrd"
            (out / recording).parent.mkdir(parents=True, exist_ok=True)
            watched = shown.rollout.frames(0, int((shown.rollout.time <= WATCHED).sum()))
            save_rollout(shown.scene, watched, out / recording)
    return {
        "figures": [_record(_figure(alike)) for alike in zip(*repeats, strict=True)],
        "broke": [one.broke for one in runs if one.broke],
        "outside": list(dict.fromkeys(outside)),
        "laws": broken,
        "recording": recording,
    }


def _figure(alike: Sequence[Check]) -> Figure:
    values = [float(check.measured) for check in alike]
    counts = max(values) if alike[0].worst else statistics.fmean(values)
    noise = statistics.stdev(values) if len(values) > 1 else 0.0
    known: dict[str, Any] = asdict(alike[0]) | {"measured": counts, "noise": noise}
    return Figure(**known)


def _record(figure: Figure) -> dict[str, Any]:
    """What JSON can hold: without limits that are infinite."""
    return {name: value for name, value in asdict(figure).items() if name not in ("low", "high") or isfinite(value)}


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


def cell(study: Study, law: Law, name: str, who: str) -> tuple[str, str]:
    """A figure with its spread, and its state: "missed" what is wanted, "behind" the teacher, "fine", or "shown"."""
    figure, best = study.figures(law, who).get(name), study.figures(law, TEACHER).get(name)
    if figure is None:
        return "-", "shown"
    result, teacher = study.results[law.name, who], study.results.get((law.name, TEACHER))
    shown = f"{round(figure.measured, figure.digits) + 0.0:.{figure.digits}f}"  # avoids -0
    if float(f"{figure.noise:.{figure.digits}f}") > 0:
        shown += f" ± {figure.noise:.{figure.digits}f}"
    shown += f" {figure.unit}"
    if result["broke"]:
        shown = f"blew up: {result['broke'][0]} ({len(result['broke'])} in all); until then {shown}"
    elif result["outside"]:
        shown += f" {OUTSIDE}"
    if not figure.better:
        return shown, "shown"
    if result["broke"] or not figure.holds:
        return shown, "missed"
    if not figure.wanted and best and teacher and who != TEACHER and not teacher["broke"]:
        gap = figure.better * (best.measured - figure.measured)
        if gap > max(figure.noise + best.noise, 10.0**-figure.digits):
            return shown, "behind"
    return shown, "fine"


def rows(study: Study, marks: dict[str, str]) -> list[tuple[str, ...]]:
    """The table, its header first, with a row for each figure; `marks` (state -> text) surround those that are missed
    or behind."""
    table: list[tuple[str, ...]] = [("case", "figure", "wanted", *study.who)]
    for law in study.laws:
        for k, figure in enumerate(study.figures(law, study.models[0]).values()):
            found = [cell(study, law, figure.name, who) for who in study.who]
            cells = (f"{marks.get(state, '')}{text}{marks.get(state, '')}" for text, state in found)
            table.append(("" if k else law.title, figure.name, figure.wanted, *cells))
    return table


def losses(study: Study) -> dict[str, dict[str, int]]:
    """For each model the number of judged figures, and of those missed, behind the teacher, or blown up."""
    found = {}
    for who in study.who:
        states = [cell(study, law, name, who)[1] for law in study.laws for name in study.figures(law, who)]
        found[who] = {
            "figures": sum(state != "shown" for state in states),
            "missed": states.count("missed"),
            "behind the teacher": states.count("behind"),
            "cases that blew up": sum(bool(r["broke"]) for (_, one), r in study.results.items() if one == who),
        }
    return found


def loss_lines(study: Study) -> list[str]:
    return [f"{who}: {', '.join(f'{n} {what}' for what, n in lost.items())}" for who, lost in losses(study).items()]


def table(study: Study) -> str:
    """The whole study in Markdown: the losses, the legend, and a table for each group."""
    parts = ["\n".join(f"- {line}" for line in [*loss_lines(study), *LEGEND]) + "\n"]
    for name in dict.fromkeys(law.group for law in study.laws):
        part = replace(study, laws=[law for law in study.laws if law.group == name])
        parts += [f"**{GROUPS[name].title}**\n", markdown(rows(part, {"missed": "**", "behind": "*"}))]
    return "\n".join(parts)


def draw_group(study: Study, name: str, path: Path) -> bool:
    """Write a plot of one group's first figure along its laws. Returns False if these have no common axis."""
    along = [law for law in study.laws if law.group == name and law.x is not None]
    if len(along) < 2:
        return False
    lines, places = [], [law.x or 0.0 for law in along]
    for who in study.who:
        found = [next(iter(study.figures(law, who).values())) for law in along]
        lines.append(Line(who, places, [one.measured for one in found], [one.noise for one in found]))
    first = next(iter(study.figures(along[0], study.who[0]).values()))
    log = "x" if min(places) > 0 and max(places) > 20 * min(places) else ""
    limit = first.high if first.wanted else None
    title, axis = GROUPS[name]
    draw([Panel(title, axis, f"{first.name} ({first.unit})", lines, log, limit)], path)
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
    """By model or engine, then LAW/FIGURE: value and noise of every judged figure."""
    found: dict[str, dict] = {who: {} for who in study.who}
    for who in study.who:
        for law in study.laws:
            for one in study.figures(law, who).values():
                if one.better:
                    found[who][f"{law.name}/{one.name}"] = {"value": one.measured, "noise": one.noise}
    return found
