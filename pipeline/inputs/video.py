"""A video -> its sharpest frames, spread evenly over the motion of the camera."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from pipeline.inputs.images import reduced, sharpness
from sdfsim.base.errors import EXIT_QUALITY, SdfsimError

SMALL, MIDDLE = 256, 960  # px, longer side of the frames for measuring motion and sharpness
STEP = 0.07  # of the picture's width: motion from one chosen frame to the next
FEWEST, MOST = 24, 100
STILLS = {"image2", "tty"}  # formats of the decoder
LEAST_MOTION = 0.5  # picture widths in total: less is not a walk around an object


def frames_of(path: Path) -> Iterator[np.ndarray]:
    """The frames of a video, upright RGB [H, W, 3] uint8; none if it cannot be decoded. A damaged end ends the film."""
    import av
    from av.error import FFmpegError

    with suppress(FFmpegError, IndexError), av.open(str(path)) as film:
        film.streams.video[0].thread_type = "AUTO"
        for frame in film.decode(video=0):
            yield np.ascontiguousarray(np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90)))


def is_film(path: Path) -> bool:
    """Whether a file holds moving pictures, whatever its name; text and single pictures, which the decoder would show
    as well, do not count."""
    import av
    from av.error import FFmpegError
    from av.stream import Disposition

    with suppress(FFmpegError), av.open(str(path)) as film:
        still = Disposition.attached_pic  # of a sound file
        moving = [stream for stream in film.streams.video if not stream.disposition & still]
        return bool(moving) and film.format.name not in STILLS and not film.format.name.endswith("_pipe")
    return False


def follow(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """First pass: how far the picture has moved up to each frame [F], in picture widths, and how sharp each is [F].

    Motion is the median displacement of corners that Lucas-Kanade tracking finds again; if most are lost, it is one
    step. Raises SdfsimError if the video cannot be decoded.
    """
    import cv2

    def shrunk(frame: np.ndarray, longest: int) -> np.ndarray:
        return cv2.resize(frame, reduced(frame.shape[1::-1], longest), interpolation=cv2.INTER_AREA)

    before, moved, sharp = None, [], []
    for frame in frames_of(path):
        frame = shrunk(frame, MIDDLE)
        sharp.append(sharpness(frame))
        grey = cv2.cvtColor(shrunk(frame, SMALL), cv2.COLOR_RGB2GRAY)
        step = 0.0
        if before is not None:
            corners = cv2.goodFeaturesToTrack(before, 200, 0.01, 6)
            if corners is not None and len(corners) >= 8:
                found, status, _ = cv2.calcOpticalFlowPyrLK(before, grey, corners, np.empty_like(corners))
                kept = status.ravel() == 1
                shift = np.linalg.norm((found - corners).reshape(-1, 2)[kept], axis=1)
                step = float(np.median(shift)) / grey.shape[1] if kept.mean() > 0.4 else STEP
        moved.append((moved[-1] if moved else 0.0) + step)
        before = grey
    if not moved:
        raise SdfsimError(f"{path}: cannot be decoded as a video", "convert it to MP4 (H.264)")
    return np.array(moved), np.array(sharp)


def choose_frames(moved: np.ndarray, sharp: np.ndarray) -> list[int]:
    """Frames to use, in order: the sharpest frame of each of equal stretches of the motion; at least `FEWEST` if the
    video has as many, at most `MOST`."""
    total = float(moved[-1])
    count = int(np.clip(round(total / STEP) + 1, FEWEST, MOST))
    stretch = np.minimum((moved / max(total, 1e-9) * count).astype(int), count - 1)
    return [int(max(np.flatnonzero(stretch == k), key=lambda i: sharp[i])) for k in np.unique(stretch)]


def chosen_frames(path: Path) -> Iterator[tuple[str, np.ndarray, float]]:
    """Name, pixels RGB [H, W, 3] uint8 and share done of each frame worth using. Raises SdfsimError if the video
    cannot be decoded, has hardly any frames, or (exit code 3) hardly moves."""
    import av

    moved, sharp = follow(path)
    with av.open(str(path)) as film:
        rate, told = float(film.streams.video[0].average_rate or 30.0), film.streams.video[0].frames
    if len(sharp) < FEWEST:
        if len(sharp) >= 0.9 * told:  # the file is complete, but short
            message = f"{path}: a clip of only {len(sharp)} frames (at least {FEWEST} are needed)"
            raise SdfsimError(message, "film for longer: half a minute, all the way around the object")
        message = f"{path}: only {len(sharp)} of {told} frames can be decoded (at least {FEWEST} are needed)"
        raise SdfsimError(message, "check that the video is complete, or convert it to MP4 (H.264)")
    if moved[-1] < LEAST_MOTION:
        message = f"{path}: the picture hardly moves (by {moved[-1]:.2f} picture widths in all)"
        raise SdfsimError(message, "walk around the object while filming", exit_code=EXIT_QUALITY)
    wanted = choose_frames(moved, sharp)
    left = set(wanted)
    for index, frame in enumerate(frames_of(path)):
        if index in left:
            left.remove(index)
            yield f"{path.name} at {index / rate:.2f} s", frame, 1 - len(left) / len(wanted)
        if not left:
            return
