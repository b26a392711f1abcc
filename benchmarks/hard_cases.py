"""The records of the hard cases, and the ratchet for later models.

    python -m benchmarks hard_cases -o DIR [--quick]

Runs the hard cases in DIR (their short form in DIR/quick) that have no results there yet; then writes the records and
benchmarks/hard_cases_ratchet.json from the short form, which the slow test runs.
With --quick the table is that of the short form too.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.engines import drake, mujoco
from benchmarks.records import Out, progress, write_record
from sdfsim.apps.stress import (
    LEGEND,
    TEACHER,
    USUAL,
    Study,
    figures,
    losses,
    rows,
    stress,
    write_report,
)
from sdfsim.base.files import read_json, write_json
from sdfsim.evaluation.laws.table import GROUPS

ENGINES = USUAL | {"MuJoCo": mujoco, "Drake": drake}
RATCHET = Path(__file__).with_name("hard_cases_ratchet.json")
SPREADS = 3.0  # standard deviations that count as noise
SHARE = 0.05  # of a figure: possible change by another machine's rounding if repetitions agree


def accepted(study: Study) -> dict[str, Any]:
    """The content of the ratchet file: each model's figures, and the cases in which it blew up."""
    models = {}
    for who, found in figures(study).items():
        if who in study.models:
            blown = [case for (case, one), result in study.results.items() if one == who and result["broke"]]
            models[who] = {"figures": found, "blew_up": blown}
    return {"quick": study.quick, "models": models}


def slipped_back(study: Study, file: Path) -> list[str]:
    """A line for every figure of a study that is clearly worse than in the ratchet, and for every new blow-up."""
    worse = []
    for who, now in accepted(study)["models"].items():
        was = read_json(file)["models"][who]
        worse += [f"{who}: {case}: blew up" for case in now["blew_up"] if case not in was["blew_up"]]
        for law in study.laws:
            for name, figure in study.figures(law, who).items():
                before = was["figures"].get(f"{law.name}/{name}")
                if before is None or not figure.better:
                    continue
                slack = max(SPREADS * before["noise"], SHARE * abs(before["value"]), 10.0**-figure.digits)
                if figure.better * (before["value"] - figure.measured) > slack:
                    accepted_was = f"accepted {before['value']:.4g} ± {before['noise']:.2g}"
                    worse.append(f"{who}: {law.name}/{name} {figure.measured:.4g} {figure.unit}, {accepted_was}")
    return worse


def main(*, out: Out, quick: bool = False) -> None:
    study = stress(out / "quick", quick=True, engines=ENGINES, on_progress=progress)
    write_report(study, out / "quick")
    write_json(RATCHET, accepted(study))
    if not quick:
        study = stress(out, engines=ENGINES, on_progress=progress)
        write_report(study, out)
    command = f"python -m benchmarks hard_cases -o DIR{' --quick' if quick else ''}"
    measured, who = f"The hard cases{' in their short form' if quick else ''}", losses(study)
    write_record(
        "hard_cases_counts", command, f"{measured}: figures that are judged.",
        ("", *who[TEACHER]), [(name, *lost.values()) for name, lost in who.items()],
    )  # fmt: skip
    found = []
    for law in study.laws:
        head, *lines = rows(replace(study, laws=[law]), {"missed": "**", "behind": "*"})
        found += [(GROUPS[law.group].title, law.title, *line[1:]) for line in lines]
    write_record("hard_cases", command, f"{measured}.", ("group", *head), found, [f"- {line}" for line in LEGEND])
