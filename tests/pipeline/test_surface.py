"""Extraction, placement, up and scale against shapes that are known exactly."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.cameras import CAREFUL, UNKNOWN, PosedPhotos, Similarity, Sparse, View, camera_up, triangulation_angle
from pipeline.field.grid_field import GridField
from pipeline.field.supervision import unit_sphere_of
from pipeline.inputs.known_cameras import Lens
from pipeline.inputs.photos import Photo
from pipeline.mesh.extraction import (
    FieldSurface,
    all_seen,
    belonging,
    components,
    field_colors,
    field_distance,
    islands,
    sample_box,
    sample_volume,
)
from pipeline.mesh.placement import (
    Scale,
    check_bodies,
    check_distance,
    check_up,
    find_up,
    given_up,
    load_placement,
    located_bodies,
    measured_scale,
    place,
    plane_up,
    resting_height,
)
from pipeline.mesh.visibility import Visibility
from pipeline.options import options_of
from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, is_closed, joined, signed_volume, vertex_normals
from tests.helpers.fields import SMALL
from tests.helpers.sparse import sparse_of
from tests.helpers.surfaces import cube, look_at, plate, ring, scenery


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


SKY = np.array([0.0, 0, 1])


def desk() -> Mesh:
    """A desk of 1 m with five boxes on it, turned all ways; nothing is seen from below."""
    parts = [plate(40)]
    for number, spot in enumerate([(0, 0), (0.3, 0.2), (-0.3, 0.25), (0.25, -0.3), (-0.25, -0.2)]):
        box = cube(0.12 + 0.02 * number)
        a = 0.7 * number
        turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        parts.append(Mesh(box.vertices @ turn.T + [*spot, 0.06 + 0.01 * number], box.faces))
    whole = joined(parts)
    corners = whole.vertices[whole.faces]
    return Mesh(whole.vertices, whole.faces[np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
                                            > -1e-12])  # fmt: skip


def shelf() -> Mesh:
    """A wall of 1 m, upright, with three boards that stand out by 0.25 m; seen from -y."""
    wall = plate(40).vertices[:, [0, 2, 1]]
    boards = [plate(20).vertices * [1, 0.25, 1] + [0, -0.125, height] for height in (-0.4, -0.1, 0.2)]
    return joined([Mesh(wall, plate(40).faces), *(Mesh(board, plate(20).faces) for board in boards)])


def downwards(yaws: np.ndarray, seed: int = 0) -> list[View]:
    """Thirty cameras 1.6 m above the desk, in an uneven grid, their axes within 2 degrees of straight down."""
    rng = np.random.default_rng(seed)
    views = []
    for number, yaw in enumerate(yaws):
        eye = np.array([0.2 * (number % 6) - 0.5, 0.15 * (number // 6) - 0.3, 1.6]) + rng.normal(0, 0.01, 3)
        target = eye + np.array([*rng.normal(0, 0.02, 2), -1])
        views.append(look_at(eye, target, up=(np.sin(yaw), np.cos(yaw), 0)))
    return views


def rail(eye_height: float = 0.0, pitch: float = 0.0) -> list[View]:
    """A dozen cameras along a rail of 2 m before the wall, all of them looking straight ahead or down by degrees."""
    down = np.tan(np.radians(pitch))
    places = [np.array([x, -1.5, eye_height]) for x in np.linspace(-1, 1, 12)]
    return [look_at(place, place + np.array([0, 1, -down])) for place in places]


def in_some_world(mesh: Mesh, views: list[View]) -> tuple[Mesh, list[View], np.ndarray]:
    """Both turned at random, as structure from motion leaves them, and up there."""
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    move = Similarity(0.7, turn, np.array([0.1, 0.2, -0.1]))
    return Mesh(move.points(mesh.vertices), mesh.faces), [move.view(view) for view in views], turn @ SKY


def off(found: np.ndarray, true: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(found @ true, -1, 1))))


@pytest.mark.parametrize(
    ("things", "cameras", "within"),
    [
        (desk(), downwards(np.zeros(30)), 30), (desk(), downwards(np.linspace(0, 5, 30)), 30),
        (desk(), downwards(np.repeat([0, np.pi], 15)), 30), (shelf(), rail(0.4), 3),
    ],
    ids=["one way", "all ways", "there and back", "shelf"],
)  # fmt: skip
def test_cameras_straight_above_a_desk_have_it_below_them_and_level_ones_a_shelf_s_boards_level(
    things, cameras, within
):
    """However those above were turned about their axes: one way, all ways, or there and back as drones do."""
    mesh, views, up = in_some_world(things, cameras)
    found = find_up(mesh, views)
    assert off(found.direction, up) < 1 and found.source == "plane" and found.within < within


def test_a_wall_alone_is_upright_but_may_be_a_floor():
    """One rail along it: nothing in the pictures says so, and the angle says that."""
    wall = Mesh(plate(40).vertices[:, [0, 2, 1]], plate(40).faces)
    mesh, views, up = in_some_world(wall, rail())
    found = find_up(mesh, views)
    assert off(found.direction, up) < 1 and found.within == UNKNOWN and found.source == "cameras"


@pytest.mark.parametrize("pitch", [25.0, 45.0, 60.0])
def test_a_floor_seen_at_a_slope_is_level(pitch):
    """As by a drone that flies one line: the cameras' up alone is off by the slope."""
    mesh, views, up = in_some_world(desk(), rail(1.0, pitch))
    assert off(camera_up(views).direction, up) > pitch - 3
    assert off(find_up(mesh, views).direction, up) < 1


def photo_of(view: View) -> Photo:
    size = (view.width, view.height)
    return Photo(view.name, view.source, *size, size, None, None, "", False, 0.4)


def test_up_can_be_said(tmp_path):
    views = [replace(view, name=f"{k}.jpg", source=f"p{k}.jpg") for k, view in enumerate(ring())]
    photos, box = [photo_of(view) for view in views], cube(1.0)
    x, y = views[1].project(np.array([[0.5, 0.1, 0.0]]))[0][0]  # the side that faces x
    axes = np.eye(3)[:, [1, 2, 0]]  # a world in which the first axis is our y, the second our z, ...
    for text, true in ((f"p1.jpg:{x:.1f},{y:.1f}", [1, 0, 0]), ("y", axes[:, 1]), ("-z", -axes[:, 2])):
        check_up(text, photos)
        found = given_up(text, axes, views, photos, box)
        assert off(found.direction, np.array(true)) < 0.1 and "given" in found.source, text
    above = downwards(np.zeros(30))
    assert off(given_up("view", axes, above, photos, box).direction, SKY) < 1


@pytest.mark.parametrize(
    ("text", "says"),
    [("q", "up: no photo is called 'q'"), ("p1.jpg", "up: p1.jpg has no pixel"), ("p1.jpg:900,1", "lies outside")],
)
def test_ups_that_are_none_are_named_before_there_are_poses(text, says):
    photos = [photo_of(replace(view, name="1.jpg", source="p1.jpg")) for view in ring(1)]
    with pytest.raises(SdfsimError, match=says):
        check_up(text, photos)


def test_up_is_an_option_of_the_mesh_stage():
    assert options_of(up="view").of_stage("mesh")["up"] == "view" and "up" not in options_of(up="z").of_stage("poses")


def test_parallel_cameras_stand_apart_as_their_points_see_them():
    """A rail of 2 m, 1.5 m before a wall: from its middle both ends are 2 atan(1 / 1.5) = 67.4 degrees apart."""
    views = rail()
    assert triangulation_angle(views, sparse_of(np.zeros((5, 3)), len(views))) == pytest.approx(67.38, abs=0.01)
    assert triangulation_angle(views[:1] * 2, sparse_of(np.zeros((5, 3)), 2)) == pytest.approx(0.0, abs=1e-3)


METRES = 3.0  # a unit of normalised space in the world that the photos were taken in


def named(views: list[View]) -> list[View]:
    return [replace(view, name=f"{k:04d}.jpg", source=f"photo{k}.jpg") for k, view in enumerate(views)]


@pytest.fixture
def views() -> list[View]:
    return named(ring(8))


@pytest.fixture
def photos(views: list[View]) -> list[Photo]:
    """Made of files twice as large."""
    return [
        Photo(v.name, v.source, v.width, v.height, (2 * v.width, 2 * v.height), None, None, "", False, 0.4)
        for v in views
    ]


def clicked(view: View, point: np.ndarray, scale: float = 2.0) -> str:
    x, y = scale * view.project(point[None])[0][0]
    return f"{view.source}:{x:.4f},{y:.4f}"


def test_two_pixels_with_a_known_distance_set_the_scale(views, photos):
    surface = Caster(cube(1.0))
    # Corners of the top (just inside its edges, which a ray may miss), each in a photo of its own.
    a, b = np.array([0.499, 0.499, 0.5]), np.array([-0.499, 0.499, 0.5])
    known = [clicked(views[1], a), clicked(views[3], b), 0.998 * METRES]
    scale = measured_scale(known, views, photos, surface)
    assert scale[0] == pytest.approx(METRES, rel=1e-3)
    assert scale[1] == f"given: {known[0]} to {known[1]} = {known[2]:g} m"


@pytest.mark.parametrize(("side", "farther", "within"), [(1.0, 1.02, 0.03), (0.98, 1.0, 0.005)])
def test_a_pixel_beside_a_corner_means_the_corner_and_one_that_came_out_rounded_is_where_it_was_pointed_at(
    views, photos, side, farther, within
):
    """A little farther out than the corners of the cube; or they came out by a hundredth too far inside."""
    wall = cube(30.0, (0.0, 0, -15.6))  # Far below and behind the cube: most rays that miss it end there.
    surface = Caster(joined([cube(side), wall]))
    # Left and right as the camera sees them.
    corners = np.array([[0.5, -0.5, 0.5], [-0.5, 0.5, 0.5]])
    known = [*(clicked(views[1], corner * [farther, farther, 1]) for corner in corners), np.sqrt(2) * METRES]
    assert measured_scale(known, views, photos, surface)[0] == pytest.approx(METRES, rel=within)


def test_a_photo_without_a_pixel_is_its_camera(views, photos):
    apart = float(np.linalg.norm(views[0].center - views[2].center))
    scale = measured_scale(["photo0.jpg", "photo2.jpg", METRES * apart], views, photos, Caster(cube(1.0)))
    assert scale[0] == pytest.approx(METRES)


@pytest.mark.parametrize(
    ("clicked", "says"),
    [
        ("photo9.jpg:1,1", r"no photo is called 'photo9\.jpg' \(did you mean 'photo\d\.jpg'\?\)"),
        ("photo1.jpg:2000,1", r"photo1.jpg:2000,1 lies outside the photo \(1280 x 960 px\)"),
        ("photo1.jpg:-1,1", r"no photo is called 'photo1.jpg:-1,1'"),
        (".jpg", "no photo is called '.jpg'"),
        ("photo1.jpg", "photo1.jpg has no pixel"),
    ],
)
def test_photos_and_pixels_that_are_none_are_named_before_there_are_poses(photos, clicked, says):
    check_distance(("photo0.jpg", "photo1.jpg:1280,960", 1.0), photos)
    check_bodies({"cup": ["photo0.jpg:1,1", "photo1.jpg:1280,960"]}, photos)
    with pytest.raises(SdfsimError, match=f"body: {says}"):
        check_bodies({"cup": ["photo0.jpg:1,1", clicked]}, photos)
    if "no pixel" not in says:
        with pytest.raises(SdfsimError, match=f"distance: {says}"):
            check_distance(("photo0.jpg", clicked, 1.0), photos)


def test_places_of_bodies_are_where_their_pixels_meet_the_surface(views, photos):
    at = np.array([[0.3, 0.2, 0.5], [-0.2, 0.1, 0.5]])
    given = {"cup": [clicked(views[1], at[0]), clicked(views[4], at[1])]}
    found = located_bodies(given, views, photos, Caster(cube(1.0)))
    np.testing.assert_allclose(found["cup"], at, atol=1e-3)
    with pytest.raises(SdfsimError, match=r"body: photo0\.jpg has no pose"):
        located_bodies({"cup": ["photo0.jpg:1,1"]}, views[1:], photos, Caster(cube(1.0)))
    with pytest.raises(SdfsimError, match=r"body: photo0\.jpg:1,1 shows nothing of the surface"):
        located_bodies({"cup": ["photo0.jpg:1,1"]}, views, photos, Caster(cube(1.0)))


def test_a_pixel_is_followed_through_the_lens(views, photos):
    surface = Caster(cube(1.0))
    lens = Lens(((560.0, 0, 325), (0, 560, 236), (0, 0, 1)), (-0.25, 0.04, 0.0, 0.0), False)
    known = []
    for view, corner in ((views[1], [0.499, 0.499, 0.5]), (views[3], [-0.499, 0.499, 0.5])):
        x, y, z = view.rotation @ corner + view.translation
        r = (x * x + y * y) / z**2
        bend = 1 - 0.25 * r + 0.04 * r * r
        u, v = 2 * (560 * bend * x / z + 325), 2 * (560 * bend * y / z + 236)
        known.append(f"{view.source}:{u:.4f},{v:.4f}")
    scale = measured_scale([*known, 0.998 * METRES], views, [replace(p, lens=lens) for p in photos], surface)
    assert scale[0] == pytest.approx(METRES, rel=1e-3)


def test_photos_of_the_same_name_have_to_be_reported_apart(views, photos):
    photos = [replace(photo, source=f"cam{k}/1.jpg") for k, photo in enumerate(photos)]
    apart = float(np.linalg.norm(views[0].center - views[2].center))
    known = ["cam0/1.jpg", "cam2/1.jpg", METRES * apart]
    assert measured_scale(known, views, photos, Caster(cube(1.0)))[0] == pytest.approx(METRES)
    with pytest.raises(SdfsimError, match=r"distance: 8 .*'1\.jpg'") as caught:
        measured_scale(["1.jpg", "cam2/1.jpg", 1.0], views, photos, Caster(cube(1.0)))
    assert "cam0/1.jpg, cam1/1.jpg" in caught.value.hint


@pytest.mark.gpu
def test_distances_and_colours_are_those_of_the_processor():
    field, points = GridField(SMALL), np.random.default_rng(0).uniform(-0.9, 0.9, (1000, 3))
    with torch.no_grad():
        distances, colors = field_distance(field)(points), field_colors(field, cube())
        field = field.to("cuda")
        np.testing.assert_allclose(field_distance(field)(points), distances, atol=1e-4)
        np.testing.assert_allclose(field_colors(field, cube()), colors, atol=1e-3)
