"""Errors on recorded MOVi-B scenes, with what ignoring all contact gives and what chaos allows: RESULTS.md.

    python benchmarks/movi_b.py DATA

DATA is a MOVi-B dataset; its test split is rolled out. Written `error [95 % interval over trajectories]`. Then the
same at the steps next to the instants of which HOPNet reports errors. Its recordings have 240 frames a second
(`frame_rate` in samples/MOVi-B/*/metadata.json of github.com/AmauryWEI/hopnet), so its frame 100 is 0.417 s.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.results import script, write_section
from sdfsim.data.dataset import Trajectory
from sdfsim.evaluation.evaluate import evaluate, load_recorded
from sdfsim.evaluation.harness import markdown, number

COMMAND = "python benchmarks/movi_b.py DATA"
STEPS = ("50", "100")
FLOWN = 1e-3  # m from free flight: what is farther has met something
# HOPNet's frames -> metres and degrees there, as Dou et al. 2026 (arXiv 2605.09196) quote it on its own recordings
RATE, HOPNET = 240, {50: (0.047, None), 75: (0.101, None), 100: (0.176, 17.9)}


def main(data: Path) -> None:
    """Write both sections."""
    horizons(data)
    instants(data)


def horizons(data: Path) -> None:
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
    write_section("MOVi-B", COMMAND, markdown(rows))


def instants(data: Path) -> None:
    """Write the section: errors at single instants, and the share of bodies that have met nothing by then."""
    recorded, _ = load_recorded(data, "test")
    columns: dict[str, dict[str, str]] = {}
    for frame, (metres, degrees) in HOPNET.items():
        step = round(frame / RATE / recorded[0].dt)
        solver, small = (
            evaluate(data, model=model, steps=step, chaos_floor=model == "small", errors_only=True)
            for model in ("solver", "small")
        )
        again = small["chaos_floor"]["perturbations"]["1e-3"]
        found = {"`solver`": solver["model"], "`small`": small["model"], "all contact ignored": small["ballistic"]}
        found["the engine again, starts 1e-3 m/s off"] = again
        cells = {name: cell(errors[str(step)]["at_frame"]) for name, errors in found.items()}
        cells["bodies that have met nothing yet"] = f"{100 * flying(recorded, step):.0f} %"
        published = f"{metres} m" + (f", {degrees} degrees" if degrees else "")
        cells["HOPNet, on its own recordings"] = f"{published}, at {frame / RATE:.3f} s"
        columns[f"at {step * recorded[0].dt:.2f} s"] = cells
    rows = [("", *columns), *((name, *(cells[name] for cells in columns.values())) for name in cells)]
    write_section("instants", COMMAND, markdown(rows))


def cell(found: dict) -> str:
    """Metres with their interval, and degrees."""
    metres, low, high = map(number, (found["translation_rmse"], *found["translation_rmse_95"]))
    return f"{metres} m [{low}, {high}], {number(found['rotation_error'])} degrees"


def flying(recorded: list[Trajectory], step: int) -> float:
    """Share of the bodies that move which are still in free flight, by their positions."""
    away = []
    for t in recorded:
        seconds = step * t.dt
        free = t.position[0] + t.velocity[0] * seconds + 0.5 * t.gravity * seconds**2
        away.append(np.linalg.norm(t.position[step] - free, axis=-1)[~t.static])
    return float((np.concatenate(away) < FLOWN).mean())


if __name__ == "__main__":
    script(__doc__, main)
