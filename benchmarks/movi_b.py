"""Errors on recorded MOVi-B scenes, with what ignoring all contact gives and what chaos allows: RESULTS.md.

    python benchmarks/movi_b.py DATA

DATA is a MOVi-B dataset; its test split is rolled out. Written `error [95 % interval over trajectories]`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.results import write_section
from sdfsim.errors import run_main
from sdfsim.evaluation.evaluate import evaluate
from sdfsim.evaluation.harness import markdown, number

MODELS = ("solver", "small")
STEPS = ("50", "100")


def row(name: str, errors: dict[str, Any]) -> tuple[str, ...]:
    """What is said of one contender."""
    cells = []
    for steps in STEPS:
        low, high = (number(end) for end in errors[steps]["translation_rmse_95"])
        cells += [
            f"{number(errors[steps]['translation_rmse'])} [{low}, {high}]",
            number(errors[steps]["rotation_error"]),
        ]
    return (name, *cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    data = parser.parse_args().data
    rows: list[tuple[str, ...]] = [("", *(f"{unit}, {steps} steps" for steps in STEPS for unit in ("m", "degrees")))]
    for model in MODELS:
        report = evaluate(data, model=model, steps=int(STEPS[-1]), chaos_floor=model == MODELS[-1], errors_only=True)
        rows.append(row(f"`{model}`", report["model"]))
    rows.append(row("all contact ignored", report["ballistic"]))
    rows += [
        row(f"the engine again, starts {name} m/s off", found)
        for name, found in report["chaos_floor"]["perturbations"].items()
    ]
    print(markdown(rows))
    write_section("MOVi-B", "python benchmarks/movi_b.py DATA", markdown(rows))


if __name__ == "__main__":
    run_main(main)
