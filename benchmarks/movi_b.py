"""Errors on recorded MOVi-B scenes, with those of free flight and of PyBullet itself from changed starts: RESULTS.md.

    python -m benchmarks movi_b DATA

DATA is a dataset of the recipe MOVi-B or MOVi-C; its test split is rolled out by the solver, as users run it, and by
all bundled networks. Results have the form `error [95 % interval over trajectories]`. For MOVi-B, a second table has
the steps nearest to the instants of HOPNet's errors. Its recordings have 240 frames a second (`frame_rate` in
samples/MOVi-B/*/metadata.json of github.com/AmauryWEI/hopnet), so its frame 100 is 0.417 s.
"""

from pathlib import Path

import numpy as np

from benchmarks.results import write_section
from sdfsim.data.dataset import Trajectory, read_info
from sdfsim.evaluation.evaluate import evaluate, load_recorded
from sdfsim.evaluation.harness import markdown, number
from sdfsim.learned.model import SOLVER, model_names

COMMAND = "python -m benchmarks movi_b DATA"
STEPS = ("50", "100")
FLOWN = 1e-3  # m from free flight: a body farther off has touched something
# HOPNet's frames -> its errors in metres and degrees on its own recordings, quoted by Dou et al. 2026 (arXiv
# 2605.09196)
RATE, HOPNET = 240, {50: (0.047, None), 75: (0.101, None), 100: (0.176, 17.9)}


def main(data: Path) -> None:
    name = {"movi-b": "MOVi-B", "movi-c": "MOVi-C"}[read_info(data)["recipe"]]
    write_section(name, COMMAND, table(of_models(data, 100)))
    if name == "MOVi-B":
        instants(data)


def of_models(data: Path, steps: int) -> dict[str, dict]:
    """Errors of the solver, of all bundled models, without contact, and of the engine from changed starts."""
    found = {}
    for model in model_names():
        report = evaluate(data, model=model, steps=steps, chaos_floor=model == SOLVER, errors_only=True)
        found[f"`{model}`"] = report["model"]
        if model == SOLVER:
            others = {"all contact ignored": report["ballistic"]}
            for size, errors in report["chaos_floor"]["perturbations"].items():
                others[f"the engine again, starts {size} m/s off"] = errors
    return found | others


def table(found: dict[str, dict]) -> str:
    """Errors at both horizons, a row for each motion."""
    rows: list[tuple[str, ...]] = [("", *(f"{unit}, {steps} steps" for steps in STEPS for unit in ("m", "degrees")))]
    for name, errors in found.items():
        cells = []
        for steps in STEPS:
            metres, low, high = map(number, (errors[steps]["translation_rmse"], *errors[steps]["translation_rmse_95"]))
            cells += [f"{metres} [{low}, {high}]", number(errors[steps]["rotation_error"])]
        rows.append((name, *cells))
    return markdown(rows)


def instants(data: Path) -> None:
    """Write the section: errors at single instants, and the share of bodies that have touched nothing by then."""
    recorded, _ = load_recorded(data, "test")
    columns: dict[str, dict[str, str]] = {}
    for frame, (metres, degrees) in HOPNET.items():
        step = round(frame / RATE / recorded[0].dt)
        cells = {name: cell(errors[str(step)]["at_frame"]) for name, errors in of_models(data, step).items()}
        cells["bodies that have met nothing yet"] = f"{100 * flying(recorded, step):.0f} %"
        published = f"{metres} m" + (f", {degrees} degrees" if degrees else "")
        cells["HOPNet, on its own recordings"] = f"{published}, at {frame / RATE:.3f} s"
        columns[f"at {step * recorded[0].dt:.2f} s"] = cells
    rows = [("", *columns), *((name, *(cells[name] for cells in columns.values())) for name in cells)]
    write_section("instants", COMMAND, markdown(rows))


def cell(found: dict) -> str:
    metres, low, high = map(number, (found["translation_rmse"], *found["translation_rmse_95"]))
    return f"{metres} m [{low}, {high}], {number(found['rotation_error'])} degrees"


def flying(recorded: list[Trajectory], step: int) -> float:
    """Share of the moving bodies that are still in free flight, by their positions."""
    away = []
    for t in recorded:
        seconds = step * t.dt
        free = t.position[0] + t.velocity[0] * seconds + 0.5 * t.gravity * seconds**2
        away.append(np.linalg.norm(t.position[step] - free, axis=-1)[~t.static])
    return float((np.concatenate(away) < FLOWN).mean())
