"""What a network is worth on top of the contact solve: docs/simulator.md.

    python benchmarks/network.py DATA [MORE ...] --at-frames DATA-60 -o DIR [--seeds 3] [--steps N]

Trains the presets *alone*, *small* and *long* with every seed on the training trajectories of DATA and MORE, then rolls
them out beside the solver with as many inner steps, on validation and test trajectories of DATA and of DATA-60 (whose
errors are those at a frame alone). Trainings resume, and results that DIR holds are kept. Writes DIR/table.md.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sdfsim.data.batching import every, scene_of
from sdfsim.data.dataset import Trajectory, load_shapes, read_info, trajectory_files
from sdfsim.dynamics.model import SOLVER, load_model
from sdfsim.dynamics.models.contact_graph import SUBSTEPS, ContactGraph
from sdfsim.dynamics.models.impulse import Velocities
from sdfsim.dynamics.simulator import Simulator
from sdfsim.errors import run_main
from sdfsim.evaluation.evaluate import evaluate
from sdfsim.evaluation.harness import Job, Results, markdown, measure, one_thread
from sdfsim.files import write_text
from sdfsim.training.contact_cache import Solved, contact_frames, join_frames
from sdfsim.training.impulse_task import ImpulseTask
from sdfsim.training.presets import PRESETS
from sdfsim.training.train import train

FRAME = "50"  # steps up to which, or at which, errors are told
TIMED, STEPS_TIMED = 5, 100  # scenes, and steps of each


@dataclass(frozen=True)
class Method:
    """A preset, or the solver (None), with steps of so many recorded ones and so many inner steps of the solve."""

    preset: str | None
    stride: int = 1
    substeps: int | None = None


METHODS = {
    "solver, 4 ms": Method(None),
    "solver, 10 ms": Method(None, 1, 2),
    "solver, 20 ms": Method(None, 1, 1),
    "solver, 40 ms": Method(None, 2, 1),
    "network alone, 20 ms": Method("alone"),
    "network on the solve, 4 ms": Method("small"),
    "network on the solve, 20 ms": Method("long"),
    "network on the solve, 40 ms": Method("long", 2),
}


def judged(model: str, method: Method, data: Path, split: str, floor: bool) -> dict[str, Any]:
    """Errors up to `FRAME` and at it alone, and how long a step takes; of the teacher run again, where asked for."""
    report = evaluate(
        data, model=model, split=split, steps=int(FRAME), stride=method.stride, substeps=method.substeps,
        chaos_floor=floor, errors_only=True,
    )  # fmt: skip
    found = {"model": report["model"][max(report["model"], key=int)]}
    again = report.get("chaos_floor", {}).get("perturbations", {})
    return found | {name: errors[FRAME] for name, errors in again.items()}


def timed(model: str, method: Method, data: Path) -> dict[str, Any]:
    """Microseconds of a step of 20 ms, the median of scenes of the validation split, each alone in one thread."""
    used, taken = load_model(model), []
    with one_thread():
        for file in trajectory_files(data, "validation")[:TIMED]:
            start = every(Trajectory.load(file), method.stride)
            scene = scene_of([start], [0], load_shapes(data, {str(n) for n in start.shape}))[0]
            simulator = Simulator(scene, used, dt=start.dt)
            substeps = method.substeps or used.inner or SUBSTEPS * method.stride
            simulator.rules = replace(simulator.rules, substeps=substeps, trust=1.0)
            simulator.run(steps=2)
            began = time.process_time()
            simulator.run(steps=STEPS_TIMED // method.stride)
            taken.append(1e6 * (time.process_time() - began) / STEPS_TIMED)
    return {"us": statistics.median(taken)}


def one_step(folders: list[Path], models: dict[str, list[str]]) -> str:
    """Held-out one-step losses of free flight, the solve, and each preset's networks on the frames that it knows."""
    lines = []
    for preset, paths in models.items():
        plan = PRESETS[preset]
        sets = [contact_frames(f, "validation", Solved(k, plan.inner, 1)) for f in folders for k in plan.strides]
        task = ImpulseTask(join_frames(sets), torch.device("cpu"))
        batches = [task.draw(np.random.default_rng(seed), 64) for seed in range(8)]
        ways: dict[str, Any] = {"free flight": _free, "solve": _solve} | {
            f"seed {k}": load_model(p).network for k, p in enumerate(paths)
        }
        with torch.no_grad():
            found = {name: np.mean([float(task.loss(way, batch)) for batch in batches]) for name, way in ways.items()}
        lines.append(f"{preset}: " + ", ".join(f"{name} {loss:.4f}" for name, loss in found.items()))
    return "\n".join(["One-step losses on held-out frames, m/s", *lines]) + "\n"


def _free(g: ContactGraph, *, mirrored: bool = False) -> Velocities:
    mean = 0.5 * (g.velocity + g.free_velocity), 0.5 * (g.angular + g.free_angular)
    return Velocities(g.free_velocity, g.free_angular, *mean)


def _solve(g: ContactGraph, *, mirrored: bool = False) -> Velocities:
    return Velocities(g.solved_velocity, g.solved_angular, g.mean_velocity, g.mean_angular)


def trained(folders: list[Path], out: Path, preset: str, seed: int, steps: int | None) -> Path:
    """The model of a preset and a seed; trained now, or on from where it was left."""
    place = out / "runs" / f"{preset}-{seed}"
    if not (place / "model.safetensors").exists():
        resume = (place / "checkpoint.npz").exists()
        train(folders, place, preset=preset, seed=seed, steps=steps, resume=resume, on_progress=told)
    return place / "model.safetensors"


def told(fraction: float, message: str) -> None:
    print(f"{fraction:6.1%}  {message}", flush=True)


def cell(results: Results, name: str, seeds: list[int], key: str, at_frame: bool) -> str:
    """Mean over seeds; in brackets their range, where there are several, and the first one's interval over scenes."""
    found = [results[key, f"{name}, seed {seed}"] for seed in seeds if (key, f"{name}, seed {seed}") in results]
    if not found or "failed" in found[0]:
        return found[0]["failed"] if found else "-"
    errors = [one["model"]["at_frame"] if at_frame else one["model"] for one in found]
    metres, degrees = ([e[what] for e in errors] for what in ("translation_rmse", "rotation_error"))
    low, high = errors[0]["translation_rmse_95"]
    between = f"seeds {min(metres):.3f} to {max(metres):.3f}; " if len(metres) > 1 else ""
    return f"{np.mean(metres):.3f} m ({between}{low:.3f} to {high:.3f}), {np.mean(degrees):.1f}°"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="+")
    parser.add_argument("--at-frames", type=Path, required=True)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, help="of training, in place of the presets'")
    chosen = parser.parse_args()
    seeds, first = list(range(chosen.seeds)), chosen.data[0]
    places = [(data, split) for data in (first, chosen.at_frames) for split in ("validation", "test")]
    jobs: list[Job] = []
    models: dict[str, list[str]] = {}
    for name, method in METHODS.items():
        for seed in seeds if method.preset else seeds[:1]:
            model = SOLVER
            if method.preset:
                model = str(trained(chosen.data, chosen.out, method.preset, seed, chosen.steps))
                if model not in models.setdefault(method.preset, []):
                    models[method.preset].append(model)
            content = [method, load_model(model).network if method.preset else None, read_info(first)]
            for data, split in places:
                key, floor = f"{data.name}-{split}", name == next(iter(METHODS))
                more = (model, method, data, split, floor)
                jobs.append(Job(key, f"{name}, seed {seed}", [content, key], judged, more))
            if seed == 0:
                jobs.append(Job("time", name, content, timed, (model, method, first)))
    results = measure(jobs, chosen.out / "results", on_progress=told)
    head = ("", *(f"{data.name}, {split}" for data, split in places), "µs for 20 ms")
    rows: list[tuple[str, ...]] = [head]
    for name in METHODS:
        cells = [cell(results, name, seeds, f"{d.name}-{s}", d == chosen.at_frames) for d, s in places]
        rows.append((name, *cells, f"{results['time', name].get('us', float('nan')):.0f}"))
    solver = f"{next(iter(METHODS))}, seed 0"
    for size in ("1e-6", "1e-3"):
        cells = []
        for data, split in places:
            errors = results[f"{data.name}-{split}", solver].get(size)
            errors = errors["at_frame"] if errors and data == chosen.at_frames else errors
            cells.append("-" if not errors else f"{errors['translation_rmse']:.3f} m, {errors['rotation_error']:.1f}°")
        rows.append((f"the teacher again, {size} m/s off", *cells, ""))
    table = markdown(rows) + "\n" + one_step(chosen.data, models)
    write_text(chosen.out / "table.md", table)
    print(table)


if __name__ == "__main__":
    run_main(main)
