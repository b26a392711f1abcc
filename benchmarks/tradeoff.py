"""What `sdfsim tradeoff` finds on MOVi-B, with its picture: RESULTS.md.

    python benchmarks/tradeoff.py DATA -o DIR

DATA is a MOVi-B dataset; DIR keeps the results of the command, which this script continues.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.results import PAGE, write_section
from sdfsim.errors import run_main
from sdfsim.evaluation.harness import markdown
from sdfsim.evaluation.tradeoff import told, tradeoff

PICTURE = PAGE.parents[1] / "docs" / "images" / "tradeoff.png"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    chosen = parser.parse_args()
    report = tradeoff(
        chosen.data, chosen.out, on_progress=lambda _, f, message: print(f"{f:4.0%} {message}", flush=True)
    )
    rows, notes = told(report)
    shutil.copyfile(chosen.out / "tradeoff.png", PICTURE)
    text = f"{markdown(rows)}\n{notes[0]}.\n\n![Error against time](../docs/images/tradeoff.png)"
    write_section("tradeoff", "python benchmarks/tradeoff.py DATA -o DIR", text)


if __name__ == "__main__":
    run_main(main)
