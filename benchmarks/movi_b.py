"""Errors on recorded MOVi-B scenes, with what ignoring all contact gives and what chaos allows: RESULTS.md.

    python benchmarks/movi_b.py DATA

DATA is a MOVi-B dataset; its test split is rolled out. Written `error [95 % interval over trajectories]`.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.results import script, write_section
from sdfsim.evaluation.evaluate import evaluate
from sdfsim.evaluation.harness import markdown, number

STEPS = ("50", "100")


def main(data: Path) -> None:
    solver, small = (
        evaluate(data, model=model, steps=100, chaos_floor=model == "small", errors_only=True)
        for model in ("solver", "small")
    )
    found = {"`solver`": solver["model"], "`small`": small["model"], "all contact ignored": small["ballistic"]}
    for size, errors in small["chaos_floor"]["perturbations"].items():
        found[f"the engine again, starts {size} m/s off"] = errors
    rows: list[tuple[str, ...]] = [("", *(f"{unit}, {steps} steps" for steps in STEPS for unit in ("m", "degrees")))]
    for name, errors in found.items():
        cells = []
        for steps in STEPS:
            metres, low, high = map(number, (errors[steps]["translation_rmse"], *errors[steps]["translation_rmse_95"]))
            cells += [f"{metres} [{low}, {high}]", number(errors[steps]["rotation_error"])]
        rows.append((name, *cells))
    write_section("MOVi-B", "python benchmarks/movi_b.py DATA", markdown(rows))


if __name__ == "__main__":
    script(__doc__, main)
