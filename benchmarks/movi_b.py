"""Errors on recorded MOVi-B scenes, with those of free flight and of PyBullet itself from changed starts: RESULTS.md.

    python -m benchmarks movi_b DATA

DATA is a dataset of the recipe MOVi-B or MOVi-C; its test split is rolled out by the solver, as users run it, and by
all bundled networks. Results have the form `error [95 % interval over trajectories]`.
"""

from pathlib import Path

from benchmarks.results import write_section
from sdfsim.data.dataset import read_info
from sdfsim.evaluation.evaluate import evaluate
from sdfsim.evaluation.harness import markdown, number
from sdfsim.learned.model import SOLVER, model_names

COMMAND = "python -m benchmarks movi_b DATA"
STEPS = ("50", "100")


def main(data: Path) -> None:
    name = {"movi-b": "MOVi-B", "movi-c": "MOVi-C"}[read_info(data)["recipe"]]
    write_section(name, COMMAND, table(of_models(data)))


def of_models(data: Path) -> dict[str, dict]:
    """Errors of the solver, of all bundled models, without contact, and of the engine from changed starts."""
    found = {}
    for model in model_names():
        report = evaluate(data, model=model, steps=100, chaos_floor=model == SOLVER, errors_only=True)
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
