"""What a step of the contact solve costs, beside PyBullet's on the same scenes, and how it grows.

    python benchmarks/contact_step.py MOVIB [--repeats 5]

MOVIB is a movi-b dataset. One thread; PyBullet and the solve take turns, and every figure is the median of the repeats.
PyBullet collides convex pieces (a bowl of 144), the solve baked distances; both make five inner steps a step. Loading,
and what a simulator keeps for its recording, is left out.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

os.environ["NUMBA_NUM_THREADS"] = "1"  # before the first import of numba

import numpy as np

from benchmarks.scale_parts.engines import bullet
from benchmarks.scale_parts.ours import apart, with_nodes_cut
from samples.large import write_scene
from sdfsim.data.batching import scene_of
from sdfsim.data.dataset import Trajectory, load_shapes, trajectory_files
from sdfsim.dynamics.simulator import Simulator
from sdfsim.dynamics.solver import Compiled, compiled_rules, taken_up
from sdfsim.errors import run_main
from sdfsim.evaluation.baselines import engine_file, started
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
        manifolds, counts = inside.run(motion, manifolds, rules)
    return 1e3 * (time.perf_counter() - began) / steps, counts


def timed(frames: Iterator, steps: int) -> float:
    """Milliseconds a step of an engine that is ready at its first frame."""
    next(frames)
    began = time.perf_counter()
    for _ in frames:
        pass
    return 1e3 * (time.perf_counter() - began) / steps


def movi_b(data: Path) -> tuple[float, float]:
    """Milliseconds a step of PyBullet and of the solve, mean over trajectories."""
    recorded = [Trajectory.load(f, as_recorded=True) for f in trajectory_files(data, "test")[:TRAJECTORIES]]
    names = {str(n) for t in recorded for n in t.shape}
    shapes, urdfs = load_shapes(data, names), {n: engine_file(data, n) for n in names}
    engine, ours = [], []
    for t in recorded:
        with started(t, urdfs, (0.3, 0.5)) as teacher:
            teacher.run(0)
            began = time.perf_counter()
            teacher.run(STEPS)
            engine.append(1e3 * (time.perf_counter() - began) / STEPS)
        ours.append(solved(scene_of([t], [0], shapes)[0], STEPS, t.dt)[0])
    return float(np.mean(engine)), float(np.mean(ours))


def bowl(count: int, folder: Path) -> tuple[float, float]:
    """Milliseconds a step of PyBullet and of the solve."""
    scene = load_scene(write_scene("bowl", folder / str(count), count))
    simulator = Simulator(scene, "solver")
    dt = simulator.rules.dt * simulator.units.time
    return timed(bullet(scene, dt, FALL), FALL), solved(scene, FALL)[0]


def with_far(count: int) -> Scene:
    """One box that slides on the floor, and static ones far away."""
    scene = apart(count + 1)
    mover = replace(scene.bodies[1], velocity=np.array([-1.0, 0.0, 0.0]))
    still = [
        replace(b, motion="static", mass=0.0, position=b.position + FAR_OFF, name=f"far {k}")
        for k, b in enumerate(scene.bodies[2:])
    ]
    return replace(scene, bodies=(scene.bodies[0], mover, *still))


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
        some, every = with_nodes_cut(heap, 0.5), heap
        against(
            "64 knots, half of the nodes and all", [(solved(some, 60)[0], solved(every, 60)[0]) for _ in times],
            ("half", "all"),
        )  # fmt: skip
        few, many = (apart(count) for count in GROWN)
        against(
            f"{GROWN[0]} and {GROWN[1]} boxes far apart", [(solved(few, 50)[0], solved(many, 50)[0]) for _ in times],
            (str(GROWN[0]), str(GROWN[1])),
        )  # fmt: skip
        few, many = (with_far(count) for count in FAR)
        against(
            f"{FAR[0]} and {FAR[1]} static boxes far away",
            [(solved(few, 500)[0], solved(many, 500)[0]) for _ in times],
            (str(FAR[0]), str(FAR[1])),
        )  # fmt: skip
        print("pairs with few and with many static boxes:", solved(few, 50)[1][0], solved(many, 50)[1][0])


if __name__ == "__main__":
    run_main(main)
