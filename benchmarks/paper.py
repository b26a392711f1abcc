"""The paper's comparison of networks, all on one footing: docs/paper.md.

    python benchmarks/paper.py graphs DATA -o DIR
        edges, nodes, memory and time of a step, on recorded steps
    python benchmarks/paper.py growth -o DIR
        the same with 2 to 512 spheres in a bowl, and where memory ends
    python benchmarks/paper.py accuracy DATA -o DIR [--minutes 5 15 30 60]
        trains all of them on one core for equal times, SDF-Sim also on unsigned distances, then rolls them out
    python benchmarks/paper.py sdf DATA -o DIR
        rollouts of the solver on networks of distances of several widths

DATA is a MOVi-B dataset with train, validation and test. Graphs have as many surface nodes as the paper's, about 440 a
body, and networks the published size. Networks of the last command have `NODES` nodes a body and the sizes `TRAINED`,
so that an hour of a core is enough to learn something. Trainings go on where they were left, results that DIR holds
are kept. Each command writes a table in Markdown into DIR.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from samples.large import write_scene
from sdfsim.data.batching import batches, first_frames, roll_out
from sdfsim.data.dataset import Trajectory, engine_substep, load_shapes, read_info, trajectory_files
from sdfsim.dynamics.model import SOLVER, Model, load_model, new_network
from sdfsim.dynamics.run_memory import Memory
from sdfsim.dynamics.simulator import Simulator
from sdfsim.errors import run_main
from sdfsim.evaluation.evaluate import errors, evaluate
from sdfsim.evaluation.harness import (
    Job,
    Line,
    Panel,
    Results,
    draw,
    markdown,
    measure,
    number,
    one_thread,
    peak_memory,
)
from sdfsim.files import write_text
from sdfsim.scene.scene import Body, Scene
from sdfsim.scene.scene_file import load_scene
from sdfsim.shape.fit import PLANS, fit_pieces
from sdfsim.shape.mesh import convex_hull
from sdfsim.shape.sdf import sample_grid
from sdfsim.shape.shape import Shape, load_shape
from sdfsim.training.contact_cache import inner_steps
from sdfsim.training.presets import PRESETS, Preset
from sdfsim.training.surface_task import SurfaceTask
from sdfsim.training.train import train

NAMES = {
    "paper": "SDF-Sim", "fignet": "FIGNet", "fignet-star": "FIGNet*", "mgn": "MGN", "mgn-large": "MGN, large radius",
    "dpi": "DPI",
}  # fmt: skip
STEPS_SEEN, STEPS_TIMED = 200, 20  # recorded steps whose graphs are counted, and passed through the network
PUBLISHED_NODES = 440  # a body: what the paper's counts of edges leave
BOWLS = (2, 8, 32, 128, 512)
SETTLED = 200  # steps of the solver before the networks see the bowl
MEMORY = 12  # GiB that a process may take
TRAINED, BATCH = {"width": 32, "steps": 4}, 4
NODES = 64  # a body, in training
FRAME = "50"


def untrained(name: str, nodes: int | None) -> Model:
    """A network of the published size with random weights: what a step costs does not depend on them."""
    plan = PRESETS[name]
    torch.manual_seed(0)
    network = new_network(plan.kind, plan.config).eval().requires_grad_(False)
    network.target.total.fill_(1.0)  # type: ignore[union-attr]
    network.target.squares.fill_(1e-12)  # type: ignore[union-attr]
    return Model(name, plan.kind, network, dt=0.02, gravity=10.0, length=1.0, reach=plan.reach, nodes=nodes)


def seen(name: str, scenes: list[Scene], nodes: int | None) -> dict[str, float]:
    """A step of every scene, all motion predicted, one thread.

    Returns:
        Means of edges between bodies (each once), of all edges and of the nodes of the graph; medians of the
        milliseconds to find what is near and to pass the graph; peak memory.
    """
    model, found = untrained(name, nodes), []
    with one_thread(), peak_memory() as memory:
        for scene in scenes:
            sim = Simulator(scene, model, free_flight="learned")
            sim.step()  # not timed: it loads what is compiled
            sim.reset()
            found.append(next(sim.frames(1)).counters)
    counts = {key: float(np.mean([f[key][0] for f in found])) for key in ("contacts", "edges", "nodes")}
    times = {key: statistics.median(float(f[key][0]) for f in found) for key in ("contact_ms", "network_ms")}
    return counts | times | {"mib": memory["mib"] or float("nan")}


def recorded(name: str, data: Path) -> dict[str, float]:
    """The same of random recorded steps of test trajectories, with as many nodes as in the paper."""
    plan = replace(PRESETS[name], nodes=PUBLISHED_NODES)
    task, network = SurfaceTask(data, "test", plan, torch.device("cpu")), untrained(name, PUBLISHED_NODES).network
    shared, found = Memory(), []
    with one_thread(), torch.no_grad(), peak_memory() as memory:
        for k in range(STEPS_SEEN):
            bodies, state, _ = task.scenes(np.random.default_rng([0, k]), 1)
            if name == "paper":
                shared.compiled(bodies, state)  # not timed: a rollout does this once
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
    """Of spheres that the solver has let settle in a bowl."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY << 30, MEMORY << 30))
    scene = load_scene(scene_file)
    settled = Simulator(scene).step(SETTLED)  # a sphere's origin is its centre of mass

    def moved(k: int, body: Body) -> Body:
        if body.motion != "dynamic":
            return body
        return replace(body, position=settled.position[k].numpy(), quat_xyzw=settled.orientation[k].numpy())

    bodies = tuple(moved(k, body) for k, body in enumerate(scene.bodies))
    return seen(name, [replace(scene, bodies=bodies)], 64)


UNSIGNED = 64  # samples along each side
COMPARED = NAMES | {"paper-unsigned": "SDF-Sim, unsigned distances"}


def trained(name: str, data: Path, place: Path, minutes: float) -> Path:
    """The model of a network after so many minutes of one core."""
    torch.set_num_threads(1)
    plan = plan_of(name)
    resume = (place / "checkpoint.npz").exists()
    report = train(data, place, preset=plan, resume=resume, budget=60 * minutes, on_progress=told)
    return Path(report["model"])


def plan_of(name: str) -> Preset:
    """How a network is trained for the comparison: at equal sizes, with the schedule of the published ones."""
    return replace(PRESETS[name.removesuffix("-unsigned")], config=TRAINED, batch=BATCH, nodes=NODES)


def judged(model: Path, data: Path, split: str, free_flight: str) -> dict[str, Any]:
    """Errors up to `FRAME`."""
    torch.set_num_threads(1)
    report = evaluate(data, model=model, split=split, steps=int(FRAME), free_flight=free_flight, errors_only=True)  # type: ignore[arg-type]
    return report["model"][FRAME]


def told(fraction: float, message: str) -> None:
    print(f"{fraction:6.1%}  {message}", flush=True)


def unsigned(data: Path, home: Path) -> Path:
    """The dataset with unsigned distances: its shapes as grids of |d|, which know no inside."""
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


def graphs(data: Path, out: Path) -> None:
    """Write graphs.md."""
    jobs = [
        Job(
            "movi-b",
            name,
            [PRESETS[name], STEPS_SEEN, STEPS_TIMED, PUBLISHED_NODES, read_info(data)],
            recorded,
            (name, data),
        )
        for name in NAMES
    ]
    results = measure(jobs, out / "graphs", where="fresh", on_progress=told)
    columns = {
        "contacts": "collision edges", "edges": "graph edges", "nodes": "nodes", "contact_ms": "ms to find them",
        "network_ms": "ms of the network", "mib": "MiB",
    }  # fmt: skip
    rows: list[tuple[str, ...]] = [("", *columns.values())]
    for name, title in NAMES.items():
        found = results["movi-b", name]
        rows.append(
            (title, *(number(found.get(k)) for k in columns), *([found["failed"]] if "failed" in found else []))
        )
    written(out / "graphs.md", markdown(rows))


def growth(out: Path) -> None:
    """Write growth.md and growth.png."""
    jobs = []
    for count in BOWLS:
        home = out / "scenes" / str(count)
        file = home / "scene.yaml" if (home / "scene.yaml").exists() else write_scene("bowl", home, count, 64)
        jobs += [Job(f"{count} spheres", name, [PRESETS[name], SETTLED, MEMORY], grown, (name, file)) for name in NAMES]
    results = measure(jobs, out / "growth", where="fresh", on_progress=told)
    rows: list[tuple[str, ...]] = [("ms of the network / MiB", *NAMES.values())]
    for count in BOWLS:
        cells = (results[f"{count} spheres", name] for name in NAMES)
        rows.append((
            f"{count} spheres",
            *(f["failed"] if "failed" in f else f"{number(f['network_ms'])} / {number(f['mib'])}" for f in cells),
        ))  # fmt: skip
    panels = []
    for key, label in (("edges", "edges of the graph"), ("network_ms", "ms of the network"), ("mib", "MiB")):
        lines = []
        for name, title in NAMES.items():
            known = [(n, results[f"{n} spheres", name]) for n in BOWLS if "failed" not in results[f"{n} spheres", name]]
            lines.append(Line(title, [n for n, _ in known], [f[key] for _, f in known]))
        panels.append(Panel("spheres in a bowl", "spheres", label, lines, "xy"))
    draw(panels, out / "growth.png", wide=3, dpi=110)
    written(out / "growth.md", markdown(rows))


def accuracy(data: Path, out: Path, minutes: list[float]) -> None:
    """Train everything a little, then a little more, and write accuracy.md and accuracy.png."""
    results: Results = {}
    for spent in sorted(minutes):
        for name in COMPARED:
            place = out / "runs" / name
            seen_by = unsigned(data, out / "unsigned") if name.endswith("unsigned") else data
            case = f"{name} after {spent:g} minutes"
            content = [plan_of(name), spent, read_info(data)]
            for way in ("exact", "learned"):
                file = out / "models" / f"{name}-{spent:g}.safetensors"
                if not file.exists():
                    file.parent.mkdir(parents=True, exist_ok=True)
                    trained(name, seen_by, place, spent).rename(file)
                splits = ("validation", "test") if spent == max(minutes) else ("validation",)
                jobs = [Job(f"{split}, {way}", case, content, judged, (file, seen_by, split, way)) for split in splits]
                results |= measure(jobs, out / "accuracy")
        written(out / "accuracy.md", accuracy_table(results, sorted(minutes)))
    panels = []
    for way in ("exact", "learned"):
        lines = []
        for name, title in COMPARED.items():
            found = [
                results.get((f"validation, {way}", f"{name} after {spent:g} minutes"), {}) for spent in sorted(minutes)
            ]
            known = [
                (m, f["translation_rmse"]) for m, f in zip(sorted(minutes), found, strict=True) if "failed" not in f
            ]
            lines.append(Line(title, [m for m, _ in known], [e for _, e in known]))
        panels.append(
            Panel(f"free flight {way}", "minutes of one core", f"m at {FRAME} steps, validation", lines, "xy")
        )
    draw(panels, out / "accuracy.png", wide=2, dpi=110)


def rolled_out(data: Path, width: int | None, home: Path) -> dict[str, Any]:
    """Errors of the solver on validation data whose shapes are networks of so many hidden units, refitted where they
    are not 64 wide and kept in `home`; on the convex pieces themselves for None."""
    torch.set_num_threads(1)
    recorded = [Trajectory.load(file) for file in trajectory_files(data, "validation")]
    recorded = [first_frames(t, int(FRAME) + 1) for t in recorded if not t.static.all()]
    shapes = load_shapes(data, {str(n) for t in recorded for n in t.shape})
    if width is not None:
        shapes = {name: refitted(shape, width, home / name) for name, shape in shapes.items()}
    inner = inner_steps(recorded[0].dt, engine_substep(data))
    solver, motions = load_model(SOLVER), []
    for group in batches(recorded):
        motions += roll_out(solver, group, shapes, int(FRAME), torch.device("cpu"), substeps=inner, as_teacher=True)
    return errors(motions, [t for group in batches(recorded) for t in group])[FRAME]


def refitted(shape: Shape, width: int, folder: Path) -> Shape:
    """The shape known by a network of so many hidden units alone, with its own nodes, fitted for a minute."""
    if width == PLANS["default"].width:
        return replace(shape, pieces=())
    if not (folder / "shape.json").exists():
        usual = PLANS["default"]
        PLANS["default"] = replace(usual, width=width)
        try:
            fit_pieces([convex_hull(piece) for piece in shape.pieces], name=shape.name).save(folder)
        finally:
            PLANS["default"] = usual
    return replace(shape, pieces=(), sdf=load_shape(folder).sdf)


def sdf(data: Path, out: Path) -> None:
    """Write sdf.md."""
    ways = {"convex pieces, exactly": None, "64 wide": 64, "32 wide": 32, "128 wide": 128}
    jobs = [
        Job("rollouts", name, [width, read_info(data)], rolled_out, (data, width, out / "shapes" / str(width)))
        for name, width in ways.items()
    ]
    results = measure(jobs, out / "sdf", on_progress=told)
    rows = [("distances", f"validation, {FRAME} steps"), *((name, _cell(results["rollouts", name])) for name in ways)]
    written(out / "sdf.md", markdown(rows))


def accuracy_table(results: Results, minutes: list[float]) -> str:
    """Errors by network and minutes; a table for each form of free flight."""
    parts = []
    for way in ("exact", "learned"):
        told_of = (*(f"{m:g} min" for m in minutes), "by a power law at 10 h", f"test, {minutes[-1]:g} min")
        rows: list[tuple[str, ...]] = [(f"free flight {way}", *told_of)]
        for name, title in COMPARED.items():
            found = [results.get((f"validation, {way}", f"{name} after {m:g} minutes")) for m in minutes]
            test = results.get((f"test, {way}", f"{name} after {minutes[-1]:g} minutes"))
            rows.append((title, *map(_cell, found), _power_law(minutes, found), _cell(test)))
        parts.append(markdown(rows))
    return "\n".join(parts)


def _cell(found: dict[str, Any] | None) -> str:
    if found is None or "failed" in found:
        return "-" if found is None else found["failed"]
    return f"{number(found['translation_rmse'])} m, {found['rotation_error']:.1f}°"


def _power_law(minutes: list[float], found: list[dict[str, Any] | None]) -> str:
    """What a line through the logarithms of time and error says for ten hours of one core."""
    known = [(m, f["translation_rmse"]) for m, f in zip(minutes, found, strict=True) if f and "failed" not in f]
    if len(known) < 3:
        return "-"
    slope, start = np.polyfit(np.log([m for m, _ in known]), np.log([e for _, e in known]), 1)
    return f"{number(float(np.exp(start + slope * np.log(600.0))))} m"


def written(path: Path, table: str) -> None:
    write_text(path, table)
    print(table, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("graphs", "growth", "accuracy", "sdf"):
        command = commands.add_parser(name)
        if name != "growth":
            command.add_argument("data", type=Path)
        command.add_argument("-o", "--out", type=Path, required=True)
        if name == "accuracy":
            command.add_argument("--minutes", type=float, nargs="+", default=[5.0, 15.0, 30.0, 60.0])
    chosen = parser.parse_args()
    if chosen.command == "graphs":
        graphs(chosen.data, chosen.out)
    elif chosen.command == "growth":
        growth(chosen.out)
    elif chosen.command == "sdf":
        sdf(chosen.data, chosen.out)
    else:
        accuracy(chosen.data, chosen.out, chosen.minutes)


if __name__ == "__main__":
    run_main(main)
