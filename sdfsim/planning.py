"""What the command plan tells: which effects are in play, why, and what a step costs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.dynamics.memory import BYTES_A_ROW
from sdfsim.dynamics.model import load_model
from sdfsim.dynamics.ranges import constant_in_training
from sdfsim.dynamics.simulator import Simulator, pick_device
from sdfsim.scene.effects import Plan, plan
from sdfsim.scene.load import load_scene
from sdfsim.scene.schema import DEFAULT_DURATION, DEFAULT_GRAVITY
from sdfsim.scene.types import Effects, Scene

TRIAL_STEPS = 5


def describe(
    scene_file: Path, *, model: str | None, device: str, on_progress: Callable[[str, float, str], None]
) -> dict[str, Any]:
    """The plan of a scene with its units and the cost of a step, measured over the first few.

    Args:
        scene_file: scene.yaml.
        model: bundled name or path (None: what the scene says).
        device: cpu, cuda or auto.
        on_progress: called with (stage, fraction, message).

    Raises:
        SdfsimError: bad input.
    """
    pick_device(device)
    if model:
        load_model(model, weights=False)
    scene = load_scene(scene_file, on_progress=lambda fraction, message: on_progress("shapes", fraction, message))
    decided = plan(scene)
    simulator = Simulator(scene, model=model, device=device)
    units = simulator.units
    return {
        "scene": str(scene_file),
        "effects": {name: asdict(effect) for name, effect in decided.effects().items()},
        "static": list(decided.static),
        "dynamic": list(decided.dynamic),
        "kinematic": list(decided.kinematic_bodies),
        "masses_kg": {b.name: b.mass for b in scene.bodies if b.motion == "dynamic"},
        "nodes": decided.nodes,
        **_costs(simulator, decided),
        "model": simulator.model.name,
        "device": str(simulator.device),
        "duration_s": scene.duration,
        "dt_s": simulator.dt,
        "steps": max(1, round(scene.duration / simulator.dt)),
        "units": {"length_m": units.length, "time_s": units.time, "mass_kg": units.mass},
        "outside_training": simulator.outside_training,
        "constant_in_training": constant_in_training(simulator.model),
        "not_default": _not_default(scene, model),
        "failed_checks": [f"fit of shape {told}" for told in scene.missed],
    }


def _costs(simulator: Simulator, decided: Plan) -> dict[str, Any]:
    """Pairs by what filters them, and nodes, edges, memory and time of a step."""
    counters = simulator.run(steps=TRIAL_STEPS).counters
    near = int(counters["pairs"][1])
    worked_on = max(counters["sdf_queries"].max(), counters["edges"].max(), counters["nodes"].max())
    if simulator.rules.rows is not None:
        worked_on = min(worked_on, simulator.rules.rows)
    held = sum(v.nelement() * v.element_size() for v in vars(simulator.bodies).values() if hasattr(v, "element_size"))
    return {
        "pairs": {**asdict(decided.pairs), "apart": decided.pairs.possible - near, "near": near},
        "step": {
            **{k: float(counters[k][1:].max()) for k in ("nodes", "edges", "sdf_queries")},
            "memory_mib": float(held + worked_on * BYTES_A_ROW) / 2**20,
        },
        "step_ms": float(np.median(counters["step_ms"][1:])),
    }


def _not_default(scene: Scene, model: str | None) -> dict[str, Any]:
    """What the file or the command says that is not the default."""
    found: dict[str, Any] = {
        f"effects.{name}": said for name, said in vars(scene.effects).items() if said != getattr(Effects(), name)
    }
    if scene.limits.memory_gib is not None:
        found["limits.memory_gib"] = scene.limits.memory_gib
    if model or scene.model:
        found["model"] = model or scene.model
    if scene.seed:
        found["seed"] = scene.seed
    if not np.array_equal(scene.gravity, DEFAULT_GRAVITY):
        found["gravity"] = scene.gravity.tolist()
    if scene.duration != DEFAULT_DURATION:
        found["duration"] = scene.duration
    return found


def plan_lines(report: dict[str, Any]) -> list[str]:
    """`describe`'s report for people."""
    units, pairs, step = report["units"], report["pairs"], report["step"]
    counts = ", ".join(f"{len(report[kind])} {kind}" for kind in ("dynamic", "static", "kinematic"))
    widest = max(len(e["why"]) for e in report["effects"].values())
    return [
        *(
            f"{name:<12}{'on' if e['on'] else 'off':<5}{e['why']:<{widest}}  [{e['field']}]"
            for name, e in report["effects"].items()
        ),
        f"bodies: {counts}; {report['nodes']} surface nodes",
        f"pairs of bodies: {pairs['total']}, of which {pairs['unmoved']} without a dynamic body, "
        f"{pairs['excluded']} kept apart by collides_with, {pairs['apart']} too far apart in the first step; "
        f"{pairs['near']} left",
        f"model {report['model']} on {report['device']}: {report['steps']} steps of {report['dt_s']:.4g} s",
        f"a step (over the first {TRIAL_STEPS}): {report['step_ms']:.1f} ms, {step['sdf_queries']:.0f} distances, "
        f"{step['nodes']:.0f} nodes and {step['edges']:.0f} edges in the network, {step['memory_mib']:.1f} MiB",
        f"Froude scaling: the model's metre is {units['length_m']:.4g} m, its second {units['time_s']:.4g} s, "
        f"its kilogram {units['mass_kg']:.4g} kg",
        *(f"outside the model's training: {line}" for line in report["outside_training"]),
        *(f"constant in the model's training, so not learned: {name}" for name in report["constant_in_training"]),
        *(f"not the default: {name}: {said}" for name, said in report["not_default"].items()),
    ]
