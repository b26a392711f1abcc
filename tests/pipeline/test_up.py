"""Which way is up: cameras that look straight down, at a slope, or at a wall; and what the user says of it."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.cameras import UNKNOWN, Similarity, View, camera_up, triangulation_angle
from pipeline.inputs.photos import Photo
from pipeline.mesh.placement import check_up, find_up, given_up
from pipeline.options import options_of
from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.mesh import Mesh, joined
from tests.helpers.sparse import sparse_of
from tests.helpers.surfaces import cube, look_at, plate, ring

SKY = np.array([0.0, 0, 1])


def desk() -> Mesh:
    """A desk of 1 m with five boxes on it, turned all ways; nothing is seen from below."""
    parts = [plate(40)]
    for number, place in enumerate([(0, 0), (0.3, 0.2), (-0.3, 0.25), (0.25, -0.3), (-0.25, -0.2)]):
        box = cube(0.12 + 0.02 * number)
        a = 0.7 * number
        turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        parts.append(Mesh(box.vertices @ turn.T + [*place, 0.06 + 0.01 * number], box.faces))
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


@pytest.mark.parametrize("yaws", [np.zeros(30), np.linspace(0, 5, 30), np.repeat([0, np.pi], 15)])
def test_cameras_that_look_straight_down_on_a_desk_have_it_below_them(yaws):
    """However they were turned about their axes: one way, all ways, or there and back as drones do."""
    mesh, views, up = in_some_world(desk(), downwards(yaws))
    found = find_up(mesh, views)
    assert off(found.direction, up) < 1 and found.source == "plane"
    assert found.within < 30


def test_level_cameras_before_a_shelf_have_its_boards_level():
    mesh, views, up = in_some_world(shelf(), rail(0.4))
    found = find_up(mesh, views)
    assert off(found.direction, up) < 1 and found.source == "plane" and found.within < 3


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
