"""Bodies on level planes against scenes whose signed distance is known exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.cameras import PosedPhotos
from pipeline.mesh import bodies
from pipeline.mesh.bodies import Parts, split
from pipeline.mesh.extraction import EXTENT, FieldSurface, Volume, ball, sample_volume
from pipeline.mesh.seams import Part
from sdfsim.geometry.bvh import Winding
from sdfsim.geometry.mass import mass_properties
from sdfsim.geometry.mesh import Mesh, is_closed, signed_volume
from tests.helpers.sparse import NOTHING, sparse_of
from tests.helpers.surfaces import TABLE, TOP, WALL, both, box, table

FINEST = 0.02
NO_POINTS = np.zeros((0, 3))


def surface_of(distance: Callable, seen: Callable | None = None, turn: np.ndarray | None = None) -> FieldSurface:
    """A surface of which photos show all that lies above the floor, but for what `seen` [V] excludes."""
    turn = np.eye(3) if turn is None else turn
    volume = sample_volume(lambda p: np.maximum(distance(p @ turn), ball(p)).astype(np.float32), 81, extent=EXTENT)
    raw = volume.mesh()
    raw = Mesh(raw.vertices, raw.faces, np.full((len(raw.vertices), 3), 128, np.uint8))
    there = raw.vertices @ turn
    shown = (ball(raw.vertices) < -0.03) & (np.ones(len(there), bool) if seen is None else seen(there))
    faces = shown[raw.faces].all(1)
    return FieldSurface(volume, raw, shown, np.ones(len(raw.faces), bool), faces, [], 3 * shown)


def parts_of(
    distance: Callable, turn: np.ndarray | None = None, seen: Callable | None = None, points: np.ndarray = NO_POINTS
) -> Parts:
    turn = np.eye(3) if turn is None else turn
    up = turn @ np.array([0.0, 0, 1])
    field = lambda p: distance(p @ turn).astype(np.float32)  # noqa: E731
    return split(
        surface_of(distance, seen, turn), field, FINEST, PosedPhotos((), sparse_of(points)), Path(), up, alone=False
    )


def some_rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


@pytest.mark.parametrize("turn", [np.eye(3), some_rotation(3)], ids=["upright", "turned"])
def test_a_cup_on_a_table_is_a_body_of_its_own_and_hollow(turn):
    parts = parts_of(both, turn)
    assert list(parts.bodies) == ["object1"]
    mesh = parts.bodies["object1"]
    assert is_closed(mesh) and signed_volume(mesh) > 0
    true = np.pi * (0.12**2 * 0.3 - (0.12 - WALL) ** 2 * (0.3 - WALL))
    volume, com, _ = mass_properties(mesh)
    assert volume == pytest.approx(true, rel=0.05)
    there = mesh.vertices @ turn
    assert there[:, 2].min() == pytest.approx(TOP, abs=0.1 * FINEST)
    assert there[:, 2].max() == pytest.approx(TOP + 0.3, abs=0.3 * FINEST)
    np.testing.assert_allclose((com @ turn)[:2], [0.1, -0.05], atol=0.3 * FINEST)
    around = Winding(mesh)(np.array([[0.1, -0.05, TOP + 0.1], [0.1, -0.05, TOP + 0.02]]) @ turn.T)
    np.testing.assert_allclose(around, [0, 1], atol=0.01)


def test_where_the_cup_stood_the_table_is_whole():
    parts = parts_of(both)
    assert parts.solid is not None and parts.shown is not None and is_closed(parts.solid)
    alone = surface_of(table).solid
    assert signed_volume(parts.solid) == pytest.approx(signed_volume(alone), rel=1e-3)
    for mesh in (parts.solid, parts.shown):
        near = mesh.vertices[(np.hypot(mesh.vertices[:, 0] - 0.1, mesh.vertices[:, 1] + 0.05) < 0.2)]
        near = near[near[:, 2] > TOP - TABLE[2]]
        assert len(near) > 50 and np.abs(near[:, 2] - TOP).max() < 0.2 * FINEST


@pytest.mark.parametrize("tilt", [0.0, 2.0, 5.0])
def test_where_a_solid_body_stood_the_table_is_level(tilt):
    """Photos show no border between both: in there a field is as deep as the nearest surface that they do show."""

    def field(points: np.ndarray) -> np.ndarray:
        away = np.hypot(points[:, 0] - 0.1, points[:, 1] + 0.05) - 0.12  # from the side of a can of 0.3 m
        found = np.minimum(table(points), np.maximum(away, np.abs(points[:, 2] - TOP - 0.15) - 0.15))
        within, height = away < 0, points[:, 2] - TOP
        in_can = within & (height >= 0) & (height < 0.3)
        found[in_can] = -np.minimum(-away, 0.3 - height)[in_can]
        in_table = within & (height < 0) & (height > -2 * TABLE[2])
        found[in_table] = -np.minimum(np.hypot(away, height), height + 2 * TABLE[2])[in_table]
        return found

    turn = Rotation.from_euler("xy", [tilt, 0.7 * tilt], degrees=True).as_matrix()
    parts = parts_of(field, turn)
    assert list(parts.bodies) == ["object1"] and parts.solid is not None
    there = parts.solid.vertices @ turn
    near = there[(np.hypot(there[:, 0] - 0.1, there[:, 1] + 0.05) < 0.1) & (there[:, 2] > TOP - TABLE[2])]
    assert len(near) > 20 and np.abs(near[:, 2] - TOP).max() < 0.1 * FINEST
    assert (parts.bodies["object1"].vertices @ turn)[:, 2].min() == pytest.approx(TOP, abs=0.1 * FINEST)


def test_a_small_piece_without_sparse_points_is_noise_beside_bodies_that_have_them():
    """With points of its own it is a body, and so it is where nothing has any."""
    small = ((-0.25, 0.1, TOP + 0.06), (0.04, 0.04, 0.06))

    def scene(p: np.ndarray) -> np.ndarray:
        return np.minimum(both(p), box(p, *small))

    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, 2 * np.pi, 400), rng.uniform(0.03, 0.27, 400)
    on_cup = np.stack([0.1 + 0.12 * np.cos(angle), -0.05 + 0.12 * np.sin(angle), TOP + height], 1)
    on_box = np.array(small[0]) + [-0.04, 0, 0] + rng.uniform(-0.03, 0.03, (60, 3)) * [0, 1, 1]
    without = parts_of(scene, points=on_cup)
    assert list(without.bodies) == ["object1"] and len(without.noise) == 1 and without.noise[0] < 0.25
    assert without.solid is not None and signed_volume(without.solid) == pytest.approx(
        signed_volume(surface_of(table).solid), rel=2e-3
    )
    for points in (NO_POINTS, np.concatenate([on_cup, on_box])):
        found = parts_of(scene, points=points)
        assert len(found.bodies) == 2 and not found.noise


def test_crumbs_that_hang_beside_a_body_do_not_stay_in_the_scenery():
    def torn(p: np.ndarray) -> np.ndarray:
        crumbs = [box(p, (0.1, 0.125, TOP + 0.25), (0.03, 0.02, 0.02)), box(p, (0.27, -0.05, TOP + 0.27), (0.02,) * 3)]
        return np.minimum.reduce([both(p), *crumbs])

    parts, clean = parts_of(torn), parts_of(both)
    assert list(parts.bodies) == ["object1"]
    for mesh in (parts.solid, parts.shown):
        assert mesh is not None and mesh.vertices[:, 2].max() < TOP + 0.3 * FINEST
    assert is_closed(parts.bodies["object1"])
    assert signed_volume(parts.bodies["object1"]) == pytest.approx(signed_volume(clean.bodies["object1"]), rel=0.02)


def test_a_small_thing_that_stands_beside_a_body_is_no_crumb():
    def scene(p: np.ndarray) -> np.ndarray:
        return np.minimum(both(p), box(p, (0.1, 0.15, TOP + 0.06), (0.025, 0.025, 0.06)))

    parts = parts_of(scene)
    assert len(parts.bodies) == 2


def hidden(points: np.ndarray) -> np.ndarray:
    return (np.hypot(points[:, 0] - 0.1, points[:, 1] + 0.05) > 0.15) | (points[:, 2] < TOP + 0.02)


@pytest.mark.parametrize(
    ("scene", "seen", "why"),
    [
        (table, None, "a table carries a plane of its own"),
        (
            lambda p: np.minimum(table(p), box(p, (0, 0, 0.15), (0.45, 0.3, 0.05))),
            None,
            "a slab that covers it is relief",
        ),
        (lambda p: np.minimum(table(p), box(p, (0.2, 0, 0.12), (0.03, 0.03, 0.03))), None, "a crumb is too small"),
        (lambda p: np.minimum(table(p), box(p, (0.3, 0, 0.6), (0.1, 0.1, 0.6))), None, "a post goes on outside"),
        (lambda p: np.minimum(table(p), box(p, (0.3, 0, 0.3), (0.1, 0.1, 0.06))), None, "what hovers does not stand"),
        (both, hidden, "no photo shows it"),
    ],
    ids=lambda value: value.replace(" ", "-") if isinstance(value, str) else "",
)
def test_what_is_no_body_stays_scenery(scene, seen, why):
    parts = parts_of(scene, seen=seen)
    assert parts.bodies == {}, why
    assert parts.solid is not None and signed_volume(parts.solid) == pytest.approx(
        signed_volume(surface_of(scene).solid)
    )


def test_what_seams_split_off_inside_of_a_body_is_no_body(monkeypatch):
    """A block on a table, which seams divide in two halves and a core that no photo sees: two bodies, no core left."""
    low, half = np.array([0.1, -0.05, TOP + 0.15]), 0.15
    scene = lambda p: np.minimum(table(p), box(p, low, (half, half, half)))  # noqa: E731
    core = lambda p: np.linalg.norm(p - low, axis=-1) - 0.08  # noqa: E731

    def parted(surface, body, *rest) -> tuple[list[Part], str, str]:
        points = Volume(np.zeros(body.own.shape), body.low, body.cell).points()
        left, inner = points[..., 0] - low[0], core(points)
        values = [np.maximum(left, -inner), np.maximum(-left, -inner), inner]
        seams = [Volume(value.astype(np.float32), body.low, body.cell) for value in values]
        return [Part(0, seam, [n for n in range(3) if n != k]) for k, seam in enumerate(seams)], "shape", ""

    monkeypatch.setattr(bodies, "_parted", parted)
    parts = parts_of(scene)
    assert list(parts.bodies) == ["object1", "object2"] and parts.touching == [("object1", "object2", "shape")]
    total = sum(signed_volume(mesh) for mesh in parts.bodies.values())
    assert total == pytest.approx((2 * half) ** 3, rel=0.05)  # The core is 8 % of it.


def test_a_body_that_two_photos_see_is_none():
    assert list(parts_of(both).bodies) == ["object1"]
    few = surface_of(both)
    few = replace(few, views=np.where(few.raw.vertices[:, 2] > TOP + 0.05, 2, few.views))
    up, field = np.array([0.0, 0, 1]), lambda p: both(p).astype(np.float32)
    assert split(few, field, FINEST, NOTHING, Path(), up, alone=False).bodies == {}
    pair = lambda p: np.minimum(box(p, (0.3, 0, 0), (0.1, 0.2, 0.1)), box(p, (-0.4, 0, 0), (0.3, 0.2, 0.2)))  # noqa: E731
    alone = surface_of(pair)
    alone = replace(alone, views=np.where(alone.raw.vertices[:, 0] > 0.1, 2, alone.views))
    (left,) = split(alone, pair, FINEST, NOTHING, Path(), up, alone=True).bodies.values()
    assert signed_volume(left) == pytest.approx(0.6 * 0.4 * 0.4, rel=0.05)
