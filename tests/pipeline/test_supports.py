"""Level surfaces without texture: a plain table around a patterned mat, of which a field knows the mat alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.cameras import PosedPhotos, Sparse, View
from pipeline.mesh.extraction import FieldSurface, Volume
from pipeline.mesh.supports import complete, on_any
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh
from tests.pipeline.photo_sets import around

# In normalised units: half of the table's sides, its top and its underside, half of the mat's side, and the floor.
HALF, TOP, UNDER, MAT, FLOOR = np.array([0.6, 0.4]), 0.1, 0.02, 0.2, -0.45
CELL = 0.02
UP = np.array([0.0, 0, 1])
BROWN = np.array([150, 105, 70])


def box_distance(points: np.ndarray) -> np.ndarray:
    """Signed distance [P] from the table, a board, at points [P, 3]."""
    middle, half = np.array([0, 0, (TOP + UNDER) / 2]), np.array([*HALF, (TOP - UNDER) / 2])
    q = np.abs(points - middle) - half
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


def as_trained(points: np.ndarray) -> np.ndarray:
    """What a field has in place of the table [P]: sunk on one side of the mat, piled up on the other."""
    x, y, z = np.moveaxis(points, -1, 0)
    on = (np.abs(y) < HALF[1] - 0.02) & (np.abs(x) < HALF[0] - 0.02)
    sunk, piled = on & (x > MAT + 0.05), on & (x < -MAT - 0.05)
    lifted = points + np.stack([0 * x, 0 * x, 0.05 * sunk - 0.07 * piled], -1)
    return np.minimum(box_distance(np.where((z > 0.04)[..., None], lifted, points)), z - FLOOR)


@pytest.fixture(scope="module")
def photographed(tmp_path_factory) -> tuple[FieldSurface, PosedPhotos, Path]:
    folder = tmp_path_factory.mktemp("photos")
    (folder / "images").mkdir()
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (UNDER, TOP)]) * [*HALF, 1]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    ground = np.array([[-4, -4, FLOOR], [4, -4, FLOOR], [4, 4, FLOOR], [-4, 4, FLOOR]])
    scene = Caster(Mesh(np.concatenate([corner, ground]), np.array([*faces, (8, 9, 10), (8, 10, 11)])))
    rng = np.random.default_rng(0)
    speckles = rng.integers(30, 220, (400, 400, 3))
    views, point_of, view_of = [], [], []
    points = np.concatenate([
        np.column_stack([rng.uniform(-MAT, MAT, (60, 2)), np.full(60, TOP)]),
        np.column_stack([rng.uniform(-0.8, 0.8, (300, 2)), np.full(300, FLOOR)]),
    ])  # fmt: skip
    for k, pose in enumerate(around(18, 2.4)):
        turn = np.diag([1.0, -1, -1]) @ pose[:3, :3].T
        view = View(f"{k:04d}.jpg", f"{k}.jpg", 240, 180, 230.0, 120, 90, 0.0, turn, -turn @ pose[:3, 3])
        column, row = np.meshgrid(np.arange(240) + 0.5, np.arange(180) + 0.5)
        rays = view.rays(column.ravel(), row.ravel())
        away, face = scene.hits(view.center, rays)
        hit = np.isfinite(away)
        at = view.center + np.where(hit, away, 0)[:, None] * rays
        pattern = speckles[tuple((np.mod(at[:, :2] / 0.02, 400)).astype(int).T)]
        mat = (np.abs(at[:, :2]) < MAT).all(1) & (at[:, 2] > UNDER)
        color = np.where(((face >= 12) | mat)[:, None], pattern, np.where(at[:, 2:] > TOP - 1e-4, 1.0, 0.7) * BROWN)
        color[~hit] = 200
        # A camera's noise, and exposures that differ.
        color = (0.8 + 0.04 * (k % 6)) * color + rng.normal(0, 2, color.shape)
        Image.fromarray(color.clip(0, 255).astype(np.uint8).reshape(180, 240, 3)).save(
            folder / "images" / view.name, quality=95
        )
        pixels, depth = view.project(points)
        seen = (pixels > 0).all(1) & (pixels < [240, 180]).all(1) & ~scene.blocked(points + 1e-3 * UP, view.center)
        for p in np.flatnonzero(seen & (depth > 0)):
            point_of.append(p)
            view_of.append(k)
        views.append(view)
    rgb = np.array([0.9 * speckles[tuple((np.mod(p[:2] / 0.02, 400)).astype(int))] for p in points]).astype(np.uint8)
    sparse = Sparse(points, rgb, np.full(len(points), 0.5), np.array(point_of), np.array(view_of))
    count = int(2.04 / CELL) + 1
    empty = Volume(np.zeros((count,) * 3, np.float32), np.full(3, -1.02), CELL)
    there = empty.points()
    values = np.maximum(as_trained(there), np.linalg.norm(there, axis=-1) - 0.99)
    volume = Volume(values.astype(np.float32), empty.low, CELL)
    raw = volume.mesh()
    raw = Mesh(raw.vertices, raw.faces, np.full(raw.vertices.shape, 128, np.uint8))
    known = (np.abs(raw.vertices[:, :2]) < MAT + 0.03).all(1) & (np.abs(raw.vertices[:, 2] - TOP) < 0.5 * CELL)
    known |= np.abs(raw.vertices[:, 2] - FLOOR) < 0.5 * CELL
    shown = known[raw.faces].all(1)
    surface = FieldSurface(volume, raw, known, np.ones(len(raw.faces), bool), shown, [], 3 * known)
    return surface, PosedPhotos(tuple(views), sparse), folder


def tops(volume: Volume, at: np.ndarray) -> np.ndarray:
    """Heights [P] of the topmost surface over places [P, 2]."""
    down = np.concatenate([at, np.full((len(at), 1), 0.9)], 1)
    return 0.9 - Caster(volume.mesh()).hits(down, np.broadcast_to([0.0, 0, -1], down.shape))[0]


def test_a_plain_table_goes_on_around_its_mat_up_to_its_edge_and_no_further(photographed):
    surface, poses, folder = photographed
    found = complete(surface, UP, CELL, poses, folder)
    assert len(found) == 1 and found[0].level.height == pytest.approx(TOP, abs=0.1 * CELL)
    line = np.linspace(-0.97, 0.97, 98)
    grid = np.stack(np.meshgrid(line, line, indexing="ij"), -1).reshape(-1, 2)
    inner = (np.abs(grid) < HALF - 3 * CELL).all(1)
    outer = (np.abs(grid) > HALF + 3 * CELL).any(1)
    before, volume = tops(surface.volume, grid), found[0].filled(surface.volume)
    after = tops(volume, grid)
    assert np.abs(before[inner] - TOP).max() > 0.04
    assert (np.abs(after[inner] - TOP) < 0.3 * CELL).mean() > 0.97
    mat = (np.abs(grid) < MAT - 2 * CELL).all(1)
    np.testing.assert_allclose(after[outer | mat], before[outer | mat], atol=1e-6)
    true = 4 * HALF.prod() - 4 * MAT**2
    assert found[0].area == pytest.approx(true, rel=0.2)
    on = on_any(found, CELL)(np.array([[0.5, 0.0, TOP], [0.5, 0.0, TOP + 0.1], [0.9, 0.0, TOP]]))
    assert on.tolist() == [True, False, False]


def test_nothing_is_completed_where_all_of_it_is_seen_or_patterned(photographed):
    surface, poses, folder = photographed
    # The floor has a pattern: what a field has of it is what photos show.
    low = (surface.raw.vertices[surface.raw.faces][:, :, 2] < 0).all(1)
    assert complete(replace(surface, shown=surface.shown & low), UP, CELL, poses, folder) == []
    flat = Volume(np.minimum(box_distance(surface.volume.points()), 1).astype(np.float32), surface.volume.low, CELL)
    raw = flat.mesh()
    whole = FieldSurface(
        flat,
        raw,
        np.ones(len(raw.vertices), bool),
        *[np.ones(len(raw.faces), bool)] * 2,
        [],
        np.full(len(raw.vertices), 3),
    )
    assert complete(whole, UP, CELL, poses, folder) == []


def test_a_distance_is_completed_as_its_samples_are(photographed):
    surface, poses, folder = photographed
    (one,) = complete(surface, UP, CELL, poses, folder)
    points = surface.volume.points().reshape(-1, 3)
    samples = one.filled(surface.volume).values.reshape(-1)
    changed = one.within(surface.volume.at)(points)
    np.testing.assert_allclose(changed, samples, atol=1e-5)
    assert np.abs(changed - surface.volume.values.reshape(-1)).max() > 2 * CELL


def test_flat_spots_of_a_round_thing_are_no_tables(photographed):
    """A plain ball has flat spots on top of itself; what photos show around them is as plain as they are."""
    surface, poses, folder = photographed
    ball = np.linalg.norm(surface.volume.points() - [0, 0, FLOOR], axis=-1) - 0.4
    bumps = 0.01 * np.sin(40 * surface.volume.points()).prod(-1)
    volume = replace(surface.volume, values=(ball + bumps).astype(np.float32))
    raw = volume.mesh()
    raw = replace(raw, colors=np.full(raw.vertices.shape, 128, np.uint8))
    whole = FieldSurface(
        volume,
        raw,
        np.ones(len(raw.vertices), bool),
        *[np.ones(len(raw.faces), bool)] * 2,
        [],
        np.full(len(raw.vertices), 3),
    )
    plain = folder.parent / "plain"
    (plain / "images").mkdir(parents=True, exist_ok=True)
    for view in poses.views:
        Image.new("RGB", (240, 180), (150, 105, 70)).save(plain / "images" / view.name)
    assert complete(whole, UP, CELL, poses, plain) == []
