"""What can be given: folders, masks, transforms.json, COLMAP models; against cameras that we know."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.cameras import load_views
from pipeline.inputs.known_cameras import read_cameras
from pipeline.inputs.photos import KNOWN_CAMERAS, load_photos, prepare_photos
from pipeline.inputs.sources import find_source
from sdfsim.errors import SdfsimError
from tests.pipeline.conftest import noise

SIZE = (120, 90)
SIMPLE = [100.0, 60.0, 45.0]


def turned(angle: float) -> np.ndarray:
    """World to camera: about the y axis."""
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def fresh(folder: Path) -> Path:
    folder.mkdir()
    return folder


NAMES = ["a.jpg", "b.jpg", "c.jpg"]


def write_transforms(folder: Path, names: list[str] = NAMES, **more) -> Path:
    frames = []
    for k, name in enumerate(names):
        pose = np.eye(4)
        pose[:3, :3] = turned(0.3 * k).T @ np.diag([1.0, -1, -1])
        pose[:3, 3] = [k, 2 * k, 3]
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    path = folder / "transforms.json"
    path.write_text(json.dumps({"fl_x": 100.0, "w": 120, "h": 90, "frames": frames, **more}))
    return path


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


def write_binary_model(folder: Path) -> None:
    from scipy.spatial.transform import Rotation

    folder.mkdir(parents=True)
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ3d", 1, 7, 0, 120, 90, *SIMPLE))
    data = struct.pack("<Q", 3)
    for k, name in enumerate(NAMES):
        x, y, z, w = Rotation.from_matrix(turned(0.3 * k)).as_quat()
        shift = -turned(0.3 * k) @ [k, 2 * k, 3]
        data += struct.pack("<I7dI", k + 1, w, x, y, z, *shift, 7) + name.encode() + b"\0"
        data += struct.pack("<Q", 2) + struct.pack("<ddq", 1.0, 2.0, -1) * 2
    (folder / "images.bin").write_bytes(data)


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


def test_a_lens_is_straightened(tmp_path):
    """Where the camera's own formula puts a ray's point before, the pinhole's has it afterwards."""
    k1, k2, p1, p2 = 0.15, -0.05, 0.002, -0.001
    fx, fy, cx, cy = 110.0, 104.0, 62.0, 43.0
    row, column = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
    x, y = (column - cx) / fx, (row - cy) / fy
    # A photo that shows the undistorted position of each of its pixels, found by fixed-point iteration.
    u, v = x.copy(), y.copy()
    for _ in range(50):
        r = u * u + v * v
        radial = 1 + k1 * r + k2 * r * r
        u = (x - 2 * p1 * u * v - p2 * (r + 2 * u * u)) / radial
        v = (y - p1 * (r + 2 * v * v) - 2 * p2 * u * v) / radial
    shown = np.stack([128 + 150 * u, 128 + 150 * v, np.zeros_like(u)], -1)
    for name in NAMES:
        (tmp_path / "images").mkdir(exist_ok=True)
        Image.fromarray((shown + 0.5).astype(np.uint8)).save(tmp_path / "images" / name.replace("jpg", "png"))
    given = write_transforms(tmp_path, [f"images/{n.replace('jpg', 'png')}" for n in NAMES], fl_x=fx, fl_y=fy, cx=cx,
                             cy=cy, k1=k1, k2=k2, p1=p1, p2=p2)  # fmt: skip
    prepare_photos(given, fresh(tmp_path / "out"))
    view = load_views(tmp_path / "out" / KNOWN_CAMERAS)[0]
    pixels = np.asarray(Image.open(tmp_path / "out" / "images" / view.name)).astype(float)
    found = (pixels[..., :2] - 128) / 150
    expected = np.stack([(column - view.cx) / view.focal, (row - view.cy) / view.focal], -1)
    inside = np.s_[4:-4, 4:-4]
    assert np.abs(found - expected)[inside].max() < 0.02  # two grey values are 0.013
    assert np.abs(found - np.stack([x, y], -1))[inside].max() > 0.03  # it was bent before


FISHEYE = {"fl_x": 80.0, "fl_y": 80.0, "cx": 62.0, "cy": 43.0}


@pytest.mark.parametrize("where", ["camera_model", "is_fisheye", "each frame", "COLMAP"])
def test_an_ideal_fisheye_is_straightened_though_its_coefficients_are_all_zero(tmp_path, where):
    """Equidistant: a ray at an angle t to the axis is f t from the middle of the photo, f tan t from the pinhole's."""
    row, column = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
    x, y = (column - FISHEYE["cx"]) / FISHEYE["fl_x"], (row - FISHEYE["cy"]) / FISHEYE["fl_y"]
    angle = np.hypot(x, y)
    u, v = x * np.tan(angle) / angle, y * np.tan(angle) / angle
    shown = np.stack([128 + 80 * u, 128 + 80 * v, np.zeros_like(u)], -1)
    (tmp_path / "images").mkdir()
    for name in NAMES:
        Image.fromarray((shown + 0.5).clip(0, 255).astype(np.uint8)).save(tmp_path / "images" / f"{name[0]}.png")
    if where == "COLMAP":
        given = tmp_path / "sparse"
        write_text_model(given, "1 OPENCV_FISHEYE 120 90 80 80 62 43 0 0 0 0")
        text = (given / "images.txt").read_text()
        (given / "images.txt").write_text(text.replace(".jpg", ".png"))
    else:
        fisheye = {"is_fisheye": True} if where == "is_fisheye" else {"camera_model": "OPENCV_FISHEYE"}
        files = [f"images/{name[0]}.png" for name in NAMES]
        given = write_transforms(tmp_path, files, **FISHEYE, **({} if where == "each frame" else fisheye))
        if where == "each frame":
            about = json.loads(given.read_text())
            about["frames"] = [{**frame, **fisheye} for frame in about["frames"]]
            given.write_text(json.dumps(about))
    prepare_photos(given, fresh(tmp_path / "out"))
    view = load_views(tmp_path / "out" / KNOWN_CAMERAS)[0]
    pixels = np.asarray(Image.open(tmp_path / "out" / "images" / view.name)).astype(float)
    found = (pixels[..., :2] - 128) / 80
    expected = np.stack([(column - view.cx) / view.focal, (row - view.cy) / view.focal], -1)
    inside = np.s_[4:-4, 4:-4]
    off = (found - expected)[inside]  # A grey value is 0.0125, half a pixel 0.006.
    assert np.abs(off).max() < 0.05 and np.abs(off.mean((0, 1))).max() < 1e-3
    assert np.abs(np.stack([x - u, y - v], -1))[inside].max() > 0.1  # so much it was bent before


def brown(x: float, y: float, k1: float, k2: float, p1: float, p2: float) -> tuple[float, float]:
    """OpenCV's distortion, as its documentation has it."""
    r = x * x + y * y
    radial = 1 + k1 * r + k2 * r * r
    return (
        x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x),
        y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y,
    )


def kannala(x: float, y: float, k1: float, k2: float, k3: float, k4: float) -> tuple[float, float]:
    """OpenCV's fisheye model."""
    r = np.hypot(x, y)
    t = np.arctan(r)
    bent = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8)
    return x * bent / r, y * bent / r


@pytest.mark.parametrize(
    ("model", "lens"),
    [
        (brown, {"k1": -0.2, "k2": 0.03, "p1": 0.002, "p2": -0.001}),
        (kannala, {"k1": 0.05, "k2": -0.02, "k3": 0.004, "k4": -0.001}),
        (kannala, {"k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0}),
        (brown, {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}),
    ],
    ids=["bent", "fisheye", "ideal fisheye", "straight"],
)
def test_a_pixel_of_the_users_photo_is_found_in_the_prepared_one(tmp_path, model, lens):
    """Points of the world, through the lens into the user's photo, from there into the smaller, cut, prepared one."""
    noise(tmp_path / "images", NAMES)
    inner = {"fl_x": 80.0, "fl_y": 80.0, "cx": 62.0, "cy": 43.0, "is_fisheye": model is kannala}
    given = write_transforms(tmp_path, [f"images/{name}" for name in NAMES], **inner, **lens)
    prepared, _ = prepare_photos(given, tmp_path, long_side=96)
    assert load_photos(tmp_path) == prepared
    photo, view = prepared[1], load_views(tmp_path / KNOWN_CAMERAS)[1]
    assert photo.original == SIZE and (photo.width, photo.height) == (96, 72)
    rays = np.random.default_rng(0).uniform([-0.6, -0.45, 1], [0.6, 0.45, 1], (50, 3))
    points = (rays * 2.5) @ view.rotation + view.center
    bent = np.array([model(x, y, *lens.values()) for x, y, _ in rays])
    pixels = bent * [80.0, 80.0] + [62.0, 43.0]
    found = photo.prepared(pixels, view)
    np.testing.assert_allclose(found, view.project(points)[0], atol=1e-6)
    scaled = np.abs(pixels * 0.8 - found).max()  # What a smaller copy alone would make of them.
    assert scaled < 1e-9 if not any(lens.values()) and model is brown else scaled > 1


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
     ('{"frames": [{"file_path": "a.jpg", "camera_model": "PANO"}]}', r"a\.jpg: camera_model: 'PANO' is not read"),
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
    with pytest.raises(SdfsimError, match=r"\./a\.jpg and a\.jpg are the same photo"):
        find_source(write_transforms(tmp_path, ["./a.jpg", *NAMES]))


def test_a_model_that_was_cut_is_one_line(tmp_path):
    write_binary_model(tmp_path / "model")
    path = tmp_path / "model" / "images.bin"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(SdfsimError, match="cannot be read as cameras"):
        read_cameras(tmp_path / "model")


def test_colmap_reads_the_model_as_we_do(tmp_path):
    """COLMAP's own reader, in a process of its own, on the same text model written as binary by it."""
    import subprocess
    import sys

    write_text_model(tmp_path / "text")
    (tmp_path / "text" / "points3D.txt").write_text("")
    (tmp_path / "binary").mkdir()
    code = "import zlib, pycolmap, sys\nm = pycolmap.Reconstruction()\nm.read_text(sys.argv[1])\n"
    code += "m.write_binary(sys.argv[2])"
    subprocess.run([sys.executable, "-c", code, tmp_path / "text", tmp_path / "binary"], check=True)
    for one, other in zip(read_cameras(tmp_path / "text"), read_cameras(tmp_path / "binary"), strict=True):
        assert one.name == other.name and one.lens.distortion == other.lens.distortion
        np.testing.assert_allclose(one.lens.matrix, other.lens.matrix)
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-12)
        np.testing.assert_allclose(one.translation, other.translation, atol=1e-12)
