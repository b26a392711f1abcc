"""Steps in a row: which frames they may begin at, what carries over, and that a team shares them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.dynamics.impulse import Velocities
from sdfsim.training.contact_cache import contact_frames, join_frames
from sdfsim.training.distributed import Team
from sdfsim.training.impulse_task import ImpulseTask, Noise, disturbed
from sdfsim.training.run import Run
from sdfsim.training.unrolled import Unrolled, followed, left_over

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def frames(ball_data):
    return contact_frames(ball_data, "train", 0.1)


def flying(g, mirrored=False):
    return Velocities(g.free_velocity, g.free_angular, g.mean_velocity, g.mean_angular)


def test_a_row_begins_only_where_the_recording_goes_on(frames):
    twice = join_frames([frames, frames])
    goes_on = followed(twice)
    assert goes_on.sum() > 0 and not goes_on[len(frames) - 1]
    for k in np.flatnonzero(goes_on):
        one, two, end = twice.body_start[k : k + 3]
        np.testing.assert_array_equal(twice.end_velocity[one:two], twice.velocity[two:end])
    for steps in (2, 3, 5):
        begins = np.flatnonzero(Unrolled(ImpulseTask(twice, CPU, None), steps).weight)
        expected = [k for k in range(len(twice) - steps + 1) if goes_on[k : k + steps - 1].all()]
        np.testing.assert_array_equal(begins, expected)


def test_what_is_left_over_leads_from_the_recorded_pose_to_the_predicted_one(frames):
    """Undoing a disturbance by what it left over gives the recorded frame again."""
    task = ImpulseTask(frames, CPU, None)
    batch = task.batch(np.arange(8))
    off = torch.randn(len(batch.size), 3, generator=torch.Generator().manual_seed(0)) * 1e-3
    there = off * batch.counts[:, None]
    truth, dt = batch.truth, batch.graph.dt
    predicted = Velocities(
        truth.velocity + off, truth.angular + off, truth.mean_velocity + off / dt, truth.mean_angular + off / dt
    )
    left = left_over(predicted, batch)
    torch.testing.assert_close(left.shift, there, rtol=0, atol=1e-6)
    torch.testing.assert_close(left.push, there, rtol=0, atol=1e-6)
    torch.testing.assert_close(left.turn, there * 0.5 * batch.size[:, None], rtol=0, atol=1e-6)
    moved = disturbed(batch, left)
    back = disturbed(moved, replace(left, shift=-left.shift, turn=-left.turn, push=-left.push, spin=-left.spin))
    torch.testing.assert_close(back.graph.gap, batch.graph.gap, rtol=0, atol=1e-6)
    torch.testing.assert_close(back.truth.mean_velocity, batch.truth.mean_velocity, rtol=0, atol=1e-5)


def test_a_perfect_network_has_no_loss_and_the_gradient_leads_back_through_the_steps(frames):
    task = Unrolled(ImpulseTask(frames, CPU, None), 3)
    batches = task.draw(np.random.default_rng(0), 16)
    truths = iter([batch.truth for batch in batches])
    assert float(task.loss(lambda graph, mirrored: next(truths), batches)) < 1e-9

    push = torch.zeros(3, requires_grad=True)
    calls = []

    def pushing(g, mirrored):
        calls.append(1)
        flown = flying(g)
        return replace(flown, velocity=flown.velocity + push) if len(calls) == 1 else flown

    first_alone = Unrolled(ImpulseTask(frames, CPU, None), 1)
    together = torch.autograd.grad(task.loss(pushing, batches) * task.weight_of(batches), push)[0]
    calls.clear()
    alone = torch.autograd.grad(first_alone.loss(pushing, batches[:1]) * first_alone.weight_of(batches[:1]), push)[0]
    assert (together - alone).norm() > 0.1 * alone.norm()


def test_a_team_shares_rows_as_it_does_frames(frames):
    task = Unrolled(ImpulseTask(frames, CPU, Noise()), 2)

    def summed(team):
        batches = task.draw(np.random.default_rng(3), 8, team)
        return float(task.loss(flying, batches)) * task.weight_of(batches), task.weight_of(batches)

    whole, parts = summed(Team()), [summed(Team(rank, 2)) for rank in range(2)]
    assert sum(weight for _, weight in parts) == whole[1]
    assert sum(loss for loss, _ in parts) == pytest.approx(whole[0], rel=1e-5)


def test_the_last_part_of_a_training_is_unrolled(frames, presets):
    from sdfsim.training import train as module

    plan = replace(module.PRESETS["tiny"], in_row=2, late=0.5)
    run = Run(plan, ImpulseTask(frames, CPU, Noise()), 6, 0, CPU)
    drawn = []
    for name, task in (("single", run.task), ("row", run.late)):
        draw = task.draw
        task.draw = lambda *a, name=name, draw=draw: (drawn.append(name), draw(*a))[1]
    for _ in range(6):
        run.advance()
    assert drawn == ["single"] * 3 + ["row"] * 3
