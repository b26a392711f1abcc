"""What a step of ours costs: one scene in a process of its own, so that its peak memory is its own."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.scale_parts.overlaps import overlaps
from sdfsim import Simulator, load_scene
from sdfsim.dynamics.contacts import find_contacts, thin_contacts
from sdfsim.dynamics.memory import PHASES
from sdfsim.dynamics.rollout import Rollout
from sdfsim.dynamics.simulator import SimulationError, join
from sdfsim.dynamics.step import contact_graph, fly
from sdfsim.scene.types import Body, Scene
from sdfsim.shape.shape import analytic_shape

COUNTS = ("pairs", "sdf_queries", "sdf_waiting", "nodes", "edges", "active")


def run(scene: Scene | str, steps: int, *, model: str | None = None, always: bool = False) -> dict:
    """Cost of `steps` steps of a scene, on one thread.

    Args:
        scene: or its file.
        steps: to simulate.
        model: bundled name or path.
        always: the network predicts all motion of all bodies (the *paper* network's own way).

    Returns:
        bodies, nodes, contacts, ms (CPU time of a step, mean), wall_ms (its median), phases (wall ms, mean), counts,
        peak_mib (growth of the process over the loaded scene), penetration_95 m (of the deepest node of a step),
        overlap_95 m (of all contacts of all steps; bowls only), lost (bodies below the floor or
        outside of what holds them), finite, speed (median of the bodies at the end, m/s), and steps that were made.
    """
    torch.set_num_threads(1)
    scene = load_scene(scene) if isinstance(scene, str) else scene
    before = peak_from_here()
    simulator = Simulator(scene, model=model, free_flight="learned" if always else "exact")
    frames: list[Rollout] = []
    began, broken = time.process_time(), None
    try:
        for frame in simulator.frames(steps):
            frames.append(frame)
    except SimulationError as error:
        broken = error.message
    spent = time.process_time() - began
    return {
        "bodies": int(simulator.bodies.moves.sum()),
        "nodes": len(simulator.bodies.node),
        "ms": 1e3 * spent / max(1, len(frames)),
        "peak_mib": memory("VmHWM") - before,
        "broken": broken,
        **(told(scene, join(frames)) if frames else {"steps": 0}),
    }


def peak_from_here() -> float:
    """MiB that the process holds now; its peak is from now on counted anew (a new process inherits its parent's)."""
    Path("/proc/self/clear_refs").write_text("5")
    return memory("VmRSS")


def memory(kind: str) -> float:
    """MiB of this process, by a name of /proc/self/status."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith(f"{kind}:")) / 1024


def told(scene: Scene, rollout: Rollout) -> dict:
    """What a rollout without its initial state tells of itself."""
    counters = rollout.counters
    moving = np.array([b.motion == "dynamic" for b in scene.bodies])
    bowl = any(b.name == "bowl" for b in scene.bodies)
    deep = np.concatenate([overlaps(scene, place[moving]) for place in rollout.position]) if bowl else np.zeros(0)
    return {
        "steps": len(rollout.time),
        "contacts": float(counters["contacts"].mean()),
        "wall_ms": float(np.median(counters["step_ms"])),
        "phases": {k: float(counters[k].mean()) for k in PHASES},
        "counts": {k: float(counters[k].mean()) for k in COUNTS},
        "penetration_95": float(np.percentile(counters["worst_penetration"], 95)),
        "overlap_95": float(np.percentile(deep, 95)) if len(deep) else None,
        "lost": int(_lost(scene, rollout)[moving].sum()),
        "finite": bool(np.isfinite(rollout.position).all()),
        "speed": float(np.median(np.linalg.norm(rollout.velocity[-1, moving], axis=-1))),
    }


def _lost(scene: Scene, rollout: Rollout) -> np.ndarray:
    """[N] bool: whose centre is below the floor, or outside of the bowl and below its rim, at the end."""
    place = rollout.position[-1]
    lost = place[:, 2] < 0
    for body in scene.bodies:
        if body.name == "bowl" and body.motion == "static":
            away = np.linalg.norm(place - body.position, axis=1)
            lost |= (away > 0.5 * body.scale) & (place[:, 2] < body.position[2])
    return lost


def apart(count: int) -> Scene:
    """Boxes at rest on the floor, far from each other."""
    side = int(np.ceil(count**0.5))
    shapes = (analytic_shape("plane"), analytic_shape("box", size=(1.0, 1.0, 1.0)))
    still = {"quat_xyzw": np.array([0.0, 0.0, 0.0, 1.0]), "velocity": np.zeros(3), "angular_velocity": np.zeros(3)}
    still |= {"scale": 1.0, "friction": 0.5, "restitution": 0.5}
    places = [np.array([3.0 * (k % side), 3.0 * (k // side), 0.5]) for k in range(count)]
    bodies = [Body("floor", 0, "static", position=np.zeros(3), mass=0.0, **still)]
    bodies += [Body(f"b{k}", 1, "dynamic", position=place, mass=1.0, **still) for k, place in enumerate(places)]
    return Scene(shapes, tuple(bodies), gravity=np.array([0.0, 0.0, -9.81]), duration=1.0)


def run_apart(count: int, steps: int) -> dict:
    """`run` of `apart`."""
    return run(apart(count), steps)


def selection(scene_file: str, steps: int) -> dict:
    """What choosing a few edges a pair changes in the network's answer, after some steps.

    Returns:
        edges and kept (how many), change (root mean square change of velocity that contact makes, m/s) and error (of
        it, when edges are chosen instead of all taken).
    """
    torch.set_num_threads(1)
    simulator = Simulator(load_scene(scene_file))
    simulator.run(steps=steps)
    bodies, state, rules = simulator.bodies, simulator.state, simulator.rules
    free = fly(bodies, state, rules)
    every = find_contacts(bodies, state, rules.gravity, simulator.model.reach, rules.dt)
    velocity, sizes = [], []
    for contacts in (every, thin_contacts(bodies, every)):
        active, graph = contact_graph(bodies, state, free, contacts, rules)
        with torch.no_grad():
            answer = simulator.model.network(graph, friction=rules.friction)
        velocity.append((answer.velocity - graph.free_velocity)[bodies.moves[active]] * simulator.units.velocity)
        sizes.append(len(contacts))

    def rms(v: torch.Tensor) -> float:
        return float(v.square().sum(-1).mean().sqrt())

    return {"edges": sizes[0], "kept": sizes[1], "change": rms(velocity[0]), "error": rms(velocity[1] - velocity[0])}


def with_nodes_cut(scene: Scene, keep: float) -> Scene:
    """The scene with a part of every shape's nodes only, the first of them: `thin` orders them farthest first."""
    shapes = tuple(replace(s, nodes=s.nodes[: max(1, round(keep * len(s.nodes)))]) for s in scene.shapes)
    return replace(scene, shapes=shapes)


def run_cut(scene_file: Path | str, keep: float, steps: int) -> dict:
    """`run` of a scene with a part of its nodes."""
    return run(with_nodes_cut(load_scene(scene_file), keep), steps)
