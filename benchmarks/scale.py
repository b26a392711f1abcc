"""Time and memory of large scenes, and of many scenes at once: RESULTS.md.

    python -m benchmarks scale growth -o DIR
        bowls of spheres, boxes far apart and knots against bodies, nodes and contacts, with two engines
    python -m benchmarks scale large -o DIR
        heaps, shoes and knots to the end on all cores
    python -m benchmarks scale many DATA [--scenes 1000]
        scenes of a MOVi-B dataset at once, on Dask clusters of 1, 2 ... workers on this machine

Every case of the first command runs in a separate process on one thread; times are processor times. Results in DIR are
not measured again.
"""

import os
import resource
import subprocess
import sys
import time
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.engines import bullet, mujoco
from benchmarks.records import Out, progress, write_record
from samples.large import HEAPS, write_scene
from sdfsim.base.parallel import cluster, parallel
from sdfsim.data.batching import scene_of
from sdfsim.data.dataset import conditions_of
from sdfsim.evaluation.engines import Engine, Ran, scene_rollout, start_of_scene, timed_rollout
from sdfsim.evaluation.evaluate import load_recorded
from sdfsim.evaluation.harness import Job, measure, one_thread, peak_memory
from sdfsim.evaluation.instruments import depths
from sdfsim.evaluation.laws.hard_cases import body, box, on_floor
from sdfsim.physics.rollout import Rollout
from sdfsim.physics.units import scene_units
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Scene
from sdfsim.simulate.simulator import Simulator

BOWLS = (1, 16, 64, 256, 512)
APART = (125, 500, 2000)
PARTS = (16, 4, 1)  # of the nodes of a knot
DISTINCT, CHUNK, STEPS = 100, 50, 96  # scenes that differ, scenes of a job, steps of a scene
COLUMNS = {"ms": "ms a step", "peak_mib": "MiB", "contacts": "contacts", "depth_95": "deepest 95 %, mm", "lost": "lost"}


def apart(count: int) -> Scene:
    """Boxes of 1 m at rest on the floor, 3 m from each other; the floor is the last body."""
    side = int(np.ceil(count**0.5))
    places = [[3.0 * (k % side), 3.0 * (k // side), 0.5] for k in range(count)]
    return on_floor([box(1.0)], [body(f"b{k}", 0, place) for k, place in enumerate(places)])


def with_nodes_cut(scene: Scene, keep: float) -> Scene:
    """The scene with only the first part of every shape's nodes, which are stored farthest first."""
    shapes = tuple(replace(s, nodes=s.nodes[: max(1, round(keep * len(s.nodes)))]) for s in scene.shapes)
    return replace(scene, shapes=shapes)


@one_thread()
def ours(source: Path | int, steps: int, keep: float = 1.0) -> dict:
    """Time and memory of a scene (its file, or a number of boxes `apart`), and the depth of overlaps."""
    scene = apart(source) if isinstance(source, int) else with_nodes_cut(load_scene(source), keep)
    with peak_memory() as memory:
        rollout, timing = timed_rollout(Simulator(scene, "solver"), steps)
    contacts = float(rollout.counters["contacts"].mean())
    return {"ms": timing.cpu_ms, "contacts": contacts, "peak_mib": memory["mib"]} | _where(Ran(scene, rollout))


def engine(run: Engine, file: Path, steps: int) -> dict:
    """The same for an engine; spheres stay spheres, all other shapes become convex pieces."""
    scene = load_scene(file)
    units = scene_units(scene)
    start = start_of_scene(scene, file.parent / "engine", units)
    with peak_memory() as memory:
        motion, timing = run(start, steps)
    run_of = Ran(scene, scene_rollout(scene, motion, units))
    return {"ms": timing.cpu_ms, "peak_mib": memory["mib"]} | _where(run_of)


def _where(run: Ran) -> dict[str, float]:
    """Depth of overlaps, mm, and the number of bodies below the floor at the end."""
    depth = depths(run.scene, run.rollout)
    return {
        "depth_95": 1e3 * float(np.percentile(depth, 95)) if len(depth) else 0.0,
        "lost": int((run.motion.position[-1, :, 2] < -0.1).sum()),
    }


def jobs_of(folder: Path) -> list[Job]:
    """All jobs; scene files are written on first use."""

    def scene(name: str, count: int, nodes: int = 0) -> Path:
        home = folder / "scenes" / f"{name}_{count}_{nodes}"
        return home / "scene.yaml" if (home / "scene.yaml").exists() else write_scene(name, home, count, nodes)

    jobs = []
    for count in BOWLS:
        case = f"{count} spheres in a bowl"
        for nodes in (64, 512):
            jobs.append(Job(case, f"solver, {nodes} nodes", [200], ours, (scene("bowl", count, nodes), 200)))
        for name, run in (("PyBullet", bullet), ("MuJoCo", mujoco)):
            jobs.append(Job(case, name, [200], engine, (run, scene("bowl", count, 64), 200)))
    jobs += [Job(f"{n} boxes far apart", "solver", [30], ours, (n, 30)) for n in APART]
    for parts in PARTS:
        knots = (scene("knots", 64, 2844), 100, 1 / parts)
        jobs.append(Job(f"64 knots of {2844 // parts} nodes", "solver", [100], ours, knots))
    return jobs


def growth(*, out: Out) -> None:
    results = measure(jobs_of(out), out / "results", where="fresh", on_progress=progress)
    rows = [(*key, *map(found.get, COLUMNS), found.get("failed", "")) for key, found in results.items()]
    measured = (
        "200 steps of spheres in a bowl, 30 of boxes, 100 of knots; each row is a process on one thread, in processor "
        "time."
    )
    columns = ("case", "with", *COLUMNS.values(), "not finished")
    write_record("growth", "python -m benchmarks scale growth -o DIR", measured, columns, rows)


def to_the_end(name: str, home: Path) -> dict[str, Any]:
    """A large scene run like by a user: the command and its recording."""
    scene, run = home / name / "scene.yaml", home / name / "run"
    if not scene.exists():
        write_scene(name, home / name)
    began = time.perf_counter()
    command = [sys.executable, "-c", "import cli; cli.app()"]
    subprocess.run([*command, "simulate", str(scene), "-o", str(run)], check=True, capture_output=True)
    seconds = time.perf_counter() - began
    mib = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    loaded, rollout = load_scene(scene), Rollout.load(run / "rollout.npz")
    depth = depths(loaded, rollout, every=20)
    moving = [k for k, b in enumerate(loaded.bodies) if b.motion == "dynamic"]
    return {
        "bodies": len(moving),
        "nodes": sum(len(loaded.shapes[loaded.bodies[k].shape].nodes) for k in moving),
        "steps": len(rollout),
        "s": seconds,
        "mib": mib,
        "worst": 1e3 * float(depth.max()),
        "lost": int((rollout.position[-1, moving, 2] < -0.1).sum()),
    }


def large(*, out: Out) -> None:
    jobs = [Job("to the end", name, [name], to_the_end, (name, out)) for name in HEAPS]
    results = measure(jobs, out / "large", where="fresh", on_progress=progress)
    titles = {"bodies": "bodies", "nodes": "nodes", "steps": "steps", "s": "s from command to recording", "mib": "MiB",
              "worst": "deepest, mm", "lost": "below the floor"}  # fmt: skip
    rows = [(name, *(results["to the end", name].get(k) for k in titles)) for name in HEAPS]
    measured = "The command `simulate` with its recording, on all cores, by wall clock."
    write_record("large_scenes", "python -m benchmarks scale large -o DIR", measured, ("scene", *titles.values()), rows)


def simulated(scenes: list[Scene], steps: int) -> None:
    for scene in scenes:
        Simulator(scene).run(steps=steps)


def many(data: Path, *, scenes: int = 1000) -> None:
    """Scenes a second by workers."""
    from distributed import LocalCluster

    recorded, shapes = load_recorded(data, "validation", most=DISTINCT)
    distinct = [scene_of([t], [0], shapes, conditions_of(data).floor)[0] for t in recorded]
    repeated = [distinct[k % len(distinct)] for k in range(scenes)]
    jobs = [(repeated[k : k + CHUNK], STEPS) for k in range(0, scenes, CHUNK)]
    rows, first = [], 0.0
    for workers in range(1, (os.cpu_count() or 1) + 1):
        local: Any = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address="")
        with local:
            with cluster(local.scheduler_address):
                deque(parallel(simulated, jobs[:workers]), maxlen=0)  # not timed: the workers load compiled code
                began = time.perf_counter()
                deque(parallel(simulated, jobs), maxlen=0)
                rate = scenes / (time.perf_counter() - began)
        first = first or rate
        rows.append((workers, rate, rate / first))
    command = f"python -m benchmarks scale many DATA --scenes {scenes}"
    measured = f"Scenes of a MOVi-B dataset, {STEPS} steps each, on Dask workers of one thread."
    write_record("many_scenes", command, measured, ("workers", "scenes a second", "times one worker"), rows)


COMMANDS = (growth, large, many)
