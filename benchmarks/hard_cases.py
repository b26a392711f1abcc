"""All that docs/stability.md shows of the models, and the ratchet that later models are held to.

    python benchmarks/hard_cases.py -o DIR [--quick]

Runs the hard cases in DIR (their short form in DIR/quick), as far as it does not hold their results yet; then writes
the table and the pictures of docs/stability.md, and benchmarks/hard_cases_ratchet.json from the short form, which is
what the slow test runs. With --quick the table is that of the short form too.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.results import write_section
from sdfsim.console import Session
from sdfsim.evaluation.hard_cases import GROUPS
from sdfsim.evaluation.stress import ENGINES, TEACHER, Study, draw_group, figures, losses, stress, table, write_report
from sdfsim.files import read_json, write_json, write_text
from sdfsim.recording import save_rollout

ROOT = Path(__file__).resolve().parents[1]
DOCUMENT = ROOT / "docs" / "stability.md"
RATCHET = Path(__file__).with_name("hard_cases_ratchet.json")
BEGIN, END = "<!-- written by benchmarks/hard_cases.py -->", "<!-- end -->"
SPREADS = 3.0  # so many standard deviations are noise
SHARE = 0.05  # of a figure: what another machine's rounding may change where repetitions agree
PICTURES = {"stack": "stability_stacks.png", "bounce": "stability_bounces.png", "slope": "stability_slopes.png"}


def write_document(study: Study) -> None:
    """Replace the table of the document and its pictures."""
    form = "Short form, `sdfsim stress --quick`:" if study.quick else "Long form, `sdfsim stress`:"
    pictures = "\n".join(f"![{GROUPS[group].title}](images/{name})" for group, name in PICTURES.items())
    before, rest = DOCUMENT.read_text(encoding="utf-8").split(BEGIN)
    shown = f"{BEGIN}\n\n{form}\n\n{table(study)}\n{pictures}\n\n{END}"
    write_text(DOCUMENT, before + shown + rest.split(END)[1])
    # Beside engines that know no restitution nothing else could be seen.
    others = [who for who in study.who if who == TEACHER or who not in ENGINES]
    for group, name in PICTURES.items():
        draw_group(replace(study, who=others), group, ROOT / "docs" / "images" / name)


def accepted(study: Study) -> dict[str, Any]:
    """What the ratchet file holds: each model's figures, and the cases in which it blew up."""
    models = {}
    for who, found in figures(study).items():
        if who not in ENGINES:
            blown = [case for (case, one), result in study.results.items() if one == who and result["broke"]]
            models[who] = {"figures": found, "blew_up": blown}
    return {"quick": study.quick, "models": models}


def slipped_back(study: Study, file: Path) -> list[str]:
    """A line for every figure of a study that is clearly worse than in the ratchet, and for every new blow-up."""
    ratchet, now = read_json(file), accepted(study)
    worse = []
    for who, entry in now["models"].items():
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="the table of the short form")
    chosen = parser.parse_args()
    with Session() as session:
        for quick in (True,) if chosen.quick else (True, False):
            folder = chosen.out / "quick" if quick else chosen.out
            study = stress(
                folder, quick=quick, engines=tuple(ENGINES), record=save_rollout, on_progress=session.progress
            )
            write_report(study, folder)
            if quick:
                write_json(RATCHET, accepted(study))
        write_document(study)
        command = f"python benchmarks/hard_cases.py -o DIR{' --quick' if chosen.quick else ''}"
        lost = [
            f"- {who}: {', '.join(f'{n} {what}' for what, n in found.items())}" for who, found in losses(study).items()
        ]
        write_section("hard cases", command, "\n".join(lost))
        session.report({"document": str(DOCUMENT), "ratchet": str(RATCHET)})


if __name__ == "__main__":
    main()
