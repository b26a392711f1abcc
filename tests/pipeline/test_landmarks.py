"""Free space that photos prove, and the grid from which samples along rays are chosen."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipeline.cameras import Sparse
from pipeline.field.grid_field import FieldSize, GridField
from pipeline.field.rendering import sdf_cache
from pipeline.sfm.supervision import CLEARANCE, FILLED, GAP, JUST_EMPTY, SLOPE, FreeSpace, Normalisation, find_landmarks
from tests.pipeline.test_surface import ring


def ball_cache(radius: float, n: int = 65) -> torch.Tensor:
    line = torch.linspace(-1, 1, n)
    return (torch.stack(torch.meshgrid(line, line, line, indexing="ij")).norm(dim=0) - radius)[..., None]


def test_lines_of_sight_end_before_their_points_and_stay_in_the_sphere():
    views = ring(4)
    xyz = np.array([[0.1, 0.0, 0.2], [0.0, 0.3, 0.0], [0.0, 0.0, 0.4]])
    seen = np.array([0, 0, 0, 0, 1, 1, 1, 2])  # The last point has too few views to be believed.
    sparse = Sparse(xyz, np.zeros((3, 3), np.uint8), np.full(3, 0.5), seen, np.array([0, 1, 2, 3, 0, 1, 2, 0]))
    found = find_landmarks(sparse, views, Normalisation(np.zeros(3), 1.0))
    np.testing.assert_allclose(found.points, xyz[:2])
    assert found.sight.shape == (7, 6)
    start, end = found.sight[:, :3], found.sight[:, 3:]
    np.testing.assert_allclose(np.linalg.norm(start, axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(end - xyz[seen[:7]], axis=1), GAP, atol=1e-9)


def crossing(count: int) -> np.ndarray:
    """Lines along x, evenly spread in y: few of them cross a ball of radius 0.1."""
    y = np.linspace(-0.9, 0.9, count)
    return np.stack([np.full(count, -0.4), y, 0 * y, np.full(count, 0.4), y, 0 * y], 1)


def test_half_the_points_are_where_free_space_is_filled():
    sight = crossing(400)
    free = FreeSpace(sight, "cpu")
    rng = torch.Generator().manual_seed(0)
    evenly, _ = free.pick(200, rng)
    assert (evenly.norm(dim=1) < 0.1).float().mean() < 0.1
    free.look(ball_cache(0.1), rng)
    assert len(free.filled) > 50
    points, clearance = free.pick(200, rng)
    filled = points.norm(dim=1) < 0.1 + FILLED + 0.01
    assert filled[:100].all() and filled[100:].float().mean() < 0.1
    rest = 0.4 - points[:, 0] + GAP
    expected = (SLOPE * rest).clamp_max(CLEARANCE)
    torch.testing.assert_close(clearance[100:], expected[100:])
    torch.testing.assert_close(clearance[:100], expected[:100].clamp_max(JUST_EMPTY))


def test_nothing_is_filled_in_an_empty_field():
    free = FreeSpace(crossing(50), "cpu")
    rng = torch.Generator().manual_seed(0)
    free.look(ball_cache(0.1) * 0 + 1, rng)
    assert len(free.filled) == 0 and len(free.pick(64, rng)[0]) == 50
    assert len(FreeSpace(np.zeros((0, 6)), "cpu").pick(64, rng)[0]) == 0


def test_the_cache_is_the_field_near_its_surface_and_has_its_signs_everywhere():
    field = GridField(FieldSize((8, 16), (2, 2), 16, 8), seed=1, start_radius=0.4)
    with torch.no_grad():
        field.grids[1].normal_(0, 0.05, generator=torch.Generator().manual_seed(0))
        line = torch.linspace(-1, 1, 41)
        z, y, x = torch.meshgrid(line, line, line, indexing="ij")
        dense = field.sdf(torch.stack([x, y, z], -1).view(-1, 3)).view(41, 41, 41, 1)
    asked = []
    plain = field.sdf
    field.sdf = lambda points: asked.append(len(points)) or plain(points)  # type: ignore[method-assign]
    cache = sdf_cache(field, 41)
    near = dense.abs() < 0.05
    torch.testing.assert_close(cache[near], dense[near], rtol=0, atol=1e-6)
    assert ((cache < 0) == (dense < 0)).all()
    assert sum(asked) < 0.6 * 41**3 and not torch.equal(cache, dense)


@pytest.mark.parametrize("radius", [0.05, 0.3])
def test_a_filled_hollow_is_emptied_by_its_lines_of_sight(radius):
    """A field that is a ball everywhere learns from lines of sight alone that a part of it is empty."""
    field = GridField(FieldSize((8, 16, 32), (2, 2, 2), 16, 8), seed=0, start_radius=0.5)
    y, z = (a.ravel() for a in np.meshgrid(np.linspace(-radius, radius, 6), np.linspace(-radius, radius, 6)))
    sight = np.stack([np.full(36, -0.9), y, z, np.full(36, 0.0), y, z], 1)
    free = FreeSpace(sight, "cpu")
    optimizer = torch.optim.Adam(field.parameters(), lr=0.01)
    rng = torch.Generator().manual_seed(0)
    inside = torch.tensor(sight[:, :3] * [0.2, 1, 1], dtype=torch.float32)  # On the lines, within the ball.
    assert (field.sdf(inside) < 0).all()
    for step in range(150):
        if step % 25 == 0:
            free.look(sdf_cache(field, 33), rng)
        points, clearance = free.pick(128, rng)
        loss = torch.relu(clearance - field.sdf(points)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert (field.sdf(inside) > 0).all()
