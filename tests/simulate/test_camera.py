"""A camera's depth, bodies and colours against closed forms, and its conventions against OpenCV's."""

from dataclasses import replace

import numpy as np
import pytest

import sdfsim
from sdfsim import Camera, SdfsimError, Simulator, Style
from sdfsim.scene.scene import Scene
from sdfsim.simulate.looks import STATIC_COLOR, body_colors


def still(**bodies: dict) -> Simulator:
    scene = sdfsim.Scene(gravity=(0, 0, -9.81))
    for name, keys in bodies.items():
        scene.add(name, **keys)
    return Simulator(scene)


def cube(size: float, *position: float, **keys) -> dict:
    return {"box": {"size": (size, size, size)}, "position": position, **keys}


@pytest.mark.parametrize(("width", "height"), [(128, 128), (60, 120), (121, 60)])
def test_a_sphere_has_the_depth_and_the_outline_of_a_sphere(width: int, height: int):
    radius, away, fov = 0.5, 3.0, 40.0
    seen = still(ball={"sphere": {"radius": radius}, "position": (1.0, 2.0, 3.0)})
    camera = Camera((1.0, 2.0 - away, 3.0), (1.0, 2.0, 3.0), fov=fov, width=width, height=height)
    color, depth, body = camera.image(seen)
    assert color.shape == (height, width, 3) and color.dtype == np.uint8 and depth.dtype == np.float32
    assert ((body == 0) == np.isfinite(depth)).all() and set(np.unique(body)) == {-1, 0}
    focal = height / 2 / np.tan(np.radians(fov / 2))
    across, down = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    ray = np.stack([across / focal, down / focal, np.ones_like(down)], -1)
    ray2, middle = (ray**2).sum(-1), away
    root = middle**2 - ray2 * (away**2 - radius**2)
    wanted = np.where(root > 0, (middle - np.sqrt(np.maximum(root, 0.0))) / ray2, np.inf)
    inner = root > 0.1  # at the rim the ball's triangles lie deepest below it
    assert np.abs(depth[inner] - wanted[inner]).max() < 0.005
    assert (body == 0).sum() == pytest.approx((root > 0).sum(), rel=0.03)


def test_a_plane_has_the_depth_of_a_plane_from_above_and_from_below():
    tilted = still(floor={"plane": {"normal": (0.2, -0.1, 1.0), "offset": 0.3}})
    normal = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
    for position in ((1.0, -2.0, 1.5), (1.0, -2.0, -4.0)):
        camera = Camera(position, (0.3, 0.2, 0.1), width=64, height=48)
        depth = camera.image(tilted).depth
        rows, columns = np.nonzero(np.isfinite(depth))
        assert len(rows) > 1000
        lens = 48 / 2 / np.tan(np.radians(20.0))
        away = depth[rows, columns].astype(float)
        seen = np.stack([(columns + 0.5 - 32) / lens, (rows + 0.5 - 24) / lens, np.ones(len(rows))], 1) * away[:, None]
        points = seen @ camera.rotation + position
        assert np.abs(points @ normal - 0.3).max() < 1e-5 * away.max()


def test_two_boxes_are_told_apart_and_what_is_behind_the_camera_is_not_seen():
    seen = still(
        near=cube(0.4, -0.3, 0, 0), far=cube(1.0, 0.1, 2, 0), behind=cube(1.0, 0, -8, 0), around=cube(0.2, 0.5, -4, 0)
    )
    _, depth, body = Camera((0, -4, 0), width=50, height=100, fov=50.0).image(seen)
    scale = 100 / 2 / np.tan(np.radians(25.0))

    def at(x: float, away: float) -> tuple[int, float]:
        column = int(25 + scale * x / away)
        return int(body[50, column]), float(depth[50, column])

    assert at(-0.3, 3.8) == (0, pytest.approx(3.8, abs=1e-5))
    assert at(0.3, 5.5) == (1, pytest.approx(5.5, abs=1e-5))
    assert at(-0.08, 3.8)[0] == 1 and at(1.2, 5.5)[0] == -1
    assert set(np.unique(body)) == {-1, 0, 1}
    assert (body == 0).sum() == pytest.approx((0.4 * scale / 3.8) ** 2, rel=0.06)


def test_its_pixels_are_those_of_opencv_and_colmap():
    import cv2

    turn = cv2.Rodrigues(np.array([0.4, -0.7, 0.2]))[0]
    move, focal, principal = np.array([0.2, -0.1, 3.0]), (80.0, 95.0), (70.0, 40.0)
    camera = Camera.posed(turn, move, focal, 120, 90, principal)
    np.testing.assert_allclose(camera.rotation, turn, atol=1e-12)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    lens = np.array([[focal[0], 0, principal[0] - 0.5], [0, focal[1], principal[1] - 0.5], [0, 0, 1]])
    wanted = cv2.projectPoints(points, cv2.Rodrigues(turn)[0], move, lens, None)[0][:, 0] + 0.5
    places, depth = camera.project(points)
    np.testing.assert_allclose(places, wanted, atol=1e-9)
    np.testing.assert_allclose(depth, (points @ turn.T + move)[:, 2])
    for point in points[:3]:
        seen = camera.image(still(dot={"sphere": {"radius": 0.12}, "position": point})).segmentation
        rows, columns = np.nonzero(seen == 0)
        assert (columns.mean() + 0.5, rows.mean() + 0.5) == pytest.approx(tuple(camera.project(point)[0]), abs=0.7)


def test_it_follows_bodies_and_reads_any_frame_of_a_run():
    scene = sdfsim.Scene(gravity=(0, 0, -9.81)).add("ball", sphere={"radius": 0.2}, position=(0, 0, 0)).load()
    simulator, camera = Simulator(scene), Camera((0, -3, 0), width=64, height=64)
    rollout = simulator.run(seconds=0.2)
    first, last = camera.image(rollout, scene, frame=0), camera.image(rollout, scene)
    live = camera.image(simulator)
    for key in ("color", "depth", "segmentation"):
        np.testing.assert_array_equal(getattr(last, key), getattr(live, key))
    fallen = np.subtract(*(np.nonzero(seen.segmentation == 0)[0].mean() for seen in (last, first)))
    pixel = 32 / np.tan(np.radians(20.0)) / 3
    assert fallen == pytest.approx(0.5 * 9.81 * rollout.time[-1] ** 2 * pixel, abs=0.5)


def test_bodies_and_the_background_may_be_transparent():
    seen = still(front=cube(0.5, 0, 0, 0), back=cube(1.0, 0, 2, 0))
    camera = Camera((0, -3, 0), width=40, height=40)
    plain = camera.image(seen)
    clear = camera.image(seen, style=Style(background=None, opacity={"front": 0.0}))
    half = camera.image(seen, style=Style(opacity={"front": 0.5}))
    assert plain.segmentation[20, 20] == 0 and (clear.segmentation[20, 20], half.segmentation[20, 20]) == (1, 1)
    assert clear.color.shape == (40, 40, 4) and clear.color[0, 0, 3] == 0 and clear.color[20, 20, 3] == 255
    behind = clear.color[20, 20, :3].astype(float)
    assert half.color[20, 20] == pytest.approx((behind + plain.color[20, 20]) / 2, abs=2.0)


def test_the_camera_that_fits_does_not_follow_a_coin_that_rolls_away():
    scene = sdfsim.Scene(gravity=(0, 0, -9.81)).add("floor", plane={})
    for k in range(6):
        scene.add(f"box{k}", **cube(0.1, 0.12 * k - 0.3, 0, 0.05))
    known = scene.load()
    run = Simulator(known).run(seconds=0.1)
    place = np.repeat(run.position[:1], 50, 0)
    at_rest = Camera.fit(replace(run, position=place, time=np.arange(50.0)), known)
    place = place.copy()
    place[:, 6, 0] += np.linspace(0.0, 30.0, 50)
    rolled = Camera.fit(replace(run, position=place, time=np.arange(50.0)), known)
    far = [float(np.linalg.norm(np.subtract(of.position, of.look_at))) for of in (at_rest, rolled)]
    assert far[1] < 2 * far[0]


def test_a_body_has_the_colour_of_the_scene_whether_it_moves_or_not(tmp_path):
    scene = sdfsim.Scene().add("base", **cube(1.0, 0, 0, 0, motion="static", color=(250, 250, 250)))
    scene.add("grey", **cube(1.0, 3, 0, 0, motion="static")).add("red", **cube(1.0, 6, 0, 0, color=(200, 10, 10)))
    known: Scene = sdfsim.load_scene(scene.save(tmp_path / "scene.yaml"))
    assert body_colors(known) == [(250, 250, 250), STATIC_COLOR, (200, 10, 10)]
    color, _, body = Camera((3, -14, 3), (3, 0, 0), width=120, height=60).image(Simulator(known))
    base, grey, red = (color[body == k].mean(0) for k in range(3))
    assert base.min() > 1.4 * grey.max() and red[0] > 10 * red[1]
    with pytest.raises(SdfsimError, match=r"color\[1\]|color.*255"):
        sdfsim.Scene().add("base", **cube(1.0, 0, 0, 0, color=(250, 300, 0))).load()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Camera((1, 2, 3), (1, 2, 3)), "different"),
        (lambda: Camera((1, 2, np.nan)), "position must be"),
        (lambda: Camera((1, 2, 3), fov=180.0), "fov"),
        (lambda: Camera((1, 2, 3), width=0), "above zero"),
        (lambda: Camera((1, 2, 3)).image(still(a=cube(1, 0, 0, 0)), style=Style(opacity={"b": 0.5})), "'b'"),
        (lambda: Camera((1, 2, 3)).image(still(a=cube(1, 0, 0, 0)), style=Style(light=(0, 0, 0))), "light"),
        (lambda: Camera((1, 2, 3)).image(still(a=cube(1, 0, 0, 0)).initial_rollout()), "needs its scene"),
    ],
)
def test_what_no_camera_can_be_is_said(make, message: str):
    with pytest.raises(SdfsimError, match=message):
        make()
