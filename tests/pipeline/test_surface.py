"""Extraction and placement against shapes that are known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.cameras import Sparse, View
from pipeline.cleaning import components, drop_small, vertex_normals
from pipeline.normalise import camera_up, find_normalisation, nearest_to_axes, plane_up
from pipeline.placement import Placement, place, resting_height
from pipeline.surface import (
    bilinear,
    marching_cubes,
    sample_volume,
    trusted_vertices,
)
from sdfsim.errors import EXIT_QUALITY, SdfsimError
from sdfsim.shape.mesh import Mesh, is_closed, signed_volume


def ball(center=(0.0, 0, 0), radius: float = 0.5):
    return lambda p: np.linalg.norm(p - np.asarray(center, np.float32), axis=1) - radius


def cube(size: float = 1.0, center=(0.0, 0, 0)) -> Mesh:
    import trimesh

    made = trimesh.creation.box((size, size, size))
    made = made.subdivide().subdivide().subdivide()
    return Mesh(np.asarray(made.vertices) + center, np.asarray(made.faces, np.int64))


def look_at(eye, target=(0.0, 0, 0), up=(0.0, 0, 1)) -> View:
    forward = np.asarray(target, float) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return View("a", "a", 640, 480, 600.0, 320.0, 240.0, 0.0, rotation, -rotation @ np.asarray(eye, float))


def ring(count: int = 12, height: float = 1.0, radius: float = 3.0) -> list[View]:
    angles = np.arange(count) * 2 * np.pi / count
    return [look_at(np.array([radius * np.cos(a), radius * np.sin(a), height])) for a in angles]


def test_marching_cubes_of_a_ball():
    volume = sample_volume(ball(), 65, extent=1.0)
    mesh = marching_cubes(volume, 1.0)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.5).max() < 1e-3
    assert is_closed(mesh)
    assert signed_volume(mesh) == pytest.approx(4 / 3 * np.pi * 0.125, rel=0.01)
    normals = vertex_normals(mesh)
    assert (normals * mesh.vertices).sum(1).min() > 0.49


def test_sparse_sampling_equals_dense_near_the_surface():
    two = lambda p: np.minimum(ball((0.4, 0, 0), 0.3)(p), ball((-0.45, 0.1, 0), 0.12)(p))  # noqa: E731
    volume = sample_volume(two, 49, extent=1.0)
    line = np.linspace(-1, 1, 49, dtype=np.float32)
    dense = two(np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)).reshape(volume.shape)
    close = np.abs(dense) < 0.08
    np.testing.assert_array_equal(volume[close], dense[close])
    assert ((volume < 0) == (dense < 0)).all()


def test_no_surface_is_a_quality_error():
    with pytest.raises(SdfsimError) as caught:
        marching_cubes(np.ones((5, 5, 5), np.float32), 1.0)
    assert caught.value.exit_code == EXIT_QUALITY


def test_small_and_unseen_components_are_dropped_and_counted():
    big, speck, hidden = cube(1.0), cube(0.05, (2, 0, 0)), cube(0.9, (4, 0, 0))
    count = len(big.vertices)
    mesh = Mesh(
        np.concatenate([big.vertices, speck.vertices, hidden.vertices]),
        np.concatenate([big.faces, speck.faces + count, hidden.faces + 2 * count]),
    )
    assert components(mesh).max() == 2
    seen = np.repeat([True, True, False], len(big.faces))
    rest, kept, report = drop_small(mesh, seen, 0.01)
    assert report["dropped_small"] == 1 and report["dropped_unseen"] == 1
    assert len(rest.faces) == len(big.faces) == kept.sum()


def test_trusted_vertices_close_gaps_but_not_the_cap():
    mesh = marching_cubes(sample_volume(ball(radius=0.5), 33, extent=1.0), 1.0)
    count = np.full(len(mesh.vertices), 3)
    count[10] = 0
    assert trusted_vertices(mesh, count, 0.05).all()
    cap = Mesh(mesh.vertices * 1.98, mesh.faces)
    assert not trusted_vertices(cap, count, 0.05).any()


def test_bilinear_is_exact_on_a_ramp():
    image = np.stack(np.meshgrid(np.arange(7.0), np.arange(5.0)), -1)
    at = np.random.default_rng(0).uniform([0, 0], [6, 4], (40, 2))
    np.testing.assert_allclose(bilinear(image, at), at)


def test_axes_meet_where_the_cameras_look():
    views = ring()
    found = nearest_to_axes(np.array([v.center for v in views]), np.array([v.rotation[2] for v in views]))
    np.testing.assert_allclose(found, 0, atol=1e-4)


def test_normalisation_holds_the_object_and_moves_cameras_along():
    rng = np.random.default_rng(0)
    views = ring()
    xyz = np.concatenate([rng.normal(size=(300, 3)) * 0.2, rng.normal(size=(40, 3)) * 20])
    observed = np.arange(340).repeat(3)
    sparse = Sparse(xyz, np.zeros((340, 3), np.uint8), np.full(340, 0.5), observed, np.zeros(1020, int))
    place_ = find_normalisation(views, sparse)
    assert np.linalg.norm(place_.center) < 0.1 and 0.5 < place_.radius < 2.5
    p = rng.normal(size=(20, 3)) * 0.3
    for before, after in zip(views, place_.views(views), strict=True):
        np.testing.assert_allclose(before.project(p)[0], after.project(place_.apply(p))[0], atol=1e-8)


def test_up_from_level_cameras():
    up = camera_up(ring())
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-6)
    half = ring()[:4]
    np.testing.assert_allclose(camera_up(half), [0, 0, 1], atol=1e-6)


def test_up_from_the_dominant_plane():
    rng = np.random.default_rng(0)
    tilt = np.radians(8)
    normal = np.array([np.sin(tilt), 0, np.cos(tilt)])
    a, b = np.array([np.cos(tilt), 0, -np.sin(tilt)]), np.array([0.0, 1, 0])
    points = rng.uniform(-1, 1, (800, 1)) * a + rng.uniform(-1, 1, (800, 1)) * b
    points = points + rng.normal(0, 0.003, (800, 1)) * normal
    clutter = rng.uniform(-1, 1, (400, 3))
    other = rng.normal(size=(400, 3))
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    found = plane_up(
        np.concatenate([points, clutter]), np.concatenate([np.repeat(normal[None], 800, 0), other]),
        np.ones(1200), np.array([0.0, 0, 1]), 0.02,
    )  # fmt: skip
    assert found is not None
    assert np.degrees(np.arccos(found[0] @ normal)) < 0.5
    assert plane_up(clutter, other, np.ones(400), np.array([0.0, 0, 1]), 0.005) is None


def scenery() -> Mesh:
    """A floor of 2 m with a block of 0.4 m on it."""
    import trimesh

    floor = trimesh.creation.box((2, 2, 0.02)).subdivide().subdivide().subdivide()
    floor.apply_translation((0, 0, -0.01))
    block = trimesh.creation.box((0.6, 0.6, 0.4)).subdivide().subdivide()
    block.apply_translation((0.1, 0, 0.2))
    both = trimesh.util.concatenate([floor, block])
    return Mesh(np.asarray(both.vertices, float), np.asarray(both.faces, np.int64))


def test_resting_height_is_the_floor_under_a_table():
    mesh = scenery()
    upper = Mesh(mesh.vertices + np.array([0, 0, 0.37]), mesh.faces)
    assert resting_height(upper) == pytest.approx(0.37, abs=0.005)


def test_placement_turns_gravity_down_and_sets_the_size():
    mesh = scenery()
    rng = np.random.default_rng(1)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    turned = Mesh(0.3 * mesh.vertices @ q.T + [0.1, -0.2, 0.05], mesh.faces)
    views = [v.transformed(0.3, q, np.array([0.1, -0.2, 0.05])) for v in ring()]
    found = place(turned, views, 3.0)
    np.testing.assert_allclose(found.rotation[2], q @ [0, 0, 1], atol=1e-6)
    placed = found.mesh(turned)
    assert np.ptp(placed.vertices, axis=0).max() == pytest.approx(3.0)
    assert resting_height(placed) == pytest.approx(0.0, abs=0.01)
    assert found.size_from == "given: widest side = 3 m"
    again = Placement.from_dict(found.to_dict())
    np.testing.assert_allclose(again.points(turned.vertices), placed.vertices)
    assert "assumed" in place(turned, views, None).size_from
