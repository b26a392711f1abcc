"""SDF-Sim and its baselines under equal conditions: docs/paper.md.

    python -m benchmarks paper graphs DATA -o DIR
        edges, nodes, memory and time of a step, on recorded steps
    python -m benchmarks paper growth -o DIR
        the same with 2 to 512 spheres in a bowl, and where memory ends
    python -m benchmarks paper accuracy DATA -o DIR [--minutes 5 --minutes 15 ...]
        trains all of them on one core for equal times, SDF-Sim also on unsigned distances, then rolls them out

DATA is a MOVi-B dataset with train, validation and test. Graphs have the published number of surface nodes, about 440
per body, and networks the published size. The trained networks have `NODES` nodes per body and the sizes `TRAINED`, so
that an hour on one core is enough to learn something. Trainings resume, and results in DIR are kept.
"""

import resource
import statistics
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import baselines  # noqa: F401, adds its networks
from benchmarks.records import Cell, Out, progress, write_record
from samples.large import write_scene
from sdfsim.data.dataset import read_info
from sdfsim.evaluation.evaluate import evaluate
from sdfsim.evaluation.harness import Job, Panel, draw, line, measure, one_thread, peak_memory, why_failed
from sdfsim.learned.model import Model, new_network
from sdfsim.learned.tensors import body_tensors, state_tensors
from sdfsim.physics.solver.prepare import Compiled
from sdfsim.scene.load import load_scene
from sdfsim.sdf.grid import sample_grid
from sdfsim.shape.shape import load_shape
from sdfsim.simulate.simulator import Simulator
from sdfsim.training.presets import PRESETS, Preset
from sdfsim.training.surface_task import SurfaceTask
from sdfsim.training.train import train as run_training

NAMES = {
    "sdf-sim": "SDF-Sim", "fignet": "FIGNet", "fignet-star": "FIGNet*", "mgn": "MGN", "mgn-large": "MGN, large radius",
    "dpi": "DPI",
}  # fmt: skip
STEPS_SEEN, STEPS_TIMED = 200, 20  # recorded steps whose graphs are counted, and those passed through the network
# Edges between bodies and of the graph in the paper, which does not give the latter for all.
PUBLISHED_EDGES = {
    "sdf-sim": (201, 6196), "fignet": (1361, 24570), "fignet-star": (1410, 8613), "mgn": (34, None),
    "mgn-large": (1798, None), "dpi": (2251, None),
}  # fmt: skip
PUBLISHED_NODES = 440  # per body, from the published numbers of edges
BOWLS = (2, 8, 32, 128, 512)
SETTLED = 200  # steps of the solver before the networks see the bowl
MEMORY = 12  # GiB that a process may take
TRAINED, BATCH = {"width": 32, "steps": 4}, 4
NODES = 64  # per body, in training
FRAME = "50"
CPU = torch.device("cpu")


def untrained(name: str, nodes: int | None) -> Model:
    """A network of the published size with random weights, because the cost of a step does not depend on them."""
    plan = PRESETS[name]
    torch.manual_seed(0)
    network = new_network(plan.kind, plan.config).eval().requires_grad_(False)
    network.target.total.fill_(1.0)  # type: ignore[union-attr]
    network.target.squares.fill_(1e-12)  # type: ignore[union-attr]
    return Model(name, plan.kind, network, dt=0.02, gravity=10.0, length=1.0, reach=plan.reach, nodes=nodes)


def recorded(name: str, data: Path) -> dict[str, float]:
    """A step's graph at random recorded steps of test trajectories, with as many nodes as published; one thread.

    Returns:
        Means of edges between bodies (each once), of all edges and of the nodes of the graph; medians of the
        milliseconds to find near pairs and to pass the graph; peak memory.
    """
    plan = replace(PRESETS[name], nodes=PUBLISHED_NODES)
    task, network = SurfaceTask(data, "test", plan), untrained(name, PUBLISHED_NODES).network
    found = []
    with one_thread(), torch.no_grad(), peak_memory() as memory:
        for k in range(STEPS_SEEN):
            bodies, state, _ = task.scenes(np.random.default_rng([0, k]), 1)
            # Not timed: a rollout does this once.
            shared = Compiled(bodies, state) if task.family.distances else None
            bodies, state = body_tensors(bodies, CPU), state_tensors(state, CPU)
            began = time.process_time()
            near = task.near(bodies, state, shared)
            graph = task.family.graph(bodies, state, near)
            made = time.process_time()
            if k < STEPS_TIMED:
                network(graph)
            times = {"contact_ms": 1e3 * (made - began), "network_ms": 1e3 * (time.process_time() - made)}
            found.append({"contacts": len(near), "edges": graph.edge_count, "nodes": len(graph)} | times)
    counts = {key: float(np.mean([f[key] for f in found])) for key in ("contacts", "edges", "nodes")}
    times = {key: statistics.median(f[key] for f in found[:STEPS_TIMED]) for key in ("contact_ms", "network_ms")}
    return counts | times | {"mib": memory["mib"] or float("nan")}


def grown(name: str, scene_file: Path) -> dict[str, float]:
    """The same for one step of spheres that the solver has let settle in a bowl, with all motion predicted."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY << 30, MEMORY << 30))
    scene = load_scene(scene_file)
    settled = Simulator(scene).step(SETTLED)  # a sphere's origin is its centre of mass
    poses = zip(settled.position, settled.orientation, strict=True)
    bodies = tuple(
        replace(body, position=position, quat_xyzw=turn) if body.motion == "dynamic" else body
        for body, (position, turn) in zip(scene.bodies, poses, strict=True)
    )
    model = untrained(name, 64)
    with one_thread(), peak_memory() as memory:
        simulator = Simulator(replace(scene, bodies=bodies), model, free_flight="learned")
        simulator.step()  # not timed: it loads compiled code
        simulator.reset()
        found = next(simulator.frames(1)).counters
    known = ("contacts", "edges", "nodes", "contact_ms", "network_ms")
    return {key: float(found[key][0]) for key in known} | {"mib": memory["mib"] or float("nan")}


UNSIGNED = 64  # samples along each side
COMPARED = NAMES | {"sdf-sim-unsigned": "SDF-Sim, unsigned distances"}


def plan_of(name: str) -> Preset:
    """The training plan of a network for the comparison: equal sizes, with the published schedule."""
    return replace(PRESETS[name.removesuffix("-unsigned")], config=TRAINED, batch=BATCH, nodes=NODES)


def judged(model: Path, data: Path, split: str, free_flight: str) -> dict[str, Any]:
    """Errors up to `FRAME`."""
    torch.set_num_threads(1)
    report = evaluate(data, model=model, split=split, steps=int(FRAME), free_flight=free_flight, errors_only=True)  # type: ignore[arg-type]
    return report["model"][FRAME]


def unsigned(data: Path, home: Path) -> Path:
    """The dataset with unsigned distances: its shapes as grids of |d|, without an inside."""
    (home / "shapes").mkdir(parents=True, exist_ok=True)
    for there in data.iterdir():
        if there.name != "shapes" and not (home / there.name).exists():
            (home / there.name).symlink_to(there.resolve())
    for folder in (data / "shapes").iterdir():
        if (folder / "shape.json").exists() and not (home / "shapes" / folder.name / "shape.json").exists():
            shape = load_shape(folder)
            grid = sample_grid(shape.sdf, shape.sdf.bounds, UNSIGNED)
            replace(shape, sdf=replace(grid, values=grid.values.abs()), pieces=()).save(home / "shapes" / folder.name)
    return home


def graphs(data: Path, *, out: Out) -> None:
    jobs = []
    for name in NAMES:
        content = [PRESETS[name], STEPS_SEEN, STEPS_TIMED, PUBLISHED_NODES, read_info(data)]
        jobs.append(Job("movi-b", name, content, recorded, (name, data)))
    results = measure(jobs, out / "graphs", where="fresh", on_progress=progress)
    columns = {
        "contacts": "edges between bodies", "edges": "graph edges", "nodes": "nodes",
        "contact_ms": "ms to find and build", "network_ms": "ms of the network", "mib": "MiB",
    }  # fmt: skip
    rows = []
    for name, title in NAMES.items():
        found, (pairs, edges) = results["movi-b", name], PUBLISHED_EDGES[name]
        contacts, *figures = map(found.get, columns)
        rows.append((title, pairs, contacts, edges, *figures, why_failed(found)))
    heads = ("edges between bodies, paper", "edges between bodies", "graph edges, paper", "graph edges")
    measured = (
        f"Means over {STEPS_SEEN} random recorded steps of MOVi-B's test trajectories, networks of the published size, "
        f"at most {PUBLISHED_NODES} surface nodes per body."
    )
    heads = ("network", *heads, *list(columns.values())[2:], "failed")
    write_record("paper_graphs", "python -m benchmarks paper graphs MOVI-B -o DIR", measured, heads, rows)


def growth(*, out: Out) -> None:
    jobs = []
    for count in BOWLS:
        home = out / "scenes" / str(count)
        file = home / "scene.yaml" if (home / "scene.yaml").exists() else write_scene("bowl", home, count, 64)
        jobs += [Job(f"{count} spheres", name, [PRESETS[name], SETTLED, MEMORY], grown, (name, file)) for name in NAMES]
    results = measure(jobs, out / "growth", where="fresh", on_progress=progress)
    rows = []
    for (case, name), found in results.items():
        rows.append((case, NAMES[name], found.get("network_ms"), found.get("mib"), why_failed(found)))
    panels = []
    for key, label in (("edges", "edges of the graph"), ("network_ms", "ms of the network"), ("mib", "MiB")):
        lines = []
        for name, title in NAMES.items():
            found = [{"spheres": n} | results[f"{n} spheres", name] for n in BOWLS]
            lines.append(line(title, found, "spheres", key))
        panels.append(Panel("spheres in a bowl", "spheres", label, lines, "xy"))
    draw(panels, out / "growth.png")
    measured = (
        "One step of spheres with 64 nodes that have settled in a bowl; networks of the published size predict all "
        "motion, on one thread."
    )
    columns = ("case", "network", "ms of the network", "MiB", "failed")
    write_record("paper_growth", "python -m benchmarks paper growth -o DIR", measured, columns, rows)


MINUTES = [5.0, 15.0, 30.0, 60.0]


def accuracy(data: Path, *, out: Out, minutes: list[float] = MINUTES) -> None:
    """Train all networks for each number of minutes in order."""
    results: dict[tuple[str, str], dict[str, Any]] = {}
    minutes = sorted(minutes)
    for spent in minutes:
        for name in COMPARED:
            seen_by = unsigned(data, out / "unsigned") if name.endswith("unsigned") else data
            file = out / "models" / f"{name}-{spent:g}.safetensors"
            if not file.exists():
                file.parent.mkdir(parents=True, exist_ok=True)
                torch.set_num_threads(1)
                place, budget = out / "runs" / name, 60 * spent
                resume = (place / "checkpoint.npz").exists()
                run_training(seen_by, place, preset=plan_of(name), resume=resume, budget=budget, on_progress=progress)
                (place / "model.safetensors").rename(file)
            jobs = []
            for split in ("validation", "test") if spent == minutes[-1] else ("validation",):
                for way in ("exact", "learned"):
                    content, arguments = [plan_of(name), spent, read_info(data)], (file, seen_by, split, way)
                    jobs.append(Job(f"{split}, {way}", _case(name, spent), content, judged, arguments))
            results |= measure(jobs, out / "accuracy")
    for way in ("exact", "learned"):
        columns, rows = accuracy_table(results, minutes, way)
        options = " ".join(f"--minutes {spent:g}" for spent in minutes)
        measured = (
            "Errors over the first 50 steps of MOVi-B after equal time on one core, with intervals of 95 % over "
            f"trajectories; free flight {way}."
        )
        name, command = f"paper_accuracy_{way}", f"python -m benchmarks paper accuracy MOVI-B -o DIR {options}"
        write_record(name, command, measured, columns, rows)


def _case(name: str, minutes: float) -> str:
    return f"{name} after {minutes:g} minutes"


def accuracy_table(
    results: dict[tuple[str, str], dict[str, Any]], minutes: list[float], way: str
) -> tuple[list[str], list[list[Cell]]]:
    """Columns and rows for a form of free flight: errors by network and minutes, last on test data."""
    seen = [("validation", m, f"{m:g} min") for m in minutes] + [("test", minutes[-1], f"test, {minutes[-1]:g} min")]
    columns = ["network", *(f"{name}, {unit}" for _, _, name in seen for unit in ("m", "degrees"))]
    rows: list[list[Cell]] = []
    for name, title in COMPARED.items():
        found = [results.get((f"{split}, {way}", _case(name, spent)), {}) for split, spent, _ in seen]
        cells: list[Cell] = [title]
        for one in found:
            error = one.get("translation_rmse")
            cells += [error and [error, *one["translation_rmse_95"]], one.get("rotation_error", why_failed(one))]
        rows.append([*cells, _power_law(minutes, found[:-1])])
    return [*columns, "m by a power law at 10 h"], rows


def _power_law(minutes: list[float], found: list[dict[str, Any]]) -> float | None:
    """Extrapolation to ten hours of one core by a line through the logarithms of time and error, m."""
    known = line(
        "", [{"minutes": m} | f for m, f in zip(minutes, found, strict=True) if f], "minutes", "translation_rmse"
    )
    if len(known.x) < 3:
        return None
    slope, start = np.polyfit(np.log(known.x), np.log(known.y), 1)
    return float(np.exp(start + slope * np.log(600.0)))


COMMANDS = (graphs, growth, accuracy)
