"""Where the field is asked: drawn samples, free space that photos prove, and the cached SDF."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pipeline.cameras import PosedPhotos, Sparse
from pipeline.field.rendering import sdf_cache
from pipeline.field.supervision import (
    GAP,
    NOISES,
    DepthPoints,
    supervision_of,
)
from tests.helpers.sparse import NOTHING
from tests.helpers.surfaces import ring

CELL = 2 / 127  # of the preset quick


def test_lines_of_sight_of_a_sensor_end_before_its_noise():
    views = ring(4)
    rng = np.random.default_rng(1)
    xyz = np.concatenate([rng.uniform(-0.3, 0.3, (50, 3)), [[0.0, 0.0, 1.5]]])  # The last one is beyond the sphere.
    depth = DepthPoints(xyz, np.zeros((51, 2)), rng.integers(0, 4, 51))
    found = supervision_of(PosedPhotos(tuple(views), NOTHING.sparse), CELL, depth, noise=0.01)
    assert {tuple(point) for point in found.depth} == {tuple(point) for point in xyz[:50]}
    centers = np.array([view.center for view in views])
    assert (np.linalg.norm(found.sight.reshape(-1, 3), axis=1) < 1 + 1e-9).all()
    # Every point has a line from its own camera, which ends 5 noises and the usual gap before it.
    sight = xyz[:50] - centers[depth.view[:50]]
    away = np.linalg.norm(sight, axis=1)
    ends = xyz[:50] - ((GAP * CELL + NOISES * 0.01 * away) / away)[:, None] * sight
    assert np.linalg.norm(ends[:, None] - found.sight[:, 3:], axis=2).min(1).max() < 1e-9


def test_lines_of_sight_through_a_fused_solid_are_left_out():
    """A ball in the middle of four cameras: points before it keep their lines, those behind it lose theirs. The lines
    of sparse points stay."""
    views, radius = ring(4), 0.2
    centers = np.array([view.center for view in views])
    towards = -centers / np.linalg.norm(centers, axis=1, keepdims=True)
    depth = DepthPoints(np.concatenate([-0.4 * towards, 0.4 * towards]), np.zeros((8, 2)), np.tile(np.arange(4), 2))
    sparse = Sparse(0.4 * towards[:1], np.zeros((1, 3), np.uint8), np.full(1, 0.5), np.zeros(3, int), np.arange(3))
    poses = PosedPhotos(tuple(views), sparse)
    found, every = (supervision_of(poses, CELL, depth, 0.0, ball) for ball in (lambda p: p.norm(dim=1) - radius, None))
    assert len(every.sight) == 11 and len(found.sight) == 7
    np.testing.assert_array_equal(found.sight[:3], every.sight[:3])
    passed = np.linalg.norm(found.sight[3:, 3:], axis=1)
    np.testing.assert_allclose(passed, 0.4 + GAP * CELL, atol=1e-9)
    np.testing.assert_array_equal(found.depth, every.depth)


@pytest.mark.parametrize("slope", [0.5, 1.0, 1.35])
@pytest.mark.parametrize("radius", [0.012, 0.04])
def test_the_cache_misses_no_speck_of_the_unit_sphere(slope, radius):
    """Balls smaller than the distance of coarse samples, anywhere and right at the sphere; flat and steep fields."""
    rng = np.random.default_rng(3)
    place = rng.normal(size=(12, 3))
    place *= np.append(rng.uniform(0.2, 0.9, 8), 4 * [0.99 - radius])[:, None] / np.linalg.norm(place, axis=1)[:, None]
    middles = torch.tensor(place, dtype=torch.float32)
    asked: list[int] = []

    def distance(points: torch.Tensor) -> torch.Tensor:
        asked.append(len(points))
        return slope * (torch.cdist(points, middles).amin(1) - radius)

    balls = SimpleNamespace(device=torch.device("cpu"), sdf=distance)
    cache = sdf_cache(balls, 2 / 128)[..., 0]  # type: ignore[arg-type]
    assert sum(asked) < 0.2 * cache.numel()
    line = torch.linspace(-1, 1, len(cache))
    points = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).flip(-1).reshape(-1, 3)
    wanted = balls.sdf(points).view(cache.shape)
    inside = (points.norm(dim=1) <= 1).view(cache.shape)
    assert (wanted[inside] < 0).any() and ((cache < 0) == (wanted < 0))[inside].all()
    near = inside & (wanted.abs() < 0.02 * slope)
    torch.testing.assert_close(cache[near], wanted[near], rtol=0, atol=1e-6)
