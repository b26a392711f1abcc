"""Evaluate a model, write its card and bundle it: `python -m sdfsim.evaluation.model_card MODEL DATA --name NAME`."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

from sdfsim.data.pybullet_sim import FPS
from sdfsim.data.scenarios import RECIPES
from sdfsim.dynamics.model import BUNDLED, Model, load_model
from sdfsim.errors import run_main
from sdfsim.evaluation.evaluate import error_rows, evaluate, notes, quality_rows
from sdfsim.evaluation.harness import markdown
from sdfsim.files import write_text
from sdfsim.training.presets import PRESETS

MODEL = "this model"  # in the tables of a card


def bundle(path: Path, data: Path, name: str, folder: Path = BUNDLED, at_frames: Path | None = None) -> dict:
    """Evaluate a trained model on the test split of `data`, then write `NAME.safetensors` and its card `NAME.md`.

    Args:
        path: what `sdfsim train` wrote.
        data: dataset folder with test/.
        name: the bundled model's name.
        folder: of the bundled models.
        at_frames: a dataset of 60 frames a second with test/, for the protocol of errors at a frame alone.

    Returns:
        The evaluation's report; `at_frames` is that of the other dataset (None without one), `as_published` the errors
        of a paper network that predicts free flight too (None for others).
    """
    model = load_model(path)
    report = evaluate(data, model=model, chaos_floor=True)
    report["as_published"] = None
    if model.kind == "paper":
        report["as_published"] = evaluate(data, model=model, free_flight="learned", errors_only=True)["model"]
    report["at_frames"] = None if at_frames is None else evaluate(at_frames, model=model, chaos_floor=True)
    kept = ("model", "ballistic", "as_published", "chaos_floor", "median_survival_s")
    kept += ("penetration", "energy_gain", "resting_speed")
    results = {"errors": {what: report[what] for what in kept}, "test_trajectories": report["trajectories"]}
    model = replace(model, name=name, card=model.card | results)
    folder.mkdir(parents=True, exist_ok=True)
    model.save(folder / f"{name}.safetensors")
    write_text(folder / f"{name}.md", card_text(model, report))
    return report


def card_text(model: Model, report: dict) -> str:
    """The model card as Markdown."""
    card, preset = model.card, model.card["preset"]
    parameters = sum(p.numel() for p in model.network.parameters())
    folders = dataset_folders(card["data"])
    published, other = report["as_published"], report["at_frames"]
    extra = {"this model, free flight learned too (as published)": published} if published else None
    data = [
        f"Data: {d['recipe']} (seed {d['seed']}, {d['shapes']} shapes), made with {d['engine']}." for d in card["data"]
    ]
    commands = [
        *training_commands(card, folders),
        f"python -m sdfsim.evaluation.model_card RUN/model.safetensors {folders[0]} --name {model.name}"
        f"{' --at-frames MOVI-B-60' if other else ''}",
    ]
    cost = {
        "parameters": f"{parameters:,}",
        "optimiser steps": f"{card['optimiser_steps']:,}",
        "batch": str(preset["batch"]),
        "time": f"{card['seconds']:,} s = {card['seconds'] / 3600:.2f} h",
        "where": f"{card['device']}, {card.get('processes', 1)} process(es) of {card['threads']} thread(s)",
    }
    ranges = [(name.replace("_", " "), f"{low:.3g}", f"{high:.3g}") for name, (low, high) in model.ranges.items()]
    at_frames = ""
    if other:
        at_frames = (
            f"{other['trajectories']} test trajectories of {1 / other['dt']:.0f} frames a second, in a frame alone;\n"
            "translation is the mean over trajectories of the RMSE over bodies:\n\n"
            + markdown(error_rows(other, name=MODEL, at_frame=True))
        )
    parts = [
        f"# {model.name}",
        f"The *{model.kind}* network, {parameters:,} parameters, {json.dumps(preset['config'])}; step {model.dt} s at\n"
        f"{model.gravity:g} m/s^2 for bodies of {model.length:.2f} m (the middle of the sizes it has seen), rescaled\n"
        "to any scene (Froude).",
        "## Training",
        "\n".join([*data, "Surfaces and nodes are those of the convex pieces that the engine collides."]),
        markdown([tuple(cost), tuple(cost.values())]),
        "Repeat with:",
        "\n".join(f"    {line}" for line in commands),
        "## Ranges it has seen",
        markdown([("quantity", "from", "to"), *ranges]),
        "Friction and restitution are products of two bodies' coefficients; sizes in m, speeds in m/s.",
        "## Errors",
        f"{report['trajectories']} test trajectories ({report['bodies']} bodies) of the same recipe, all rolled out\n"
        "from their first frame: translation RMSE and mean rotation error; 95 % intervals over trajectories.\n"
        "Ballistic: every body flies on without contact.",
        markdown(error_rows(report, name=MODEL, extra=extra)),
        at_frames,
        "## Quality of the motion",
        markdown(quality_rows(report, name=MODEL)),
        "\n".join(f"- {line}" for line in notes(report)),
    ]
    return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"


def training_commands(card: dict, folders: list[str]) -> list[str]:
    """What makes the data and trains on them; `sdfsim train` knows neither seeds nor steps but the preset's own."""
    lines = []
    for folder, made in zip(folders, card["data"], strict=True):
        recipe = RECIPES.get(made["recipe"])
        given = " --shapes SHAPES" if recipe is None or recipe.given else ""
        options = {"random-solids": made.get("random_solids"), "bodies": made.get("bodies")}
        options = given + "".join(f" --{option} {count}" for option, count in options.items() if count)
        start = f"sdfsim dataset {made['recipe']} -o {folder}{_rate(made)}{options}"
        for split, count in made["trajectories"].items():
            lines.append(f"{start} --trajectories {count} --seed {made['seed']} --split {split}")
    name, seed, steps = card["preset_name"], card.get("seed", 0), card["optimiser_steps"]
    usual = PRESETS[name].steps if name in PRESETS else card["preset"]["steps"]
    if seed == 0 and steps == usual:
        return [*lines, f"sdfsim train {' '.join(f'--data {folder}' for folder in folders)} -o RUN --preset {name}"]
    options = (f" --seed {seed}" if seed else "") + (f" --steps {steps}" if steps != usual else "")
    return [*lines, f"python -m sdfsim.training.train {' '.join(folders)} RUN --preset {name}{options}"]


def dataset_folders(data: list[dict]) -> list[str]:
    """A folder name for each dataset of a card, numbered where several are of one recipe and rate."""
    names = [made["recipe"].upper() + _rate(made).replace(" --fps ", "-") for made in data]
    return [f"{n}-{names[: k + 1].count(n)}" if names.count(n) > 1 else n for k, n in enumerate(names)]


def _rate(made: dict) -> str:
    """The option for a rate of frames that is not the usual one."""
    return f" --fps {made['fps']}" if made.get("fps", FPS) != FPS else ""


def main() -> None:
    """Command line of this module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--name", required=True)
    parser.add_argument("--at-frames", type=Path, help="dataset of 60 frames a second: errors at frames alone")
    args = parser.parse_args()
    report = bundle(args.model, args.data, args.name, at_frames=args.at_frames)
    print(json.dumps({k: report[k] for k in ("model", "ballistic")}, indent=2))


if __name__ == "__main__":
    run_main(main)
