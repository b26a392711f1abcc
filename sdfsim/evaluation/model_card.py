"""Evaluate a model, write its card and bundle it: `python -m sdfsim.evaluation.model_card MODEL DATA --name NAME`."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from sdfsim.base.errors import run_main
from sdfsim.base.files import write_text
from sdfsim.evaluation.evaluate import error_rows, evaluate, notes, quality_rows
from sdfsim.evaluation.harness import markdown
from sdfsim.learned.model import BUNDLED, Model, load_model
from sdfsim.training.presets import PRESETS

MODEL = "this model"  # its name in the tables of a card
SHOWN = 10  # rows of a learning curve


def bundle(model: Path, data: Path, name: Annotated[str, typer.Option()], folder: Path = BUNDLED) -> dict:
    """Evaluate a model of `sdfsim train` on the test split of `data`; write `NAME.safetensors` and its card `NAME.md`,
    with the learning curve if `log.jsonl` is beside the model; return the evaluation's report."""
    found = load_model(model)
    report = evaluate(data, model=found, chaos_floor=True)
    kept = ("model", "ballistic", "chaos_floor", "median_survival_s", "penetration", "energy_gain", "resting_speed")
    log = model.parent / "log.jsonl"
    records = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()] if log.exists() else []
    curve = {"curve": [[line["step"], line["held_out_loss"]] for line in records]} if records else {}
    results = curve | {"errors": {what: report[what] for what in kept}, "test_trajectories": report["trajectories"]}
    found = replace(found, name=name, card=found.card | results)
    folder.mkdir(parents=True, exist_ok=True)
    found.save(folder / f"{name}.safetensors")
    write_text(folder / f"{name}.md", card_text(found, report))
    return report


def card_text(model: Model, report: dict) -> str:
    card, parameters = model.card, sum(p.numel() for p in model.network.parameters())
    shown = ("recipe", "seed", "trajectories", "random_solids", "engine")
    data = [", ".join(f"{key} {made[key]}" for key in shown if made.get(key)) for made in card["data"]]
    ranges = [(name.replace("_", " "), f"{low:.3g}", f"{high:.3g}") for name, (low, high) in model.ranges.items()]
    parts = [
        f"# {model.name}",
        f"The *{model.kind}* network, {parameters:,} parameters, {json.dumps(card['preset']['config'])};\n"
        f"step {model.dt} s at {model.gravity:g} m/s^2 for bodies of {model.length:.2f} m, rescaled to any scene.",
        "## Training",
        "\n".join(f"- `sdfsim dataset`: {line}" for line in data),
        f"Preset {card['preset_name']}, seed {card.get('seed', 0)}: {card['optimiser_steps']:,} steps of\n"
        f"{card['preset']['batch']} frames in {card['seconds']:,} s on {card['device']}.",
        *_curve(card),
        "## Ranges it has seen",
        markdown([("quantity", "from", "to"), *ranges]),
        "Friction and restitution are products of two bodies' coefficients; sizes in m, speeds in m/s.",
        "## Errors",
        f"{report['trajectories']} test trajectories ({report['bodies']} bodies): translation RMSE and mean rotation\n"
        "error, with 95 % intervals over trajectories. Ballistic: every body flies on without contact.",
        markdown(error_rows(report, name=MODEL)),
        "## Quality of the motion",
        markdown(quality_rows(report, name=MODEL)),
        "\n".join(f"- {line}" for line in notes(report)),
    ]
    return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"


def _curve(card: dict) -> list[str]:
    """The held-out loss at about `SHOWN` steps of the training, and a summary of its fall; empty if there is no log."""
    curve = card.get("curve", [])
    if len(curve) < 2:
        return []
    rows = np.unique(np.geomspace(1, len(curve), min(SHOWN, len(curve))).round().astype(int)) - 1
    half = next(loss for step, loss in curve if step >= curve[-1][0] / 2)
    name, last = card["preset_name"], curve[-1][1]
    asked = f", of the {PRESETS[name].steps:,} that the preset has" if name in PRESETS else ""
    return [
        f"Loss on held-out recordings, up to {curve[-1][0]:,} steps{asked}. In the second half of them it fell from\n"
        f"{half:.3g} to {last:.3g}.",
        markdown([("step", "held-out loss"), *((f"{curve[k][0]:,}", f"{curve[k][1]:.4f}") for k in rows)]),
    ]


if __name__ == "__main__":
    run_main(lambda: typer.run(bundle))
