"""Bodies that start inside each other: how fast they part, and how far they are apart in the end.

python benchmarks/overlap.py [--model NAME]
"""

from __future__ import annotations

import argparse

import numpy as np

from sdfsim.dynamics.simulator import Simulator
from sdfsim.errors import run_main
from sdfsim.progress import columns
from sdfsim.scene.types import Body, Scene
from sdfsim.shape.shape import analytic_shape

SHAPES = {"ball": analytic_shape("sphere", radius=0.5), "cube": analytic_shape("box", size=(1.0, 1.0, 1.0))}
FLOOR = analytic_shape("plane")
SECONDS = 2.0


def body(name: str, shape: int, place: tuple[float, float, float], motion: str = "dynamic") -> Body:
    moves = motion == "dynamic"
    turn, still = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)
    return Body(name, shape, motion, 1.0, np.array(place), turn, still, still, float(moves), 0.5, 0.5)  # type: ignore[arg-type]


def starts() -> dict[str, Scene]:
    """By name: pairs in free space, one body half in the floor, and a heap on it."""
    found = {}
    for name, shape in SHAPES.items():
        for offset in (0.0, 0.1, 0.5):
            pair = (body("a", 0, (0, 0, 0)), body("b", 0, (offset, 0, 0)))
            found[f"two {name}s, centres {offset:g} m apart"] = Scene((shape,), pair, np.zeros(3), SECONDS)
        found[f"a {name} half in the floor"] = on_floor(shape, [(0, 0, 0)])
    third = (0.0, 0.5, 1.0)
    found["27 cubes, each half in the next"] = on_floor(
        SHAPES["cube"], [(x, y, 0.5 + z) for x in third for y in third for z in third]
    )
    return found


def on_floor(shape, places: list[tuple[float, float, float]]) -> Scene:
    bodies = [body(f"b{k}", 0, place) for k, place in enumerate(places)]
    floor = body("floor", 1, (0, 0, 0), "static")
    return Scene((shape, FLOOR), (*bodies, floor), np.array([0.0, 0.0, -9.81]), SECONDS)


def measured(scene: Scene, model: str | None, guard: str) -> tuple[str, str, str]:
    """Fastest speed, deepest node at the end, and steps in which velocities were held back."""
    rollout = Simulator(scene, model, guard=guard).run()  # type: ignore[arg-type]
    fastest = np.linalg.norm(rollout.velocity, axis=-1).max()
    counters = rollout.counters
    held = int((counters["held_back"] > 0).sum())
    return f"{fastest:.2f} m/s", f"{counters['worst_penetration'][-1]:.2f} m", f"{held} of {len(rollout)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model")
    model = parser.parse_args().model
    head = ("", "fastest", f"deepest after {SECONDS:g} s", "steps held back", "fastest, guard", "deepest", "steps")
    rows = [head]
    for name, scene in starts().items():
        rows.append((name, *measured(scene, model, "none"), *measured(scene, model, "energy")))
    print("\n".join(columns(rows)))


if __name__ == "__main__":
    run_main(main)
