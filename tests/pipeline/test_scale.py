"""Metric scale from distances that a person knows and from what cameras write into their photos."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from pipeline.cameras import View
from pipeline.inputs.known_cameras import Lens
from pipeline.inputs.photos import Photo
from pipeline.mesh.cleaning import joined
from pipeline.mesh.placement import GPS_ERROR, check_places, measured, of_exif
from pipeline.mesh.visibility import Caster
from pipeline.options import Known
from sdfsim.errors import SdfsimError
from tests.pipeline.test_surface import cube, ring

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
    known = Known(place(views[1], a), place(views[3], b), 0.998 * METRES)
    scale = measured(known, views, photos, surface)
    assert scale.metres == pytest.approx(METRES, rel=1e-3)
    assert scale.source == f"given: {known.start} to {known.end} = {known.metres:g} m"


def test_a_pixel_just_beside_a_corner_means_the_corner(views, photos):
    wall = cube(30.0, (0.0, 0, -15.6))  # Far below and behind the cube: most rays that miss it end there.
    surface = Caster(joined([cube(1.0), wall]))
    # Left and right as the camera sees them, and a little farther out.
    corners = np.array([[0.5, -0.5, 0.5], [-0.5, 0.5, 0.5]])
    known = Known(*(place(views[1], corner * [1.02, 1.02, 1]) for corner in corners), np.sqrt(2) * METRES)
    assert measured(known, views, photos, surface).metres == pytest.approx(METRES, rel=0.03)


def test_corners_that_came_out_rounded_are_where_they_were_pointed_at(views, photos):
    wall = cube(30.0, (0.0, 0, -15.6))
    surface = Caster(joined([cube(0.98), wall]))  # corners by a hundredth too far inside
    corners = np.array([[0.5, -0.5, 0.5], [-0.5, 0.5, 0.5]])
    known = Known(*(place(views[1], corner) for corner in corners), np.sqrt(2) * METRES)
    assert measured(known, views, photos, surface).metres == pytest.approx(METRES, rel=0.005)


def test_a_photo_without_a_pixel_is_its_camera(views, photos):
    apart = float(np.linalg.norm(views[0].center - views[2].center))
    scale = measured(Known("photo0.jpg", "photo2.jpg", METRES * apart), views, photos, Caster(cube(1.0)))
    assert scale.metres == pytest.approx(METRES)


@pytest.mark.parametrize(
    ("start", "end", "says"),
    [
        ("photo9.jpg:1,1", "photo1.jpg:3,3", "no posed photo is called 'photo9.jpg'"),
        ("photo0.jpg:2000,1", "photo1.jpg:3,3", r"photo0.jpg:2000,1 lies outside the photo \(1280 x 960 px\)"),
        ("photo0.jpg:1,1", "photo1.jpg:640,480", "photo0.jpg:1,1 shows nothing of the surface"),
        ("photo1.jpg:640,480", "photo1.jpg:640.0,480", "are in the same place"),
    ],
)
def test_places_that_are_none_are_named(views, photos, start, end, says):
    with pytest.raises(SdfsimError, match=says):
        measured(Known(start, end, 1.0), views, photos, Caster(cube(1.0)))


@pytest.mark.parametrize(
    ("end", "says"),
    [
        ("photo9.jpg:1,1", "no photo is called 'photo9.jpg'"),
        ("photo1.jpg:2000,1", r"photo1.jpg:2000,1 lies outside the photo \(1280 x 960 px\)"),
        (".jpg", "no photo is called '.jpg'"),
    ],
)
def test_photos_and_pixels_that_are_none_are_named_before_there_are_poses(photos, end, says):
    check_places(Known("photo0.jpg", "photo1.jpg:1280,960", 1.0), photos)
    with pytest.raises(SdfsimError, match=says):
        check_places(Known("photo0.jpg", end, 1.0), photos)


@pytest.mark.parametrize("known", [Known("a:1,1", "b:1,1", 0.0), Known("a:1,1", "a:1,1", 1.0)])
def test_distances_that_make_no_sense_are_refused(known):
    with pytest.raises(SdfsimError):
        known.check()


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
    scale = measured(Known(*known, 0.998 * METRES), views, [replace(p, lens=lens) for p in photos], surface)
    assert scale.metres == pytest.approx(METRES, rel=1e-3)


def test_photos_of_the_same_name_have_to_be_told_apart(views, photos):
    views = [replace(view, source=f"cam{k}/1.jpg") for k, view in enumerate(views)]
    apart = float(np.linalg.norm(views[0].center - views[2].center))
    known = Known("cam0/1.jpg", "cam2/1.jpg", METRES * apart)
    assert measured(known, views, photos, Caster(cube(1.0))).metres == pytest.approx(METRES)
    with pytest.raises(SdfsimError, match=r"8 posed photos are called '1\.jpg'") as caught:
        measured(Known("1.jpg", "cam2/1.jpg", 1.0), views, photos, Caster(cube(1.0)))
    assert "cam0/1.jpg, cam1/1.jpg" in caught.value.hint


def write_exif(photos: Path, views: list[View], metres: float, noise: float, subject: bool) -> None:
    """Photos with the positions of their cameras on the map, or the distances of their subjects."""
    rng = np.random.default_rng(0)
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    for view in views:
        image = Image.new("RGB", (64, 48))
        exif = image.getexif()
        if subject:
            away = metres * (np.linalg.norm(view.center) - 0.6) * (1 + noise * rng.normal())
            exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.SubjectDistance] = away
        else:
            east, north = turn @ view.center[:2] * metres + noise * rng.normal(size=2)
            degrees = np.array([48.0, 11.0]) + np.degrees([north, east / np.cos(np.radians(48))]) / 6_371_000.0
            gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
            for key, value, letter in zip((2, 4), degrees, "NE", strict=True):
                minutes = value % 1 * 60
                gps[key] = (float(int(value)), float(int(minutes)), minutes % 1 * 60)
                gps[key - 1] = letter
        (photos / view.source).parent.mkdir(exist_ok=True)
        image.save(photos / view.source, exif=exif)


def test_positions_on_the_map_set_the_scale_of_large_scenes(tmp_path, views):
    write_exif(tmp_path, views, 20.0, 0.5, subject=False)
    found = of_exif(views, tmp_path, Caster(cube(1.0)), UP)
    assert found is not None and found.metres == pytest.approx(20.0, rel=0.02)
    assert "EXIF positions of 8 photos" in found.source


@pytest.mark.parametrize(("metres", "noise"), [(GPS_ERROR / 3, 0.5), (30.0, 40.0)], ids=["too close", "contradicting"])
def test_positions_that_tell_nothing_are_not_used(tmp_path, views, metres, noise):
    write_exif(tmp_path, views, metres, noise, subject=False)
    assert of_exif(views, tmp_path, Caster(cube(1.0)), UP) is None


def test_subject_distances_set_the_scale_where_they_agree(tmp_path, views):
    surface = Caster(cube(1.2))
    middle = np.array([320.0]), np.array([240.0])
    truth = np.median([surface.hits(view.center, view.rays(*middle))[0][0] for view in views])
    write_exif(tmp_path, views, METRES, 0.02, subject=True)
    found = of_exif(views, tmp_path, surface, UP)
    nominal = METRES * (np.linalg.norm(views[0].center) - 0.6)
    assert found is not None and found.metres == pytest.approx(nominal / truth, rel=0.05)
    write_exif(tmp_path, views, METRES, 0.8, subject=True)
    assert of_exif(views, tmp_path, surface, UP) is None


def test_positions_are_read_in_subfolders_and_of_the_largest_photos(tmp_path, views, monkeypatch):
    """Photos of up to 200 megapixels are read; PIL on its own refuses them from 179 on."""
    views = [replace(view, source=f"cam{k}/1.jpg") for k, view in enumerate(views)]
    write_exif(tmp_path, views, 20.0, 0.5, subject=False)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 64 * 48 // 2 - 1)
    found = of_exif(views, tmp_path, Caster(cube(1.0)), UP)
    assert found is not None and found.metres == pytest.approx(20.0, rel=0.02)
    assert Image.MAX_IMAGE_PIXELS == 64 * 48 // 2 - 1


def test_photos_without_exif_set_no_scale(tmp_path, views):
    for view in views:
        Image.new("RGB", (64, 48)).save(tmp_path / view.source)
    assert of_exif(views, tmp_path, Caster(cube(1.0)), UP) is None
    assert of_exif(views, tmp_path / "gone", Caster(cube(1.0)), UP) is None
