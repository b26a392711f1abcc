"""What every effect costs, and what is saved where it is off, on the samples: docs/effects.md.

    python benchmarks/effects.py -o DIR [--steps 50] [--model NAME] [--paper MODEL]

Times are medians of whole steps on one thread. MODEL is a *paper* network: it then runs with every body in it in every
step, as published, and with those in contact alone. Writes DIR/table.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from sdfsim import Simulator, load_scene
from sdfsim.errors import run_main
from sdfsim.evaluation.hard_cases import body, box, on_floor
from sdfsim.evaluation.harness import Job, machine, markdown, measure, number
from sdfsim.files import write_text
from sdfsim.scene.scene import Effects, Limits, Scene

SAMPLES = Path(__file__).resolve().parents[1] / "samples"
COUNTS = ("contacts", "edges", "active", "asleep")
VARIANTS: dict[str, Callable[[Scene], Scene]] = {
    "as it is": lambda scene: scene,
    "sleep on": lambda scene: replace(scene, effects=Effects(sleep="on")),
    "sleep off": lambda scene: replace(scene, effects=Effects(sleep="off")),
    "gravity 0": lambda scene: replace(scene, gravity=np.zeros(3)),
    "friction off": lambda scene: replace(scene, effects=Effects(friction="off")),
    "restitution off": lambda scene: replace(scene, effects=Effects(restitution="off")),
    "rotation off": lambda scene: replace(scene, effects=Effects(rotation="off")),
    "contact off": lambda scene: replace(scene, effects=Effects(contact="off")),
    "memory 0.01 GiB": lambda scene: replace(scene, limits=Limits(0.01)),
}


def pile(count: int, touching: int | None = None, scenery: int = 0) -> Scene:
    """Boxes of 1 m in stacks of two within reach of each other, and boxes that do not move 1 km away.

    Args:
        count: of the boxes that move.
        touching: all but so many hang in the air, out of each other's reach.
        scenery: of those that do not.
    """
    places = np.array([[1.05 * (k // 2 % 32), 1.05 * (k // 64), 0.5 + k % 2] for k in range(count)])
    places[touching or count :] = 3 * places[touching or count :] + [0.0, 0.0, 500.0]
    far = [[1e3 + 2.0 * (k % 100), 2.0 * (k // 100), 0.5] for k in range(scenery)]
    bodies = [body(f"b{k}", 0, place) for k, place in enumerate(places)]
    return on_floor([box(1.0)], bodies + [body(f"s{k}", 0, p, motion="static", mass=0.0) for k, p in enumerate(far)])


def cost(scene: Scene, steps: int, model: str | None, learned: bool = False) -> dict:
    """Median ms of a step, and mean counts."""
    torch.set_num_threads(1)
    simulator = Simulator(scene, model, free_flight="learned" if learned else "exact")
    counters = simulator.run(steps=steps).counters
    return {"ms": float(np.median(counters["step_ms"][1:]))} | {k: float(counters[k][1:].mean()) for k in COUNTS}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--model")
    parser.add_argument("--paper", help="weights of a paper network")
    chosen = parser.parse_args()
    scenes = {file.stem: load_scene(file) for file in sorted(SAMPLES.glob("*.yaml"))}
    runs = [
        (name, what, change(scene), chosen.model) for name, scene in scenes.items() for what, change in VARIANTS.items()
    ]
    for name, scene in scenes.items() if chosen.paper else ():
        runs += [
            (name, "paper, as published", scene, chosen.paper),
            (name, "paper, in contact only", scene, chosen.paper),
        ]
    runs += [("8 boxes", f"{n} static ones far away", pile(8, scenery=n), chosen.model) for n in (10, 10_000)]
    runs += [("1,000 boxes", f"{n} of them touch", pile(1000, touching=n), chosen.model) for n in (5, 1000)]
    content = [chosen.steps, machine()]
    jobs = [
        Job(case, what, [content, model], cost, (scene, chosen.steps, model, what.endswith("published")))
        for case, what, scene, model in runs
    ]
    results = measure(jobs, chosen.out / "results", on_progress=lambda _, message: print(message, flush=True))
    rows: list[tuple[str, ...]] = [("scene", "variant", "ms a step", *COUNTS)]
    for (case, what), found in results.items():
        time = found.get("failed") or number(found["ms"])
        rows.append((case, what, time, *(number(found.get(name)) for name in COUNTS)))
    write_text(chosen.out / "table.md", markdown(rows))
    print(markdown(rows))


if __name__ == "__main__":
    run_main(main)
