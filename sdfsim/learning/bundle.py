"""Replace a bundled model: `python -m sdfsim.learning.bundle MODEL DATA --name NAME` evaluates it, writes its card."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

from sdfsim.dynamics.model import BUNDLED, Model, load_model
from sdfsim.errors import SdfsimError
from sdfsim.files import write_text
from sdfsim.learning.dataset import SPLITS, trajectory_files
from sdfsim.learning.evaluate import evaluate


def bundle(path: Path, data: Path, name: str, folder: Path = BUNDLED) -> dict:
    """Evaluate a trained model on the test split of `data`, then write `NAME.safetensors` and its card `NAME.md`.

    Args:
        path: what `sdfsim train` wrote.
        data: dataset folder with test/.
        name: the bundled model's name.
        folder: of the bundled models.

    Returns:
        The evaluation's report.
    """
    model = load_model(path)
    report = evaluate(data, model=model)
    report["made_from"] = {split: len(trajectory_files(data, split)) for split in SPLITS}
    learned = evaluate(data, model=model, free_flight="learned") if model.kind == "paper" else None
    errors = {who: report[who] for who in ("model", "ballistic")}
    model = replace(model, name=name, card=model.card | {"errors": errors, "test_trajectories": report["trajectories"]})
    folder.mkdir(parents=True, exist_ok=True)
    model.save(folder / f"{name}.safetensors")
    write_text(folder / f"{name}.md", card_text(model, report, learned))
    return report


def card_text(model: Model, report: dict, learned: dict | None) -> str:
    """The model card as Markdown."""
    parameters = sum(p.numel() for p in model.network.parameters())
    card, preset = model.card, model.card["preset"]
    rows = [("this model", report["model"]), ("flying on without contact", report["ballistic"])]
    if learned:
        rows.insert(1, ("this model, free flight learned too (as published)", learned["model"]))
    lines = [
        f"# {model.name}",
        "",
        f"The *{model.kind}* network, {parameters:,} parameters, {json.dumps(preset['config'])}; step {model.dt} s at",
        f"{model.gravity:g} m/s^2 for bodies of {model.length:.2f} m on average, rescaled to any scene (Froude).",
        "",
        "## Training",
        "",
        f"Data: {card['data']['recipe']} (seed {card['data']['seed']}), made with {card['data']['engine']}.",
        "Surfaces and nodes are those of the convex pieces that the engine collides.",
        f"{card['optimiser_steps']:,} optimiser steps of {preset['batch']}, {card['seconds']:,} s on {card['device']}",
        f"with {card['threads']} thread(s).",
        "",
        "Repeat with:",
        "",
        *(
            f"    sdfsim dataset {card['data']['recipe']} -o DATA --shapes SHAPES --trajectories {count}"
            f" --seed {card['data']['seed']} --split {split}"
            for split, count in report["made_from"].items()
        ),
        f"    sdfsim train --data DATA -o RUN --preset {card['preset_name']}",
        f"    python -m sdfsim.learning.bundle RUN/model.safetensors DATA --name {model.name}",
        "",
        "## Ranges it has seen",
        "",
        "| quantity | from | to |",
        "| --- | --- | --- |",
        *(f"| {k.replace('_', ' ')} | {low:.3g} | {high:.3g} |" for k, (low, high) in model.ranges.items()),
        "",
        "Friction and restitution are products of two bodies' coefficients; sizes in m, speeds in m/s.",
        "",
        "## Errors",
        "",
        f"{report['trajectories']} test trajectories ({report['bodies']} bodies) of the same recipe, all rolled out",
        "from their first frame; 95 % intervals over trajectories.",
        "",
        "| | steps | translation RMSE, m | rotation, degrees |",
        "| --- | --- | --- | --- |",
    ]
    for who, table in rows:
        for steps, e in table.items():
            low, high = e["translation_rmse_95"]
            turn_low, turn_high = e["rotation_error_95"]
            lines.append(
                f"| {who} | {steps} | {e['translation_rmse']:.3f} ({low:.3f}-{high:.3f}) "
                f"| {e['rotation_error']:.1f} ({turn_low:.1f}-{turn_high:.1f}) |"
            )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Command line of this module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--name", required=True)
    args = parser.parse_args()
    try:
        report = bundle(args.model, args.data, args.name)
    except SdfsimError as error:
        sys.exit(f"error: {error}\n{error.hint}")
    print(json.dumps({k: report[k] for k in ("model", "ballistic")}, indent=2))


if __name__ == "__main__":
    main()
