"""The time of a step of the contact solve and of PyBullet on the same scenes, and how it grows.

    python -m benchmarks contact_step DATA [--repeats 5]
    python -m benchmarks contact_step --check

Writes its record, and ratios that have improved into contact_step_ratchet.json. A slow test runs --check, which fails
if a ratio is worse than there. DATA is a MOVi-B dataset; without it the row is left out. Times are processor times of
one thread, which other programs change less, except for many scenes in a call, which have wall-clock times. PyBullet
and the solve alternate, each through its own API; every figure is the median of the repeats. PyBullet collides convex
pieces (144 for the bowl), the solve those or baked distances; both make five inner steps per step. Loading and the
recording of a simulator are not included.
"""

import tempfile
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.records import in_turn, table, write_record
from benchmarks.scale import apart, with_nodes_cut
from samples.large import write_scene
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_json, write_json
from sdfsim.data.batching import scene_of
from sdfsim.data.dataset import conditions_of
from sdfsim.evaluation.engines import Start, bullet, dataset_urdf, start_of_scene, timed
from sdfsim.evaluation.evaluate import load_recorded
from sdfsim.evaluation.harness import one_thread
from sdfsim.physics.units import scene_units
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Scene
from sdfsim.simulate.simulator import Simulator, run_all

RATCHET = Path(__file__).with_name("contact_step_ratchet.json")
SLACK = 0.35  # of a ratio: variation between machines and loads
LEAST = 0.05  # ratios below this count as equal, because the step takes almost no time
TRAJECTORIES, STEPS = 10, 100
BALLS, FALL = (16, 512), 200
GROWN = (256, 512)  # bodies far apart
SLIDE = 100  # steps of a body near static ones, and of bodies at rest
REST = 60  # steps until they fall asleep
WORLDS = 200
FAR, FAR_OFF = (10, 10_000), np.array([30.0, 30.0, 0.0])  # static bodies, and where


def with_far(count: int) -> Scene:
    """One box that slides on the floor, and static ones far away."""
    scene = apart(count + 1)
    mover, *others, floor = scene.bodies
    still = [replace(b, motion="static", mass=0.0, position=b.position + FAR_OFF) for b in others]
    return replace(scene, bodies=(replace(mover, velocity=np.array([-1.0, 0.0, 0.0])), *still, floor))


def solved(scene: Scene, steps: int, dt: float | None = None) -> float:
    simulator = Simulator(scene, "solver")
    options = simulator.options._replace(sleep=False)
    simulator.options = options._replace(dt=dt / simulator.units.time) if dt else options
    return timed(simulator.step, steps + 1).cpu_ms  # without the first, which prepares shapes


def asleep(scene: Scene) -> tuple[float, float]:
    """Milliseconds a step of bodies at rest: awake, and asleep."""
    taken = []
    for sleep in (False, True):
        simulator = Simulator(scene, "solver")
        simulator.options = simulator.options._replace(sleep=sleep)
        simulator.step(REST)
        taken.append(timed(simulator.step, SLIDE + 1).cpu_ms)
    return taken[0], taken[1]


def worlds(data: Path) -> tuple[float, float]:
    """Milliseconds a step of MOVi-B scenes simulated one after the other, and many in one call on all cores, including
    recordings."""
    recorded, shapes = load_recorded(data, "test", most=TRAJECTORIES, as_recorded=True)
    floor = conditions_of(data).floor
    scenes = [scene_of([t], [0], shapes, floor)[0] for t in recorded]
    run_all(scenes, steps=1)  # not timed: it prepares shapes
    began = time.perf_counter()
    for scene in scenes:
        Simulator(scene, "solver").run(steps=STEPS)
    alone = (time.perf_counter() - began) / len(scenes)
    many = scenes * (WORLDS // len(scenes))
    began = time.perf_counter()
    run_all(many, steps=STEPS)
    return 1e3 * alone / STEPS, 1e3 * (time.perf_counter() - began) / len(many) / STEPS


def movi_b(data: Path) -> tuple[float, float]:
    """Milliseconds a step of PyBullet and of the solve, mean over trajectories."""
    recorded, shapes = load_recorded(data, "test", most=TRAJECTORIES, as_recorded=True)
    urdfs = {name: dataset_urdf(data, name) for name in shapes}
    floor = conditions_of(data).floor
    engine = [bullet(Start(t, urdfs, floor), STEPS)[1].cpu_ms for t in recorded]
    ours = [solved(scene_of([t], [0], shapes, floor)[0], STEPS, t.dt) for t in recorded]
    return float(np.mean(engine)), float(np.mean(ours))


def bowl(count: int, folder: Path) -> tuple[float, float]:
    """Milliseconds a step of PyBullet and of the solve."""
    scene = load_scene(write_scene("bowl", folder / str(count), count))
    start = start_of_scene(scene, folder / "engine", scene_units(scene))
    return bullet(start, FALL)[1].cpu_ms, solved(scene, FALL)


@one_thread()
def user_steps() -> tuple[float, float]:
    """Milliseconds a step of `Simulator`, including its Python code, with few and with many static bodies."""
    taken = []
    for count in FAR:
        simulator = Simulator(with_far(count))
        simulator.options = simulator.options._replace(sleep=False)
        simulator.step(2)  # not timed: it prepares shapes
        taken.append(timed(lambda count, of=simulator: deque(of.steps(count), maxlen=0), SLIDE + 1).cpu_ms)
    return taken[0], taken[1]


def pairs(data: Path | None, folder: Path) -> dict[str, tuple[str, str, Callable[[], tuple[float, float]]]]:
    """The comparisons by name: labels of the two sides, and a call that gives the milliseconds per step of both."""
    found: dict[str, tuple[str, str, Callable[[], tuple[float, float]]]] = {}
    if data:
        found["a MOVi-B step"] = ("PyBullet", "sdfsim", lambda: movi_b(data))
        found["MOVi-B scenes, all cores"] = ("one by one", f"{WORLDS} in a call", lambda: worlds(data))
    for n in BALLS:
        found[f"{n} spheres in a bowl"] = ("PyBullet", "sdfsim", lambda n=n: bowl(n, folder))

    def both(name: str, one: tuple[str, Scene], other: tuple[str, Scene], steps: int) -> None:
        found[name] = (one[0], other[0], lambda: (solved(one[1], steps), solved(other[1], steps)))

    heap = load_scene(write_scene("knots", folder / "knots", 64))
    both("64 knots", ("half of the nodes", with_nodes_cut(heap, 0.5)), ("all", heap), 60)
    few, many = GROWN
    both("boxes far apart", (str(few), apart(few)), (str(many), apart(many)), 50)
    few, many = FAR
    both("static boxes far away", (str(few), with_far(few)), (str(many), with_far(many)), 500)
    found["64 boxes at rest"] = ("awake", "asleep", lambda: asleep(apart(64)))
    found["the same with all of `Simulator`, solver"] = (*map(str, FAR), user_steps)
    return found


def slipped_back(found: dict[str, float], kept: dict[str, float]) -> list[str]:
    """A line for every ratio that is more than `SLACK` above the kept one, or above `LEAST`."""
    return [
        f"{name}: {ratio:.2f}, kept {kept[name]:.2f}"
        for name, ratio in found.items()
        if ratio > (1.0 + SLACK) * max(kept[name], LEAST)
    ]


COLUMNS = ("a step", "first", "ms of the first", "second", "ms of the second", "second / first")


def main(data: Annotated[Path | None, typer.Argument()] = None, *, check: bool = False, repeats: int = 5) -> None:
    if not data and not check:
        raise SdfsimError("give a MOVi-B dataset, or --check")
    rows, ratios = [], {}
    with tempfile.TemporaryDirectory() as scratch:
        for name, (one, other, call) in pairs(data, Path(scratch)).items():
            times = in_turn([call], repeats)[:, 0]
            first, second = np.median(times, axis=0)
            ratios[name] = round(float(np.median(times[:, 1] / times[:, 0])), 3)
            rows.append((name, one, first, other, second, ratios[name]))
    kept = read_json(RATCHET)
    if not check:
        measured = f"ms a step on the same scenes: medians of {repeats} repeats, of pairs that alternate."
        write_record("contact_step", "python -m benchmarks contact_step DATA", measured, COLUMNS, rows)
        write_json(RATCHET, {name: min(ratio, kept.get(name, ratio)) for name, ratio in ratios.items()})
        return
    print(table(COLUMNS, rows))
    if worse := slipped_back(ratios, kept):
        raise SdfsimError("slipped back: " + "; ".join(worse))
