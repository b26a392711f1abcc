"""How far the teacher departs from its own recording: run again from starts that differ by next to nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from sdfsim.data.dataset import Trajectory, floor_of, home_of, read_info
from sdfsim.data.pybullet_sim import engine_settings, import_pybullet, substeps_of
from sdfsim.errors import SdfsimError
from sdfsim.evaluation.engines import Start, bullet, dataset_urdf
from sdfsim.parallel import parallel

# m/s; 0 tells what the recording alone does not bring back: an engine's state is more than its recorded frames.
PERTURBATIONS = {"0": 0.0, "1e-6": 1e-6, "1e-3": 1e-3}


def chaos_floor(data: Path, trajectories: list[Trajectory], steps: int, seed: int = 0) -> dict[str, list[Trajectory]]:
    """Run the teacher again from recorded starts (velocities as recorded) of a dataset with a URDF for every shape.

    Returns, by the names of `PERTURBATIONS`, the motions (steps + 1 frames) that follow when the velocity of each body
    that moves is changed by so much in a random direction. Raises SdfsimError where PyBullet or an engine file is
    absent, or the recording is not this teacher's.
    """
    import_pybullet()
    info = read_info(home_of(data) or data.parent)
    _check_teacher(info, trajectories)
    urdfs = {name: dataset_urdf(data, name) for name in {str(n) for t in trajectories for n in t.shape}}
    jobs = [
        (Start(perturbed(t, size, [seed, k]), urdfs, floor_of(info)), steps)
        for size in PERTURBATIONS.values()
        for k, t in enumerate(trajectories)
    ]
    done = {index: motion for index, (motion, _) in parallel(bullet, jobs)}
    count = len(trajectories)
    return {name: [done[i * count + k] for k in range(count)] for i, name in enumerate(PERTURBATIONS)}


def perturbed(t: Trajectory, size: float, seed: list[int]) -> Trajectory:
    """The trajectory with velocities of its moving bodies changed by `size` m/s in random directions."""
    direction = np.random.default_rng(seed).normal(size=t.velocity[0].shape)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return replace(t, velocity=t.velocity + size * direction * ~t.static[:, None])


def _check_teacher(info: dict, trajectories: list[Trajectory]) -> None:
    """That the recording was made by the engine, and the settings, that would run it again."""
    settings = info.get("engine_settings")
    if info.get("engine") != "pybullet" or not isinstance(settings, dict):
        raise SdfsimError(f"recorded by {info.get('engine') or 'an unnamed engine'}, not by PyBullet as it is set here")
    for step in {t.dt for t in trajectories}:
        ours = engine_settings(step, substeps_of(step))
        if other := [name for name, value in ours.items() if settings.get(name) != value]:
            raise SdfsimError(f"recorded with other engine settings ({', '.join(other)})")
