"""Which choices make the impulse network as accurate as it is: each is changed alone, trained briefly and rolled out.

    python benchmarks/ablations.py DATA -o DIR

DATA is a movi-b dataset. Every variant trains on its first trajectories for a few thousand steps and is judged on
validation trajectories, so differences are what counts, not the level. Finished variants are kept in DIR and not
trained again; the table is printed and written to DIR/table.md.
"""

from __future__ import annotations

import argparse
import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from sdfsim.data.dataset import read_info, trajectory_files
from sdfsim.errors import run_main
from sdfsim.evaluation.evaluate import evaluate
from sdfsim.evaluation.harness import Job, markdown, measure, number
from sdfsim.files import write_text
from sdfsim.shape.shape import load_shape
from sdfsim.training.contact_cache import contact_frames
from sdfsim.training.impulse_task import ImpulseTask, Noise
from sdfsim.training.presets import PRESETS, Preset
from sdfsim.training.run import Run, held_out_loss

TRAIN, VALIDATION = 150, 40  # trajectories
STEPS = 1500
SMALL, USUAL = PRESETS["small"], Noise()


class Squared(ImpulseTask):
    """The squared error in place of the pseudo-Huber one."""

    @staticmethod
    def size_of(error: Tensor) -> Tensor:
        return error.square().sum(-1)


@dataclass(frozen=True)
class Variant:
    """One change against the preset *small*: how it is trained, noise of the inputs, the loss, and nodes a body."""

    plan: Preset = SMALL
    noise: Noise | None = USUAL
    task: type[ImpulseTask] = ImpulseTask
    nodes: int | None = None


def sized(width: int, rounds: int) -> Preset:
    """The preset at another size."""
    return replace(SMALL, config={"width": width, "rounds": rounds})


VARIANTS = {
    "as the preset small": Variant(),
    "Adam alone, no Muon": Variant(replace(SMALL, matrix_rate=None)),
    "no noise": Variant(noise=None),
    "noise of 0.3 mm and 3 mm per s in every frame": Variant(noise=Noise(0.0003, 0.003, 1.0)),
    "noise of 1.5 mm and 15 mm per s in every frame": Variant(noise=Noise(0.0015, 0.015, 1.0)),
    "squared error": Variant(task=Squared),
    "unrolled over 2 steps": Variant(replace(SMALL, in_row=2, late=1.0)),
    "unrolled over 4 steps": Variant(replace(SMALL, in_row=4, late=1.0)),
    "matrix products in bfloat16": Variant(replace(SMALL, bf16=True)),
    "32 wide, 6 rounds": Variant(sized(32, 6)),
    "64 wide, 3 rounds": Variant(sized(64, 3)),
    "96 wide, 6 rounds": Variant(sized(96, 6)),
    "contact radius D = 0.05 m": Variant(replace(SMALL, reach=0.05)),
    "contact radius D = 0.2 m": Variant(replace(SMALL, reach=0.2)),
    "64 nodes a body": Variant(nodes=64),
    "128 nodes a body": Variant(nodes=128),
}


def subset(data: Path, out: Path, nodes: int | None) -> Path:
    """A dataset of the first trajectories of `data` whose shapes have so many nodes; made once."""
    if (out / "dataset.json").exists():
        return out
    for split, count in (("train", TRAIN), ("validation", VALIDATION)):
        (out / split).mkdir(parents=True, exist_ok=True)
        for file in trajectory_files(data, split)[:count]:
            shutil.copy(file, out / split / file.name)
    for folder in sorted((data / "shapes").iterdir()):
        if (folder / "shape.json").exists():
            shape = load_shape(folder)
            replace(shape, nodes=shape.nodes[:nodes]).save(out / "shapes" / folder.name)
    shutil.copy(data / "dataset.json", out / "dataset.json")
    return out


def train(variant: Variant, data: Path, out: Path, steps: int) -> dict:
    """Train a variant, then tell its one-step loss and rollout errors on held-out trajectories."""
    data, device = subset(data, out / "data" / str(variant.nodes), variant.nodes), torch.device("cpu")
    frames = {split: contact_frames(data, split, variant.plan.reach) for split in ("train", "validation")}
    task = variant.task(frames["train"], device, variant.noise)
    held_out = ImpulseTask(frames["validation"], device, None)
    run = Run(variant.plan, task, steps, 0, device)
    started = time.perf_counter()
    while run.step < steps:
        run.advance()
    seconds = time.perf_counter() - started
    model = run.export(name="variant", data=[read_info(data)], ranges=task.ranges())
    found = evaluate(data / "validation", model=model, steps=50, errors_only=True)["model"]["50"]
    return {
        "loss": held_out_loss(run, held_out),
        "m, 50 steps": found["translation_rmse"],
        "95 % from": found["translation_rmse_95"][0],
        "to": found["translation_rmse_95"][1],
        "degrees": found["rotation_error"],
        "edges a frame": len(frames["train"].first) / len(frames["train"]),
        "training, ms a step": 1e3 * seconds / steps,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=STEPS)
    chosen = parser.parse_args()
    jobs = [
        Job("movi-b", name, [read_info(chosen.data), v.plan, v.noise, v.task.__name__, v.nodes, chosen.steps], train,
            (v, chosen.data, chosen.out, chosen.steps))
        for name, v in VARIANTS.items()
    ]  # fmt: skip
    results = measure(jobs, chosen.out / "results", on_progress=lambda _, message: print(message, flush=True))
    rows = [("variant", *next(found for found in results.values() if "failed" not in found))]
    rows += [
        (name, *(found.get("failed") or number(found[key]) for key in rows[0][1:]))
        for (_, name), found in results.items()
    ]
    write_text(chosen.out / "table.md", markdown(rows))
    print(markdown(rows))


if __name__ == "__main__":
    run_main(main)
