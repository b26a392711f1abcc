"""Depth from photos alone, and what is made of it, against closed forms."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import map_coordinates

from pipeline.cameras import PosedPhotos
from pipeline.grids.interpolation import places_of
from pipeline.stereo.depth import BEYOND, DepthMap, neighbours, only, outside_mask, stereo, stereo_summary
from pipeline.stereo.fusion import behind, fuse
from tests.helpers.balls import BALL, GROUND, ball_on_plane, camera, grey_of, ring, shoot, true_depth


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("stereo")


@pytest.fixture(scope="module")
def scene(folder) -> tuple[PosedPhotos, list[DepthMap]]:
    views = [*ring(10, 2.4, 15, 200, 150, 210.0), *ring(10, 2.4, 40, 200, 150, 210.0, start=10)]
    poses = shoot(views, ball_on_plane, folder)
    return poses, stereo(poses, folder, 200)


def test_depth_is_that_of_a_ball_on_a_plane(scene):
    """Where the ball and the plane around it are seen; edges, and what one photo alone sees, are left out."""
    _, maps = scene
    shares, errors = [], []
    for one in maps:
        true = true_depth(one.view, ball_on_plane)
        at = one.view.center + true[..., None] * one.rays / np.linalg.norm(one.rays, axis=-1, keepdims=True)
        asked = np.isfinite(true) & (np.linalg.norm(at, axis=-1) < 1)
        found = asked & (one.inverse > 0)
        along = np.linalg.norm(one.rays, axis=-1) / np.where(one.inverse > 0, one.inverse, np.nan)
        shares.append(found.sum() / asked.sum())
        errors.append(np.abs(along / true - 1)[found])
    error = np.concatenate(errors)
    assert np.mean(shares) > 0.6
    assert np.median(error) < 0.004 and np.quantile(error, 0.95) < 0.02


def test_a_photo_is_compared_with_those_beside_it(scene):
    poses, _ = scene
    for number, chosen in enumerate(neighbours(poses)):
        turn = [poses.views[k].rotation[2] @ poses.views[number].rotation[2] for k in chosen[:4]]
        assert number not in chosen and np.degrees(np.arccos(min(turn))) < 50


def test_the_report_says_how_much_was_seen_and_how_exactly(scene):
    poses, maps = scene
    found = stereo_summary(maps, poses)
    assert found["valid"] == pytest.approx(np.mean([(one.inverse > 0).mean() for one in maps]), abs=1e-3)
    assert 0 < found["spread"] < 0.006


def test_fused_depth_is_the_signed_distance(scene, folder):
    """To a third of a cell where photos see the surface; solid within the ball and below the plane, empty above. Its
    colours are those of the texture there."""
    _, maps = scene
    fused = fuse(maps, 48, folder)
    assert fused is not None and fused.side == 95
    cell = 2 / 94
    place = places_of(fused.bricks)
    points = place[:, ::-1] * cell - 1
    value = map_coordinates(fused.coarse, place.T / 2, order=1) + fused.fine
    true = ball_on_plane(points)
    seen = (np.abs(true) < cell) & (np.linalg.norm(points, axis=1) < 0.8) & (points[:, 2] > -0.34)
    assert np.median(np.abs(value - true)[seen]) < cell / 3
    known = seen & (np.abs(fused.color - 0.5) > 1e-6).any(1)
    at = points[known] / np.maximum(np.linalg.norm(points[known], axis=1, keepdims=True), 1e-9) * BALL
    on = np.abs(np.linalg.norm(points[known], axis=1) - BALL) < cell
    wanted = grey_of(at[on])
    assert known.sum() > 0.6 * seen.sum() and np.corrcoef(wanted, fused.color[known][on][:, 0])[0, 1] > 0.8
    np.testing.assert_allclose(fused.color[known][:, 0], fused.color[known][:, 2], atol=0.02)
    line = np.linspace(-1, 1, 48)
    grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1)[..., ::-1]
    inside = np.linalg.norm(grid, axis=-1) < 0.95
    away = np.abs(ball_on_plane(grid)) > 0.08
    assert ((fused.coarse < 0) == (ball_on_plane(grid) < 0))[inside & away].mean() > 0.97


def test_what_lies_behind_the_sphere_is_there_in_its_colours(scene, folder):
    """The plane goes on below: dense where it is in contracted space, and not above; colours are those of photos."""
    _, maps = scene
    found = behind(maps, 48, folder)
    line = np.linspace(-1, 1, 48)
    at = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1)[..., ::-1]
    size = np.linalg.norm(at, axis=-1)
    dense = (found[..., 0] > 0) & (size > 0.5) & (size < 0.75)
    points = at[dense] / size[dense][:, None] / (2 - 2 * size[dense])[:, None]
    assert dense.sum() > 300 and np.median(np.abs(points[:, 2] - GROUND)) < 0.15  # one to two cells there
    assert (points[:, 2] < 0.3).mean() > 0.95
    grey = 1 / (1 + np.exp(-10 * found[dense][:, 1:]))
    assert 0.3 < grey.mean() < 0.7 and np.abs(grey[:, 0] - grey[:, 2]).max() < 0.05


def test_what_no_photo_shows_makes_no_surface(scene, tmp_path):
    _, maps = scene
    assert fuse([replace(one, inverse=np.zeros_like(one.inverse)) for one in maps], 24, tmp_path) is None


def test_what_masks_leave_out_is_empty(scene, tmp_path):
    _, maps = scene
    (tmp_path / "masks").mkdir()
    row, column = np.indices(maps[0].inverse.shape)
    disc = np.hypot(row - 75, column - 100) < 40
    Image.fromarray(255 * disc.astype(np.uint8)).save(tmp_path / "masks" / f"{maps[0].view.name}.png")
    one = outside_mask(maps[0], tmp_path)
    far = np.hypot(row - 75, column - 100) > 45
    assert (one.inverse[far] == np.float32(BEYOND)).all() and (one.certain[far] == 1).all()
    np.testing.assert_array_equal(one.inverse[disc], maps[0].inverse[disc])


def test_some_photos_keep_what_they_observe(scene):
    poses, _ = scene
    some = only(poses, [3, 7])
    assert [view.name for view in some.views] == [poses.views[3].name, poses.views[7].name]
    seen = poses.sparse.point_of[poses.sparse.view_of == 7]
    np.testing.assert_array_equal(some.sparse.point_of[some.sparse.view_of == 1], seen)


def test_two_photos_are_too_few(tmp_path):
    views = [camera(f"{k}.png", np.array([2.0, 0.2 * k, 1.0]), np.zeros(3), 60, 45, 60.0) for k in range(2)]
    assert stereo(shoot(views, ball_on_plane, tmp_path), tmp_path, 60) == []
