"""An evaluation as tables: rows of cells, the first row the head, for a terminal or a model card."""

from __future__ import annotations

from typing import Any

from sdfsim.console import columns
from sdfsim.data import metrics

SURVIVED = "0.25"  # m, the limit whose median survival time is shown
NOTHING = "-"
Rows = list[tuple[str, ...]]


def report_lines(report: dict[str, Any]) -> list[str]:
    """`evaluate`'s report for people: errors at every horizon, then the quality of the motion."""
    names = {"name": report["model_name"], "ballistic": "ballistic"}
    return [
        "Translation RMSE and mean rotation error up to each horizon (95 % intervals over trajectories)",
        *columns(error_rows(report, **names)),
        "",
        "Errors at a frame alone: translation is the mean over trajectories of the RMSE over bodies",
        *columns(error_rows(report, **names, at_frame=True, intervals=False)),
        "",
        *columns(quality_rows(report, **names)),
        "",
        *notes(report),
        f"{report['trajectories']} trajectories, {report['bodies']} bodies, "
        f"{report['ms_per_step_per_trajectory']:.2f} ms per step and trajectory",
    ]


def error_rows(
    report: dict[str, Any],
    *,
    name: str,
    ballistic: str,
    at_frame: bool = False,
    intervals: bool = True,
    extra: Rows | None = None,
) -> Rows:
    """Errors at every horizon, a row each for the model, the teacher run again, and flight without contact.

    Args:
        report: of `evaluate`.
        name: what the model is called.
        ballistic: what the baseline is called.
        at_frame: errors in a frame alone, at those of `metrics.FRAMES`; else over all steps up to a horizon.
        intervals: with those of 95 %.
        extra: further rows, below the model's (see `error_cells` and `range_cells`).
    """
    head = [""]
    for steps, errors in _shown(report["model"], at_frame).items():
        time = f"{f'frame {steps}' if at_frame else f'{steps} steps'} = {errors['seconds']:.3g} s"
        head += [f"m, {time}", f"degrees, {time}"]

    def cells(errors: dict[str, dict]) -> list[str]:
        return error_cells(errors, at_frame=at_frame, intervals=intervals)

    again = [(teacher_name(size), *cells(errors)) for size, errors in _perturbed(report).items()]
    mine = (name, *cells(report["model"]))
    return [tuple(head), mine, *(extra or []), *again, (ballistic, *cells(report["ballistic"]))]


def error_cells(horizons: dict[str, dict], *, at_frame: bool = False, intervals: bool = True) -> list[str]:
    """For each horizon, translation and rotation, with their intervals or without."""
    cells = []
    for errors in _shown(horizons, at_frame).values():
        for what, digits in (("translation_rmse", 3), ("rotation_error", 1)):
            ends = errors[f"{what}_95"] if intervals else None
            cells.append(_with_interval(errors[what], ends, digits))
    return cells


def range_cells(models: list[dict[str, dict]]) -> list[str]:
    """For each horizon, the lowest and highest translation and rotation error of models; one number if equal."""
    cells = []
    for steps in _shown(models[0], at_frame=False):
        for what, digits in (("translation_rmse", 3), ("rotation_error", 1)):
            values = [horizons[steps][what] for horizons in models]
            ends = dict.fromkeys(f"{value:.{digits}f}" for value in (min(values), max(values)))
            cells.append(" - ".join(ends))
    return cells


def _shown(horizons: dict[str, dict], at_frame: bool) -> dict[str, dict]:
    """What one of the two protocols shows of the errors at all horizons."""
    if at_frame:
        there = {steps: errors for steps, errors in horizons.items() if int(steps) in metrics.FRAMES}
        return {steps: {"seconds": errors["seconds"], **errors["at_frame"]} for steps, errors in there.items()}
    longest = max(map(int, horizons))
    return {steps: errors for steps, errors in horizons.items() if int(steps) in (*metrics.HORIZONS, longest)}


def quality_rows(report: dict[str, Any], *, name: str, ballistic: str) -> Rows:
    """Penetration, energy, rest and survival, with the teacher's recording beside the model."""
    head = ("", "penetration 95 %", "worst", "energy gain", "worst", "resting speed", f"within {SURVIVED} m for")
    length = max(errors["seconds"] for errors in report["model"].values())
    lasting = {who: _seconds(median[SURVIVED], length) for who, median in report["median_survival_s"].items()}
    again = [(teacher_name(size), lasting[f"teacher {size}"]) for size in _perturbed(report)]
    return [
        head,
        (name, *_quality_cells(report, "model"), lasting["model"]),
        ("teacher, recorded", *_quality_cells(report, "teacher"), NOTHING),
        *((who, *[NOTHING] * (len(head) - 2), time) for who, time in (*again, (ballistic, lasting["ballistic"]))),
    ]


def notes(report: dict[str, Any]) -> list[str]:
    """What has to be known beside the tables, a line each."""
    depth, floor = report["penetration"], report.get("chaos_floor", {})
    frames = {who: depth[who]["steps_with_contact"] for who in ("model", "teacher")}
    lines = [
        f"Penetration: the deepest node in every {depth['every']}th frame, of {frames['model']} with contact "
        f"(recorded: {frames['teacher']}).",
        "Energy gain: the largest over the energy at the start; mean and worst of the trajectories.",
        f"Resting speed: median of the {report['resting_speed']['bodies']} bodies that rest in the recording.",
        f"Within {SURVIVED} m: how long it takes until half of the bodies have been farther from the recording.",
    ]
    if shown := sorted(name for name, kind in depth["geometry"].items() if kind == "shown mesh"):
        lines.append(f"Without the engine's files, penetration is into the mesh that is shown of {', '.join(shown)}.")
    if (steps := report["steps"]) < report["steps_asked"]:
        lines.append(f"The shortest recording ends after {steps} steps; {report['steps_asked']} were asked for.")
    lines += [f"Outside the model's training: {line}." for line in report["outside_training"]]
    if not report["engine_substep"]:
        lines.append("No dataset.json tells the engine's inner step: velocities count as at the positions' instants.")
    if "left_out" in floor:
        lines.append(f"The teacher's chaos floor is left out: {floor['left_out']}.")
    elif floor:
        lines.append(
            "Run again unperturbed, the teacher departs from its recording by up to "
            f"{floor['median_farthest_unperturbed_m']:.1g} m (median of the trajectories)."
        )
    return lines


def teacher_name(size: str) -> str:
    """What the teacher run again from starts `size` m/s off is called."""
    return f"teacher, {size} m/s off"


def _perturbed(report: dict[str, Any]) -> dict[str, dict]:
    """Errors of the teacher run again, by perturbation, without the run that nothing perturbs: that one is a note."""
    runs = report.get("chaos_floor", {}).get("perturbations", {})
    return {size: errors for size, errors in runs.items() if size != "0"}


def _with_interval(value: float, ends: list[float] | None, digits: int) -> str:
    told = f"{value:.{digits}f}"
    return told if ends is None else f"{told} ({ends[0]:.{digits}f} to {ends[1]:.{digits}f})"


def _quality_cells(report: dict[str, Any], who: str) -> list[str]:
    depth, gain = report["penetration"][who], report["energy_gain"][who]
    return [
        _cell(depth["percentile_95"], "{:.4f} m"),
        _cell(depth["worst"], "{:.4f} m"),
        _cell(gain["mean"], "{:.2f} %", 100.0),
        _cell(gain["worst"], "{:.2f} %", 100.0),
        _cell(report["resting_speed"][who], "{:.4f} m/s"),
    ]


def _cell(value: float | None, form: str, unit: float = 1.0) -> str:
    return NOTHING if value is None else form.format(unit * value)


def _seconds(value: float | None, length: float) -> str:
    return f"> {length:g} s" if value is None else f"{value:.2f} s"
