"""Batches that other processes draw ahead are those that a run draws itself, in the order of its steps."""

import atexit
import gc
import itertools
import multiprocessing
import os
import signal
import sys
from dataclasses import fields

import numpy as np
import pytest
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.physics.solver import prepare
from sdfsim.training.batches import Draws, batches, moved
from sdfsim.training.contact_frames import Disturbed, contact_frames
from sdfsim.training.impulse_task import ImpulseTask
from sdfsim.training.presets import PRESETS
from sdfsim.training.surface_task import SurfaceTask
from sdfsim.training.train import train


def tensors(value):
    """All tensors in a batch, in order."""
    if isinstance(value, torch.Tensor):
        return [value]
    if isinstance(value, dict):
        return [found for name in sorted(value) for found in tensors(value[name])]
    if hasattr(value, "__dataclass_fields__"):
        return [found for field in fields(value) for found in tensors(getattr(value, field.name))]
    return []


class Numbered:
    """A task whose batch is the first number that the step's generator gives, and the process that drew it."""

    def draw(self, rng, count):
        return int(rng.integers(1 << 40)), os.getpid()


class Fatal:
    """A task whose process is killed, as by a system without memory."""

    def draw(self, rng, count):
        os.kill(os.getpid(), signal.SIGKILL)


class Crashing:
    """A task whose process draws as it should, and aborts when it ends."""

    def draw(self, rng, count):
        atexit.register(os.abort)
        return {}


def test_workers_that_crash_on_their_way_out_are_joined_in_silence(monkeypatch):
    told: list = []
    monkeypatch.setattr(sys, "unraisablehook", told.append)
    drawn = batches(Draws(Crashing(), 1, 0), 0, 2)
    assert next(drawn).batch == {} and len(multiprocessing.active_children()) == 2
    drawn.close()
    assert not multiprocessing.active_children()
    del drawn
    gc.collect()
    assert not told


@pytest.mark.parametrize("kind", ["impulse", "sdf-sim"])
def test_workers_draw_what_the_run_itself_would_draw(ball_data, kind):
    if kind == "impulse":
        task = ImpulseTask(contact_frames(ball_data, "train", Disturbed()))
    else:
        task = SurfaceTask(ball_data, "train", PRESETS["sdf-sim"], noisy=True)
    draws = Draws(task, 3, 5)
    own, theirs = (list(itertools.islice(batches(draws, 7, workers), 4)) for workers in (0, 1))
    assert len({sum(float(t.double().sum()) for t in tensors(d.batch)) for d in own}) == 4  # four different ones
    for mine, other in zip(own, theirs, strict=True):
        assert mine.mirrored == other.mirrored
        pairs = list(zip(tensors(mine.batch), tensors(other.batch), strict=True))
        assert len(pairs) > 10 and all(torch.equal(one, two) for one, two in pairs)


def test_batches_come_in_the_order_of_steps_from_several_processes():
    found = list(itertools.islice(batches(Draws(Numbered(), 1, 3), 10, 2), 12))
    for step, drawn in enumerate(found, start=10):
        rng = np.random.default_rng([3, 0, step])
        assert (drawn.mirrored, drawn.batch[0]) == (bool(rng.integers(2)), int(rng.integers(1 << 40)))
    processes = {drawn.batch[1] for drawn in found}
    assert len(processes) == 2 and os.getpid() not in processes


def test_a_worker_that_was_killed_is_told_in_one_line():
    with pytest.raises(SdfsimError, match="process that draws batches has ended"):
        next(batches(Draws(Fatal(), 1, 0), 0, 1))


@pytest.mark.slow
def test_a_training_with_workers_gives_the_same_weights(ball_data, presets, tmp_path):
    """Also one that was stopped and goes on without them."""
    train(ball_data, tmp_path / "none", preset="tiny-sdf-sim", steps=6)

    def stopped(share, message):
        raise KeyboardInterrupt

    from sdfsim.training import train as module

    before, module.TELL_STEPS = module.TELL_STEPS, 3
    try:
        with pytest.raises(KeyboardInterrupt):
            train(ball_data, tmp_path / "two", preset="tiny-sdf-sim", steps=6, workers=1, on_progress=stopped)
    finally:
        module.TELL_STEPS = before
    report = train(ball_data, tmp_path / "two", preset="tiny-sdf-sim", steps=6, resume=True)
    assert report["steps"] == 6
    one, two = (dict(np.load(tmp_path / name / "checkpoint.npz")) for name in ("none", "two"))
    assert set(one) == set(two) and len(one) > 100
    for name in set(one) - {"run"}:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)


def test_a_number_of_workers_below_none_is_refused(ball_data, tmp_path):
    with pytest.raises(SdfsimError, match=r"workers: must be at least 0 \(got -1\)"):
        train(ball_data, tmp_path, workers=-1)


def test_shapes_are_compiled_once_for_all_batches(ball_data, monkeypatch):
    made = []
    known = prepare.compiled_shapes

    def counted(shapes, **how):
        made.append(shapes)
        return known(shapes, **how)

    monkeypatch.setattr(prepare, "compiled_shapes", counted)
    task = SurfaceTask(ball_data, "train", PRESETS["sdf-sim"])
    for step in range(5):
        task.draw(np.random.default_rng(step), 4)
    assert len(made) == 1


def test_a_batch_moves_with_all_its_parts(ball_data):
    batch = SurfaceTask(ball_data, "train", PRESETS["sdf-sim"]).draw(np.random.default_rng(0), 2)
    there = moved(batch, torch.device("meta"))
    assert [t.shape for t in tensors(there)] == [t.shape for t in tensors(batch)]
    assert all(t.device.type == "meta" for t in tensors(there))
