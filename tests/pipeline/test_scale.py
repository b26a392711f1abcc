"""Metric scale from distances that a person knows."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.cameras import View
from pipeline.inputs.known_cameras import Lens
from pipeline.inputs.photos import Photo
from pipeline.mesh.placement import check_bodies, check_distance, located_bodies, measured_scale
from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import joined
from tests.helpers.surfaces import cube, ring

METRES = 3.0  # a unit of normalised space in the world that the photos were taken in
UP = np.array([0.0, 0, 1])


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


def place(view: View, point: np.ndarray, scale: float = 2.0) -> str:
    x, y = scale * view.project(point[None])[0][0]
    return f"{view.source}:{x:.4f},{y:.4f}"


def test_two_pixels_with_a_known_distance_set_the_scale(views, photos):
    surface = Caster(cube(1.0))
    # Corners of the top (just inside its edges, which a ray may miss), each in a photo of its own.
    a, b = np.array([0.499, 0.499, 0.5]), np.array([-0.499, 0.499, 0.5])
    known = [place(views[1], a), place(views[3], b), 0.998 * METRES]
    scale = measured_scale(known, views, photos, surface)
    assert scale[0] == pytest.approx(METRES, rel=1e-3)
    assert scale[1] == f"given: {known[0]} to {known[1]} = {known[2]:g} m"


def test_a_pixel_just_beside_a_corner_means_the_corner(views, photos):
    wall = cube(30.0, (0.0, 0, -15.6))  # Far below and behind the cube: most rays that miss it end there.
    surface = Caster(joined([cube(1.0), wall]))
    # Left and right as the camera sees them, and a little farther out.
    corners = np.array([[0.5, -0.5, 0.5], [-0.5, 0.5, 0.5]])
    known = [*(place(views[1], corner * [1.02, 1.02, 1]) for corner in corners), np.sqrt(2) * METRES]
    assert measured_scale(known, views, photos, surface)[0] == pytest.approx(METRES, rel=0.03)


def test_corners_that_came_out_rounded_are_where_they_were_pointed_at(views, photos):
    wall = cube(30.0, (0.0, 0, -15.6))
    surface = Caster(joined([cube(0.98), wall]))  # corners by a hundredth too far inside
    corners = np.array([[0.5, -0.5, 0.5], [-0.5, 0.5, 0.5]])
    known = [*(place(views[1], corner) for corner in corners), np.sqrt(2) * METRES]
    assert measured_scale(known, views, photos, surface)[0] == pytest.approx(METRES, rel=0.005)


def test_a_photo_without_a_pixel_is_its_camera(views, photos):
    apart = float(np.linalg.norm(views[0].center - views[2].center))
    scale = measured_scale(["photo0.jpg", "photo2.jpg", METRES * apart], views, photos, Caster(cube(1.0)))
    assert scale[0] == pytest.approx(METRES)


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ("photo9.jpg:1,1", r"no photo is called 'photo9\.jpg' \(did you mean 'photo\d\.jpg'\?\)"),
        ("photo1.jpg:2000,1", r"photo1.jpg:2000,1 lies outside the photo \(1280 x 960 px\)"),
        ("photo1.jpg:-1,1", r"no photo is called 'photo1.jpg:-1,1'"),
        (".jpg", "no photo is called '.jpg'"),
        ("photo1.jpg", "photo1.jpg has no pixel"),
    ],
)
def test_photos_and_pixels_that_are_none_are_named_before_there_are_poses(photos, place, says):
    check_distance(("photo0.jpg", "photo1.jpg:1280,960", 1.0), photos)
    check_bodies({"cup": ["photo0.jpg:1,1", "photo1.jpg:1280,960"]}, photos)
    with pytest.raises(SdfsimError, match=f"body: {says}"):
        check_bodies({"cup": ["photo0.jpg:1,1", place]}, photos)
    if "no pixel" not in says:
        with pytest.raises(SdfsimError, match=f"distance: {says}"):
            check_distance(("photo0.jpg", place, 1.0), photos)


def test_places_of_bodies_are_where_their_pixels_meet_the_surface(views, photos):
    at = np.array([[0.3, 0.2, 0.5], [-0.2, 0.1, 0.5]])
    given = {"cup": [place(views[1], at[0]), place(views[4], at[1])]}
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
