"""A cup from photos: training starts from fused depth, and the hollow that photos see into stays one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.field import training
from pipeline.field.grid_field import FieldSize
from pipeline.field.training import PRESETS, train
from pipeline.inputs.photos import save_photos
from tests.helpers.balls import cup, ring, shoot
from tests.helpers.photos import photo

RADIUS, WALL, DEPTH, HEIGHT = 0.3, 0.07, 0.38, 0.5
MIDDLE = (0.0, 0.0, 0.25)
SIZE = FieldSize((8, 16, 32, 56), (2, 2, 2, 2), 32, 16, finer_channels=(2,))


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> training.Trained:
    folder: Path = tmp_path_factory.mktemp("cup")
    rings = [(8, 25), (8, 45), (8, 68)]
    views = [view for k, (count, up) in enumerate(rings)
             for view in ring(count, 2.2, up, 200, 150, 260.0, MIDDLE, start=k * 8 + k)]  # fmt: skip
    views = [replace(view, name=f"{n:03d}.png") for n, view in enumerate(views)]
    poses = shoot(views, cup(RADIUS, WALL, DEPTH, HEIGHT), folder)
    save_photos([replace(photo(k, 200, 150), name=view.name) for k, view in enumerate(views)], folder)
    settings = replace(
        PRESETS["quick"], size=SIZE, rays=256, samples=24, iterations=150, surface_points=128, long_side=200, stereo=200
    )
    return train(poses, folder, folder, settings=settings, threads=1)


def bottom(found: training.Trained, at: np.ndarray) -> np.ndarray:
    """Height [P] m at which a line straight down from above the cup meets the field's surface at places [P, 2]."""
    heights = np.linspace(HEIGHT + 0.1, -0.1, 400)
    points = np.concatenate([np.repeat(at, len(heights), 0), np.tile(heights, len(at))[:, None]], 1)
    with torch.no_grad():
        sdf = found.field.sdf(torch.tensor(found.to_unit.points(points), dtype=torch.float32))
    return heights[(sdf.numpy().reshape(len(at), -1) < 0).argmax(1)]


def test_a_cup_is_as_deep_as_photos_see(trained):
    """Within a tenth of its depth; its rim and the ground beside it are where they should be too."""
    turn = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    around = np.stack([np.cos(turn), np.sin(turn)], 1)
    assert trained.report["stereo"]["fused"]
    inside = bottom(trained, np.concatenate([0.04 * around, 0.1 * around]))
    assert HEIGHT - np.median(inside) == pytest.approx(DEPTH, rel=0.1)
    assert np.median(bottom(trained, (RADIUS - WALL / 2) * around)) == pytest.approx(HEIGHT, abs=0.02)
    assert np.abs(bottom(trained, (RADIUS + 0.15) * around)).max() < 0.02


def test_its_wall_is_as_thick_as_it_is(trained):
    """Halfway down the hollow, where photos see both of its sides. 26 % too thin in the median."""
    away = np.linspace(0, RADIUS + 0.1, 400)
    walls = []
    for turn in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        points = np.stack([away * np.cos(turn), away * np.sin(turn), np.full(400, HEIGHT - DEPTH / 2)], 1)
        with torch.no_grad():
            sdf = trained.field.sdf(torch.tensor(trained.to_unit.points(points), dtype=torch.float32))
        walls.append((sdf.numpy() < 0).sum() * (away[1] - away[0]))
    assert np.median(walls) == pytest.approx(WALL, rel=0.4)


def test_bricks_are_where_the_surface_is(trained):
    """They go along the ground and the cup, and leave most of the space out."""
    level = trained.field.bricks[0]
    share = len(level.places) / (-(-level.side // 4)) ** 3
    assert 0.01 < share < 0.3 and level.values.abs().max() > 0
