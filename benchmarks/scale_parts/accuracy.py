"""Spheres in a bowl against the teacher: penetration in closed form, and how far rollouts drift from the engine's."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

from benchmarks.scale_parts.engines import bullet
from sdfsim import Simulator, load_scene
from sdfsim.dynamics.simulator import SimulationError
from sdfsim.scene.types import Scene

WALL = 0.12  # of the bowl primitive, relative to its outer radius


def depth(scene: Scene, positions: np.ndarray) -> np.ndarray:
    """[T] m, the deepest overlap in each frame: of two spheres, or of a sphere with the bowl's inside or the floor.

    Args:
        scene: one bowl, and spheres of one size.
        positions: [T, N, 3] m of the spheres.
    """
    bowl = next(b for b in scene.bodies if b.name == "bowl")
    radius = 0.5 * next(b for b in scene.bodies if b.motion == "dynamic").scale
    inner = 0.5 * bowl.scale * (1 - WALL)
    away = positions - bowl.position
    length, height = np.linalg.norm(away, axis=-1), away[..., 2]
    inside = (length < 0.5 * bowl.scale) & (height < 0)
    wall = np.where(inside, length + radius - inner, 0.0)
    deepest = np.maximum(wall, radius - positions[..., 2]).max(1, initial=0.0)
    for k, place in enumerate(positions):
        pairs = cKDTree(place).query_pairs(2 * radius, output_type="ndarray")
        if len(pairs):
            gap = np.linalg.norm(place[pairs[:, 0]] - place[pairs[:, 1]], axis=1) - 2 * radius
            deepest[k] = max(deepest[k], -gap.min())
    return np.maximum(deepest, 0.0)


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
