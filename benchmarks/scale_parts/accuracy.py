"""Spheres in a bowl against the teacher: penetration in closed form, and how far rollouts drift from the engine's."""

from __future__ import annotations

import numpy as np
import torch

from benchmarks.scale_parts.engines import bullet
from benchmarks.scale_parts.overlaps import depth
from sdfsim import Simulator, load_scene
from sdfsim.dynamics.simulator import SimulationError


def run(scene_file: str, steps: int, model: str | None = None, always: bool = False) -> dict:
    """Rollouts of a model and of the teacher from one start.

    Returns:
        error [steps] m (root mean square over the spheres), depth [steps] m, teacher_depth [steps] m, floor [steps] m
        (the teacher against itself, started 1 mm/s off), and diameter m.
    """
    torch.set_num_threads(1)
    scene = load_scene(scene_file)
    simulator = Simulator(scene, model=model, free_flight="learned" if always else "exact")
    rows = [k for k, b in enumerate(scene.bodies) if b.motion == "dynamic"]
    try:
        mine = simulator.run(steps=steps).position[1:, rows]
    except SimulationError as broken:
        mine = broken.rollout.position[1:, rows]
    teacher = np.array([place for place, _ in bullet(scene, simulator.dt, steps)])[1:]
    start = np.random.default_rng(0).normal(size=(len(rows), 3)) * 1e-3
    shaken = np.array([place for place, _ in bullet(scene, simulator.dt, steps, push=start)])[1:]

    def error(places: np.ndarray) -> list[float]:
        gone = np.square(places - teacher[: len(places)]).sum(-1)
        return np.sqrt(gone.mean(1)).tolist()

    return {
        "bodies": len(rows),
        "dt": simulator.dt,
        "diameter": float(scene.bodies[rows[0]].scale),
        "error": error(mine),
        "floor": error(shaken),
        "depth": depth(scene, mine).tolist(),
        "teacher_depth": depth(scene, teacher).tolist(),
    }
