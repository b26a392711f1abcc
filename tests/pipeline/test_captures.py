"""Captures of phones, written by ourselves from the bundled set in each app's layout, against its true cameras."""

import json
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.cameras import PosedPhotos, Sparse, View, load_views
from pipeline.field.supervision import depth_points, depth_scale
from pipeline.inputs.captures import UP, DepthFile, load_capture, read_depth, spread
from pipeline.inputs.known_cameras import lens_of, posed
from pipeline.inputs.photos import KNOWN_CAMERAS, Photo, load_photos, prepare_photos
from pipeline.inputs.sources import find_source
from pipeline.sfm.poses import solve
from sdfsim.base.errors import SdfsimError
from tests.helpers.photos import noise
from tests.pipeline.photo_sets import SAMPLES, TABLE_VASE

sys.path.insert(0, str(SAMPLES))
import phone

EVERY = 6


def capture(layout: str, folder: Path, **more) -> Path:
    out = folder / ("capture.r3d" if layout == "record3d" else layout)
    phone.write(layout, out, every=EVERY, **more)
    return out / "transforms.json" if layout == "nerfstudio" else out


def true_poses() -> list[np.ndarray]:
    """Camera to world [4, 4], OpenGL axes, in a world with y up."""
    frames = json.loads((TABLE_VASE / "transforms.json").read_text())["frames"][::EVERY]
    return [phone.TO_ARKIT @ np.array(frame["transform_matrix"]) for frame in frames]


@pytest.mark.parametrize("layout", phone.LAYOUTS)
def test_every_layout_gives_the_same_cameras_and_depth(layout, tmp_path):
    given = capture(layout, tmp_path, exact=True)
    out = tmp_path / "photos"
    out.mkdir()
    photos, _ = prepare_photos(given, out)
    views, poses = load_views(out / KNOWN_CAMERAS), true_poses()
    assert len(photos) == len(views) == len(poses)
    assert photos == load_photos(out) and all(photo.depth for photo in photos)
    assert not (out / ".capture").exists()
    found = load_capture(out)
    assert found is not None and found.up == (None if layout == "nerfstudio" else UP)
    for view, pose in zip(views, poses, strict=True):
        np.testing.assert_allclose(view.center, pose[:3, 3], atol=1e-6)
        np.testing.assert_allclose(view.rotation, np.diag([1, -1, -1]) @ pose[:3, :3].T, atol=1e-6)
    # The table's top is level at its height wherever the sensor saw it.
    points = depth_points(views, photos, out)
    on_table = (
        (np.abs(points.xyz[:, 0]) < 0.5) & (np.abs(points.xyz[:, 2]) < 0.3) & (np.abs(points.xyz[:, 1] - 0.55) < 0.05)
    )
    height = points.xyz[on_table, 1]
    assert on_table.sum() > 5000
    assert abs(np.median(height) - 0.55) < 0.002 and np.abs(height - 0.55).mean() < 0.01


def test_the_poses_of_a_phone_are_refined(tmp_path):
    """Every second photo: with every third one of the room, few pairs look into the vase from near, and the error only
    halves."""
    phone.write("polycam", tmp_path / "capture", every=2)
    folder, out = tmp_path / "photos", tmp_path / "poses"
    folder.mkdir()
    out.mkdir()
    photos, _ = prepare_photos(tmp_path / "capture", folder)
    solve(photos, folder, out)
    frames = json.loads((TABLE_VASE / "transforms.json").read_text())["frames"][::2]
    true = np.array([(phone.TO_ARKIT @ np.array(frame["transform_matrix"]))[:3, 3] for frame in frames])

    def shape_error(views: list[View]) -> float:
        """Median m by which the cameras are off after the best similarity: their world is the phone's."""
        from pycolmap import estimate_sim3d

        centers = np.array([view.center for view in views])
        move: Any = estimate_sim3d(centers, true)
        off = move.scale * centers @ move.rotation.matrix().T + move.translation - true
        return float(np.median(np.linalg.norm(off, axis=1)))

    given, found = load_views(folder / KNOWN_CAMERAS), load_views(out)
    assert shape_error(given) > 0.003
    assert shape_error(found) < 0.5 * shape_error(given)
    # As a whole they stay in the phone's world, at its scale.
    centers = [np.array([view.center for view in views]) for views in (given, found)]
    np.testing.assert_allclose(centers[0].mean(0), centers[1].mean(0), atol=0.003)
    assert np.std(centers[0]) == pytest.approx(np.std(centers[1]), rel=2e-3)


def test_depth_is_read_in_its_unit_where_it_can_be_believed(tmp_path):
    depth = np.full((6, 8), 1.5)
    depth[:, 5:] = 2.5  # An edge between columns 4 and 5.
    depth[0, 0], depth[1, 1] = 0, 20.0
    sure = np.full((6, 8), 255, np.uint8)
    sure[5, 7] = 0
    Image.fromarray((1000 * depth).astype(np.uint16)).save(tmp_path / "mm.png")
    Image.fromarray(sure).save(tmp_path / "sure.png")
    np.save(tmp_path / "m.npy", depth.astype(np.float32))
    wanted = depth.copy()
    wanted[:, 4:6] = 0
    wanted[0, 0] = wanted[1, 1] = wanted[5, 7] = 0
    for file in (
        DepthFile(tmp_path / "mm.png", None, tmp_path / "sure.png"),
        DepthFile(tmp_path / "mm.png", 0.001, tmp_path / "sure.png"),
        DepthFile(tmp_path / "m.npy", None, tmp_path / "sure.png"),
    ):
        np.testing.assert_allclose(read_depth(file), wanted, atol=1e-6)


def camera(name: str, x: float, width: int = 64, height: int = 48) -> View:
    """A level camera at x, looking along +z."""
    return View(name, name, width, height, 60.0, width / 2, height / 2, 0.0, np.eye(3), np.array([-x, 0.0, 0.0]))


def photo(name: str, width: int = 64, height: int = 48) -> Photo:
    return Photo(name, name, width, height, (width, height), None, None, "", False, 0.3, depth=True)


def plane_at(tmp_path: Path, away: float) -> tuple[list[View], list[Photo]]:
    """Two cameras before a plane z = away, with its depth on fewer pixels than the photos have."""
    (tmp_path / "depth").mkdir()
    for name in ("a", "b"):
        np.save(tmp_path / "depth" / f"{name}.npy", np.full((24, 32), away, np.float32))
    return [camera("a", 0.0), camera("b", 0.3)], [photo("a"), photo("b")]


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.1])
def test_the_scale_of_depth_is_found_from_triangulated_points(factor, tmp_path):
    views, photos = plane_at(tmp_path, 2.0)
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-0.5, 0.8, 300), rng.uniform(-0.5, 0.5, 300), np.full(300, 2.0 * factor)])
    sparse = Sparse(
        xyz, np.zeros((300, 3), np.uint8), np.zeros(300), np.tile(np.arange(300), 2), np.repeat([0, 1], 300)
    )
    found = depth_scale(PosedPhotos(tuple(views), sparse), depth_points(views, photos, tmp_path))
    assert found["scale"] == pytest.approx(factor, rel=1e-6) and found["spread"] < 1e-6
    again = depth_points(views, photos, tmp_path, scale=found["scale"])
    np.testing.assert_allclose(again.xyz[:, 2], 2.0 * factor, rtol=1e-6)


def test_depth_in_other_units_is_refused(tmp_path):
    views, photos = plane_at(tmp_path, 2.0)
    points = depth_points(views, photos, tmp_path, scale=1e-3)
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-0.5, 0.5, (300, 2)), np.full(300, 2.0)])
    sparse = Sparse(xyz, np.zeros((300, 3), np.uint8), np.zeros(300), np.arange(300), np.zeros(300, int))
    with pytest.raises(SdfsimError, match=r"^depth: .*\b1e\+03\b"):
        depth_scale(PosedPhotos(tuple(views), sparse), points)


def test_depth_of_another_shape_is_refused(tmp_path):
    given = capture("polycam", tmp_path, exact=True)
    depth = sorted((given / "keyframes" / "depth").iterdir())[2]
    Image.fromarray(np.full((256, 192), 1000, np.uint16)).save(depth)
    (given / "keyframes" / "confidence" / depth.name).unlink()
    out = tmp_path / "photos"
    out.mkdir()
    with pytest.raises(SdfsimError, match=f"{depth.name}: .*192 x 256"):
        prepare_photos(given, out)


def test_a_long_recording_is_thinned_along_its_way_to_its_sharpest_frames(tmp_path):
    import cv2

    pixels = np.random.default_rng(0).integers(0, 255, (96, 128, 3), dtype=np.uint8)
    soft = cv2.GaussianBlur(pixels, (0, 0), 4)
    photos, cameras = [], {}
    for number in range(40):
        path = tmp_path / f"{number:03d}.png"
        Image.fromarray(pixels if number % 4 == 3 else soft).save(path)
        # The camera stands still for a while: these frames are one stretch.
        pose = np.column_stack([np.eye(3), [max(0, number - 20), 0.0, 0.0]])
        photos.append(path)
        cameras[path] = posed(path.name, (128, 96), lens_of(100, 100, 64, 48), pose)
    chosen = [photos.index(path) for path in spread(photos, cameras, most=5)]
    assert len(chosen) == 5 and chosen[0] <= 23 and chosen == sorted(set(chosen))
    assert all(number % 4 == 3 for number in chosen)
    assert spread(photos, cameras, most=40) == photos


def test_what_is_no_capture_is_reported(tmp_path):
    broken = tmp_path / "a.r3d"
    broken.write_text("no zip")
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(SdfsimError, match=r"a\.r3d: "):
        prepare_photos(broken, out)
    given = capture("polycam", tmp_path)
    file = sorted((given / "keyframes" / "cameras").iterdir())[0]
    file.write_text("{}")
    with pytest.raises(SdfsimError, match="cannot be read as a capture"):
        find_source(given)


@pytest.mark.parametrize("name", ["../outside.txt", "..\\outside.txt", "{}/outside.txt"])
def test_a_zip_does_not_write_outside_of_its_folder(tmp_path, name):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr(name.format(tmp_path), "no")
    with pytest.raises(SdfsimError, match="photos found: 0"):
        prepare_photos(tmp_path / "a.zip", tmp_path / "out")
    assert not (tmp_path / "outside.txt").exists() and not (tmp_path / "out" / "outside.txt").exists()


def wrapped(given: Path, archive: Path, above: str, separator: str = "/", previews: int = 3) -> Path:
    """A zip of a folder, or of what another zip holds, in one more folder, with what macOS and apps put beside it."""
    if given.is_dir():
        content = {path.relative_to(given).as_posix(): path.read_bytes() for path in given.rglob("*") if path.is_file()}
    else:
        with zipfile.ZipFile(given) as file:
            content = {entry.filename: file.read(entry) for entry in file.infolist() if not entry.is_dir()}
    with zipfile.ZipFile(archive, "w") as file:
        for name, data in content.items():
            place = Path(above) / name
            file.writestr(str(place).replace("/", separator), data)
            file.writestr(f"__MACOSX/{place.parent}/._{place.name}", b"\0\5\x16\7")
            file.writestr(str(place.with_name(f"._{place.name}")), b"\0\5\x16\7")
        file.writestr(f"{above}/.DS_Store", b"Bud1")
        for number in range(previews):
            file.writestr(f"thumbnail{number}.jpg", b"small")
    return archive


def cameras_of(given: Path, out: Path) -> list[View]:
    out.mkdir()
    photos, notes = prepare_photos(given, out)
    assert not notes and all(photo.depth for photo in photos) and load_capture(out) is not None
    return load_views(out / KNOWN_CAMERAS)


@pytest.mark.parametrize(
    ("layout", "above", "separator"),
    [("record3d", "scan", "/"), ("polycam", "scan", "/"), ("polycam", "a/b", "/"), ("polycam", "scan", "\\")],
)
def test_a_zip_may_hold_its_capture_in_a_folder_beside_what_macos_adds(layout, above, separator, tmp_path):
    given = capture(layout, tmp_path, exact=True)
    plain = cameras_of(given, tmp_path / "plain")
    found = cameras_of(wrapped(given, tmp_path / "w.zip", above, separator), tmp_path / "found")
    assert len(found) == len(true_poses())
    for one, other in zip(plain, found, strict=True):
        assert one.source.split("/")[-1] == other.source.split("/")[-1] and one.focal == other.focal
        np.testing.assert_array_equal(one.rotation, other.rotation)
        np.testing.assert_array_equal(one.translation, other.translation)


def test_an_unpacked_capture_may_lie_farther_below_with_files_of_macos(tmp_path):
    given = capture("polycam", tmp_path, exact=True)
    plain = cameras_of(given, tmp_path / "plain")
    for file in list((given / "keyframes").rglob("*.*")):
        file.with_name(f"._{file.name}").write_bytes(b"\0\5\x16\7")
    (tmp_path / "top" / "scan").mkdir(parents=True)
    given.rename(tmp_path / "top" / "scan" / "mine")
    (tmp_path / "top" / "__MACOSX" / "keyframes" / "cameras").mkdir(parents=True)
    (tmp_path / "top" / "__MACOSX" / "keyframes" / "cameras" / "0.json").write_text("{}")
    found = cameras_of(tmp_path / "top", tmp_path / "found")
    assert [view.focal for view in found] == [view.focal for view in plain] and len(found) == len(true_poses())
    phone.write("polycam", tmp_path / "top" / "scan" / "other", every=EVERY)
    with pytest.raises(SdfsimError, match=r": .*mine.*, .*other"):
        find_source(tmp_path / "top")


@pytest.mark.parametrize("photos", ["their own", "none of their own"])
def test_the_better_cameras_of_polycam_do_not_say_how_large_their_photos_are(photos, tmp_path):
    """Their photos say it. Where these were not exported, the other cameras with theirs are taken."""
    given = capture("polycam", tmp_path, exact=True)
    plain = cameras_of(given, tmp_path / "plain")
    better = given / "keyframes" / "corrected_cameras"
    better.mkdir()
    for file in (given / "keyframes" / "cameras").iterdir():
        about = json.loads(file.read_text())
        del about["width"], about["height"]
        (better / file.name).write_text(json.dumps(about | {"fx": about["fx"] * 1.01, "fy": about["fy"] * 1.01}))
    factor = 1.0
    if photos == "their own":
        (given / "keyframes" / "images").rename(given / "keyframes" / "corrected_images")
        factor = 1.01
    found = cameras_of(given, tmp_path / "found")
    assert [view.focal for view in found] == pytest.approx([factor * view.focal for view in plain])
    assert [(view.width, view.height) for view in found] == [(view.width, view.height) for view in plain]


def test_a_zip_of_photos_may_hold_them_in_a_folder_and_says_where_they_are_if_there_are_several(tmp_path):
    names = [f"{k}.jpg" for k in range(3)]
    given = wrapped(noise(tmp_path / "in", names), tmp_path / "a.zip", "holiday/day one", previews=1)
    out = tmp_path / "out"
    out.mkdir()
    assert [photo.source for photo in prepare_photos(given, out)[0]] == names
    noise(tmp_path / "in", [f"{side}/{name}" for side in ("left", "right") for name in names])
    for name in names:
        (tmp_path / "in" / name).unlink()
    given = wrapped(tmp_path / "in", tmp_path / "b.zip", "holiday", previews=1)
    (tmp_path / "other").mkdir()
    with pytest.raises(SdfsimError, match=r"b\.zip: .*\b1\b.* 3 in .*b\.zip/holiday/left, 3 in"):
        prepare_photos(given, tmp_path / "other")
