"""The room around the trained ball: its floor, walls and furniture are where they are, and bodies meet them."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.mesh.surroundings import surroundings_of
from pipeline.stereo.depth import DepthMap
from pipeline.stereo.fusion import load_far, save_far, surrounding_distance
from sdfsim.geometry.bvh import ClosestPoint
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.primitives import sphere
from tests.helpers.balls import ring, shoot, true_depth

FLOOR, WALL, HIGH = -0.4, 3.5, 2.5


def box(points: np.ndarray, low: list[float], high: list[float]) -> np.ndarray:
    away = np.maximum(np.array(low) - points, points - high)
    return np.minimum(away.max(1), 0) + np.linalg.norm(np.maximum(away, 0), axis=1)


def room(points: np.ndarray) -> np.ndarray:
    """A ball on the floor of a room, 7 m wide, with a cabinet in one corner."""
    inside = -box(points, [-WALL, -WALL, FLOOR], [WALL, WALL, HIGH])
    cabinet = box(points, [2.0, 2.0, FLOOR - 1], [WALL + 1, WALL + 1, 1.0])
    return np.minimum(np.minimum(inside, cabinet), np.linalg.norm(points - [0, 0, 0.0], axis=1) - 0.4)


def depth_map(view) -> DepthMap:
    away = true_depth(view, room, far=12.0)
    row, column = np.indices(away.shape) + 0.5
    along = view.rays(column.ravel(), row.ravel()) @ view.rotation[2]
    matrix = np.array([[view.focal, 0, view.cx - 0.5], [0, view.focal, view.cy - 0.5], [0, 0, 1]])
    inverse = np.nan_to_num(1 / (away * along.reshape(away.shape)), nan=0.0).astype(np.float32)
    return DepthMap(view, matrix, inverse, (inverse > 0).astype(np.float32))


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """Photos from a ring inside the room, their depth with a hundredth of noise, and the surroundings from it."""
    folder = tmp_path_factory.mktemp("photos")
    views = ring(16, 1.6, 6, 160, 120, 90.0) + ring(10, 1.7, 35, 160, 120, 90.0, start=1)
    views = [replace(view, name=f"{k:03d}.png", source=f"{k:03d}.png") for k, view in enumerate(views)]
    poses, noise = shoot(views, room, folder), np.random.default_rng(0)
    maps = [depth_map(view) for view in views]
    wrong = [(1 + 0.01 * noise.standard_normal(one.inverse.shape)).astype(np.float32) for one in maps]
    noisy = [replace(one, inverse=one.inverse * off) for one, off in zip(maps, wrong, strict=True)]
    far = surrounding_distance(noisy)
    assert far is not None and WALL < far.reach < 2 * WALL
    save_far(far, folder)
    kept = load_far(folder)
    assert kept is not None and np.allclose(kept.values, far.values, atol=0.01)
    ball = sphere(1.0)
    table = Mesh(ball.vertices * 0.8 / np.ptp(ball.vertices, axis=0).max(), ball.faces)
    return surroundings_of(kept, lambda p: p[:, 2] - FLOOR, [table], poses.views, folder), maps


def test_what_is_shown_lies_on_the_room(seen):
    around = seen[0]
    off = np.abs(room(around.shown.vertices))
    assert np.quantile(off, 0.5) < 0.3 * around.cell and np.quantile(off, 0.95) < 1.5 * around.cell
    level = around.shown.vertices[np.abs(around.shown.vertices[:, 2] - FLOOR) < 0.3 * around.cell]
    assert np.ptp(level[:, :2], axis=0).min() > 1.6 * WALL  # the floor goes from wall to wall
    for axis, side in ((0, -1), (1, -1)):  # and so do the walls that no cabinet hides
        wall = around.shown.vertices[np.abs(around.shown.vertices[:, axis] - side * WALL) < around.cell]
        assert np.ptp(wall[:, 1 - axis]) > 1.3 * WALL


def test_nearly_all_that_the_photos_see_of_the_room_is_shown(seen):
    around, maps = seen
    nearest = ClosestPoint(around.shown)
    at = np.concatenate([one.points()[::37] for one in maps])
    at = at[np.linalg.norm(at, axis=1) > 1.1]
    away = np.linalg.norm(nearest(at)[0] - at, axis=1)
    assert (away < 2 * around.cell).mean() > 0.93


def test_bodies_meet_walls_and_furniture_but_not_the_noise_of_the_floor(seen):
    solid = ClosestPoint(seen[0].solid)
    cell = seen[0].cell
    walls = [[-WALL - 3 * cell, 0, 0.3], [0, -WALL - 3 * cell, 0.3]]
    beyond = np.array([*walls, [2.6, 2.6, 0.3], [0.0, 0, FLOOR - 3 * cell]])
    assert solid.odd(beyond).all()
    rng = np.random.default_rng(0)
    air = rng.uniform([-3, -3, FLOOR + 0.01], [1.5, 1.5, 1.0], (4000, 3))
    assert solid.odd(air).mean() < 0.002


def test_photos_of_one_thing_alone_have_no_surroundings():
    views = ring(6, 2.0, 20, 80, 60, 120.0)
    maps = [depth_map(view) for view in views]
    near = []
    for one in maps:
        at = one.view.center + one.rays / np.maximum(one.inverse, 1e-6)[..., None]
        near.append(replace(one, inverse=np.where(np.linalg.norm(at, axis=-1) < 0.9, one.inverse, 0)))
    assert surrounding_distance(near) is None
