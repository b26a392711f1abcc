"""The report of the command plan: which effects are on, why, and what a step costs."""

import importlib
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.base.console import duration
from sdfsim.base.devices import pick_device
from sdfsim.base.parallel import StageProgress
from sdfsim.learned.model import load_model
from sdfsim.scene.collision_filter import count_pairs
from sdfsim.scene.load import load_scene
from sdfsim.scene.plan import plan
from sdfsim.simulate.simulator import Simulator

TRIAL_STEPS = 5
KINDS = ("dynamic", "static", "kinematic")


def describe(
    scene_file: Path, *, model: str | None, device: str, on_progress: StageProgress, allow_outside: bool = False
) -> dict[str, Any]:
    """The plan of a scene with its units, and the cost of a step over the first few: pairs by what filters them;
    contacts, nodes, edges, time and memory. Raises SdfsimError for invalid input."""
    pick_device(device)
    if model:
        load_model(model, weights=False)
    scene = load_scene(scene_file, partial(on_progress, "shapes"), allow_outside=allow_outside)
    pairs = count_pairs(scene.bodies)
    simulator = Simulator(scene, model=model, device=device)
    units, steps = simulator.units, simulator.steps_in(scene.duration)
    counters = simulator.run(steps=TRIAL_STEPS).counters
    near, step_ms = int(counters["pairs"][1]), float(np.median(counters["step_ms"][1:]))
    return {
        "scene": str(scene_file),
        "effects": {name: asdict(effect) for name, effect in plan(scene).items()},
        **{kind: [b.name for b in scene.bodies if b.motion == kind] for kind in KINDS},
        "masses_kg": {b.name: b.mass for b in scene.bodies if b.motion == "dynamic"},
        "nodes": sum(len(scene.shapes[b.shape].nodes) for b in scene.bodies),
        "pairs": {**asdict(pairs), "apart": pairs.possible - near, "near": near},
        "step": {k: float(counters[k][1:].max()) for k in ("contacts", "nodes", "edges")},
        "memory_mib": _peak_mib(),
        "step_ms": step_ms,
        "run_s": 1e-3 * step_ms * steps,
        "model": simulator.model.name,
        "device": simulator.device,
        "duration_s": scene.duration,
        "dt_s": simulator.dt,
        "steps": steps,
        "substeps": simulator.options.substeps,
        "units": {"length_m": units.length, "time_s": units.time, "mass_kg": units.mass},
        "outside_training": simulator.outside_training,
        "failed_checks": [f"fit of shape {line}" for line in scene.missed],
        "notes": list(scene.notes),
    }


def _peak_mib() -> float | None:
    """Peak memory of this process, MiB; None on Windows, which does not report it this way."""
    try:
        resource: Any = importlib.import_module("resource")
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def plan_lines(report: dict[str, Any]) -> list[str]:
    units, pairs, step = report["units"], report["pairs"], report["step"]
    counts = ", ".join(f"{len(report[kind])} {kind}" for kind in KINDS)
    widest = max(len(e["why"]) for e in report["effects"].values())
    return [
        *(
            f"{name:<12}{'on' if e['on'] else 'off':<5}{e['why']:<{widest}}  [{e['field']}]"
            for name, e in report["effects"].items()
        ),
        f"bodies: {counts}; {report['nodes']} surface nodes",
        f"pairs of bodies: {pairs['total']}, of which {pairs['unmoved']} without a dynamic body, "
        f"{pairs['excluded']} excluded by collides_with, {pairs['apart']} too far apart in the first step; "
        f"{pairs['near']} left",
        f"model {report['model']} on {report['device']}: {report['steps']} steps of {report['dt_s']:.4g} s "
        f"with {report['substeps']} inner steps each",
        f"a step (over the first {TRIAL_STEPS}): {report['step_ms']:.2g} ms, {step['contacts']:.0f} contacts, "
        f"{step['nodes']:.0f} nodes and {step['edges']:.0f} edges in the network"
        + ("" if report["memory_mib"] is None else f"; {report['memory_mib']:.0f} MiB"),
        f"the whole run at this speed:  {duration(report['run_s'])}; more where bodies meet later on",
        f"Froude scaling: the model's metre is {units['length_m']:.4g} m, its second {units['time_s']:.4g} s, "
        f"its kilogram {units['mass_kg']:.4g} kg",
        *(f"outside the model's training: {line}" for line in report["outside_training"]),
    ]
