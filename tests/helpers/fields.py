"""Small fields, and rays to train them with."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from pipeline.cameras import PosedPhotos, Similarity, Sparse, View
from pipeline.field.grid_field import FieldSize
from pipeline.field.training import Rays, Trainer
from pipeline.inputs.photos import save_photos

SMALL = FieldSize((8, 16), (2, 2), 16, 8)

UNIT = Similarity(1.0, np.eye(3), np.zeros(3))


def toy_rays(count: int = 2000) -> Rays:
    """A red ball in front of grey, seen from two sides."""
    rng = np.random.default_rng(0)
    pixel = rng.integers(0, 40, (count, 2))
    view = rng.integers(0, 2, count)
    inside = ((pixel - 19.5) ** 2).sum(1) < 100
    rgb = np.where(inside[:, None], [200, 30, 30], [128, 128, 128]).astype(np.uint8)
    turn = np.diag([-1.0, 1, -1])
    return Rays(
        torch.tensor(rgb), None, torch.tensor(view.astype(np.int16)), torch.tensor(pixel.astype(np.int16)),
        torch.tensor([[60.0, 20, 20, 0]] * 2), torch.tensor(np.stack([np.eye(3), turn]), dtype=torch.float32),
        torch.tensor([[0.0, 0, -3], [0, 0, 3]]), torch.tensor([[40, 40]] * 2),
    )  # fmt: skip


def assert_resumes(make: Callable[[], Trainer], steps: int, checkpoint: Path, more: int | None = None) -> Trainer:
    """A run that is left after some steps and goes on from a checkpoint for as many, or so many `more`, ends as an
    undisturbed one, to the bit: all that is learned. Returns it."""
    whole, first, second = make(), make(), make()
    more = steps if more is None else more
    for run, count in ((whole, steps + more), (first, steps)):
        for _ in range(count):
            run.step()
    first.save(checkpoint)
    assert second.load(checkpoint)
    for _ in range(more):
        second.step()
    for a, b in zip(whole._parameters(), second._parameters(), strict=True):
        assert torch.equal(a, b)
    return second


def posed_noise(folder: Path) -> PosedPhotos:
    """Four photos of noise, as the photos stage leaves them, and cameras around points that mean nothing."""
    from PIL import Image

    from tests.helpers.photos import photo

    (folder / "images").mkdir()
    rng = np.random.default_rng(0)
    views = []
    for k in range(4):
        Image.fromarray(rng.integers(0, 255, (40, 40, 3), dtype=np.uint8)).save(folder / "images" / f"{k}.jpg")
        a = k * np.pi / 2
        turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        views.append(View(f"{k}.jpg", f"{k}.jpg", 40, 40, 50.0, 20.0, 20.0, 0.0, turn, np.array([0.0, 0, 3])))
    save_photos([replace(photo(k, 40, 40), name=f"{k}.jpg") for k in range(4)], folder)
    points = rng.normal(size=(50, 3)) * 0.3
    point_of, view_of = np.repeat(np.arange(50), 4), np.tile(np.arange(4), 50)
    sparse = Sparse(points, np.zeros((50, 3), np.uint8), np.full(50, 0.5), point_of, view_of)
    return PosedPhotos(tuple(views), sparse)
