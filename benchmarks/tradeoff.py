"""The results of `sdfsim tradeoff` on MOVi-B, with its picture: docs/notes/error-against-time.md.

    python -m benchmarks tradeoff DATA -o DIR

DATA is a MOVi-B dataset; DIR keeps the results of the command, which this script continues.
"""

import shutil
from pathlib import Path

from benchmarks.results import ROOT, progress, write_section
from sdfsim.evaluation import tradeoff as study
from sdfsim.evaluation.harness import markdown


def main(data: Path, *, out: Path) -> None:
    report = study.tradeoff(data, out, on_progress=lambda _, fraction, message: progress(fraction, message))
    rows, notes = study.report_table(report)
    shutil.copyfile(out / "tradeoff.png", ROOT / "docs" / "images" / "tradeoff.png")
    text = f"{markdown(rows)}\n{notes[0]}.\n\n![Error against time](../images/tradeoff.png)"
    write_section("tradeoff", "python -m benchmarks tradeoff DATA -o DIR", text)
