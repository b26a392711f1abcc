"""The results of the hard cases as a table: a row for each figure, a column for each model, the teacher last."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sdfsim.evaluation.hard_cases import GROUPS, Case, Figure
from sdfsim.evaluation.hard_cases_results import TEACHER, Result, Study

State = Literal["fine", "missed", "behind", "told"]
NOTHING = "-"
NO_TEACHER = "PyBullet is not installed"
OUTSIDE = "†"
LEGEND = (
    "bold: beyond what is wanted",
    "italic: worse than the teacher by more than both spreads, where nothing else is wanted",
    f"{OUTSIDE}: outside of what the model has seen in training",
    "±: standard deviation over repetitions, started slightly off or with other random scenes",
)


@dataclass(frozen=True)
class Cell:
    """One figure of one model.

    Attributes:
        text: value with its spread, or why there is none.
        state: "missed" what is wanted, "behind" the teacher, "fine", or "told" where nothing is judged.
        recording: file to watch, relative to the folder of the study.
    """

    text: str
    state: State = "told"
    recording: str | None = None


@dataclass(frozen=True)
class Row:
    """One figure of one case, and its cells in the order of `columns`."""

    group: str
    case: str
    figure: str
    wanted: str
    cells: tuple[Cell, ...]


def columns(study: Study) -> list[str]:
    """The models, then the teacher, which has a column even where PyBullet is absent."""
    return [*(who for who in study.who if who != TEACHER), TEACHER]


def rows(study: Study) -> list[Row]:
    """The whole table."""
    return [
        Row(
            case.group,
            case.title,
            figure.name,
            "" if figure.limit is None else f"at most {figure.limit:g}",
            tuple(_cell(study, case, figure, who) for who in columns(study)),
        )
        for case in study.cases
        for figure in case.figures
    ]


def losses(study: Study) -> dict[str, dict[str, int]]:
    """For each model how many judged figures there are, and how many are missed, behind the teacher, or blew up."""
    found = {}
    for place, who in enumerate(columns(study)[:-1]):
        states = [row.cells[place].state for row in rows(study)]
        blown = [case for case in study.cases if study.results[case.name, who].broke]
        found[who] = {
            "figures": sum(state != "told" for state in states),
            "missed": states.count("missed"),
            "behind the teacher": states.count("behind"),
            "cases that blew up": len(blown),
        }
    return found


def markdown(study: Study) -> list[str]:
    """The table as Markdown; what is missed is bold, what is behind the teacher italic."""
    head = ["case", "figure", "wanted", *columns(study)]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    group = case = ""
    for row in rows(study):
        if row.group != group:
            group, case = row.group, ""
            told = GROUPS[group]
            lines.append(f"| **{told.title}** |" + " |" * (len(head) - 1))
        marks = {"missed": "**", "behind": "*"}
        cells = [f"{marks.get(c.state, '')}{c.text}{marks.get(c.state, '')}" for c in row.cells]
        lines.append("| " + " | ".join([row.case if row.case != case else "", row.figure, row.wanted, *cells]) + " |")
        case = row.case
    return lines


def _cell(study: Study, case: Case, figure: Figure, who: str) -> Cell:
    result = study.results.get((case.name, who))
    if result is None:
        return Cell(NO_TEACHER if case.teacher and TEACHER not in study.who else NOTHING)
    if result.skipped:
        return Cell(result.skipped)
    text = _told(result, figure)
    state = _state(study, result, figure)
    return Cell(text, state, result.recording)


def _told(result: Result, figure: Figure) -> str:
    value = result.value(figure)
    assert value is not None
    text = f"{value:.{figure.digits}f}"
    noise = f"{result.noise(figure):.{figure.digits}f}"
    if float(noise) > 0:
        text += f" ± {noise}"
    text += f" {figure.unit}"
    if result.broke:
        text = f"blew up: {result.broke[0]} ({len(result.broke)} in all); until then {text}"
    return text + (f" {OUTSIDE}" if result.outside else "")


def _state(study: Study, result: Result, figure: Figure) -> State:
    if not figure.judged:
        return "told"
    if result.broke or result.missed(figure):
        return "missed"
    taught = study.results.get((result.case, TEACHER))
    if figure.limit is not None or result.who == TEACHER:
        return "fine"
    return "behind" if taught and not taught.broke and worse(result, taught, figure) else "fine"


def worse(result: Result, other: Result, figure: Figure) -> bool:
    """Whether a result is worse than another by more than both their spreads and what the table shows."""
    one, two = result.value(figure), other.value(figure)
    if one is None or two is None:
        return two is not None
    slack = max(result.noise(figure) + other.noise(figure), 10.0**-figure.digits)
    return (two - one if figure.longer else one - two) > slack
