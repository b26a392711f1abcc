"""Evaluate a model, write its card and bundle it: `python -m sdfsim.evaluation.model_card MODEL DATA --name NAME`."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from sdfsim.data.pybullet_sim import FPS
from sdfsim.data.scenarios import RECIPES
from sdfsim.dynamics.model import BUNDLED, Model, load_model
from sdfsim.errors import SdfsimError, run_main
from sdfsim.evaluation import tables
from sdfsim.evaluation.evaluate import evaluate
from sdfsim.files import write_text
from sdfsim.training.presets import PRESETS, Preset

MODEL, BASELINE = "this model", "flying on without contact"  # in the tables of a card


def bundle(
    path: Path,
    data: Path,
    name: str,
    folder: Path = BUNDLED,
    seeds: Sequence[Path] = (),
    at_frames: Path | None = None,
) -> dict:
    """Evaluate a trained model on the test split of `data`, then write `NAME.safetensors` and its card `NAME.md`.

    Args:
        path: what `sdfsim train` wrote.
        data: dataset folder with test/.
        name: the bundled model's name.
        folder: of the bundled models.
        seeds: models of the same preset trained from other seeds; the range of their errors goes into the card.
        at_frames: a dataset of 60 frames a second with test/, for the protocol of errors at a frame alone.

    Returns:
        The evaluation's report; `at_frames` is that of the other dataset (None without one), `other_seeds` holds the
        errors of `seeds`, `as_published` those of a paper network that predicts free flight too (None for others).

    Raises:
        SdfsimError: a model of `seeds` is of another preset, or the same again.
    """
    model = load_model(path)
    others = [_other_seed(model, path, other) for other in seeds]
    report = evaluate(data, model=model, chaos_floor=True)
    report["other_seeds"] = [evaluate(data, model=other, errors_only=True)["model"] for other in others]
    report["as_published"] = None
    if model.kind == "paper":
        report["as_published"] = evaluate(data, model=model, free_flight="learned", errors_only=True)["model"]
    report["at_frames"] = None if at_frames is None else evaluate(at_frames, model=model, chaos_floor=True)
    kept = ("model", "ballistic", "other_seeds", "as_published", "chaos_floor", "median_survival_s")
    kept += ("penetration", "energy_gain", "resting_speed")
    results = {"errors": {what: report[what] for what in kept}, "test_trajectories": report["trajectories"]}
    model = replace(model, name=name, card=model.card | results)
    folder.mkdir(parents=True, exist_ok=True)
    model.save(folder / f"{name}.safetensors")
    write_text(folder / f"{name}.md", card_text(model, report))
    return report


def _other_seed(model: Model, path: Path, other: Path) -> Model:
    """A further model, checked to be what the card will say it is: trained likewise, with another outcome."""
    found = load_model(other)
    for what in ("preset_name", "preset", "optimiser_steps", "data"):
        if _trained(found.card, what) != _trained(model.card, what):
            raise SdfsimError(f"{other}: trained with another {what.replace('_', ' ')} than {path}")
    ours, theirs = model.network.state_dict(), found.network.state_dict()
    if all(torch.equal(weights, theirs[key]) for key, weights in ours.items()):
        hint = "`python -m sdfsim.training.train DATA RUN --seed K` trains from another seed"
        raise SdfsimError(f"{other}: the same weights as {path}", hint)
    return found


def _trained(card: dict, what: str) -> Any:
    """An entry of a card, less the test trajectories, which a machine that only trains does not have."""
    if what == "preset":
        return Preset(**card["preset"])  # older cards lack what was the same for all
    if what != "data":
        return card.get(what)
    return [d | {"trajectories": {**d["trajectories"], "test": None}} for d in card["data"]]


def card_text(model: Model, report: dict) -> str:
    """The model card as Markdown."""
    parameters = sum(p.numel() for p in model.network.parameters())
    card, preset = model.card, model.card["preset"]
    folders = _folders(card["data"])
    extra: tables.Rows = []
    if published := report["as_published"]:
        extra.append(("this model, free flight learned too (as published)", *tables.error_cells(published)))
    if others := report.get("other_seeds"):
        several = f"other training seeds ({len(others)}): low - high"
        extra.append((several if len(others) > 1 else "another training seed", *tables.range_cells(others)))
    lines = [
        f"# {model.name}",
        "",
        f"The *{model.kind}* network, {parameters:,} parameters, {json.dumps(preset['config'])}; step {model.dt} s at",
        f"{model.gravity:g} m/s^2 for bodies of {model.length:.2f} m (the middle of the sizes it has seen), rescaled",
        "to any scene (Froude).",
        "",
        "## Training",
        "",
        *(
            f"Data: {d['recipe']} (seed {d['seed']}, {_cast(d)}), made with {d['engine']}{_trajectories(d)}."
            for d in card["data"]
        ),
        "Surfaces and nodes are those of the convex pieces that the engine collides.",
        "",
        *_markdown(_training_rows(card, parameters)),
        "",
        "Repeat with:",
        "",
        *(f"    {line}" for line in _commands(card, folders)),
        f"    python -m sdfsim.evaluation.model_card RUN/model.safetensors {folders[0]} --name {model.name}"
        f"{' --seeds OTHERS' if others else ''}{' --at-frames MOVI-B-60' if report['at_frames'] else ''}",
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
        "from their first frame: translation RMSE and mean rotation error; 95 % intervals over trajectories.",
        "",
        *_markdown(tables.error_rows(report, name=MODEL, ballistic=BASELINE, extra=extra)),
        *_at_frames(report),
        "",
        "## Quality of the motion",
        "",
        *_markdown(tables.quality_rows(report, name=MODEL, ballistic=BASELINE)),
        "",
        *(f"- {line}" for line in tables.notes(report)),
    ]
    return "\n".join(lines) + "\n"


def _at_frames(report: dict) -> list[str]:
    """The other protocol's table, where it was measured."""
    other = report["at_frames"]
    if other is None:
        return []
    told = f"{other['trajectories']} test trajectories of {1 / other['dt']:.0f} frames a second, in a frame alone:"
    about = "translation is the mean over trajectories of the RMSE over bodies."
    rows = tables.error_rows(other, name=MODEL, ballistic=BASELINE, at_frame=True)
    return ["", told, about, "", *_markdown(rows)]


def _cast(made: dict) -> str:
    """How many shapes there are, and if each belongs to one split alone, as a recipe's own scenery does not."""
    recipe = RECIPES.get(made["recipe"])
    if recipe is None or recipe.kubasic or not recipe.given:
        return f"{made['shapes']} shapes"
    own = len(recipe.scenery)
    also = f", and {own} of the recipe's own in all" if own else ""
    return f"{made['shapes'] - own} shapes, each in one split alone{also}"


def _trajectories(made: dict) -> str:
    """How many trained; models of older versions may not know."""
    count = made["trajectories"].get("train")
    return "" if count is None else f"; {count:,} trajectories"


def _commands(card: dict, folders: list[str]) -> list[str]:
    """What makes the data and trains on them."""
    lines = [
        f"sdfsim dataset {made['recipe']} -o {folder}{_rate(made)}{_shapes(made)} --trajectories {count}"
        f" --seed {made['seed']} --split {split}"
        for folder, made in zip(folders, card["data"], strict=True)
        for split, count in made["trajectories"].items()
    ]
    return [*lines, _training(card, folders)]


def _training(card: dict, folders: list[str]) -> str:
    """What trains: `sdfsim train` knows neither seeds nor numbers of steps but the preset's own."""
    name, seed, steps = card["preset_name"], card.get("seed", 0), card["optimiser_steps"]
    usual = PRESETS[name].steps if name in PRESETS else card["preset"]["steps"]
    if seed == 0 and steps == usual:
        return f"sdfsim train {' '.join(f'--data {folder}' for folder in folders)} -o RUN --preset {name}"
    options = (f" --seed {seed}" if seed else "") + (f" --steps {steps}" if steps != usual else "")
    return f"python -m sdfsim.training.train {' '.join(folders)} RUN --preset {name}{options}"


def _shapes(made: dict) -> str:
    """The options that say which shapes a recipe draws from."""
    recipe = RECIPES.get(made["recipe"])
    given = " --shapes SHAPES" if recipe is None or recipe.given else ""
    options = {"random-solids": made.get("random_solids"), "bodies": made.get("bodies")}
    return given + "".join(f" --{option} {count}" for option, count in options.items() if count)


def _rate(made: dict) -> str:
    """The option for a rate of frames that is not the usual one."""
    return f" --fps {made['fps']}" if made.get("fps", FPS) != FPS else ""


def _folders(data: list[dict]) -> list[str]:
    """A folder for each dataset, numbered where several are of one recipe and rate."""
    names = [made["recipe"].upper() + _rate(made).replace(" --fps ", "-") for made in data]
    return [f"{n}-{names[: k + 1].count(n)}" if names.count(n) > 1 else n for k, n in enumerate(names)]


def _training_rows(card: dict, parameters: int) -> tables.Rows:
    """What the training cost."""
    return [
        ("parameters", "optimiser steps", "batch", "time", "where"),
        (
            f"{parameters:,}",
            f"{card['optimiser_steps']:,}",
            str(card["preset"]["batch"]),
            f"{card['seconds']:,} s = {card['seconds'] / 3600:.2f} h",
            f"{card['device']}, {card.get('processes', 1)} process(es) of {card['threads']} thread(s)",
        ),
    ]


def _markdown(rows: tables.Rows) -> list[str]:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return [lines[0], "|" + " --- |" * len(rows[0]), *lines[1:]]


def main() -> None:
    """Command line of this module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--name", required=True)
    parser.add_argument("--at-frames", type=Path, help="dataset of 60 frames a second: errors at frames alone")
    parser.add_argument("--seeds", type=Path, nargs="+", default=[], help="models of the same preset, other seeds")
    args = parser.parse_args()
    report = bundle(args.model, args.data, args.name, seeds=args.seeds, at_frames=args.at_frames)
    print(json.dumps({k: report[k] for k in ("model", "ballistic", "other_seeds")}, indent=2))


if __name__ == "__main__":
    run_main(main)
