"""What is watched while a network is trained: rollouts of held-out trajectories, and curves of the log.

`python -m sdfsim.learning.watch RUN -o curves.png` draws the curves.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from sdfsim.errors import SdfsimError
from sdfsim.learning.dataset import Trajectory, load_shapes, trajectory_files
from sdfsim.learning.instants import at_instants, engine_substep
from sdfsim.learning.training_run import Run

if TYPE_CHECKING:
    from sdfsim.shape.asset import Shape

WATCHED = 10  # held-out trajectories that are rolled out
STEPS = 50


@dataclass(frozen=True)
class Rollouts:
    """Held-out trajectories and what is needed to roll them out.

    Attributes:
        recorded: their first frames.
        shapes: by name.
        substep: s, the recording engine's inner step.
        device: where to simulate.
    """

    recorded: list[Trajectory]
    shapes: dict[str, Shape]
    substep: float
    device: torch.device

    def __call__(self, run: Run) -> dict[str, float]:
        """Translation RMSE in m and mean rotation error in degrees of the averaged weights; NaN where they blow up."""
        from sdfsim.learning.metrics import rotation_error, translation_rmse
        from sdfsim.learning.rollouts import batches, roll_out

        model = run.export(name="watched", data=[], ranges=run.task.ranges())
        steps = len(self.recorded[0].position) - 1
        metres, degrees = [], []
        known = {name: replace(s, nodes=s.nodes[: model.nodes]) for name, s in self.shapes.items()}
        for group in batches([at_instants(t, self.substep) for t in self.recorded]):
            try:
                predicted = roll_out(model, group, known, steps, self.device)
            except SdfsimError:
                return {"rollout_m": math.nan, "rollout_degrees": math.nan}
            for one, truth in zip(predicted, group, strict=True):
                moving = ~truth.static
                metres.append(translation_rmse(one.position[:, moving], truth.position[:, moving]))
                degrees.append(rotation_error(one.quat_xyzw[:, moving], truth.quat_xyzw[:, moving]))
        return {"rollout_m": sum(metres) / len(metres), "rollout_degrees": sum(degrees) / len(degrees)}


def held_out_rollouts(data: Path, device: torch.device, tell: Callable[[str], None]) -> Rollouts | None:
    """The first validation trajectories; None, and why is told, where they, shapes or libraries are not at hand."""
    if not (data / "validation").is_dir():
        tell(f"no rollouts while training: {data / 'validation'} is not here")
        return None
    try:
        from sdfsim.learning.rollouts import first_frames

        recorded = [Trajectory.load(f) for f in trajectory_files(data, "validation")[:WATCHED]]
        shapes = load_shapes(data, {str(n) for t in recorded for n in t.shape})
    except (ImportError, SdfsimError) as error:
        tell(f"no rollouts while training: {error}")
        return None
    recorded = [t for t in recorded if not t.static.all()]
    steps = min(STEPS, *(len(t.position) - 1 for t in recorded)) if recorded else 0
    substep = engine_substep(data)
    return Rollouts([first_frames(t, steps + 1) for t in recorded], shapes, substep, device) if recorded else None


def draw(run: Path, picture: Path) -> None:
    """Curves of RUN/log.jsonl as a picture (needs matplotlib)."""
    from matplotlib.figure import Figure

    log = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    one, two = figure.subplots(1, 2)
    one.plot([e["step"] for e in log], [e["loss"] for e in log], label="training (hard frames more often)")
    one.plot([e["step"] for e in log], [e["held_out_loss"] for e in log], label="held out")
    one.set(xlabel="optimiser step", ylabel="one-step loss", yscale="log")
    one.legend()
    rolled = [e for e in log if "rollout_m" in e]
    two.plot([e["step"] for e in rolled], [e["rollout_m"] for e in rolled], "o-", color="C2")
    two.set(xlabel="optimiser step", ylabel=f"rollout error, m (first {STEPS} steps)", ylim=(0, None))
    figure.savefig(picture, dpi=120)


def main() -> None:
    """Command line of this module."""
    parser = argparse.ArgumentParser(description="Draw the curves of a training run.")
    parser.add_argument("run", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    args = parser.parse_args()
    draw(args.run, args.out)


if __name__ == "__main__":
    main()
