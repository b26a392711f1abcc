"""Frames of a video: spread over the motion, the sharpest of each stretch; drawn by ourselves."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.inputs.photos import prepare_photos
from pipeline.inputs.sources import find_source
from pipeline.inputs.video import FEWEST, choose_frames, follow, frames_of
from sdfsim.base.errors import EXIT_QUALITY, SdfsimError
from tests.pipeline.photo_sets import TABLE_VASE

WIDTH, HEIGHT = 320, 240


def film(path: Path, places: np.ndarray, blurred: np.ndarray | None = None) -> None:
    """A window that slides over the photos of the bundled set, at these columns (px)."""
    import cv2

    strip = np.hstack([cv2.imread(str(TABLE_VASE / "images" / f"{k:03d}.jpg")) for k in range(6)])[:HEIGHT]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, (WIDTH, HEIGHT))
    for number, place in enumerate(places):
        frame = strip[:, int(place) : int(place) + WIDTH]
        if blurred is not None and blurred[number]:
            frame = cv2.GaussianBlur(frame, (0, 0), 4)
        writer.write(np.ascontiguousarray(frame))
    writer.release()


def test_frames_follow_the_motion_not_the_time():
    """The camera rests for two thirds of the film: hardly a frame of these is wanted."""
    moved = np.concatenate([np.zeros(200), np.linspace(0, 6, 100)])
    chosen = choose_frames(moved, np.ones(300))
    assert sum(index < 200 for index in chosen) <= 2
    assert np.diff(moved[chosen]).max() < 0.15 and len(chosen) == round(6 / 0.07) + 1


def test_the_sharpest_frame_of_each_stretch_is_taken(tmp_path):
    blurred = np.arange(90) % 3 != 1
    film(tmp_path / "a.mp4", np.arange(90) * 6, blurred)
    photos, notes = prepare_photos(tmp_path / "a.mp4", tmp_path)
    frames = [round(float(p.source.split(" at ")[1].split()[0]) * 25) for p in photos]
    assert len(frames) >= FEWEST and frames == sorted(set(frames))
    assert not blurred[frames].any()
    assert not any(p.fault for p in photos) and notes == []


@pytest.mark.parametrize(
    ("places", "told", "code", "hint"),
    [
        (np.full(60, 100), "hardly moves", EXIT_QUALITY, ""),
        (np.arange(12) * 6, "a clip of only 12 frames", 1, "film for longer"),
    ],
    ids=["still", "short"],
)
def test_a_film_without_motion_and_a_short_clip_are_refused_with_the_reason(tmp_path, places, told, code, hint):
    film(tmp_path / "a.mp4", places)
    with pytest.raises(SdfsimError, match=told) as caught:
        prepare_photos(tmp_path / "a.mp4", tmp_path)
    assert caught.value.exit_code == code and hint in caught.value.hint and "convert" not in caught.value.hint


def test_what_is_no_video_is_named(tmp_path, capfd):
    (tmp_path / "a.mp4").write_bytes(b"nothing of the kind" * 100)
    with pytest.raises(SdfsimError, match=r"a\.mp4: "):
        prepare_photos(tmp_path / "a.mp4", tmp_path)
    assert capfd.readouterr().err == ""


def encode(path: Path, codec: str, container: str, frames: int = 40, turned: float = 0) -> None:
    """A film of a window that slides over a photo, by PyAV."""
    import av

    with Image.open(TABLE_VASE / "images" / "000.jpg") as image:
        strip = np.asarray(image.resize((WIDTH + 8 * frames, HEIGHT)))
    with av.open(str(path), "w", format=container) as film:
        stream = film.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        if turned:
            stream.set_display_rotation(turned)
        for number in range(frames):
            pixels = np.ascontiguousarray(strip[:, 8 * number : 8 * number + WIDTH])
            film.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        film.mux(stream.encode(None))


@pytest.mark.parametrize(
    ("name", "codec", "container"),
    [
        ("walk.mp4", "libsvtav1", "mp4"), ("WALK.MTS", "libx264", "mpegts"), ("walk.3gp", "mpeg4", "3gp"),
        ("walk.mpg", "mpeg2video", "mpeg"), ("walk.wmv", "wmv2", "asf"), ("walk", "libx264", "matroska"),
    ],
)  # fmt: skip
def test_what_can_be_decoded_is_a_film(tmp_path, name, codec, container):
    encode(tmp_path / name, codec, container)
    source = find_source(tmp_path / name)
    assert source.video == tmp_path / name
    moved, _ = follow(source.video)
    assert 38 <= len(moved) <= 40
    assert moved[-1] / (len(moved) - 1) == pytest.approx(8 / WIDTH, rel=0.1)


@pytest.mark.parametrize("turned", [0, 90, 180, -90])
def test_films_are_upright_as_opencv_shows_them(tmp_path, turned):
    """Phones store films as the sensor lies."""
    import cv2

    encode(tmp_path / "a.mp4", "libx264", "mp4", turned=turned)
    wanted = cv2.VideoCapture(str(tmp_path / "a.mp4")).read()[1][..., ::-1]
    assert np.abs(next(frames_of(tmp_path / "a.mp4")).astype(int) - wanted).mean() < 3


@pytest.mark.parametrize("name", ["notes.txt", "song.mp3", "lens.xml"])
def test_text_and_sound_are_no_films(tmp_path, name):
    (tmp_path / name).write_bytes(b"a line of text\n" * 2000)
    with pytest.raises(SdfsimError, match="not a folder, a video"):
        find_source(tmp_path / name)


def test_a_folder_with_a_film_of_any_kind_names_the_command(tmp_path):
    encode(tmp_path / "00012.MTS", "libx264", "mpegts")
    with pytest.raises(SdfsimError, match=r"it holds the video 00012\.MTS") as caught:
        find_source(tmp_path)
    assert "sdfsim reconstruct" in caught.value.hint
