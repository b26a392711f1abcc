"""What is watched while a network is trained: rollouts of held-out trajectories."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from sdfsim.data.dataset import Trajectory, engine_substep, load_shapes, trajectory_files
from sdfsim.errors import SdfsimError
from sdfsim.training.contact_cache import inner_steps
from sdfsim.training.run import Run

if TYPE_CHECKING:
    from sdfsim.shape.shape import Shape

WATCHED = 10  # held-out trajectories that are rolled out
STEPS = 50


@dataclass(frozen=True)
class Rollouts:
    """Held-out trajectories and what is needed to roll them out."""

    recorded: list[Trajectory]  # their first frames
    shapes: dict[str, Shape]  # by name
    substep: float  # s, the recording engine's inner step
    device: torch.device  # where to simulate

    def __call__(self, run: Run) -> dict[str, float]:
        """Translation RMSE in m and mean rotation error in degrees of the averaged weights; NaN where they blow up.
        Over all bodies that move and all steps, as `evaluate` has them."""
        from sdfsim.data.metrics import rotation_error, translation_rmse
        from sdfsim.data.replay import batches, roll_out

        model = run.export(name="watched", data=[], ranges=run.task.ranges())
        steps = len(self.recorded[0].position) - 1
        squared, degrees, bodies = 0.0, 0.0, 0
        for group in batches(self.recorded):
            try:
                inner = inner_steps(group[0].dt, self.substep)
                predicted = roll_out(model, group, self.shapes, steps, self.device, substeps=inner, as_teacher=True)
            except SdfsimError:
                return {"rollout_m": math.nan, "rollout_degrees": math.nan}
            for one, truth in zip(predicted, group, strict=True):
                moving = ~truth.static
                count = int(moving.sum())
                squared += count * translation_rmse(one.position[1:, moving], truth.position[1:, moving]) ** 2
                degrees += count * rotation_error(one.quat_xyzw[1:, moving], truth.quat_xyzw[1:, moving])
                bodies += count
        return {"rollout_m": math.sqrt(squared / bodies), "rollout_degrees": degrees / bodies}


def held_out_rollouts(data: Path, device: torch.device, tell: Callable[[str], None]) -> Rollouts | None:
    """The first validation trajectories; None, and why is told, where they, shapes or libraries are not at hand."""
    if not (data / "validation").is_dir():
        tell(f"no rollouts while training: {data / 'validation'} is not here")
        return None
    try:
        from sdfsim.data.replay import first_frames

        recorded = [Trajectory.load(f) for f in trajectory_files(data, "validation")[:WATCHED]]
        shapes = load_shapes(data, {str(n) for t in recorded for n in t.shape})
    except (ImportError, SdfsimError) as error:
        tell(f"no rollouts while training: {error}")
        return None
    recorded = [t for t in recorded if not t.static.all()]
    steps = min(STEPS, *(len(t.position) - 1 for t in recorded)) if recorded else 0
    substep = engine_substep(data)
    return Rollouts([first_frames(t, steps + 1) for t in recorded], shapes, substep, device) if recorded else None
