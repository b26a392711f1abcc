"""What can be given: folders, masks, labels, transforms.json, COLMAP models; against cameras that we know."""

import json
import struct
import subprocess
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
from pipeline.inputs.known_cameras import PARAMETERS, lens_of, posed, read_cameras
from pipeline.inputs.labels import UNKNOWN, load_labels, load_names
from pipeline.inputs.photos import KNOWN_CAMERAS, Photo, load_photos, prepare_photos
from pipeline.inputs.sources import find_source
from pipeline.sfm.poses import solve
from sdfsim.base.errors import SdfsimError
from tests.helpers.photos import NAMES, noise, turned, write_transforms
from tests.pipeline.photo_sets import SAMPLES, TABLE_VASE

sys.path.insert(0, str(SAMPLES))
import phone

SIZE = (120, 90)
SIMPLE = [100.0, 60.0, 45.0]


def fresh(folder: Path) -> Path:
    folder.mkdir()
    return folder


def write_text_model(folder: Path, camera: str = "1 SIMPLE_PINHOLE 120 90 100 60 45") -> None:
    from scipy.spatial.transform import Rotation

    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text(f"# Camera list\n{camera}\n")
    lines = []
    for k, name in enumerate(NAMES):
        x, y, z, w = Rotation.from_matrix(turned(0.3 * k)).as_quat()
        shift = -turned(0.3 * k) @ [k, 2 * k, 3]
        lines += [f"{k + 1} {w} {x} {y} {z} {shift[0]} {shift[1]} {shift[2]} 1 {name}", "1.0 2.0 -1"]
    (folder / "images.txt").write_text("# Image list\n" + "\n".join(lines) + "\n")


def in_colmap(code: str, *given) -> str:
    """What COLMAP prints in a process of its own."""
    command = [sys.executable, "-c", f"import zlib, pycolmap, json, sys\n{code}", *map(str, given)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def write_binary_model(folder: Path) -> None:
    """As COLMAP writes the text model."""
    text = folder.with_name("text")
    write_text_model(text)
    (text / "points3D.txt").write_text("")
    folder.mkdir(parents=True)
    in_colmap("pycolmap.Reconstruction(sys.argv[1]).write_binary(sys.argv[2])", text, folder)


@pytest.mark.parametrize("kind", ["transforms", "text", "binary"])
def test_the_same_cameras_come_out_of_every_format(tmp_path, kind):
    noise(tmp_path / "images", NAMES)
    given = tmp_path / "sparse" / "0"
    if kind == "transforms":
        given = write_transforms(tmp_path, [f"images/{name}" for name in NAMES])
    else:
        (write_text_model if kind == "text" else write_binary_model)(given)
    prepared, _ = prepare_photos(given, fresh(tmp_path / "out"))
    views = load_views(tmp_path / "out" / KNOWN_CAMERAS)
    assert [p.source for p in prepared] == [v.source for v in views] == NAMES
    for k, view in enumerate(views):
        np.testing.assert_allclose(view.rotation, turned(0.3 * k), atol=1e-9)
        np.testing.assert_allclose(view.center, [k, 2 * k, 3], atol=1e-9)
        assert (view.focal, view.cx, view.cy, view.k) == pytest.approx((100, 60, 45, 0))


def test_intrinsics_of_another_size_are_scaled(tmp_path):
    noise(tmp_path / "images", ["r_000.png", "r_001.png", "r_010.png"])
    about = json.loads(write_transforms(tmp_path, ["./train/r_000", "./train/r_001", "./train/r_010"]).read_text())
    for key in ("w", "h", "fl_x"):
        del about[key]
    (tmp_path / "transforms.json").write_text(json.dumps({**about, "camera_angle_x": 2 * np.arctan(0.5 * 120 / 100)}))
    prepare_photos(tmp_path / "transforms.json", tmp_path, long_side=100)
    view = load_views(tmp_path / KNOWN_CAMERAS)[2]
    assert view.source == "r_010.png" and view.focal == pytest.approx(100 * 100 / 120) and view.cx == 50


FISHEYE = {"fl_x": 80.0, "fl_y": 80.0, "cx": 62.0, "cy": 43.0}


def test_an_ideal_fisheye_is_straightened_though_its_coefficients_are_all_zero(tmp_path):
    """Equidistant: a ray at an angle t to the axis is f t from the middle of the photo, f tan t from the pinhole's."""
    row, column = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
    x, y = (column - FISHEYE["cx"]) / FISHEYE["fl_x"], (row - FISHEYE["cy"]) / FISHEYE["fl_y"]
    angle = np.hypot(x, y)
    u, v = x * np.tan(angle) / angle, y * np.tan(angle) / angle
    shown = np.stack([128 + 80 * u, 128 + 80 * v, np.zeros_like(u)], -1)
    for name in "abc":
        Image.fromarray((shown + 0.5).clip(0, 255).astype(np.uint8)).save(tmp_path / f"{name}.png")
    files = ["a.png", "b.png", "c.png"]
    prepare_photos(write_transforms(tmp_path, files, **FISHEYE, is_fisheye=True), fresh(tmp_path / "out"))
    view = load_views(tmp_path / "out" / KNOWN_CAMERAS)[0]
    pixels = np.asarray(Image.open(tmp_path / "out" / "images" / view.name)).astype(float)
    found = (pixels[..., :2] - 128) / 80
    expected = np.stack([(column - view.cx) / view.focal, (row - view.cy) / view.focal], -1)
    inside = np.s_[4:-4, 4:-4]
    off = (found - expected)[inside]  # A grey value is 0.0125, half a pixel 0.006.
    assert np.abs(off).max() < 0.05 and np.abs(off.mean((0, 1))).max() < 1e-3
    assert np.abs(np.stack([x - u, y - v], -1))[inside].max() > 0.1  # so much it was bent before


@pytest.mark.parametrize("fisheye", [{"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}])
def test_a_fisheye_may_be_told_in_each_frame(tmp_path, fisheye):
    given = write_transforms(tmp_path, NAMES, **FISHEYE)
    about = json.loads(given.read_text())
    about["frames"] = [{**frame, **fisheye} for frame in about["frames"]]
    given.write_text(json.dumps(about))
    assert all(camera.lens.fisheye for camera in read_cameras(given))


def test_photos_of_the_same_name_in_several_folders_keep_apart(tmp_path):
    names = ["left/1.jpg", "right/1.jpg", "right/2.jpg"]
    noise(tmp_path, names)
    given = write_transforms(tmp_path, names)
    prepared, _ = prepare_photos(given, fresh(tmp_path / "out"))
    assert [p.source for p in prepared] == [v.source for v in load_views(tmp_path / "out" / KNOWN_CAMERAS)] == names
    source = find_source(given)
    assert [source.folder / p.source for p in prepared] == [path.absolute() for path in source.photos]


@pytest.mark.parametrize("name", ["a.jpg.png", "a.png", "a.jpg"])
def test_masks_in_a_folder_go_by_the_photos_names(tmp_path, name):
    noise(tmp_path / "images", NAMES)
    (tmp_path / "masks").mkdir()
    shade = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    shade[:, 60:] = 255
    for other in NAMES:
        Image.fromarray(shade).save(tmp_path / "masks" / name.replace("a", other[0], 1))
    prepared, _ = prepare_photos(tmp_path, fresh(tmp_path / "out"))
    assert all(photo.mask for photo in prepared)
    found = np.asarray(Image.open(tmp_path / "out" / "masks" / "0000.jpg.png"))
    assert found[:, :57].max() < 10 and found[:, 63:].min() > 245
    assert abs(np.asarray(Image.open(tmp_path / "out" / "images" / "0000.jpg"))[:, :50].mean() - 128) < 2


@pytest.mark.parametrize(
    ("content", "words"),
    [("{", "cannot be read as cameras"), ('{"frames": []}', "cameras with a photo: 0, at least 3"),
     ('{"frames": [{"file_path": "a.jpg", "camera_model": "PANO"}]}', r"a\.jpg: camera_model: 'PANO'"),
     ('{"fl_x": 9, "w": 5, "frames": [{"file_path": "a.jpg"}]}', "needs fl_x, w and h"),
     ('{"camera_angle_x": 2, "is_fisheye": true, "frames": [{"file_path": "a.jpg"}]}', "needs fl_x, w and h")],
)  # fmt: skip
def test_bad_transforms_are_one_line(tmp_path, content, words):
    (tmp_path / "transforms.json").write_text(content)
    with pytest.raises(SdfsimError, match=words) as caught:
        find_source(tmp_path / "transforms.json")
    assert "\n" not in caught.value.message


def test_two_cameras_of_one_photo_are_named(tmp_path):
    noise(tmp_path, NAMES)
    with pytest.raises(SdfsimError, match=r"(?m)\./a\.jpg and a\.jpg\b.*a\.jpg$"):
        find_source(write_transforms(tmp_path, ["./a.jpg", *NAMES]))


def test_a_model_that_was_cut_is_one_line(tmp_path):
    write_binary_model(tmp_path / "model")
    path = tmp_path / "model" / "images.bin"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(SdfsimError, match="cannot be read as cameras"):
        read_cameras(tmp_path / "model")


def names_of(folder: Path) -> list[str]:
    return [path.name for path in find_source(folder).photos]


@pytest.mark.parametrize(("count", "size"), [(1, (64, 64)), (3, (64, 64)), (5, (64, 64)), (2, SIZE)])
def test_previews_beside_the_folder_of_the_photos_are_passed_over(tmp_path, count, size):
    noise(tmp_path / "images", NAMES)
    noise(tmp_path, [f"preview{k}.jpg" for k in range(count)], size)
    noise(tmp_path / "thumbnails", NAMES, (64, 64))
    assert names_of(tmp_path) == NAMES and find_source(tmp_path).folder == tmp_path / "images"
    assert "photos beside the folder images are not used" in find_source(tmp_path).notes[0]


def test_a_few_pictures_in_a_folder_images_do_not_take_the_place_of_the_photos(tmp_path):
    names = [f"{k}.jpg" for k in range(6)]
    noise(tmp_path, names)
    noise(tmp_path / "images", NAMES)
    assert names_of(tmp_path) == names


def test_it_is_reported_where_photos_are_if_they_lie_deeper(tmp_path):
    noise(tmp_path / "card" / "DCIM" / "100", NAMES)
    noise(tmp_path / "card" / "DCIM" / "101" / "images", [*NAMES, "d.jpg"])
    with pytest.raises(SdfsimError, match=r"(?m)card: .*\b0\b.*3 in .*DCIM/100, 4 in .*DCIM/101$"):
        find_source(tmp_path / "card")
    noise(tmp_path / "card", NAMES[:2])
    with pytest.raises(SdfsimError, match=r"\b2\b.*3 in .*DCIM/100"):
        find_source(tmp_path / "card")
    write_text_model(tmp_path / "set" / "sparse" / "0")
    with pytest.raises(SdfsimError, match="sparse/0"):
        find_source(tmp_path / "set")


def test_files_that_macos_adds_are_no_photos_and_no_masks(tmp_path):
    noise(tmp_path / "in" / "images", NAMES)
    for folder in ("masks", "masks/cup", "masks/__MACOSX"):
        noise(tmp_path / "in" / folder, ["a.png"])
    for file in list((tmp_path / "in").rglob("*.*")):
        file.with_name(f"._{file.name}").write_bytes(b"\0\5\x16\7")
    source = find_source(tmp_path / "in")
    assert names_of(tmp_path / "in") == NAMES and source.labels.names == ("cup",) and not source.notes
    assert not [path for path in source.files() if path.name.startswith("._")]


def test_a_model_may_lie_in_colmap_sparse_0_beside_the_photos_and_previews(tmp_path):
    noise(tmp_path / "images", NAMES)
    noise(tmp_path, NAMES, (64, 64))
    write_text_model(tmp_path / "colmap" / "sparse" / "0")
    assert find_source(tmp_path / "colmap" / "sparse" / "0").folder == tmp_path / "images"


@pytest.mark.parametrize("place", ["images\\left\\", ".\\images\\left\\", "C:\\Users\\me\\scan\\images\\", "/home/me/"])
def test_names_of_windows_and_of_other_computers_find_their_photos(tmp_path, place):
    folder = tmp_path / "images" / ("left" if "left" in place else "")
    noise(folder, NAMES)
    noise(tmp_path / "masks", ["a.png", "b.png", "c.png"])
    given = write_transforms(tmp_path, [place + name for name in NAMES])
    about = json.loads(given.read_text())
    for frame, name in zip(about["frames"], "abc", strict=True):
        frame["mask_path"] = f"masks\\{name}.png"
    given.write_text(json.dumps(about))
    source = find_source(given)
    assert list(source.photos) == [folder / name for name in NAMES]
    assert [source.masks[folder / name] for name in NAMES] == [tmp_path / "masks" / f"{name[0]}.png" for name in NAMES]
    write_text_model(tmp_path / "sparse" / "0")
    images = tmp_path / "sparse" / "0" / "images.txt"
    images.write_text("".join(line.replace(" 1 ", f" 1 {place}") if ".jpg" in line else line
                              for line in images.read_text().splitlines(keepends=True)))  # fmt: skip
    assert sorted(find_source(tmp_path / "sparse" / "0").photos) == [folder / name for name in NAMES]


def test_the_photos_of_windows_keep_their_names_where_a_file_is_called_like_that(tmp_path):
    noise(tmp_path, ["a\\b.jpg", "c.jpg", "d.jpg"])
    assert find_source(write_transforms(tmp_path, ["a\\b.jpg", "c.jpg", "d.jpg"])).photos[0].name == "a\\b.jpg"


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_camera_files_may_begin_with_a_byte_order_mark(tmp_path, encoding):
    noise(tmp_path / "images", NAMES)
    given = write_transforms(tmp_path, [f"images/{name}" for name in NAMES])
    write_text_model(tmp_path / "sparse")
    for file in (given, tmp_path / "sparse" / "cameras.txt", tmp_path / "sparse" / "images.txt"):
        file.write_bytes(file.read_text().encode(encoding))
    assert len(find_source(given).photos) == len(find_source(tmp_path / "sparse").photos) == 3


HEADER = "# Image list with two lines of data per image:\n"
FIRST, SECOND, THIRD = (f"{k + 1} 1 0 0 0 {k} 0 0 1 {name}" for k, name in enumerate(NAMES))
POINTS = "1.0 2.0 -1 3.5 4.5 7"


@pytest.mark.parametrize(
    "lines",
    [
        [FIRST, POINTS, SECOND, POINTS, THIRD, POINTS],
        [FIRST, "", SECOND, "", THIRD, ""],
        [FIRST, "", SECOND, POINTS, THIRD],
        ["", FIRST, POINTS, "", "", SECOND, "", "", THIRD, POINTS, ""],
        [FIRST, "  ", "", SECOND, " # a remark", POINTS, "", THIRD],
        [FIRST, SECOND, THIRD],
    ],
)
def test_lines_of_images_may_be_empty(tmp_path, lines):
    write_text_model(tmp_path / "m")
    (tmp_path / "m" / "images.txt").write_text(HEADER + "\n".join(lines) + "\n")
    found = read_cameras(tmp_path / "m")
    assert [camera.name for camera in found] == NAMES
    assert [camera.translation.tolist() for camera in found] == [[0, 0, 0], [1, 0, 0], [2, 0, 0]]


@pytest.mark.parametrize(
    ("line", "camera", "words"),
    [
        ("1 1 0 0 0 0 0 0 1", None, "images.txt: line 2: not an image's number"),
        ("1 1 0 0 0 0 0 0 9 a.jpg", None, "a.jpg: there is no camera 9"),
        (None, "1 SIMPLE_RADIAL 120 90 100 60 45", r"camera 1: 3 parameters, SIMPLE_RADIAL has 4 \(f cx cy k1\)"),
        (None, "one PINHOLE 120 90 100 60 45", "cameras.txt: line 2: not a camera's number"),
        (None, "1 EUCM 120 90 100 100 60 45 0 1", "EUCM"),
    ],
)
def test_what_is_wrong_in_a_text_model_is_named(tmp_path, line, camera, words):
    write_text_model(tmp_path / "m", camera or "1 SIMPLE_PINHOLE 120 90 100 60 45")
    if line:
        (tmp_path / "m" / "images.txt").write_text(HEADER + line + "\n")
    with pytest.raises(SdfsimError, match=words) as caught:
        read_cameras(tmp_path / "m")
    assert "\n" not in caught.value.message


@pytest.mark.parametrize(("number", "name"), [(7, "FOV"), (11, "RAD_TAN_THIN_PRISM_FISHEYE"), (99, "of number 99")])
def test_a_camera_model_that_is_not_read_is_named(tmp_path, number, name):
    write_binary_model(tmp_path / "m")
    (tmp_path / "m" / "cameras.bin").write_bytes(struct.pack("<QIiQQ3d", 1, 7, number, 120, 90, *SIMPLE))
    with pytest.raises(SdfsimError, match=rf"\b{name}\b") as caught:
        read_cameras(tmp_path / "m")
    assert "SIMPLE_RADIAL" in caught.value.hint


@pytest.mark.parametrize("form", ["3 x 4", "16", "12"])
def test_a_matrix_may_have_three_rows_or_be_flat(tmp_path, form):
    given = write_transforms(tmp_path)
    wanted = read_cameras(given)
    about = json.loads(given.read_text())
    for frame in about["frames"]:
        rows = np.array(frame["transform_matrix"])[: 4 if form == "16" else 3]
        frame["transform_matrix"] = rows.tolist() if form == "3 x 4" else rows.ravel().tolist()
    given.write_text(json.dumps(about))
    for one, other in zip(wanted, read_cameras(given), strict=True):
        np.testing.assert_array_equal(one.rotation, other.rotation)
        np.testing.assert_array_equal(one.translation, other.translation)


@pytest.mark.parametrize(("rows", "columns", "words"), [(4, 4, "last row"), (4, 3, "4 x 3"), (3, 3, "3 x 3")])
def test_a_matrix_by_columns_or_of_another_shape_is_refused(tmp_path, rows, columns, words):
    given = write_transforms(tmp_path)
    about = json.loads(given.read_text())
    for frame in about["frames"]:
        frame["transform_matrix"] = np.array(frame["transform_matrix"]).T[:rows, :columns].tolist()
    given.write_text(json.dumps(about))
    with pytest.raises(SdfsimError, match=rf"a\.jpg: transform_matrix: .*{words}"):
        read_cameras(given)


CURVED = {
    "SIMPLE_PINHOLE": [100, 60, 45], "PINHOLE": [100, 104, 60, 45], "SIMPLE_RADIAL": [100, 60, 45, -0.1],
    "RADIAL": [100, 60, 45, -0.1, 0.02], "OPENCV": [100, 104, 60, 45, -0.1, 0.02, 0.003, -0.002],
    "FULL_OPENCV": [100, 104, 60, 45, -0.1, 0.02, 0.003, -0.002, 0.01, 0.02, -0.01, 0.004],
    "SIMPLE_FISHEYE": [80, 60, 45], "FISHEYE": [80, 84, 60, 45], "SIMPLE_RADIAL_FISHEYE": [80, 60, 45, 0.05],
    "RADIAL_FISHEYE": [80, 60, 45, 0.05, -0.02], "OPENCV_FISHEYE": [80, 84, 60, 45, 0.05, -0.02, 0.004, -0.001],
}  # fmt: skip
LOCAL = np.random.default_rng(0).uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (20, 3))


@pytest.fixture(scope="module")
def projected() -> dict[str, list]:
    """Where COLMAP puts the rays `LOCAL` in the photo of each of its lenses."""
    code = "lenses, rays = json.loads(sys.argv[1])\n"
    code += "put = lambda model, values: pycolmap.Camera(model=model, width=120, height=90, params=values)\n"
    code += "print(json.dumps({m: put(m, v).img_from_cam(rays).tolist() for m, v in lenses.items()}))"
    return json.loads(in_colmap(code, json.dumps([CURVED, LOCAL.tolist()])))


@pytest.mark.parametrize("kind", ["transforms", "text"])
@pytest.mark.parametrize("model", CURVED)
def test_each_lens_is_colmaps_in_every_format(tmp_path, model, kind, projected):
    noise(tmp_path, NAMES)
    values = CURVED[model]
    if kind == "text":
        write_text_model(tmp_path / "sparse", f"1 {model} 120 90 {' '.join(map(str, values))}")
        given = tmp_path / "sparse"
    else:
        names = PARAMETERS[model]
        known = {{"f": "fl_x", "fx": "fl_x", "fy": "fl_y"}.get(n, n): v for n, v in zip(names, values, strict=True)}
        given = write_transforms(tmp_path, camera_model=model, **known)
    prepared, _ = prepare_photos(given, fresh(tmp_path / "out"), long_side=96)
    assert load_photos(tmp_path / "out") == prepared and prepared[0].original == SIZE
    view = load_views(tmp_path / "out" / KNOWN_CAMERAS)[0]
    points = (LOCAL - view.translation) @ view.rotation
    found = prepared[0].prepared(np.array(projected[model]), view)
    np.testing.assert_allclose(found, view.project(points)[0], atol=1e-6)


def test_depth_and_confidence_among_the_photos_are_named_and_not_used(tmp_path):
    """As a phone's scanner writes them: with the numbers of the photos."""
    names = ("frame_{:05d}.jpg", "depth_{:05d}.png", "conf_{:05d}.png")
    source = find_source(noise(tmp_path, [name.format(k) for name in names for k in range(4)]))
    assert [path.name for path in source.photos] == [f"frame_{k:05d}.jpg" for k in range(4)] and not source.masks
    assert source.notes == (
        "4 pictures are confidence of photos, by their names (first: conf_00000.png): they are not used",
        "4 pictures are depth of photos, by their names (first: depth_00000.png): they are not used",
    )


@pytest.mark.parametrize("name", ["{}_mask.png", "{}.mask.png", "Mask-{}.png"])
def test_masks_among_the_photos_are_masks(tmp_path, name):
    noise(tmp_path / "in", [f"{k:03d}.png" for k in range(3)])
    half = np.zeros((90, 120), np.uint8)
    half[:, :60] = 255
    for k in range(3):
        Image.fromarray(half).save(tmp_path / "in" / name.format(f"{k:03d}"))
    photos, notes = prepare_photos(tmp_path / "in", fresh(tmp_path / "out"))
    assert [photo.source for photo in photos] == ["000.png", "001.png", "002.png"] and all(p.mask for p in photos)
    with Image.open(tmp_path / "out" / "masks" / "0000.jpg.png") as mask:
        assert (np.asarray(mask) == half).all()
    assert len(notes) == 1 and "3 pictures are masks of photos" in notes[0]


def test_folders_called_image_and_mask_are_photos_and_masks(tmp_path):
    noise(tmp_path / "image", ["a.png", "b.png", "c.png"])
    noise(tmp_path / "mask", ["a.png", "b.png", "c.png"])
    source = find_source(tmp_path)
    assert [path.parent.name for path in source.photos] == ["image"] * 3
    assert {photo.name: mask for photo, mask in source.masks.items()} == {
        f"{name}.png": tmp_path / "mask" / f"{name}.png" for name in "abc"
    }


@pytest.mark.parametrize("names", [["mask_1.png", "mask_2.png", "mask_3.png"], ["a.png", "b.png", "my mask.png"]])
def test_photos_of_masks_are_photos(tmp_path, names):
    """There is no other picture of the same number or name."""
    source = find_source(noise(tmp_path, names))
    assert sorted(path.name for path in source.photos) == sorted(names) and source.notes == ()


@pytest.mark.parametrize("given", ["sparse", "sparse/0", "sparse/1"])
def test_of_several_models_the_largest_is_used_and_all_are_named(tmp_path, given):
    """COLMAP leaves one for each set of photos that it cannot join; 0 is not always the larger."""
    noise(tmp_path / "images", NAMES)
    write_text_model(tmp_path / "sparse" / "1")
    write_text_model(tmp_path / "sparse" / "0")
    lines = (tmp_path / "sparse" / "0" / "images.txt").read_text().splitlines()
    (tmp_path / "sparse" / "0" / "images.txt").write_text("\n".join(lines[:3]) + "\n")  # of one photo
    source = find_source(tmp_path / given)
    assert len(source.photos) == 3 and source.cameras == tmp_path / "sparse" / "1"
    assert source.notes[0].endswith("holds 2 models (1 photos in 0, 3 photos in 1): the largest, 1, is used")


@pytest.mark.parametrize(
    ("name", "content", "says", "instead"),
    [
        ("sfm_data.json", {"sfm_data_version": "0.3", "views": [], "extrinsics": []}, "OpenMVG", "openMVG2Colmap"),
        ("reconstruction.json", [{"cameras": {}, "shots": {"a.jpg": {}}}], "OpenSfM", "export_colmap"),
        ("camera_models.json", {"v2 x": {"projection_type": "perspective", "width": 1}}, "OpenSfM", "export_colmap"),
        ("cameras.json", [{"id": 0, "img_name": "a", "position": [0, 0, 0]}], "3D Gaussian splatting", "sparse/0"),
        ("sfm.json", {"version": ["1", "2"], "views": [], "intrinsics": []}, "Meshroom", "COLMAP"),
        ("c.json", {"points": [], "colors": []}, "it has no `frames`, but colors, points", ""),
        ("c.json", [], "it has no `frames`, but nothing", ""),
        ("c.json", {"fl_x": 1, "w": 1, "h": 1, "frames": [{"file_path": "a"}]}, "it has no 'transform_matrix'", ""),
    ],
)  # fmt: skip
def test_json_files_of_other_programs_are_named_with_what_to_give_or_told_what_they_lack(
    tmp_path, name, content, says, instead
):
    (tmp_path / name).write_text(json.dumps(content))
    with pytest.raises(SdfsimError, match=f"{name}: is a file of {says}" if instead else says) as caught:
        find_source(tmp_path / name)
    assert instead in caught.value.hint and "transforms.json" in caught.value.hint
    assert "KeyError" not in str(caught.value)


NUMBERED = ["0.jpg", "1.jpg", "2.jpg"]


def mask(path: Path, columns: slice) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.zeros((90, 120), np.uint8)
    pixels[:, columns] = 255
    Image.fromarray(pixels).save(path)


def test_masks_by_object_become_labels_and_say_nothing_where_there_are_none(tmp_path):
    folder = noise(tmp_path / "in" / "images", NUMBERED)
    mask(tmp_path / "in" / "masks" / "cup" / "0.png", slice(0, 60))
    mask(tmp_path / "in" / "masks" / "vase" / "0.jpg.png", slice(50, 100))
    mask(tmp_path / "in" / "masks" / "vase" / "1.png", slice(50, 100))
    mask(tmp_path / "in" / "masks" / "vase" / "z.png", slice(50, 100))
    out = tmp_path / "out"
    out.mkdir()
    prepared, notes = prepare_photos(folder, out)
    assert load_names(out) == ["cup", "vase"]
    both, one = load_labels(out, "0000.jpg"), load_labels(out, "0001.jpg")
    assert both is not None and one is not None and load_labels(out, "0002.jpg") is None
    assert [both[5, x] for x in (10, 55, 80, 110)] == [1, UNKNOWN, 2, 0]
    assert [one[5, x] for x in (10, 80)] == [UNKNOWN, 2]  # the photo may show a cup that nobody marked
    assert [note.endswith("masks/vase belong to no photo (first: z.png)") for note in notes] == [True]
    assert not any(photo.mask for photo in prepared)
    assert tmp_path / "in" / "masks" / "cup" / "0.png" in find_source(folder).files()


@pytest.mark.parametrize("kind", ["palette", "8 bits", "16 bits"])
def test_label_images_keep_their_numbers_as_names(tmp_path, kind):
    folder = noise(tmp_path / "in", NUMBERED)
    values = np.zeros((90, 120), np.uint16 if kind == "16 bits" else np.uint8)
    values[:40], values[40:60] = 7, 1000 if kind == "16 bits" else 9
    image = Image.fromarray(values)
    if kind == "palette":
        image.putpalette(list(range(256)) * 3)
    (folder / "labels").mkdir()
    image.save(folder / "labels" / "1.png")
    prepare_photos(folder, tmp_path, long_side=60)
    assert load_names(tmp_path) == ["object7", "object1000" if kind == "16 bits" else "object9"]
    found = load_labels(tmp_path, "0001.jpg")
    assert found is not None and found.shape == (45, 60)
    assert [found[y, 3] for y in (5, 25, 40)] == [1, 2, 0] and set(np.unique(found)) == {0, 1, 2}


def test_labels_are_straightened_with_the_lens(tmp_path):
    """A grey photo that shows the labels themselves has them in the same places afterwards."""
    folder = noise(tmp_path / "in", NUMBERED)
    pixels = np.zeros((90, 120), np.uint8)
    pixels[20:70, 30:100] = 200
    Image.fromarray(pixels).convert("RGB").save(folder / "0.jpg", quality=98)
    (folder / "labels").mkdir()
    Image.fromarray(pixels).save(folder / "labels" / "0.png")
    prepare_photos(write_transforms(folder, NUMBERED, k1=0.2, k2=-0.05), tmp_path)
    found = load_labels(tmp_path, "0000.jpg")
    with Image.open(tmp_path / "images" / "0000.jpg") as image:
        shown = np.asarray(image.convert("L")) > 100
    assert found is not None and (found > 0).sum() > 1000
    assert ((found > 0) != shown).mean() < 0.02 and not np.array_equal(found > 0, pixels > 0)


@pytest.mark.parametrize(
    ("name", "file", "why"),
    [("cup", "z.png", "belong to no photo"), ("my cup", "0.png", "no body can have this name"),
     ("no", "0.png", "no body can have this name"), ("scene", "0.png", "no body can have this name")],
)  # fmt: skip
def test_masks_of_no_use_are_refused(tmp_path, name, file, why):
    folder = noise(tmp_path / "in", NUMBERED)
    mask(folder / "masks" / name / file, slice(0, 9))
    with pytest.raises(SdfsimError, match=why):
        find_source(folder)


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
    out = fresh(tmp_path / "photos")
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


@pytest.mark.parametrize(("every", "left"), [(3, 0.7), pytest.param(2, 0.5, marks=pytest.mark.slow)])
def test_the_poses_of_a_phone_are_refined(tmp_path, every, left):
    """With every third photo of the room, few pairs look into the vase from near, and the error only halves."""
    phone.write("polycam", tmp_path / "capture", every=every)
    folder, out = tmp_path / "photos", tmp_path / "poses"
    folder.mkdir()
    out.mkdir()
    photos, _ = prepare_photos(tmp_path / "capture", folder)
    solve(photos, folder, out)
    frames = json.loads((TABLE_VASE / "transforms.json").read_text())["frames"][::every]
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
    assert shape_error(found) < left * shape_error(given)
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
    out = fresh(tmp_path / "photos")
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
    out = fresh(tmp_path / "out")
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
    better = fresh(given / "keyframes" / "corrected_cameras")
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
    out = fresh(tmp_path / "out")
    assert [photo.source for photo in prepare_photos(given, out)[0]] == names
    noise(tmp_path / "in", [f"{side}/{name}" for side in ("left", "right") for name in names])
    for name in names:
        (tmp_path / "in" / name).unlink()
    given = wrapped(tmp_path / "in", tmp_path / "b.zip", "holiday", previews=1)
    (tmp_path / "other").mkdir()
    with pytest.raises(SdfsimError, match=r"b\.zip: .*\b1\b.* 3 in .*b\.zip/holiday/left, 3 in"):
        prepare_photos(given, tmp_path / "other")
