"""Bodies on level planes, bodies that touch, and supports without texture, against scenes whose signed distance is
known exactly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from pipeline.cameras import PosedPhotos, Similarity, Sparse, View
from pipeline.inputs.labels import FOLDER, NAMES
from pipeline.inputs.photos import Photo
from pipeline.mesh import bodies
from pipeline.mesh.bodies import Parts, split
from pipeline.mesh.extraction import EXTENT, FieldSurface, Volume, ball, sample_volume
from pipeline.mesh.placement import located_bodies
from pipeline.mesh.supports import complete, on_any
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import write_json
from sdfsim.geometry.bvh import Caster, Winding
from sdfsim.geometry.mass import mass_properties
from sdfsim.geometry.mesh import Mesh, is_closed, signed_volume
from tests.helpers.sparse import NOTHING, sparse_of
from tests.helpers.surfaces import TABLE, TOP, WALL, both, box, table
from tests.pipeline import photo_sets
from tests.pipeline.photo_sets import around

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


QUICK = 0.0157  # as of the quick preset


def signed(part) -> Callable[[np.ndarray], np.ndarray]:
    """Signed distance [P] of a part at points [P, 3] m."""
    import open3d as o3d

    if len(part.vertices) == 8:
        low, high = part.vertices.min(0), part.vertices.max(0)
        return lambda points: box(points, (low + high) / 2, (high - low) / 2)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(part.vertices.astype(np.float32)), o3d.core.Tensor(part.faces.astype(np.uint32))
    )
    return lambda points: scene.compute_signed_distance(np.asarray(points, np.float32)).numpy()


def union(first: np.ndarray, second: np.ndarray, fill: float) -> np.ndarray:
    """Signed distance [P] of two solids together, their grooves rounded where both are nearer than `fill`."""
    bulge = np.maximum(fill - np.abs(first - second), 0) ** 2 / (4 * fill) if fill else 0.0
    return np.minimum(first, second) - bulge


def plain(seed: int, rows: int, columns: int, palette: list, *rest) -> np.ndarray:
    """Only mean colours are looked at here, and drawing a pattern takes seconds."""
    return np.mean(palette, axis=0)[None, None]


_samples: dict[tuple, Volume] = {}


def sampled(distance: Callable[[np.ndarray], np.ndarray], side: int, *part) -> Volume:
    """Samples of the distance, m, of a part of some scene; taken once for scenes that differ in other things."""
    key = (side, *part)
    if key not in _samples:
        _samples[key] = sample_volume(lambda p: distance(p).astype(np.float32), side, extent=EXTENT)
    return _samples[key]


class Scene:
    """A rendered scene as a field would have it, in the space of the unit sphere.

    Args:
        build: of `photo_sets`.
        chosen: names of the parts that are there; floor and furniture always are.
        radius: m, of the space that the field is trained in.
        side: samples a side of that space.
        floor: whether it is there.
        fill: m, about how wide the grooves are that are filled between parts; trained fields fill them.
        painted: whether bodies have the colours of their parts, or one colour all.
    """

    def __init__(self, build: Callable, chosen: Sequence[str], radius: float, side: int = 97,
                 *, floor: bool = True, fill: float = 0.0, painted: bool = True) -> None:  # fmt: skip
        self.make = photo_sets.studio()
        self.make.texture = plain
        parts, names = build(self.make)
        self.parts = [part for name, part in zip(names, parts, strict=False) if name in chosen] + parts[len(names) :]
        self.names = [name for name in names if name in chosen]
        at = np.concatenate([part.vertices for part in self.parts[: len(self.names)]])
        middle = (at.min(0) + at.max(0)) / 2
        self.to_unit = Similarity(1 / radius, np.eye(3), -middle / radius)
        self.poses = [pose.copy() for pose in photo_sets.around(18, 2 * radius)]
        for pose in self.poses:
            pose[:3, 3] += middle - [0, 0, 0.12]
        self.views = [
            self.to_unit.view(
                View(f"{k:04d}.jpg", f"{k}.jpg", 480, 360, 465.0, 240, 180, 0.0, turn, -turn @ pose[:3, 3])
            )
            for k, pose in enumerate(self.poses)
            for turn in [np.diag([1.0, -1, -1]) @ pose[:3, :3].T]
        ]
        each = [signed(part) for part in self.parts[:-2]]
        back = self.to_unit.inverse()
        volumes = [
            sampled(lambda points, one=one: one(back.points(points)), side, build, tuple(self.names), radius, k)
            for k, one in enumerate([lambda there: there[:, 2], *each])
        ]
        values = [volume.values for volume in volumes[0 if floor else 1 :]]
        limit = sample_volume(ball, side, extent=EXTENT).values
        volume = replace(
            volumes[0],
            values=np.maximum(reduce(lambda a, b: union(a, b, fill), values) / radius, limit).astype(np.float32),
        )
        raw = volume.mesh()
        there = self.to_unit.inverse().points(raw.vertices)
        nearest = np.argmin([np.abs(there[:, 2]), *(np.abs(one(there)) for one in each)], axis=0)
        mean = [
            np.full(3, 0.5),
            *(part.texture.mean((0, 1)) if painted else [0.7, 0.6, 0.5] for part in self.parts[:-2]),
        ]
        raw = Mesh(raw.vertices, raw.faces, (255 * np.array(mean)[nearest] ** (1 / 1.6)).astype(np.uint8))
        shown = ball(raw.vertices) < -0.03
        self.surface = FieldSurface(
            volume, raw, shown, np.ones(len(raw.faces), bool), shown[raw.faces].all(1), [], 3 * shown
        )
        # What the field is between its samples is that of the samples: exact distances take minutes.
        self.distance = lambda points: volume.at(points).astype(np.float32)

    def split(
        self,
        folder: Path,
        masks: Sequence[str] = (),
        *,
        alone: bool = False,
        clicked: dict[str, list[str]] | None = None,
    ) -> Parts:
        """What is found, with masks of the bodies of these names, or places that were clicked; meshes in metres."""
        (folder / "images").mkdir(parents=True)
        labels = photo_sets.shoot_labels(self.make, self.parts, self.poses, len(self.names)) if masks else []
        number = np.array([0, *(list(masks).index(name) + 1 if name in masks else 0 for name in self.names)], np.uint8)
        for view in self.views:
            Image.new("RGB", (480, 360)).save(folder / "images" / view.name)
        for view, label in zip(self.views, labels, strict=False):
            (folder / FOLDER).mkdir(exist_ok=True)
            Image.fromarray(number[label]).save(folder / FOLDER / f"{view.name}.png")
        if masks:
            write_json(folder / FOLDER / NAMES, {"names": list(masks)})
        poses, up = PosedPhotos(tuple(self.views), NOTHING.sparse), np.array([0, 0, 1.0])
        points = {}
        if clicked:
            for view, picture in zip(self.views, self.pictures(), strict=True):
                Image.fromarray(picture).save(folder / "images" / view.name, quality=95)
            photos = [Photo(v.name, v.source, 480, 360, (480, 360), None, None, "", False, 0.4) for v in self.views]
            points = located_bodies(clicked, self.views, photos, Caster(self.surface.raw))
        found = split(self.surface, self.distance, QUICK, poses, folder, up, alone=alone, clicked=points)
        back = self.to_unit.inverse()
        return replace(found, bodies={
            name: Mesh(back.points(mesh.vertices), mesh.faces) for name, mesh in found.bodies.items()
        })  # fmt: skip

    def labels(self) -> list[np.ndarray]:
        """Which body, from 1 on, each pixel of each photo shows; 0 for none."""
        return photo_sets.shoot_labels(self.make, self.parts, self.poses, len(self.names))

    def pictures(self) -> list[np.ndarray]:
        """Photos of flat colours, with noise."""
        rng = np.random.default_rng(0)
        colors = 255 * np.array([[0.5] * 3, *(part.texture.mean((0, 1)) for part in self.parts[: len(self.names)])])
        return [
            np.clip(colors[label] + rng.normal(0, 12, (*label.shape, 3)), 0, 255).astype(np.uint8)
            for label in self.labels()
        ]

    def click(self, name: str, number: int = 0) -> str:
        """A place on the body of this name, in the photo that shows most of it, or the next ones by `number`."""
        shown = [label == self.names.index(name) + 1 for label in self.labels()]
        view = int(np.argsort([-mask.sum() for mask in shown])[number])
        at = np.argwhere(shown[view])
        row, column = at[np.linalg.norm(at - at.mean(0), axis=1).argmin()]
        return f"{self.views[view].source}:{column + 0.5},{row + 0.5}"

    def check(self, found: Parts, called: dict[str, str], size: float, share: float) -> None:
        """Holds bodies to the truth: extents within `size` m, volumes within `share`."""
        for name, true in called.items():
            mesh, part = found.bodies[name], self.parts[self.names.index(true)]
            assert is_closed(mesh)
            np.testing.assert_allclose(mesh.vertices.min(0), part.vertices.min(0), atol=size, err_msg=name)
            np.testing.assert_allclose(mesh.vertices.max(0), part.vertices.max(0), atol=size, err_msg=name)
            true_volume = signed_volume(Mesh(part.vertices, part.faces))
            assert signed_volume(mesh) == pytest.approx(true_volume, rel=share), name


PAIR, BOOKS = ("cup", "vase"), ("book1", "book2", "book3")
CELL = 2 * EXTENT / 96 * 0.4  # m, of the samples


@pytest.fixture(autouse=True)
def unrefined(monkeypatch):
    """The photos here are black: there is nothing to refine a surface by, and looking for it takes most of the time."""
    monkeypatch.setattr(bodies, "refine", lambda mesh, *rest: (mesh, ""))


@pytest.fixture(scope="module")
def pair() -> Scene:
    return Scene(photo_sets.touching, PAIR, 0.4)


def test_a_cup_and_the_vase_that_it_touches_come_apart_by_their_masks(pair, tmp_path):
    found = pair.split(tmp_path / "p", PAIR)
    assert list(found.bodies) == ["vase", "cup"] and found.touching == [("cup", "vase", "masks")]
    pair.check(found, {"cup": "cup", "vase": "vase"}, 0.5 * CELL, 0.02)


@pytest.mark.slow
def test_masks_of_one_of_two_leave_the_other_a_number_and_masks_of_nothing_are_reported(pair, tmp_path):
    found = pair.split(tmp_path / "p", ("cup", "spoon"))
    assert list(found.bodies) == ["object1", "cup"] and found.missing == ["spoon"]
    pair.check(found, {"cup": "cup", "object1": "vase"}, 0.5 * CELL, 0.02)


def test_without_masks_a_cup_and_the_vase_that_it_touches_come_apart_by_their_groove(pair, tmp_path):
    found = pair.split(tmp_path / "p")
    assert [(set(names), by) for *names, by in found.touching] == [({"object1", "object2"}, "shape")]
    pair.check(found, {"object1": "vase", "object2": "cup"}, 0.5 * CELL, 0.02)


@pytest.mark.parametrize("painted", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_groove_that_is_half_filled_parts_what_has_two_colours_only(painted, tmp_path):
    found = Scene(photo_sets.touching, PAIR, 0.4, fill=0.054, painted=painted).split(tmp_path / "p")
    assert len(found.bodies) == (2 if painted else 1)


def two_colours(make) -> tuple[list, list[str]]:
    """A jug that is painted blue below its neck and red above."""
    lower = make.lathe(np.array([(0, 0), (0.07, 0), (0.1, 0.06), (0.1, 0.14), (0.06, 0.22), (0, 0.22)]))
    upper = make.lathe(np.array([(0, 0.22), (0.06, 0.22), (0.075, 0.27), (0, 0.27)]))
    colors = {"lower": (0.2, 0.32, 0.62), "upper": (0.62, 0.2, 0.16)}
    return photo_sets.in_room(make, {"lower": lower, "upper": upper}, colors), ["lower", "upper"]


def test_a_jug_of_two_colours_stays_whole(tmp_path):
    assert len(Scene(two_colours, ("lower", "upper"), 0.4, 65, fill=0.01).split(tmp_path / "p").bodies) == 1


@pytest.fixture(scope="module")
def books() -> Scene:
    return Scene(photo_sets.touching, BOOKS, 0.4, 129)


def test_books_in_a_stack_come_apart_where_photos_show_borders_between_clicked_places(books, tmp_path):
    found = books.split(tmp_path / "p", clicked={name: [books.click(name)] for name in BOOKS})
    assert set(found.bodies) == set(BOOKS) and found.missing == []
    assert {(*sorted(names), by) for *names, by in found.touching} == {
        ("book1", "book2", "clicks"), ("book2", "book3", "clicks"),
    }  # fmt: skip
    books.check(found, {name: name for name in BOOKS}, 1.2 * CELL, 0.03)


@pytest.mark.slow
def test_several_places_of_one_body_and_the_shape_where_nothing_was_clicked(pair, tmp_path):
    found = pair.split(tmp_path / "p", clicked={"cup": [pair.click("cup"), pair.click("cup", 1)]})
    assert list(found.bodies) == ["object1", "cup"]
    pair.check(found, {"cup": "cup", "object1": "vase"}, 0.5 * CELL, 0.02)


@pytest.mark.slow
def test_a_place_on_the_floor_names_no_body(pair, tmp_path):
    floor = f"{pair.views[0].source}:240.0,350.0"
    found = pair.split(tmp_path / "p", clicked={"rug": [floor]})
    assert found.missing == ["rug"] and len(found.bodies) == 2


def test_masks_beside_places_are_refused(pair, tmp_path):
    with pytest.raises(SdfsimError, match="body: the photos have masks of cup already"):
        pair.split(tmp_path / "p", ("cup",), clicked={"cup": [pair.click("cup")]})


@pytest.mark.slow
def test_without_scenery_a_connected_pair_comes_apart_by_masks(tmp_path):
    free = Scene(photo_sets.touching, PAIR, 0.4, floor=False)
    found = free.split(tmp_path / "p", PAIR, alone=True)
    assert list(found.bodies) == ["vase", "cup"] and found.solid is None
    free.check(found, {"cup": "cup", "vase": "vase"}, 0.5 * CELL, 0.02)


def test_what_masks_name_is_cut_off_a_wall_too(tmp_path):
    def wall(make) -> tuple[list, list[str]]:
        shapes = {
            "shelf": make.box((-0.06, -0.05, 0.1), (0.06, 0.05, 0.22)),
            "wall": make.box((-0.96, -0.3, 0), (-0.06, 0.3, 0.5)),
        }
        colors = {"shelf": (0.2, 0.42, 0.3), "wall": (0.6, 0.45, 0.28)}
        return photo_sets.in_room(make, shapes, colors), ["shelf"]

    scene = Scene(wall, ("shelf",), 0.3)
    found = scene.split(tmp_path / "p", ("shelf",))
    assert list(found.bodies) == ["shelf"] and found.solid is not None and is_closed(found.solid)
    scene.check(found, {"shelf": "shelf"}, CELL, 0.05)


def mug(make) -> tuple[list, list[str]]:
    """A mug with a handle, which meets it in two sharp grooves, and a jug."""
    body, faces = make.lathe(np.array([(0, 0), (0.1, 0), (0.1, 0.22), (0.075, 0.22), (0.075, 0.04), (0, 0.04)]))
    ring, around = photo_sets.ring((0, 0, 0), 0.06, 0.02)
    handle = ring @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) + [0.115, 0, 0.11]
    jug, more = make.lathe(
        np.array([(0, 0), (0.07, 0), (0.1, 0.06), (0.1, 0.14), (0.06, 0.22), (0.075, 0.27), (0, 0.27)])
    )
    shapes = {"mug": (body, faces), "handle": (handle, around), "jug": (jug - [0.22, 0, 0], more)}
    colors = {"mug": (0.7, 0.66, 0.6), "handle": (0.16, 0.3, 0.62), "jug": (0.2, 0.32, 0.62)}
    return photo_sets.in_room(make, shapes, colors), list(shapes)


@pytest.mark.slow
def test_a_mug_with_a_handle_and_a_jug_stay_one_each(tmp_path):
    found = Scene(mug, ("mug", "handle", "jug"), 0.4).split(tmp_path / "p")
    assert len(found.bodies) == 2 and found.touching == []


def board(make) -> tuple[list, list[str]]:
    """The shelf without its sides."""
    parts, names = photo_sets.shelf(make)
    return parts[: len(names) + 1] + parts[-2:], names


@pytest.mark.slow
def test_what_stands_apart_on_a_board_is_three_whole_bodies(tmp_path):
    shelf = Scene(board, ("torus", "carton", "jug"), 0.7, 129)
    found = shelf.split(tmp_path / "p")
    assert len(found.bodies) == 3 and found.touching == []
    for name, true in zip(found.bodies, ("torus", "jug", "carton"), strict=True):
        sides = np.ptp(shelf.parts[["torus", "carton", "jug"].index(true)].vertices, axis=0)
        np.testing.assert_allclose(np.ptp(found.bodies[name].vertices, axis=0), sides, rtol=0.01)


# In normalised units: half of the table's sides, its top and its underside, half of the mat's side, and the floor.
HALF, HIGH, UNDER, MAT, GROUND = np.array([0.6, 0.4]), 0.1, 0.02, 0.2, -0.45
GRAIN = 0.02
UP = np.array([0.0, 0, 1])
BROWN = np.array([150, 105, 70])


def board_distance(points: np.ndarray) -> np.ndarray:
    """Signed distance [P] from the table, a board, at points [P, 3]."""
    middle, half = np.array([0, 0, (HIGH + UNDER) / 2]), np.array([*HALF, (HIGH - UNDER) / 2])
    q = np.abs(points - middle) - half
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


def as_trained(points: np.ndarray) -> np.ndarray:
    """What a field has in place of the table [P]: sunk on one side of the mat, piled up on the other."""
    x, y, z = np.moveaxis(points, -1, 0)
    on = (np.abs(y) < HALF[1] - 0.02) & (np.abs(x) < HALF[0] - 0.02)
    sunk, piled = on & (x > MAT + 0.05), on & (x < -MAT - 0.05)
    lifted = points + np.stack([0 * x, 0 * x, 0.05 * sunk - 0.07 * piled], -1)
    return np.minimum(board_distance(np.where((z > 0.04)[..., None], lifted, points)), z - GROUND)


@pytest.fixture(scope="module")
def photographed(tmp_path_factory) -> tuple[FieldSurface, PosedPhotos, Path]:
    folder = tmp_path_factory.mktemp("photos")
    (folder / "images").mkdir()
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (UNDER, HIGH)]) * [*HALF, 1]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    ground = np.array([[-4, -4, GROUND], [4, -4, GROUND], [4, 4, GROUND], [-4, 4, GROUND]])
    scene = Caster(Mesh(np.concatenate([corner, ground]), np.array([*faces, (8, 9, 10), (8, 10, 11)])))
    rng = np.random.default_rng(0)
    speckles = rng.integers(30, 220, (400, 400, 3))
    views, point_of, view_of = [], [], []
    points = np.concatenate([
        np.column_stack([rng.uniform(-MAT, MAT, (60, 2)), np.full(60, HIGH)]),
        np.column_stack([rng.uniform(-0.8, 0.8, (300, 2)), np.full(300, GROUND)]),
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
        color = np.where(((face >= 12) | mat)[:, None], pattern, np.where(at[:, 2:] > HIGH - 1e-4, 1.0, 0.7) * BROWN)
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
    count = int(2.04 / GRAIN) + 1
    empty = Volume(np.zeros((count,) * 3, np.float32), np.full(3, -1.02), GRAIN)
    there = empty.points()
    values = np.maximum(as_trained(there), np.linalg.norm(there, axis=-1) - 0.99)
    volume = Volume(values.astype(np.float32), empty.low, GRAIN)
    raw = volume.mesh()
    raw = Mesh(raw.vertices, raw.faces, np.full(raw.vertices.shape, 128, np.uint8))
    known = (np.abs(raw.vertices[:, :2]) < MAT + 0.03).all(1) & (np.abs(raw.vertices[:, 2] - HIGH) < 0.5 * GRAIN)
    known |= np.abs(raw.vertices[:, 2] - GROUND) < 0.5 * GRAIN
    shown = known[raw.faces].all(1)
    surface = FieldSurface(volume, raw, known, np.ones(len(raw.faces), bool), shown, [], 3 * known)
    return surface, PosedPhotos(tuple(views), sparse), folder


def tops(volume: Volume, at: np.ndarray) -> np.ndarray:
    """Heights [P] of the topmost surface over places [P, 2]."""
    down = np.concatenate([at, np.full((len(at), 1), 0.9)], 1)
    return 0.9 - Caster(volume.mesh()).hits(down, np.broadcast_to([0.0, 0, -1], down.shape))[0]


def test_a_plain_table_goes_on_around_its_mat_up_to_its_edge_and_no_further(photographed):
    surface, poses, folder = photographed
    found = complete(surface, UP, GRAIN, poses, folder)
    assert len(found) == 1 and found[0].level.height == pytest.approx(HIGH, abs=0.1 * GRAIN)
    line = np.linspace(-0.97, 0.97, 98)
    grid = np.stack(np.meshgrid(line, line, indexing="ij"), -1).reshape(-1, 2)
    inner = (np.abs(grid) < HALF - 3 * GRAIN).all(1)
    outer = (np.abs(grid) > HALF + 3 * GRAIN).any(1)
    before, volume = tops(surface.volume, grid), found[0].filled(surface.volume)
    after = tops(volume, grid)
    assert np.abs(before[inner] - HIGH).max() > 0.04
    assert (np.abs(after[inner] - HIGH) < 0.3 * GRAIN).mean() > 0.97
    mat = (np.abs(grid) < MAT - 2 * GRAIN).all(1)
    np.testing.assert_allclose(after[outer | mat], before[outer | mat], atol=1e-6)
    true = 4 * HALF.prod() - 4 * MAT**2
    assert found[0].area == pytest.approx(true, rel=0.2)
    on = on_any(found, GRAIN)(np.array([[0.5, 0.0, HIGH], [0.5, 0.0, HIGH + 0.1], [0.9, 0.0, HIGH]]))
    assert on.tolist() == [True, False, False]


def test_nothing_is_completed_where_all_of_it_is_seen_or_patterned(photographed):
    surface, poses, folder = photographed
    # The floor has a pattern: what a field has of it is what photos show.
    low = (surface.raw.vertices[surface.raw.faces][:, :, 2] < 0).all(1)
    assert complete(replace(surface, shown=surface.shown & low), UP, GRAIN, poses, folder) == []
    flat = Volume(np.minimum(board_distance(surface.volume.points()), 1).astype(np.float32), surface.volume.low, GRAIN)
    raw = flat.mesh()
    whole = FieldSurface(
        flat,
        raw,
        np.ones(len(raw.vertices), bool),
        *[np.ones(len(raw.faces), bool)] * 2,
        [],
        np.full(len(raw.vertices), 3),
    )
    assert complete(whole, UP, GRAIN, poses, folder) == []


def test_a_distance_is_completed_as_its_samples_are(photographed):
    surface, poses, folder = photographed
    (one,) = complete(surface, UP, GRAIN, poses, folder)
    points = surface.volume.points().reshape(-1, 3)
    samples = one.filled(surface.volume).values.reshape(-1)
    changed = one.within(surface.volume.at)(points)
    np.testing.assert_allclose(changed, samples, atol=1e-5)
    assert np.abs(changed - surface.volume.values.reshape(-1)).max() > 2 * GRAIN


def test_flat_spots_of_a_round_thing_are_no_tables(photographed):
    """A plain ball has flat spots on top of itself; what photos show around them is as plain as they are."""
    surface, poses, folder = photographed
    ball = np.linalg.norm(surface.volume.points() - [0, 0, GROUND], axis=-1) - 0.4
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
    assert complete(whole, UP, GRAIN, poses, plain) == []
