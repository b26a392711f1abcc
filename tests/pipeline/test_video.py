"""Frames of a video: spread over the motion, the sharpest of each stretch; drawn by ourselves."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.inputs.photos import prepare_photos
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


def test_motion_is_measured_in_picture_widths(tmp_path):
    film(tmp_path / "a.mp4", np.arange(60) * 8)
    moved, _ = follow(tmp_path / "a.mp4")
    assert len(moved) == 60 and frames_of(tmp_path / "a.mp4")[1] == 25
    assert moved[-1] == pytest.approx(59 * 8 / WIDTH, rel=0.1)


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


def test_a_film_without_motion_is_refused_with_the_reason(tmp_path):
    film(tmp_path / "a.mp4", np.full(60, 100))
    with pytest.raises(SdfsimError, match="hardly moves") as caught:
        prepare_photos(tmp_path / "a.mp4", tmp_path)
    assert caught.value.exit_code == EXIT_QUALITY


def test_what_is_no_video_is_named(tmp_path, capfd):
    (tmp_path / "a.mp4").write_bytes(b"nothing of the kind" * 100)
    with pytest.raises(SdfsimError, match=r"a\.mp4: "):
        prepare_photos(tmp_path / "a.mp4", tmp_path)
    assert capfd.readouterr().err == ""
