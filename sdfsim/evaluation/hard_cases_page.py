"""The page of the hard cases: one HTML file that needs nothing else, and links to the recordings beside it."""

from __future__ import annotations

import base64
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any

import sdfsim
from sdfsim.evaluation.hard_cases import GROUPS, group_order
from sdfsim.evaluation.hard_cases_plots import group_picture
from sdfsim.evaluation.hard_cases_results import TEACHER, Study
from sdfsim.evaluation.hard_cases_tables import LEGEND, Cell, Row, columns, losses, rows
from sdfsim.files import write_text

PAGE = "index.html"
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 1250px; margin: 2em auto; padding: 0 1em; color: #222; }
table { border-collapse: collapse; margin: 0.6em 0 1em; font-size: 14px; }
th, td { border-bottom: 1px solid #ddd; padding: 0.25em 0.8em 0.25em 0; text-align: left; vertical-align: top; }
.missed { color: #b00020; font-weight: 600; }
.behind { color: #9a5b00; font-style: italic; }
.told { color: #555; }
h2 { margin: 1.8em 0 0.1em; font-size: 19px; }
img { max-width: 100%; }
"""


def write_report(study: Study, out: Path) -> dict[str, Any]:
    """Write the page into the folder of a study, and tell all that it shows as plain data.

    Raises:
        SdfsimError: the page cannot be written.
    """
    write_text(out / PAGE, page(study))
    recordings = {r.recording for r in study.results.values() if r.recording}
    return {
        "folder": str(out),
        "page": str(out / PAGE),
        "quick": study.quick,
        "models": losses(study),
        "columns": columns(study),
        "figures": [asdict(row) for row in rows(study)],
        "recordings": sorted(str(out / recording) for recording in recordings),
        "failed_checks": [
            f"{result.case} with {result.who} blew up: {result.broke[0]}"
            for result in study.results.values()
            if result.broke and result.who != TEACHER
        ],
    }


def report_table(study: Study) -> list[tuple[str, ...]]:
    """The table for a terminal: what is beyond what is wanted has a !, what is worse than the teacher a <."""
    head = ("case", "figure", "wanted", *columns(study))
    return [head, *((row.case, row.figure, row.wanted, *(_marked(cell) for cell in row.cells)) for row in rows(study))]


def report_notes(report: dict[str, Any]) -> list[str]:
    """What goes below the table: its marks, what was lost, and where to look."""
    return [
        "! beyond what is wanted, < worse than the teacher",
        *(f"{who}: {_summary(found)}" for who, found in report["models"].items()),
        f"wrote {report['page']} and {len(report['recordings'])} recordings",
    ]


def _marked(cell: Cell) -> str:
    return {"missed": "! ", "behind": "< "}.get(cell.state, "  ") + cell.text


def page(study: Study) -> str:
    """The whole page as text."""
    table = rows(study)
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8"><title>Hard cases</title>',
        f"<style>{STYLE}</style></head><body>",
        "<h1>Hard cases</h1>",
        f"<p>sdfsim {sdfsim.__version__}{', the short form' if study.quick else ''}. Teacher: PyBullet as it made the "
        "training data, on the same scenes. Each number is what was measured; none is left out.</p>",
        _list([f"{who}: {_summary(found)}" for who, found in losses(study).items()]),
        _list(list(LEGEND)),
    ]
    for name in group_order(study.cases):
        group = GROUPS[name]
        parts += [
            f"<h2>{escape(group.title)}</h2>",
            f"<p>Wanted: {escape(group.wanted)}.</p>",
            _table(study, [row for row in table if row.group == name]),
        ]
        if picture := group_picture(study, name):
            encoded = base64.b64encode(picture).decode()
            parts.append(f'<img alt="{escape(group.title)}" src="data:image/png;base64,{encoded}">')
    parts += _notes(study)
    return "\n".join([*parts, "</body></html>", ""])


def _summary(found: dict[str, int]) -> str:
    return ", ".join(f"{count} {what}" for what, count in found.items())


def _table(study: Study, table: list[Row]) -> str:
    head = ["case", "figure", "wanted", *columns(study)]
    lines = ["<table><tr>" + "".join(f"<th>{escape(name)}</th>" for name in head) + "</tr>"]
    before = ""
    for row in table:
        told = [row.case if row.case != before else "", row.figure, row.wanted]
        before = row.case
        cells = "".join(f"<td>{escape(text)}</td>" for text in told) + "".join(map(_cell, row.cells))
        lines.append(f"<tr>{cells}</tr>")
    return "\n".join([*lines, "</table>"])


def _cell(cell: Cell) -> str:
    link = f' <a href="{escape(cell.recording)}">recording</a>' if cell.recording and cell.state == "missed" else ""
    return f'<td class="{cell.state}">{escape(cell.text)}{link}</td>'


def _notes(study: Study) -> list[str]:
    """In what the cases lie outside the models' training, and everything that blew up."""
    outside, broke = [], []
    for case in study.cases:
        for who in study.who:
            if who == TEACHER or (result := study.results.get((case.name, who))) is None:
                continue
            outside += [f"{case.title}: {line}" for line in result.outside]
            broke += [f"{who}: {line}" for line in result.broke]
    found = [("Outside of training", outside), ("Blew up", broke)]
    parts = [part for title, lines in found if lines for part in (f"<h2>{title}</h2>", _list(lines))]
    return [*parts, "<p>A recording opens with <code>sdfsim view FILE.rrd</code>.</p>"]


def _list(lines: list[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"
