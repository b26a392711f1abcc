"""Movies and pictures: where things appear, how large, in what light; and what the end of a run says."""

from dataclasses import replace

import av
import numpy as np
import pytest
from PIL import Image

import sdfsim
from sdfsim import SdfsimError, Simulator
from sdfsim.apps.render import FRAMES, SIZE, picture_at, render
from sdfsim.apps.run import ending_lines, summary
from sdfsim.geometry.mesh import Mesh
from sdfsim.scene.scene import Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.simulate.camera import Camera, Style

SKY = np.array([236, 240, 245])


def falling(**keys) -> tuple[Scene, sdfsim.Rollout]:
    scene = sdfsim.Scene(duration=0.5, gravity=(0, 0, -9.81)).add("ball", sphere={"radius": 0.1}, mass=1, **keys).load()
    return scene, Simulator(scene).run()


def seen(scene: Scene, rollout: sdfsim.Rollout, camera, look_at, time=0.0) -> np.ndarray:
    """[H, W] bool: pixels that are not sky."""
    fitted = Camera.fit(None, scene, position=camera, look_at=look_at)
    return np.abs(picture_at(fitted, scene, rollout, time, Style(smooth=True)).astype(int) - SKY).max(-1) > 8


HIGH = [(0.0, 0.0, 0.5 * k) for k in range(8)]
ROW = [(0.5 * k, 0.0, 0.0) for k in range(8)]
DEEP = [(0.0, 0.5 * k, 0.0) for k in range(8)]
GRID = [(0.3 * i, 0.3 * j, 0.3 * k) for i in range(2) for j in range(2) for k in range(3)]


@pytest.mark.parametrize(
    "places", [HIGH, ROW, DEEP, GRID, [(1.0, 2.0, 3.0)]], ids=["roof", "row", "deep", "grid", "one"]
)
@pytest.mark.parametrize("look_at", [None, (0.2, 0.1, 0.3)], ids=["middle", "aside"])
def test_all_is_in_sight_of_the_camera_that_is_chosen(places, look_at):
    """Nothing but sky is at the border of the picture, and what is shown is not small in it."""
    scene = sdfsim.Scene(gravity=(0, 0, -9.81))
    for k, place in enumerate(places):
        scene.add(f"box{k}", box={"size": (0.12, 0.12, 0.12)}, position=place)
    loaded = scene.load()
    picture = seen(loaded, Simulator(loaded).initial_rollout(), None, look_at)
    border = np.concatenate([picture[[0, -1]].ravel(), picture[:, [0, -1]].ravel()])
    assert picture.any() and not border.any()
    if look_at is None:
        rows, columns = np.nonzero(picture)
        assert max(np.ptp(rows) / SIZE[1], np.ptp(columns) / SIZE[0]) > 0.5


@pytest.mark.parametrize(("place", "where"), [((0.3, 0, 0), (1, 0)), ((0, 0, 0.2), (0, -1)), ((-0.3, 0.0, 0), (-1, 0))])
def test_right_is_right_and_up_is_up(place, where):
    """Seen along y, x goes to the right and z up, which is towards the first rows."""
    scene, rollout = falling(position=place)
    row, column = (axis.mean() for axis in np.nonzero(seen(scene, rollout, (0, -2, 0), (0, 0, 0))))
    pixel = SIZE[1] / 2 / np.tan(np.radians(20.0)) / 2  # at 2 m, so many pixels are a metre
    wanted = (SIZE[0] / 2 + where[0] * 0.3 * pixel, SIZE[1] / 2 + where[1] * 0.2 * pixel)
    assert (column, row) == pytest.approx(wanted, abs=2.0)


def test_what_is_between_the_floor_and_the_sun_throws_a_shadow():
    scene = sdfsim.Scene().add("floor", plane={}).add("box", box={"size": (0.4, 0.4, 0.1)}, position=(0, 0, 1.5)).load()
    camera, sun = Camera((0.0, -4.0, 6.0)), np.array([0.3, -0.4, 0.8])
    picture = camera.image(Simulator(scene), style=Style(light=sun, smooth=True)).color.astype(int)

    def at(point: np.ndarray) -> int:
        """Brightness of a point of the floor."""
        column, row = camera.project(point)[0]
        return picture[int(row), int(column)].sum()

    middle = np.array([0, 0, 1.5]) - sun * 1.5 / sun[2]
    inside = [at(middle + np.array([x, y, 0])) for x in (-0.13, 0.13) for y in (-0.13, 0.13)]
    outside = [at(middle + np.array([x, y, 0])) for x in (-0.27, 0.27) for y in (-0.27, 0.27)]
    assert max(inside) < 0.7 * min(outside)
    # Half of the sun is hidden from the places at which its middle just disappears.
    edge = np.mean([at(middle + 0.2 * np.array([x, y, 0])) for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1))])
    assert edge == pytest.approx((np.mean(inside) + np.mean(outside)) / 2, rel=0.15)


def test_a_texture_is_seen_where_its_places_are():
    corners = np.array([[x, 0.0, z] for z in (-1, 1) for x in (-1, 1)], dtype=float)
    uv = np.array([[0.0, 1.0], [1.0, 1.0], [0.0, 0.0], [1.0, 0.0]])  # its upper left is at -x, +z
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[0, 0], texture[0, 1], texture[1, 0], texture[1, 1] = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0)
    sheet = Mesh(corners, np.array([[0, 1, 2], [1, 3, 2]]), uv=uv, texture=texture)
    shape = replace(analytic_shape("box", size=(2.0, 0.1, 2.0)), skin=sheet)
    scene, rollout = falling(position=(0, 0, 0))
    scene = replace(scene, shapes=(shape,))
    picture = Camera((0, -6, 0)).image(rollout, scene, frame=0).color
    middle, off = np.array(SIZE[::-1]) // 2, 60
    for (row, column), color in np.ndenumerate(np.array([["r", "g"], ["b", "y"]])):
        seen = picture[middle[0] + off * (2 * row - 1), middle[1] + off * (2 * column - 1)].astype(int)
        strong = {"r": [1, 0, 0], "g": [0, 1, 0], "b": [0, 0, 1], "y": [1, 1, 0]}[str(color)]
        assert ((seen > 60) == np.array(strong, bool)).all()


def test_a_movie_has_its_frames_and_ends_as_the_picture_of_the_end(tmp_path):
    scene, rollout = falling(position=(0, 0, 1))
    render(scene, rollout, tmp_path / "fall.mp4")
    render(scene, rollout, tmp_path / "fall.png")
    with av.open(str(tmp_path / "fall.mp4")) as movie:
        stream = movie.streams.video[0]
        assert stream.codec_context.name == "h264" and stream.average_rate == FRAMES
        frames = [frame.to_ndarray(format="rgb24") for frame in movie.decode(stream)]
    assert len(frames) == round(rollout.time[-1] * FRAMES) + 1
    last = np.asarray(Image.open(tmp_path / "fall.png"), dtype=float)
    assert np.abs(frames[-1] - last).mean() < 3.0 < np.abs(frames[0].astype(float) - frames[-1]).max()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["fall.mp4", "fall.png"]


def test_size_rate_and_background_are_as_asked(tmp_path):
    scene, rollout = falling(position=(0, 0, 1))
    render(scene, rollout, tmp_path / "clear.png", size=(50, 101), background="none", at=0.0)
    pixels = np.asarray(Image.open(tmp_path / "clear.png"))
    assert pixels.shape == (101, 50, 4) and pixels[0, 0, 3] == 0 and pixels[..., 3].max() == 255
    render(scene, rollout, tmp_path / "navy.png", size=(40, 40), background="#202830")
    assert np.asarray(Image.open(tmp_path / "navy.png"))[0, 0].tolist() == [0x20, 0x28, 0x30]
    camera = Camera((0, -4, 0.5), (0, 0, 0.5), width=64, height=32)
    render(scene, rollout, tmp_path / "small.mp4", camera=camera, fps=12.5)
    with av.open(str(tmp_path / "small.mp4")) as movie:
        stream = movie.streams.video[0]
        assert (stream.width, stream.height, stream.average_rate) == (64, 32, 12.5)
        assert sum(1 for _ in movie.decode(stream)) == round(rollout.time[-1] * 12.5) + 1
    for wrong, told in (
        ({"size": (33, 32)}, "even"),
        ({"background": "none"}, "transparent"),
        ({"fps": 0.0}, "above zero"),
    ):
        with pytest.raises(SdfsimError, match=told):
            render(scene, rollout, tmp_path / "no.mp4", **wrong)
    with pytest.raises(SdfsimError, match="no such colour"):
        render(scene, rollout, tmp_path / "no.png", background="blurple")


def test_the_end_of_a_run_reports_who_rests_who_moves_and_who_is_gone():
    scene = sdfsim.Scene(duration=2.5).add("slope", plane={"normal": (0.1, 0, 1)}, friction=1.0)
    scene.add("block", box={"size": (0.1, 0.1, 0.05)}, position=(0, 0, 0.03), friction=0.8, restitution=0.0)
    scene.add("ball", sphere={"radius": 0.05}, position=(0, 0.4, 0.06), friction=0.8, restitution=0.0)
    scene.add("lost", shape="ball", position=(0, -0.4, 0.2), collides_with=[], velocity=(0, 0, -5))
    scene = scene.load()
    report = summary(scene, Simulator(scene).run(), 1.0)
    assert [(body["rests"], body["left"]) for body in report["ended"]] == [(True, False), (False, False), (False, True)]
    lines = ending_lines(report)
    assert "at rest" in lines[0] and "m/s" in lines[1] and "m/s" in lines[2]
    assert lines[3:] == ["1 of 3 bodies rest", "move: ball", "left the scene: lost"]
