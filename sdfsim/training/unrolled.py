"""Training over steps in a row: each starts where the network left the bodies the step before.

Single steps teach what follows from recorded states, with noise about them. In a rollout the error of a step is the
input of the next, and it is not noise: it points where the network errs.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sdfsim.dynamics.impulse import ImpulseNetwork, Velocities
from sdfsim.training.contact_cache import ContactFrames
from sdfsim.training.distributed import ALONE, Team
from sdfsim.training.impulse_task import Batch, Disturbance, ImpulseTask, disturbed


class Unrolled:
    """Draws runs of contact frames; the loss is the mean over all of their steps, and leads back through those before.

    The edges of the later frames are those of their recorded poses, with gaps to first order in how far the network
    is beside them: no signed distance is asked.

    Args:
        task: where single frames come from, and its noise for the first one.
        steps: in a row.
    """

    def __init__(self, task: ImpulseTask, steps: int) -> None:
        self.task, self.steps = task, steps
        follows = followed(task.frames)
        begins = np.ones(len(task.frames), dtype=bool)
        for later in range(1, steps):
            begins &= np.append(follows[later - 1 :], np.zeros(later, dtype=bool))
        weight = task.weight * begins
        self.weight = weight / weight.sum()

    def draw(self, rng: np.random.Generator, count: int, team: Team = ALONE) -> list[Batch]:
        """`count` runs of frames, or the part of them that falls to one of a team: a batch for each step."""
        picked = np.sort(rng.choice(len(self.weight), size=count, p=self.weight))
        first = self.task.batch(picked[team.share(count)], self.task.noise_for(picked, rng, team))
        return [first, *(self.task.batch(picked[team.share(count)] + later) for later in range(1, self.steps))]

    def loss(self, network: ImpulseNetwork, batches: list[Batch], *, mirrored: bool = False) -> Tensor:
        """Mean over the bodies of all steps, see `ImpulseTask.error`."""
        errors, left = [], None
        for recorded in batches:
            batch = recorded if left is None else disturbed(recorded, left)
            predicted = network(batch.graph, mirrored=mirrored)
            errors.append(self.task.error(predicted, batch) * self.task.weight_of(batch))
            left = left_over(predicted, batch)
        return torch.stack(errors).sum() / max(1, self.weight_of(batches))

    def weight_of(self, batches: list[Batch]) -> int:
        """Over how many bodies the loss is the mean."""
        return sum(self.task.weight_of(batch) for batch in batches)


def followed(frames: ContactFrames) -> np.ndarray:
    """[F - 1] bool: the next frame is the next step of the same bodies, which start as this one recorded their end."""
    start, same = frames.body_start, []
    for one, two, end in zip(start[:-2], start[1:-1], start[2:], strict=True):
        same.append(
            two - one == end - two
            and np.array_equal(frames.mass[one:two], frames.mass[two:end])
            and np.array_equal(frames.end_velocity[one:two], frames.velocity[two:end])
            and np.array_equal(frames.end_angular[one:two], frames.angular[two:end])
        )
    return np.array(same, dtype=bool)


def left_over(predicted: Velocities, batch: Batch) -> Disturbance:
    """By how much the end of a step lies beside what was recorded; nothing where bodies fly."""
    here, lever, dt = batch.counts[:, None], 0.5 * batch.size[:, None], batch.graph.dt
    return Disturbance(
        shift=(predicted.mean_velocity - batch.truth.mean_velocity) * dt * here,
        turn=(predicted.mean_angular - batch.truth.mean_angular) * dt * lever * here,
        push=(predicted.velocity - batch.truth.velocity) * here,
        spin=(predicted.angular - batch.truth.angular) * lever * here,
    )
