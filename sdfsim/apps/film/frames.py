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
# Of the changes before and after, of what changes most, and of all of the picture: less is a repetition.
SAME = 0.65, 0.3
MISSED = 0.3  # of the usual spacing: a frame after less is not the next one
MOVING = 20  # px at least, of the parts of pictures that change most
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

    A frame repeats the one before if nothing moves in it while things move before and after. Where this recurs evenly,
    the film was copied at another rate: its times are those of the copy, and the camera's own are even. Other copies
    fill gaps of the camera, and the times of other frames are right.
    """
    small = pixels[:, ::2, ::2].astype(np.int16)
    change = np.array([np.abs(now - before).max(-1) for before, now in pairwise(small)]).reshape(len(time) - 1, -1)
    most = max(MOVING, change.shape[1] // 500)
    fast = np.partition(change, -most, axis=1)[:, -most:]
    # What moves changes a part of the picture; noise and lamps change all of it.
    both = np.stack([fast.mean(1), change.mean(1)])
    around = np.minimum(np.c_[[np.inf] * 2, both[:, :-1]], np.c_[both[:, 1:], [np.inf] * 2])
    again = 1 + np.flatnonzero((both < np.array(SAME)[:, None] * around).all(0))
    kept = np.setdiff1d(np.arange(len(time)), again)
    told = f"{len(again)} of {len(time)} frames repeat others"
    if not _even(again):
        return time[kept], kept, (f"{told} and are left out",) if len(again) else ()
    gaps = np.diff(time[kept])
    step = float(gaps.mean())
    number = np.r_[0, np.cumsum([1 if MISSED * step < gap < 2.5 * step else round(gap / step) for gap in gaps])]
    last = np.r_[number[1:] != number[:-1], True]  # a repetition that compression hid comes just before the next frame
    kept, number = kept[last], number[last]
    step, first = np.polyfit(number, time[kept], 1)
    return first + step * number, kept, (f"{told}: frames are taken to be 1/{1 / step:.4g} s apart",)


def _even(rows: np.ndarray) -> bool:
    """Whether numbers recur evenly, apart from some that are missing."""
    gaps = np.diff(rows)
    if len(gaps) < 3:
        return False
    period = float(np.median(gaps[gaps <= 1.5 * gaps.min()]))
    fits = np.abs(gaps - period * np.round(gaps / period)) <= 1.0
    return bool(fits.mean() > 0.9 and len(gaps) > 0.7 * gaps.sum() / period)
