"""Where a camera stood in a room that photos showed: a painted corner in place of a reconstruction."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim import Camera
from sdfsim.apps.film.camera import of_points
from sdfsim.apps.film.room import of_room, photos_of
from sdfsim.base.errors import SdfsimError

SIZE = 320, 240
# From the reconstruction's axes and units to metres, with a step between.
UNIT = {"scale": 0.25, "rotation": np.eye(3)[[1, 2, 0]].tolist(), "translation": [0.1, -0.2, 0.3]}
SCALE, TURN, SHIFT = 0.7, Rotation.from_euler("xyz", [30, -50, 80], degrees=True).as_matrix(), np.array([0.3, -1, 2])


def painted(seed: int) -> np.ndarray:
    """[S, S, 3] a wall with blots of many sizes."""
    import cv2

    draw = np.random.default_rng(seed)
    wall = np.full((900, 900, 3), 128.0, np.float32)
    for size in (8, 20, 60, 150):
        blots = draw.uniform(-90, 90, (900 // size + 2,) * 2 + (3,)).astype(np.float32)
        wall += cv2.resize(blots, (900, 900), interpolation=cv2.INTER_CUBIC) * (0.4 if size > 20 else 0.6)
    return wall.clip(0, 255)


WALLS = [painted(k) for k in range(3)]


def where(camera: Camera, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a camera sees the corner of a room of 3 m at pixels [...]: places [..., 3] m, and the axes across walls."""
    wide, high = SIZE
    focal = camera.lens[0, 0]
    rays = np.stack([(x - wide / 2) / focal, (y - high / 2) / focal, np.ones_like(x)], -1) @ camera.rotation
    start = np.asarray(camera.position)
    far = np.where(rays < 0, -start / np.minimum(rays, -1e-9), np.inf)
    return start + rays * far.min(-1)[..., None], far.argmin(-1)


def seen(camera: Camera) -> np.ndarray:
    """What a camera sees, [H, W, 3]."""
    import cv2

    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    place, axis = where(camera, x, y)
    picture = np.zeros((*x.shape, 3), np.float32)
    for k, wall in enumerate(WALLS):
        u, v = (place[..., other].astype(np.float32) * 300 for other in ((k + 1) % 3, (k + 2) % 3))
        shown = cv2.remap(cv2.GaussianBlur(wall, (0, 0), 1.5), u, v, cv2.INTER_LINEAR)
        picture[axis == k] = shown[axis == k]
    return picture.round().clip(0, 255).astype(np.uint8)


def at(k: float, fov: float = 50.0) -> Camera:
    place = (2.2 + 0.5 * np.cos(k), 2.2 + 0.5 * np.sin(k), 1.6 + 0.1 * k)
    return Camera(place, look_at=(0.5, 0.6, 0.4), fov=fov, width=SIZE[0], height=SIZE[1])


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """The files of a reconstruction that tell where its photos show what."""
    import cv2

    folder = tmp_path_factory.mktemp("room")
    for name in ("poses", "mesh", "distill", "photos/images"):
        (folder / name).mkdir(parents=True)
    (folder / "scene.yaml").write_text("version: 1\n")
    views, places = [], []
    for k in range(6):
        camera = at(k)
        picture = seen(camera)
        cv2.imwrite(str(folder / f"photos/images/{k}.png"), picture[..., ::-1])
        keys = cv2.SIFT.create(500).detect(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), None)
        places.append(where(camera, *(np.array([key.pt for key in keys]).T + 0.5))[0])
        # A point p of the reconstruction is at SCALE TURN p + SHIFT m.
        rotation = camera.rotation @ TURN
        translation = camera.rotation @ (SHIFT - camera.position) / SCALE
        views.append({"name": f"{k}.png", "focal": camera.lens[0, 0], "cx": 160, "cy": 120, "k": 0.0,
                      "rotation": rotation.tolist(), "translation": translation.tolist()})  # fmt: skip
    xyz = (np.concatenate(places) - SHIFT) @ TURN / SCALE
    every = np.arange(len(xyz))
    np.savez(
        folder / "poses/sparse.npz", xyz=xyz, point_of=np.tile(every, 6), view_of=np.repeat(np.arange(6), len(xyz))
    )
    (folder / "poses/cameras.json").write_text(json.dumps({"views": views}))
    (folder / "distill/field.json").write_text(json.dumps({"to_unit": UNIT}))
    turn, scale = TURN @ np.array(UNIT["rotation"]).T, SCALE / UNIT["scale"]
    shift = SHIFT - scale * turn @ UNIT["translation"]
    way = {"scale": scale, "rotation": turn.tolist(), "translation": shift.tolist()}
    (folder / "mesh/placement.json").write_text(json.dumps({"to_metres": way}))
    return folder


@pytest.mark.parametrize(("where", "fov"), [(2.5, 50.0), (0.7, 35.0), (4.4, 65.0)])
def test_a_camera_is_found_by_what_it_sees_of_the_room(room: Path, where: float, fov: float) -> None:
    """Its place, where it looks, and its focal length, which no photo has."""
    camera = at(where, fov)
    points = of_room(seen(camera), room, "clip.mp4")
    assert np.linalg.norm(camera.project(points.places)[0] - points.pixels, axis=1).max() < 5.0
    eye = of_points(points, SIZE, "clip.mp4")
    assert np.rad2deg(Rotation.from_matrix(eye.rotation @ camera.rotation.T).magnitude()) < 0.5
    assert eye.focal == pytest.approx(camera.lens[0, 0], rel=0.03)
    center = -eye.rotation.T @ eye.translation
    assert np.linalg.norm(center - camera.position) < 0.05


def test_a_film_of_another_room_is_said(room: Path) -> None:
    other = np.random.default_rng(3).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    for picture in (other, np.full((240, 320, 3), 90, np.uint8)):
        with pytest.raises(SdfsimError, match=r"clip.mp4: only .* features of the room"):
            of_room(picture, room, "clip.mp4")


def test_photos_are_used_where_they_are(room: Path, tmp_path: Path) -> None:
    assert photos_of(room / "scene.yaml") == room
    assert photos_of(tmp_path / "scene.yaml") is None and photos_of(None) is None
