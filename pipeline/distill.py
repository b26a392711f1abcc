"""Trains the field on posed photos, measures it on held-out ones, and keeps it in a folder."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open

from pipeline.cameras import Sparse, View
from pipeline.field import Field, FieldSize, GridField
from pipeline.held_out import HeldOut, score
from pipeline.landmarks import find_landmarks
from pipeline.mlp_field import MlpField, MlpSize
from pipeline.mlp_trainer import trainer_for
from pipeline.normalise import Normalisation, find_normalisation
from pipeline.photos import load_photos
from pipeline.rays import held_out, load_rays
from pipeline.recipe import Recipe
from pipeline.snapshots import Snapshots
from pipeline.trainer import Trainer
from sdfsim.errors import SdfsimError
from sdfsim.files import replacing, write_json
from sdfsim.parallel import choose_threads

Progress = Callable[[float, str], None]

FEWEST_STEPS = 100  # with however small a budget
PACE = 25  # steps between looks at the clock


@dataclass
class Trained:
    """A trained field and where its space lies in the world of the poses."""

    field: Field
    beta: float
    normalisation: Normalisation
    report: dict


def train(
    views: list[View], sparse: Sparse, photos_folder: Path, out: Path, *, recipe: Recipe, budget: float | None = None,
    seed: int = 0, device: str = "cpu", threads: int | None = None, checkpoint_every: float = 20.0,
    on_progress: Progress | None = None,
) -> Trained:  # fmt: skip
    """Trains a field and writes `field.safetensors` and `field.json` to `out`; resumes from `checkpoint.safetensors`.

    Args:
        views: posed cameras in the world of the poses.
        sparse: points in the same world.
        photos_folder: of the photos stage.
        out: existing folder.
        recipe: see `PRESETS`.
        budget: s of training, those before a kill included; the number of steps is cut to what fits, measured after
            the first steps.
        seed: of everything random.
        device: where to compute.
        threads: of the CPU; None takes what is fastest now (a second thread only slows things down where another
            program uses the core).
        checkpoint_every: s.
        on_progress: called with (fraction, message).

    Raises:
        SdfsimError: the loss is no longer finite.
    """
    out = Path(out)
    masked = all(photo.mask for photo in load_photos(photos_folder))
    normalisation = find_normalisation(views, sparse, masked=masked)
    local = normalisation.views(views)
    test = held_out(len(views))
    rays = load_rays([v for i, v in enumerate(local) if i not in test], photos_folder, recipe.long_side, masks=masked)
    landmarks = find_landmarks(sparse, local, normalisation)
    make = trainer_for(recipe.size)
    trainer = make(recipe, rays, landmarks, seed, device)
    checkpoint = out / "checkpoint.safetensors"
    resumed = trainer.load(checkpoint)
    per_step = calibrate(make(recipe, trainer.rays, landmarks, seed, device), threads)
    if budget is not None and not resumed:
        trainer.iterations = min(recipe.iterations, max(FEWEST_STEPS, int(budget / per_step)))
    left = None if budget is None else budget - trainer.seconds
    held = HeldOut([local[i] for i in test], photos_folder, trainer, masked=masked) if test else None
    snapshots = Snapshots(out, trainer, held)
    saved, started, first = time.monotonic(), time.monotonic(), trainer.iteration
    before = trainer.seconds
    smooth: dict[str, float] = {}
    while trainer.iteration < trainer.iterations:
        losses = trainer.step()
        smooth = {k: 0.95 * smooth.get(k, v) + 0.05 * v for k, v in losses.items()}
        if not all(math.isfinite(v) for v in losses.values()):
            raise SdfsimError(
                "distill: the loss is no longer finite",
                "the poses may be wrong: look at the cameras in the report, or take more photos",
            )
        snapshots.take(smooth)
        now = time.monotonic()
        trainer.seconds = before + now - started
        if left is not None and trainer.iteration % PACE == 0:
            trainer.iterations = paced(trainer, recipe, left, now - started, trainer.iteration - first)
        if now - saved > checkpoint_every:
            trainer.save(checkpoint)
            saved = now
        if on_progress and trainer.iteration % 10 == 0:
            on_progress(0.92 * trainer.fraction, f"step {trainer.iteration} of {trainer.iterations}, "
                        f"colour error {smooth['color']:.4f}")  # fmt: skip
    trainer.save(checkpoint)
    trainer.refresh()
    beta = trainer.beta
    scores = {}
    if held:
        scores = score(held, out, lambda part, text: on_progress(0.92 + 0.08 * part, text) if on_progress else None)
    report = {
        "iterations": trainer.iterations, "rays": len(rays), "train_seconds": round(trainer.seconds, 1),
        "seconds_before": round(before, 1), "resumed": resumed, "masked": masked, "beta": beta,
        "threads": torch.get_num_threads(), "losses": {k: round(v, 5) for k, v in smooth.items()},
        "snapshots": snapshots.curve, **scores,
    }  # fmt: skip
    save_field(trainer.field, beta, normalisation, report, out)
    checkpoint.unlink(missing_ok=True)
    return Trained(trainer.field.cpu(), beta, normalisation, report)


def calibrate(probe: Trainer, threads: int | None) -> float:
    """Seconds a step, late in training; sets the number of threads to `threads`, or to the fastest."""
    probe.iteration, probe.iterations = 9701, 10_000  # Late in training all levels are active.
    probe.refresh()
    return choose_threads(probe.step, threads if probe.device == "cpu" else torch.get_num_threads())


def paced(trainer: Trainer, recipe: Recipe, budget: float, elapsed: float, done: int) -> int:
    """Steps that fit into the time: the measured pace may be another than before training, when other work goes on.

    Args:
        trainer: in training.
        recipe: whose number of steps is never exceeded.
        budget: s, for the steps of this run.
        elapsed: s since it began.
        done: steps since it began.
    """
    left = int((budget - elapsed) / (elapsed / done))
    least = max(trainer.iteration, min(FEWEST_STEPS, recipe.iterations))
    if left <= 0:
        return least
    # Schedules follow the share that is done: they must not jump.
    wanted = min(recipe.iterations, trainer.iteration + left)
    low, high = int(0.9 * trainer.iterations), int(1.1 * trainer.iterations)
    return max(least, min(max(wanted, low), high))


def save_field(field: Field, beta: float, normalisation: Normalisation, report: dict, folder: Path) -> None:
    """Writes `field.safetensors`, then `field.json`."""
    tensors = {k: v.detach().cpu().contiguous() for k, v in field.state_dict().items()}
    with replacing(folder / "field.safetensors") as partial:
        partial.write_bytes(safetensors.torch.save(tensors))
    about = {
        "version": 1, "size": field.size.to_dict(), "start_radius": field.start_radius, "beta": beta,
        "center": normalisation.center.tolist(), "radius": normalisation.radius, "report": report,
    }  # fmt: skip
    write_json(folder / "field.json", about)


def load_field(folder: Path) -> Trained:
    """Reads what `train` wrote.

    Raises:
        SdfsimError: no readable field in `folder`.
    """
    try:
        about = json.loads((Path(folder) / "field.json").read_text(encoding="utf-8"))
        size, radius = about["size"], float(about["start_radius"])
        if "levels" in size:
            size = replace(FieldSize(**size), levels=tuple(size["levels"]), channels=tuple(size["channels"]))
            field: Field = GridField(size, start_radius=radius)
        else:
            field = MlpField(MlpSize(**size), start_radius=radius)
        with safe_open(str(Path(folder) / "field.safetensors"), "pt") as file:
            field.load_state_dict({key: file.get_tensor(key) for key in file.keys()})
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise SdfsimError(f"{folder}: no trained field", "run the distill stage first") from error
    place = Normalisation(np.array(about["center"]), float(about["radius"]))
    return Trained(field, float(about["beta"]), place, about["report"])
