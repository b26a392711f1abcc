"""All that docs/stability.md shows of the bundled models, and the ratchet that later models are held to.

    python benchmarks/hard_cases.py -o DIR [--quick]

Runs the hard cases in DIR (their short form in DIR/quick), as far as it does not hold their results yet; then writes
the table and the pictures of docs/stability.md, and benchmarks/hard_cases_ratchet.json from the short form, which is
what the slow test runs. With --quick the table is that of the short form too.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from sdfsim.console import Session
from sdfsim.evaluation.hard_cases_page import write_report
from sdfsim.evaluation.hard_cases_plots import group_picture
from sdfsim.evaluation.hard_cases_ratchet import accepted
from sdfsim.evaluation.hard_cases_results import Study
from sdfsim.evaluation.hard_cases_run import stress
from sdfsim.evaluation.hard_cases_tables import LEGEND, losses, markdown
from sdfsim.files import replacing, write_json, write_text
from sdfsim.recording import save_rollout

ROOT = Path(__file__).resolve().parents[1]
DOCUMENT = ROOT / "docs" / "stability.md"
RATCHET = Path(__file__).with_name("hard_cases_ratchet.json")
BEGIN, END = "<!-- written by benchmarks/hard_cases.py -->", "<!-- end -->"
PICTURES = {
    "stack": ("Stacks", "stability_stacks.png"),
    "bounce": ("Balls dropped", "stability_bounces.png"),
    "slope": ("Boxes on slopes", "stability_slopes.png"),
}
DPI = 70


def section(study: Study) -> str:
    """What stands between the two marks of the document."""
    form = "Short form, `sdfsim stress --quick`:" if study.quick else "Long form, `sdfsim stress`:"
    told = [f"{who}: {', '.join(f'{n} {what}' for what, n in found.items())}" for who, found in losses(study).items()]
    legend = [f"- {line}" for line in LEGEND]
    pictures = [f"![{what}](images/{name})" for what, name in PICTURES.values()]
    parts = [
        BEGIN,
        "",
        form,
        "",
        *(f"- {line}" for line in told),
        *legend,
        "",
        *pictures,
        "",
        *markdown(study),
        "",
        END,
    ]
    return "\n".join(parts)


def write_document(study: Study) -> None:
    """Replace the table of the document and its pictures."""
    before, rest = DOCUMENT.read_text(encoding="utf-8").split(BEGIN)
    write_text(DOCUMENT, before + section(study) + rest.split(END)[1])
    for group, (_, name) in PICTURES.items():
        picture = group_picture(study, group, dpi=DPI)
        assert picture is not None
        with replacing(ROOT / "docs" / "images" / name) as partial:
            partial.write_bytes(picture)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="the table of the short form")
    chosen = parser.parse_args()
    with Session() as session:
        folder = chosen.out / "quick"
        study = stress(folder, quick=True, record=save_rollout, on_progress=session.progress)
        write_report(study, folder)
        write_json(RATCHET, accepted(study))
        if not chosen.quick:
            study = stress(chosen.out, record=save_rollout, on_progress=session.progress)
            write_report(study, chosen.out)
        write_document(study)
        session.report({"document": str(DOCUMENT), "ratchet": str(RATCHET)})


if __name__ == "__main__":
    main()
