"""Batches of networks on surface nodes."""

from dataclasses import fields

import numpy as np
import torch

from sdfsim.physics.solver import prepare
from sdfsim.training.batches import moved
from sdfsim.training.presets import PRESETS
from sdfsim.training.surface_task import SurfaceTask


def tensors(value):
    """All tensors in a batch, in order."""
    if isinstance(value, torch.Tensor):
        return [value]
    if isinstance(value, dict):
        return [found for name in sorted(value) for found in tensors(value[name])]
    if hasattr(value, "__dataclass_fields__"):
        return [found for field in fields(value) for found in tensors(getattr(value, field.name))]
    return []


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
