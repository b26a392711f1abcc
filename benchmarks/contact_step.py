"""What a step of the contact solve costs, beside PyBullet's on the same scenes, and how it grows.

    python -m benchmarks.contact_step DATA [--repeats 5]
    python -m benchmarks.contact_step --check

Writes its section of RESULTS.md, and the ratios into contact_step_ratchet.json. A slow test holds later steps to these:
it asks for --check, which fails where a ratio has slipped back. DATA is a MOVi-B dataset; without one its row is left
out. One thread; PyBullet and the solve take turns, and every figure is the median of the repeats. PyBullet collides
convex pieces (a bowl of 144), the solve baked distances; both make five inner steps a step. Loading, and what a
simulator keeps for its recording, is left out.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

if __name__ == "__main__":
    os.environ["NUMBA_NUM_THREADS"] = "1"  # before the first import of numba

import numpy as np

from benchmarks.results import write_section
from benchmarks.scale import apart, with_nodes_cut
from samples.large import write_scene
from sdfsim.data.batching import scene_of
from sdfsim.data.dataset import FLOOR, Trajectory, load_shapes, trajectory_files
from sdfsim.dynamics.model import load_model
from sdfsim.dynamics.simulator import Simulator
from sdfsim.dynamics.solver import Compiled, compiled_rules, taken_up
from sdfsim.dynamics.units import scene_units
from sdfsim.errors import SdfsimError, run_main
from sdfsim.evaluation.engines import Start, bullet, dataset_urdf, start_of_scene
from sdfsim.evaluation.harness import markdown, number
from sdfsim.files import read_json, write_json
from sdfsim.scene.scene import Scene
from sdfsim.scene.scene_file import load_scene

RATCHET = Path(__file__).with_name("contact_step_ratchet.json")
SLACK = 0.35  # of a ratio: what machines and their load make of it
TRAJECTORIES, STEPS = 10, 100
BALLS, FALL = (16, 512), 200
GROWN = (256, 512)  # bodies far apart
FAR, FAR_OFF = (10, 10_000), np.array([30.0, 30.0, 0.0])  # static ones, and where


def solved(scene: Scene, steps: int, dt: float | None = None, *, sleep: bool = False) -> tuple[float, tuple[int, ...]]:
    """Milliseconds a step of the compiled solve, and what its last step counted (pairs, contacts, ...)."""
    simulator = Simulator(scene, "solver")
    options = replace(simulator.rules, sleep=sleep)
    rules = compiled_rules(replace(options, dt=dt / simulator.units.time) if dt else options)
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


def pairs(data: Path | None, folder: Path) -> dict[str, tuple[tuple[str, str], Callable[[], tuple[float, float]]]]:
    """What is compared, by name: what the two are called, and a call that gives the milliseconds a step of both."""
    heap = load_scene(write_scene("knots", folder / "knots", 64))
    half, scenes = with_nodes_cut(heap, 0.5), {n: apart(n) for n in GROWN}
    far, engine = {n: with_far(n) for n in FAR}, ("PyBullet", "sdfsim")
    return {
        **({"a MOVi-B step": (engine, partial(movi_b, data))} if data else {}),
        **{f"{n} spheres in a bowl": (engine, partial(bowl, n, folder)) for n in BALLS},
        "64 knots": (("half of the nodes", "all"), lambda: (solved(half, 60)[0], solved(heap, 60)[0])),
        "boxes far apart": (
            (str(GROWN[0]), str(GROWN[1])),
            lambda: (solved(scenes[GROWN[0]], 50)[0], solved(scenes[GROWN[1]], 50)[0]),
        ),
        "static boxes far away": (
            (str(FAR[0]), str(FAR[1])), lambda: (solved(far[FAR[0]], 500)[0], solved(far[FAR[1]], 500)[0]),
        ),
    }  # fmt: skip


def measured(data: Path | None, repeats: int) -> dict[str, tuple[str, str, float, float, float]]:
    """By name: what was compared, the medians of both in ms, and the median of their ratios."""
    found = {}
    with tempfile.TemporaryDirectory() as scratch:
        for name, ((one, other), call) in pairs(data, Path(scratch)).items():
            times = np.array([call() for _ in range(repeats)])
            first, second = np.median(times, axis=0)
            found[name] = (one, other, float(first), float(second), float(np.median(times[:, 1] / times[:, 0])))
    return found


def slipped_back(found: dict[str, float], kept: dict[str, float]) -> list[str]:
    """A line for every ratio that is more than `SLACK` above the kept one."""
    return [
        f"{name}: {ratio:.2f}, kept {kept[name]:.2f}"
        for name, ratio in found.items()
        if ratio > (1.0 + SLACK) * kept[name]
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="a MOVi-B dataset")
    parser.add_argument("--check", action="store_true", help="compare with the ratios that are kept")
    parser.add_argument("--repeats", type=int, default=5)
    chosen = parser.parse_args()
    found = measured(chosen.data, chosen.repeats)
    rows = [("a step", "of", "ms", "of", "ms", "second / first")]
    for name, (one, other, first, second, ratio) in found.items():
        rows.append((name, one, number(first), other, number(second), f"{ratio:.2f}"))
    print(markdown(rows))
    if chosen.check:
        if worse := slipped_back({name: values[-1] for name, values in found.items()}, read_json(RATCHET)):
            raise SdfsimError("slipped back: " + "; ".join(worse))
        return
    if not chosen.data:
        parser.error("DATA is needed")
    write_section("contact step", "python -m benchmarks.contact_step DATA", markdown(rows))
    write_json(RATCHET, {name: round(values[-1], 3) for name, values in found.items()})


if __name__ == "__main__":
    run_main(main)
