"""Two processes that share every batch train as one does."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sdfsim.training.contact_cache import Solved, contact_frames
from sdfsim.training.distributed import Team
from sdfsim.training.impulse_task import ImpulseTask
from sdfsim.training.train import train

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("size", [1, 2, 3, 7])
def test_the_parts_of_a_batch_are_the_batch(size):
    parts = [np.arange(10)[Team(rank, size).share(10)] for rank in range(size)]
    np.testing.assert_array_equal(np.concatenate(parts), np.arange(10))


def test_the_parts_losses_add_up_to_the_whole_batchs_loss(ball_data):
    task = ImpulseTask(contact_frames(ball_data, "train", Solved()))

    def flying(g, mirrored):
        from sdfsim.learned.impulse import Velocities

        return Velocities(g.free_velocity, g.free_angular, g.mean_velocity, g.mean_angular)

    def summed(team):
        batch = task.draw(np.random.default_rng(3), 8, team)
        return float(task.loss(flying, batch)) * task.weight_of(batch), task.weight_of(batch)

    whole = summed(Team())
    parts = [summed(Team(rank, 2)) for rank in range(2)]
    assert all(weight > 0 for _, weight in parts)
    assert sum(weight for _, weight in parts) == whole[1]
    assert sum(loss for loss, _ in parts) == pytest.approx(whole[0], rel=1e-5)


@pytest.mark.slow
def test_two_processes_have_the_gradients_of_one(ball_data, tmp_path):
    """After one step an optimiser's momentum is a multiple of the gradient. Weights would not do: they move by as much
    where a gradient is next to zero, in a direction that rounding decides."""
    train(ball_data, tmp_path / "one", preset="small", steps=1)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    command += ["-m", "sdfsim.training.train", str(ball_data), str(tmp_path / "two"), "--steps", "1", "--device", "cpu"]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=600)
    one, two = (dict(np.load(tmp_path / name / "checkpoint.npz")) for name in ("one", "two"))
    momenta = [name for name in one if name.endswith(("/exp_avg", "/momentum_buffer"))]
    assert len(momenta) > 60
    largest = max(np.abs(one[name]).max() for name in momenta)
    assert largest > 1e-4
    for name in momenta:  # attention is the same whatever its bias is: that one's gradient is rounding alone
        assert np.abs(one[name] - two[name]).max() <= 1e-4 * np.abs(one[name]).max() + 1e-7 * largest, name
