"""Which choices make the impulse network as accurate as it is: each is changed alone, trained briefly and rolled out.

    python benchmarks/simulator.py DATA -o DIR [--meshes MESHES]

DATA is a movi-b dataset. Every variant trains on its first trajectories for a few thousand steps and is judged on
validation trajectories, so differences are what counts, not the level. Finished variants are kept in DIR and not
trained again; the table is printed and written to DIR/table.md. MESHES (the folders that DATA was made from) adds the
variant whose surfaces are the detailed meshes.
"""

from __future__ import annotations

import argparse
import re
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from sdfsim.data.dataset import read_info, trajectory_files
from sdfsim.errors import run_main
from sdfsim.evaluation.evaluate import evaluate
from sdfsim.files import read_json, write_json, write_text
from sdfsim.shape.fit import fit_mesh
from sdfsim.shape.mesh import load_mesh
from sdfsim.shape.shape import Shape, load_shape
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
    """One change against the preset *small*.

    Attributes:
        name: in the table.
        plan: how it is trained.
        noise: of the inputs.
        task: what is minimised.
        shapes: name of the set of shapes in `SHAPES`.
    """

    name: str
    plan: Preset = SMALL
    noise: Noise | None = USUAL
    task: type[ImpulseTask] = ImpulseTask
    shapes: str = "pieces"


def sized(width: int, rounds: int) -> Preset:
    """The preset at another size."""
    return replace(SMALL, config={"width": width, "rounds": rounds})


VARIANTS = [
    Variant("as the preset *small*"),
    Variant("Adam alone, no Muon", replace(SMALL, matrix_rate=None)),
    Variant("no noise", noise=None),
    Variant("noise of 0.3 mm and 3 mm/s in every frame", noise=Noise(0.0003, 0.003, 1.0)),
    Variant("noise of 1.5 mm and 15 mm/s in every frame", noise=Noise(0.0015, 0.015, 1.0)),
    Variant("squared error", task=Squared),
    Variant("unrolled over 2 steps", replace(SMALL, in_row=2, late=1.0)),
    Variant("unrolled over 4 steps", replace(SMALL, in_row=4, late=1.0)),
    Variant("matrix products in bfloat16", replace(SMALL, bf16=True)),
    Variant("32 wide, 6 rounds", sized(32, 6)),
    Variant("64 wide, 3 rounds", sized(64, 3)),
    Variant("96 wide, 6 rounds", sized(96, 6)),
    Variant("contact radius D = 0.05 m", replace(SMALL, reach=0.05)),
    Variant("contact radius D = 0.2 m", replace(SMALL, reach=0.2)),
    Variant("64 nodes a body", shapes="64 nodes"),
    Variant("128 nodes a body", shapes="128 nodes"),
]
DETAILED = Variant("surfaces and nodes of the detailed meshes", shapes="detailed")


def subset(data: Path, out: Path, change: Callable[[str, Shape], Shape]) -> Path:
    """A dataset of the first trajectories of `data` whose shapes are changed; made once."""
    if (out / "dataset.json").exists():
        return out
    for split, count in (("train", TRAIN), ("validation", VALIDATION)):
        (out / split).mkdir(parents=True, exist_ok=True)
        for file in trajectory_files(data, split)[:count]:
            shutil.copy(file, out / split / file.name)
    for folder in sorted((data / "shapes").iterdir()):
        if (folder / "shape.json").exists():
            change(folder.name, load_shape(folder)).save(out / "shapes" / folder.name)
    shutil.copy(data / "dataset.json", out / "dataset.json")
    return out


def shapes_of(meshes: Path | None) -> dict[str, Callable[[str, Shape], Shape]]:
    """How each set of shapes comes from the dataset's."""

    def detailed(name: str, shape: Shape) -> Shape:
        assert meshes is not None
        fitted = fit_mesh(load_mesh(meshes / name / "visual_geometry.obj"), name=name, nodes=len(shape.nodes))
        return replace(fitted, com=shape.com)  # the dataset's bodies turn about the engine's centre of mass

    return {
        "pieces": lambda name, shape: shape,
        "64 nodes": lambda name, shape: replace(shape, nodes=shape.nodes[:64]),
        "128 nodes": lambda name, shape: replace(shape, nodes=shape.nodes[:128]),
        "detailed": detailed,
    }


def measure(variant: Variant, data: Path, steps: int) -> dict:
    """Train a variant, then its one-step loss and rollout errors on held-out trajectories."""
    device = torch.device("cpu")
    frames = {split: contact_frames(data, split, variant.plan.reach) for split in ("train", "validation")}
    task = variant.task(frames["train"], device, variant.noise)
    held_out = ImpulseTask(frames["validation"], device, None)
    run = Run(variant.plan, task, steps, 0, device)
    started = time.perf_counter()
    while run.step < steps:
        run.advance()
    seconds = time.perf_counter() - started
    model = run.export(name="variant", data=[read_info(data)], ranges=task.ranges())
    report = evaluate(data / "validation", model=model, steps=50, errors_only=True)
    errors = report["model"]["50"]
    return {
        "loss": held_out_loss(run, held_out),
        "metres": errors["translation_rmse"],
        "metres_95": errors["translation_rmse_95"],
        "degrees": errors["rotation_error"],
        "ms_per_step": 1e3 * seconds / steps,
        "edges_per_frame": len(frames["train"].first) / len(frames["train"]),
    }


def table(results: dict[str, dict]) -> str:
    """The results as Markdown."""
    lines = [
        "| variant | held-out one-step loss | m, 50 steps | degrees | edges a frame | training, ms a step |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name, r in results.items():
        low, high = r["metres_95"]
        cells = (f"{r['loss']:.4f}", f"{r['metres']:.3f} ({low:.3f} to {high:.3f})", f"{r['degrees']:.1f}")
        cells += (f"{r['edges_per_frame']:.0f}", f"{r['ms_per_step']:.0f}")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Command line of this script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--meshes", type=Path)
    parser.add_argument("--steps", type=int, default=STEPS)
    args = parser.parse_args()
    changes = shapes_of(args.meshes)
    results = {}
    for variant in [*VARIANTS, *([DETAILED] if args.meshes else [])]:
        kept = args.out / f"{re.sub('[^A-Za-z0-9.]+', '_', variant.name)}-{args.steps}.json"
        if not kept.exists():
            data = subset(args.data, args.out / "data" / variant.shapes.replace(" ", "_"), changes[variant.shapes])
            found = measure(variant, data, args.steps)
            write_json(kept, found)
        results[variant.name] = read_json(kept)
        write_text(args.out / "table.md", table(results))
        print(variant.name, results[variant.name], flush=True)
    print(table(results))


if __name__ == "__main__":
    run_main(main)
