"""Measurements as data: every benchmark writes `benchmarks/results/NAME.json`, and `render` shows them on pages."""

import json
import os
import platform
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from sdfsim.base.files import read_json, write_text
from sdfsim.evaluation.harness import markdown

ROOT = Path(__file__).resolve().parents[1]
RECORDS = Path(__file__).with_name("results")
UNKNOWN = "unknown"
Out = Annotated[Path, typer.Option("-o", "--out")]  # a benchmark's folder
# A number, a text, [value, lowest, highest], or None for what is unknown.
Cell = float | str | Sequence[float | None] | None


@dataclass(frozen=True)
class Record:
    """A table, and how it was measured."""

    command: str
    day: str  # in ISO form
    commit: str
    machine: str
    data: str  # what was measured, and on which data
    columns: list[str]
    rows: list[list[Any]]  # of `Cell`; where ours is worse comes first
    notes: list[str]  # lines below the table

    def save(self, name: str) -> None:
        rows = ",\n".join(f"    {json.dumps(row, allow_nan=False)}" for row in self.rows)
        text = json.dumps(asdict(self) | {"rows": []}, indent=2)
        write_text(RECORDS / f"{name}.json", text.replace('"rows": []', f'"rows": [\n{rows}\n  ]') + "\n")


def read_record(name: str) -> Record:
    """A record by its name. Raises SdfsimError if there is none."""
    return Record(**read_json(RECORDS / f"{name}.json"))


def write_record(
    name: str, command: str, data: str, columns: Sequence[str], rows: Sequence[Sequence[Cell]],
    notes: Sequence[str] = (),
) -> None:  # fmt: skip
    """Print a measurement, and keep it with today's day, the commit and the machine. Numbers keep three digits."""
    commit = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True)
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    kept = [[_rounded(cell) for cell in row] for row in rows]
    print(table(columns, kept), *notes, sep="\n", flush=True)
    day = date.today().isoformat()
    Record(command, day, commit.stdout.strip() or UNKNOWN, machine, data, [*columns], kept, [*notes]).save(name)


def _rounded(cell: Any) -> Any:
    if isinstance(cell, str) or cell is None or isinstance(cell, int):
        return cell
    if np.ndim(cell):
        return [_rounded(one) for one in cell]
    value = float(cell)
    return float(f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}") if np.isfinite(value) else None


def shown(cell: Any) -> str:
    """A cell as pages show it."""
    if isinstance(cell, list):
        return "{} ({} to {})".format(*map(shown, cell))
    if cell is None:
        return "-"
    return cell if isinstance(cell, str) else f"{cell:,.10g}"


def table(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table in Markdown."""
    return markdown([columns, *([shown(cell) for cell in row] for row in rows)])


# --- measuring ---


def progress(fraction: float, message: str) -> None:
    print(f"{fraction:6.1%}  {message}", flush=True)


def in_turn(calls: Sequence[Callable[[], Any]], rounds: int) -> np.ndarray:
    """Results of the calls, [rounds, calls, ...], in alternating order, so that other work on the machine slows all of
    them alike. A first round, which loads and compiles, is left out."""
    return np.array([[call() for call in calls] for _ in range(rounds + 1)])[1:]


def spread(values: np.ndarray) -> list[float]:
    """Median and range of [rounds]."""
    return [float(np.median(values)), float(values.min()), float(values.max())]
