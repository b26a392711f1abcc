"""Extraction and placement against shapes that are known exactly."""

import numpy as np
import pytest

from pipeline.cameras import CAREFUL, UNKNOWN, PosedPhotos, Similarity, Sparse, camera_up
from pipeline.field.supervision import unit_sphere_of
from pipeline.mesh.extraction import (
    FieldSurface,
    all_seen,
    belonging,
    components,
    islands,
    sample_box,
    sample_volume,
    trusted_vertices,
)
from pipeline.mesh.placement import Scale, find_up, load_placement, place, plane_up, resting_height
from pipeline.mesh.visibility import Visibility
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, is_closed, joined, signed_volume, vertex_normals
from tests.helpers.surfaces import cube, look_at, ring, scenery


def ball(center=(0.0, 0, 0), radius: float = 0.5):
    return lambda p: np.linalg.norm(p - np.asarray(center, np.float32), axis=1) - radius


def test_marching_cubes_of_a_ball():
    mesh = sample_volume(ball(), 65, extent=1.0).mesh()
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.5).max() < 1e-3
    assert is_closed(mesh)
    assert signed_volume(mesh) == pytest.approx(4 / 3 * np.pi * 0.125, rel=0.01)
    normals = vertex_normals(mesh)
    assert (normals * mesh.vertices).sum(1).min() > 0.49


def two_balls(points: np.ndarray) -> np.ndarray:
    return np.minimum(ball((0.4, 0, 0), 0.3)(points), ball((-0.45, 0.1, 0), 0.12)(points))


def test_sparse_sampling_equals_dense_near_the_surface():
    volume = sample_volume(two_balls, 49, extent=1.0)
    dense = sample_box(two_balls, np.full(3, -1.0), np.full(3, 1.0), volume.cell).values
    close = np.abs(dense) < 0.08
    np.testing.assert_allclose(volume.values[close], dense[close], atol=1e-6)
    assert ((volume.values < 0) == (dense < 0)).all()


def crowd() -> tuple[Mesh, np.ndarray]:
    """A large cube, a speck, a cube that no photo shows, and a bubble in the large one; faces seen."""
    big, speck, hidden, bubble = cube(1.0), cube(0.05, (2, 0, 0)), cube(0.9, (4, 0, 0)), cube(0.3)
    bubble = Mesh(bubble.vertices, bubble.faces[:, ::-1])
    return joined([big, speck, hidden, bubble]), np.repeat([True, True, False, False], len(big.faces))


def test_small_and_unseen_components_are_left_out():
    mesh, seen = crowd()
    assert components(mesh).max() == 3
    kept, sizes = belonging(mesh, seen, 0.01, 0.02)
    assert kept.sum() == len(mesh.faces) / 4 and kept[: len(mesh.faces) // 4].all()
    # The bubble is a flaw of the cube around it: it is left out, but is no piece.
    np.testing.assert_allclose(sizes, [0.9, 0.05], atol=1e-6)
    assert len(belonging(mesh, seen, 0.01, 0.1)[1]) == 1  # The speck has become too small to mention.


def test_patches_of_a_large_surface_are_left_out_but_not_small_things():
    mesh = joined([cube(1.0), cube(0.1, (2, 0, 0))])
    faces = np.zeros(len(mesh.faces), bool)
    faces[: len(faces) // 2] = (
        mesh.vertices[mesh.faces[: len(faces) // 2]][:, :, 2].min(1) > 0.4
    )  # the large cube's top
    faces[np.flatnonzero(mesh.vertices[mesh.faces[: len(faces) // 2]][:, :, 2].max(1) < -0.4)[:1]] = True
    faces[len(faces) // 2 :] = True
    found = islands(mesh, faces, 0.02)
    lower = mesh.vertices[mesh.faces][:, :, 2].max(1) < -0.4
    assert faces[lower].any() and not found[lower].any()
    assert found[len(faces) // 2 :].all() and (found == faces)[~lower].all()


def test_trusted_vertices_close_gaps_but_not_where_the_solid_was_cut_off():
    mesh = sample_volume(ball(radius=0.5), 33, extent=1.0).mesh()
    count = np.full(len(mesh.vertices), 3)
    count[10] = 0
    nowhere = np.zeros(len(count), bool)
    assert trusted_vertices(mesh, count, nowhere).all()
    assert not trusted_vertices(mesh, count, ~nowhere).any()


def test_a_vertex_behind_something_is_not_seen():
    mesh, wall = cube(0.4), cube(1.0, (2.0, 0, 0))
    free, hidden = (Visibility(mesh, 1e-3, block) for block in (None, Caster(joined([mesh, wall]))))
    view = look_at(np.array([5.0, 0.1, 0.1]))
    index, pixels, cosine = free.of_view(view)
    assert len(index) > 20 and mesh.vertices[index, 0].min() == pytest.approx(0.2) and (cosine > 0.9).sum() > 0
    np.testing.assert_allclose(pixels, view.project(mesh.vertices[index])[0])
    assert len(hidden.of_view(view)[0]) == 0


def test_the_unit_sphere_holds_the_object_and_moves_cameras_along():
    rng = np.random.default_rng(0)
    views = ring()
    xyz = np.concatenate([rng.normal(size=(300, 3)) * 0.2, rng.normal(size=(40, 3)) * 20])
    observed = np.arange(340).repeat(3)
    sparse = Sparse(xyz, np.zeros((340, 3), np.uint8), np.full(340, 0.5), observed, np.zeros(1020, int))
    to_unit = unit_sphere_of(PosedPhotos(tuple(views), sparse))
    assert np.linalg.norm(to_unit.inverse().translation) < 0.1 and 0.5 < 1 / to_unit.scale < 2.5
    p = rng.normal(size=(20, 3)) * 0.3
    for view in views:
        np.testing.assert_allclose(view.project(p)[0], to_unit.view(view).project(to_unit.points(p))[0], atol=1e-8)


def test_up_from_level_cameras():
    for views in (ring(), ring()[:4]):
        up = camera_up(views)
        np.testing.assert_allclose(up.direction, [0, 0, 1], atol=1e-6)
        assert up.within == pytest.approx(CAREFUL)
    assert camera_up(ring()[:1]).within == UNKNOWN


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
    assert np.degrees(np.arccos(found[0] @ normal)) < 0.5 and found[1] < 0.5
    assert plane_up(clutter, other, np.ones(400), np.array([0.0, 0, 1]), 0.005) is None


def test_placement_turns_gravity_down_and_sets_the_size(tmp_path):
    mesh = scenery()
    rng = np.random.default_rng(1)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    turned = Mesh(0.3 * mesh.vertices @ q.T + [0.1, -0.2, 0.05], mesh.faces)
    views = [Similarity(0.3, q, np.array([0.1, -0.2, 0.05])).view(v) for v in ring()]
    found = place(turned, views, size=3.0)
    np.testing.assert_allclose(found.to_metres.rotation[2], q @ [0, 0, 1], atol=1e-6)
    placed = found.mesh(turned)
    assert np.ptp(placed.vertices, axis=0).max() == pytest.approx(3.0)
    assert resting_height(placed) == pytest.approx(0.0, abs=0.01)
    assert found.size_from == "given: widest side = 3 m"
    found.save(tmp_path)
    np.testing.assert_allclose(load_placement(tmp_path).mesh(turned).vertices, placed.vertices)
    assert found.up_from == "plane" and found.up_within < 1 and found.up_confidence == "high"
    assert place(turned, views).size_assumed and not found.size_assumed
    known = place(turned, views, Scale(10.0, "a ruler"), size=3.0)
    assert known.size_from == "a ruler" and np.ptp(known.mesh(turned).vertices, axis=0).max() == pytest.approx(6.0)


def test_a_floor_that_the_cameras_contradict_is_not_trusted():
    mesh = scenery()
    tilt = np.radians(20)
    turn = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    up = find_up(Mesh(mesh.vertices @ turn.T, mesh.faces), ring())
    assert up.source == "plane" and up.within == pytest.approx(20, abs=0.5)
    alone = find_up(Mesh(np.random.default_rng(0).normal(size=(300, 3)), np.arange(300).reshape(-1, 3)), ring())
    assert alone.source == "cameras" and alone.within == pytest.approx(CAREFUL)


def test_bodies_without_scenery_stand_on_the_floor():
    found = place(cube(1.0), ring(), size=2.0, alone=True)
    assert found.mesh(cube(1.0)).vertices[:, 2].min() == pytest.approx(0.0, abs=1e-9)


def test_all_that_photos_see_of_the_solid_is_shown_but_no_cut_and_no_back():
    """A ball cut off at its top, of which only a half was shown before; photos see all but its underside."""
    volume = sample_volume(ball(), 65)
    limit = lambda p: p[:, 2] - 0.3  # noqa: E731
    raw = volume.limited(limit).mesh()
    height = raw.vertices[:, 2]
    few = (raw.vertices[:, 0] > 0) & (np.abs(height) < 0.2)
    before = FieldSurface(volume, raw, few, np.ones(len(raw.faces), bool), few[raw.faces].all(1), [],
                          np.where(height > -0.2, 2, 0))  # fmt: skip
    shown = all_seen(before, limit).shown
    middle = raw.vertices[raw.faces].mean(1)[:, 2]
    assert shown[(middle > -0.15) & (middle < 0.2)].all()
    assert not shown[middle < -0.4].any()
    assert not shown[middle > 0.28].any()
