"""The gain of a network on top of the contact solve: docs/simulator.md.

    python -m benchmarks network DATA [MORE ...] -o DIR [--seeds 3] [--steps N]

Trains the presets *alone* and *small* with every seed on the training trajectories of DATA and MORE, then rolls them
out, and the solver with the same inner steps, on validation and test trajectories of DATA. Trainings resume, and
results in DIR are kept. Writes DIR/table.md.
"""

import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.results import progress
from sdfsim.base.files import write_text
from sdfsim.data.batching import scene_of
from sdfsim.data.dataset import conditions_of, read_info
from sdfsim.evaluation.engines import timed_rollout
from sdfsim.evaluation.evaluate import evaluate, load_recorded
from sdfsim.evaluation.harness import Job, markdown, measure, one_thread
from sdfsim.learned.contact_graph import ContactGraph
from sdfsim.learned.impulse import Velocities
from sdfsim.learned.model import SOLVER, load_model
from sdfsim.physics.options import SUBSTEPS
from sdfsim.simulate.simulator import Simulator
from sdfsim.simulate.steppers import stepper_of
from sdfsim.training.contact_cache import Solved, contact_frames, join_frames
from sdfsim.training.impulse_task import ImpulseTask
from sdfsim.training.train import train

HORIZON = "50"  # steps over which errors are measured
SPLITS = ("validation", "test")
TIMED, STEPS_TIMED = 5, 100  # scenes, and steps of each


@dataclass(frozen=True)
class Method:
    """A preset, or the solver (None), with a number of inner steps of the solve in a recorded step."""

    preset: str | None
    substeps: int | None = None


METHODS = {
    "solver, 4 ms": Method(None),
    "solver, 10 ms": Method(None, 2),
    "solver, 20 ms": Method(None, 1),
    "network alone, 20 ms": Method("alone"),
    "network on the solve, 4 ms": Method("small"),
}


def judged(model: str, method: Method, data: Path, split: str, floor: bool) -> dict[str, Any]:
    """Errors up to `HORIZON`; those of PyBullet run again, if requested."""
    report = evaluate(
        data, model=model, split=split, steps=int(HORIZON), substeps=method.substeps, chaos_floor=floor,
        errors_only=True,
    )  # fmt: skip
    found = {"model": report["model"][max(report["model"], key=int)]}
    again = report.get("chaos_floor", {}).get("perturbations", {})
    return found | {name: errors[HORIZON] for name, errors in again.items()}


def timed(model: str, method: Method, data: Path) -> dict[str, Any]:
    """Microseconds of a step of 20 ms, the median of scenes of the validation split, each alone in one thread."""
    used, taken = load_model(model), []
    with one_thread():
        recorded, shapes = load_recorded(data, "validation", most=TIMED)
        for start in recorded:
            scene = scene_of([start], [0], shapes, conditions_of(data).floor)[0]
            simulator = Simulator(scene, used, dt=start.dt)
            substeps = method.substeps or used.inner or SUBSTEPS
            simulator.options = simulator.options._replace(substeps=substeps)
            simulator.stepper = stepper_of(used)  # accept the network for any scene
            taken.append(1e3 * timed_rollout(simulator, STEPS_TIMED)[1].cpu_ms)
    return {"us": statistics.median(taken)}


def one_step(folders: list[Path], models: dict[str, list[str]]) -> str:
    """Held-out one-step losses of free flight, the solve, and each preset's networks."""
    lines = []
    task = ImpulseTask(join_frames([contact_frames(f, "validation", Solved(1)) for f in folders]))
    batches = [task.draw(np.random.default_rng(seed), 64) for seed in range(8)]
    for preset, paths in models.items():
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


def trained(folders: list[Path], out: Path, preset: str, seed: int, steps: int | None) -> str:
    """The model of a preset and a seed; trained now, or resumed."""
    place = out / "runs" / f"{preset}-{seed}"
    if not (place / "model.safetensors").exists():
        resume = (place / "checkpoint.npz").exists()
        train(folders, place, preset=preset, seed=seed, steps=steps, resume=resume, on_progress=progress)
    return str(place / "model.safetensors")


def cell(found: list[dict[str, Any]]) -> str:
    """Mean over seeds; in brackets their range, if there are several, and the first one's interval over scenes."""
    if not found or "failed" in found[0]:
        return found[0]["failed"] if found else "-"
    metres, degrees = ([one[what] for one in found] for what in ("translation_rmse", "rotation_error"))
    low, high = found[0]["translation_rmse_95"]
    between = f"seeds {min(metres):.3f} to {max(metres):.3f}; " if len(metres) > 1 else ""
    return f"{np.mean(metres):.3f} m ({between}{low:.3f} to {high:.3f}), {np.mean(degrees):.1f}°"


def main(data: list[Path], *, out: Path, seeds: int = 3, steps: int | None = None) -> None:
    first = data[0]
    jobs: list[Job] = []
    presets = dict.fromkeys(method.preset for method in METHODS.values() if method.preset)
    models = {preset: [trained(data, out, preset, seed, steps) for seed in range(seeds)] for preset in presets}
    for name, method in METHODS.items():
        for seed, model in enumerate(models[method.preset] if method.preset else [SOLVER]):
            content = [method, load_model(model).network if method.preset else None, read_info(first)]
            for split in SPLITS:
                arguments = (model, method, first, split, name == next(iter(METHODS)))
                jobs.append(Job(split, f"{name}, seed {seed}", [content, split], judged, arguments))
            if seed == 0:
                jobs.append(Job("time", name, content, timed, (model, method, first)))
    results = measure(jobs, out / "results", on_progress=progress)

    def errors(name: str, who: str) -> list[list[dict[str, Any]]]:
        """By split and seed, the errors of the model or of PyBullet run again."""
        found = []
        for split in SPLITS:
            runs = [results.get((split, f"{name}, seed {seed}"), {}) for seed in range(seeds)]
            found.append([run.get(who, run) for run in runs if who in run or "failed" in run])
        return found

    rows: list[tuple[str, ...]] = [("", *SPLITS, "µs for 20 ms")]
    for name in METHODS:
        us = results["time", name].get("us", float("nan"))
        rows.append((name, *map(cell, errors(name, "model")), f"{us:.0f}"))
    for size in ("1e-6", "1e-3"):
        rows.append((f"the teacher again, {size} m/s off", *map(cell, errors(next(iter(METHODS)), size)), ""))
    table = markdown(rows) + "\n" + one_step(data, models)
    write_text(out / "table.md", table)
    print(table)
