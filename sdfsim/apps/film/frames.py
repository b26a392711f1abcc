"""The frames of a film, upright, with the times at which they were taken."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.base.parallel import Progress, silent

WIDE = 640  # px: larger pictures are made smaller
MOST = 1500  # frames that are kept in memory
LEAST = 8
SAME = 0.3  # of the usual change between frames: less is a repetition
EVEN = 0.05  # of the spacing: times that are off by less are even


@dataclass(frozen=True)
class Clip:
    """T frames of a film."""

    path: Path
    time: np.ndarray  # [T] s of the motion
    pixels: np.ndarray  # [T, H, W, 3] uint8 RGB
    smaller: float = 1.0  # how many times smaller they are than those of the film
    notes: tuple[str, ...] = ()

    @property
    def step(self) -> float:
        """s, the usual time between two frames."""
        return float(np.median(np.diff(self.time)))

    @property
    def even(self) -> bool:
        off = self.time - self.time[0] - self.step * np.arange(len(self.time))
        return float(np.abs(off).max()) < EVEN * self.step


def read_clip(
    path: Path, *, slow: float = 1.0, start: float | None = None, end: float | None = None,
    on_progress: Progress = silent,
) -> Clip:  # fmt: skip
    """Read the frames from `start` to `end` s of the film; `slow`: how many times slower it plays than things moved.
    Raises SdfsimError if it cannot be read, or if too few or too many frames remain."""
    import av
    from av.error import FFmpegError

    times, pictures, small = [], [], 1.0
    try:
        with av.open(str(path)) as film:
            stream = film.streams.video[0]
            for frame in film.decode(stream):
                now = float(frame.time or 0.0)
                if now < (start or 0.0) - 1e-6 or (end is not None and now > end + 1e-6):
                    continue
                small = min(1.0, WIDE / max(frame.width, frame.height))
                size = {"width": round(frame.width * small), "height": round(frame.height * small)}
                pixels = frame.reformat(**size, format="rgb24", interpolation="AREA").to_ndarray()
                pictures.append(np.rot90(pixels, round(frame.rotation / 90)))
                times.append(now)
                if len(times) > MOST:
                    raise SdfsimError(f"{path}: more than {MOST} frames", "choose a part with --start and --end")
                if len(times) % 20 == 0:
                    on_progress(min(0.99, len(times) / max(stream.frames, len(times), 1)), f"frame {len(times)}")
    except (FFmpegError, IndexError) as error:
        raise SdfsimError(f"{path}: not a film that can be read ({error})") from error
    if len(times) < LEAST:
        raise SdfsimError(f"{path}: {len(times)} frames (at least {LEAST})", "check --start and --end")
    time, kept, note = true_times(np.array(times), np.stack(pictures))
    return Clip(Path(path), time / slow, np.stack([pictures[k] for k in kept]), 1.0 / small, note)


def true_times(time: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Times [K] s of frames, the frames [K] that were kept, and notes.

    No camera gives the same picture twice: noise differs. If single frames repeat the one before, the film was copied
    at another rate, and its times are those of the copy; the camera's own are even.
    """
    small = pixels[:, ::2, ::2].astype(np.int16)
    change = np.array([np.abs(now - before).mean() for before, now in pairwise(small)])
    small = np.r_[False, change < SAME * np.median(change)]
    alone = small & ~np.r_[False, small[:-1]] & ~np.r_[small[1:], False]
    every = np.arange(len(time))
    if alone.sum() < 2 or (small & ~alone).any():  # at rest many frames in a row are alike
        return time, every, ()
    kept = every[~alone]
    gaps = np.diff(time[kept])
    step = float(gaps.mean())
    number = np.r_[0, np.cumsum([1 if SAME * step < gap < 2.5 * step else round(gap / step) for gap in gaps])]
    last = np.r_[number[1:] != number[:-1], True]  # a repetition that compression hid comes just before the next frame
    kept, number = kept[last], number[last]
    step, first = np.polyfit(number, time[kept], 1)
    note = (
        f"{len(time) - len(kept)} of {len(time)} frames repeat others: frames are taken to be 1/{1 / step:.4g} s apart"
    )
    return first + step * number, kept, (note,)
