"""Errors on recorded MOVi-B scenes, with those of free flight and of PyBullet itself from changed starts: RESULTS.md.

    python -m benchmarks movi_b DATA

DATA is a dataset of the recipe MOVi-B or MOVi-C; its test split is rolled out by the solver, as users run it, and by
all bundled networks. Results have the form `error [95 % interval over trajectories]`.
"""

from pathlib import Path

from benchmarks.records import Cell, write_record
from sdfsim.data.dataset import read_info
from sdfsim.evaluation.evaluate import evaluate
from sdfsim.learned.model import SOLVER, model_names

COMMAND = "python -m benchmarks movi_b DATA"
STEPS = ("50", "100")
PUBLISHED = ("SDF-Sim, published", 0.160, 18.0, None, None)  # on its own recordings


def main(data: Path) -> None:
    recipe = read_info(data)["recipe"]
    columns = [f"{unit}, {steps} steps" for steps in STEPS for unit in ("m", "degrees")]
    measured = (
        f"The test trajectories of {recipe}: Kubric's recipe, recorded again with PyBullet. Root mean square errors "
        "with 95 % intervals over trajectories, and mean errors of rotation."
    )
    rows = [*table(of_models(data)), *([PUBLISHED] if recipe == "movi-b" else [])]
    write_record(recipe.replace("-", "_"), COMMAND, measured, ("", *columns), rows)


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


def table(found: dict[str, dict]) -> list[list[Cell]]:
    """Errors at both horizons, a row for each motion."""
    rows: list[list[Cell]] = []
    for name, errors in found.items():
        rows.append([name])
        for known in (errors[steps] for steps in STEPS):
            rows[-1] += [[known["translation_rmse"], *known["translation_rmse_95"]], known["rotation_error"]]
    return rows
