"""What a step of the contact solve costs, beside PyBullet's on the same scenes, and how it grows.

    python -m benchmarks.contact_step MOVIB [--repeats 5]

MOVIB is a movi-b dataset. One thread; PyBullet and the solve take turns, and every figure is the median of the repeats.
PyBullet collides convex pieces (a bowl of 144), the solve baked distances; both make five inner steps a step. Loading,
and what a simulator keeps for its recording, is left out.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

os.environ["NUMBA_NUM_THREADS"] = "1"  # before the first import of numba

import numpy as np

from benchmarks.scale import apart, with_nodes_cut
from samples.large import write_scene
from sdfsim.data.batching import scene_of
from sdfsim.data.dataset import FLOOR, Trajectory, load_shapes, trajectory_files
from sdfsim.dynamics.model import load_model
from sdfsim.dynamics.simulator import Simulator
from sdfsim.dynamics.solver import Compiled, compiled_rules, taken_up
from sdfsim.dynamics.units import scene_units
from sdfsim.errors import run_main
from sdfsim.evaluation.engines import Start, bullet, dataset_urdf, start_of_scene
from sdfsim.scene.scene import Scene
from sdfsim.scene.scene_file import load_scene

TRAJECTORIES, STEPS = 10, 100
BALLS, FALL = (16, 512), 200
GROWN = (256, 512)  # bodies far apart
FAR, FAR_OFF = (10, 10_000), np.array([30.0, 30.0, 0.0])  # static ones, and where


def solved(scene: Scene, steps: int, dt: float | None = None, *, sleep: bool = False) -> tuple[float, tuple[int, ...]]:
    """Milliseconds a step of the compiled solve, and what its last step counted (pairs, contacts, ...)."""
    simulator = Simulator(scene, "solver")
    rules = compiled_rules(
        simulator.rules.gravity.numpy(), dt / simulator.units.time if dt else simulator.rules.dt,
        simulator.rules.substeps, sleep=sleep,
    )  # fmt: skip
    inside = Compiled(simulator.bodies, simulator.state)
    motion, manifolds = taken_up(simulator.bodies, simulator.state, inside, rules)
    counts: tuple[int, ...] = ()
    began = time.perf_counter()
    for _ in range(steps):
        manifolds, _, counts = inside.run(motion, manifolds, rules)
    return 1e3 * (time.perf_counter() - began) / steps, counts


def movi_b(data: Path) -> tuple[float, float]:
    """Milliseconds a step of PyBullet and of the solve, mean over trajectories."""
    recorded = [Trajectory.load(f, as_recorded=True) for f in trajectory_files(data, "test")[:TRAJECTORIES]]
    names = {str(n) for t in recorded for n in t.shape}
    shapes, urdfs = load_shapes(data, names), {n: dataset_urdf(data, n) for n in names}
    engine = [bullet(Start(t, urdfs, FLOOR), STEPS)[1].wall_ms for t in recorded]
    ours = [solved(scene_of([t], [0], shapes)[0], STEPS, t.dt)[0] for t in recorded]
    return float(np.mean(engine)), float(np.mean(ours))


def bowl(count: int, folder: Path) -> tuple[float, float]:
    """Milliseconds a step of PyBullet and of the solve."""
    scene = load_scene(write_scene("bowl", folder / str(count), count))
    start = start_of_scene(scene, folder / "engine", scene_units(scene, load_model("solver")))
    return bullet(start, FALL)[1].wall_ms, solved(scene, FALL)[0]


def with_far(count: int) -> Scene:
    """One box that slides on the floor, and static ones far away."""
    scene = apart(count + 1)
    mover, *others, floor = scene.bodies
    still = [replace(b, motion="static", mass=0.0, position=b.position + FAR_OFF) for b in others]
    return replace(scene, bodies=(replace(mover, velocity=np.array([-1.0, 0.0, 0.0])), *still, floor))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("movib", type=Path, help="a movi-b dataset")
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()

    def against(name: str, pairs: list[tuple[float, float]], what: tuple[str, str] = ("PyBullet", "solve")) -> None:
        one, other = np.median(np.array(pairs), axis=0)
        ratio = np.median([b / a for a, b in pairs])
        print(f"{name:44s} {what[0]} {one:9.3f} ms   {what[1]} {other:9.3f} ms   ratio {ratio:.2f}", flush=True)

    with tempfile.TemporaryDirectory() as scratch:
        folder, times = Path(scratch), range(args.repeats)
        against("MOVi-B test, a recorded step", [movi_b(args.movib) for _ in times])
        for count in BALLS:
            against(f"{count} spheres in a bowl", [bowl(count, folder) for _ in times])
        heap = load_scene(write_scene("knots", folder / "knots", 64))
        pairs = {
            "64 knots": (("half of the nodes", with_nodes_cut(heap, 0.5)), ("all", heap), 60),
            "boxes far apart": (*((str(n), apart(n)) for n in GROWN), 50),
            "static boxes far away": (*((str(n), with_far(n)) for n in FAR), 500),
        }
        for name, ((one, few), (other, many), steps) in pairs.items():
            against(name, [(solved(few, steps)[0], solved(many, steps)[0]) for _ in times], (one, other))


if __name__ == "__main__":
    run_main(main)
