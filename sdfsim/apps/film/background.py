"""What stands still in a film, its noise, and lamps that flicker."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sdfsim.apps.film.frames import Clip
from sdfsim.base.errors import SdfsimError

DIFFER = 25.0  # levels by which the first and last frames differ where something began or came to rest
FEW = 40  # frames from which the median is taken
LEAST_NOISE = 1.5  # levels: less is compression
DARK, FLAT = 14.0, 3.0  # levels: mean and spread of a picture that shows nothing
DRIFT = 0.7  # px between the first and last frames, of a camera that moves


@dataclass(frozen=True)
class Background:
    """Pictures without the bodies, as far as they were ever seen so."""

    pixels: np.ndarray  # [H, W, 3] float32 levels; nan where it is not known
    # The same from the first and from the last frames: where a body rests in the end is free in the beginning.
    first: np.ndarray
    last: np.ndarray
    noise: float  # levels, standard deviation of a pixel
    gain: np.ndarray  # [T] brightness of the frames
    front: Callable[[np.ndarray, int], np.ndarray] = lambda still, _: still  # draws supports where they are in a frame


def background(clip: Clip, hidden: Sequence[np.ndarray | None] | None = None, complete: bool = True) -> Background:
    """The median of frames, without the pixels that bodies `hidden` ([T] masks [H, W] each) cover; `complete`: nothing
    else moves."""
    count = len(clip.time)
    some = np.unique(np.linspace(0, count - 1, FEW).astype(int))
    gain = np.ones(count)
    usual_of = np.median(clip.pixels[some], 0).astype(np.float32)
    usual = usual_of[::4, ::4]
    for k in range(count):  # the median ratio: what moves is a small part of the picture
        now = clip.pixels[k, ::4, ::4]
        bright = usual > 20.0
        gain[k] = np.median(now[bright] / usual[bright]) if bright.sum() > 50 else 1.0
    part = max(3, count * 3 // 10)
    ends = [rows[:: max(1, part // 15)] for rows in (np.arange(part), np.arange(count - part, count))]
    if hidden is None:
        first, last = (np.median(clip.pixels[rows], 0).astype(np.float32) for rows in ends)
    else:
        usual_of, first, last = (_median(clip, rows, gain, hidden) for rows in (some, *ends))
        first, last = (np.where(np.isnan(one), usual_of, one) for one in (first, last))
    if hidden is not None and complete:
        first = last = pixels = usual_of
    else:
        differ = np.abs(first - last).max(-1) > DIFFER
        pixels = np.where(differ[..., None], np.nan, usual_of).astype(np.float32)
    still = np.abs(np.diff(clip.pixels[some][:, ::4, ::4].astype(np.float32), axis=0))
    noise = max(LEAST_NOISE, 1.48 * float(np.median(still)) / np.sqrt(2.0))
    return Background(pixels, first, last, noise, gain)


def _median(clip: Clip, rows: np.ndarray, gain: np.ndarray, hidden: Sequence[np.ndarray | None]) -> np.ndarray:
    """[H, W, 3] the median of these frames, nan where something is always hidden."""
    found = np.median(clip.pixels[rows], 0).astype(np.float32)
    covers = [(row, cover) for row, k in enumerate(rows) if (cover := hidden[k]) is not None]
    if not covers:
        return found
    touched = np.logical_or.reduce([cover for _, cover in covers])
    seen = clip.pixels[rows][:, touched] / gain[rows, None, None].astype(np.float32)
    for row, cover in covers:
        seen[row][cover[touched]] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # where a body always was
        found[touched] = np.nanmedian(seen, 0)
    return found


def checked(clip: Clip, back: Background) -> None:
    """Raises SdfsimError for films in which nothing can be tracked: dark ones, and those of a moving camera."""
    import cv2

    level, spread = float(np.nanmean(back.pixels)), float(np.nanstd(back.pixels))
    if level < DARK or spread < FLAT:
        raise SdfsimError(
            f"{clip.path}: too dark to see anything (mean level {level:.0f} of 255)", "film with more light"
        )
    corners = cv2.goodFeaturesToTrack(cv2.cvtColor(clip.pixels[0], cv2.COLOR_RGB2GRAY), 200, 0.01, 8)
    if corners is None or len(corners) < 12:
        return  # a plain wall cannot tell
    grey = [cv2.cvtColor(clip.pixels[k], cv2.COLOR_RGB2GRAY) for k in (0, len(clip.time) // 2, -1)]
    for later in grey[1:]:
        moved, found, _ = cv2.calcOpticalFlowPyrLK(grey[0], later, corners, corners.copy(), winSize=(15, 15))
        way = (moved - corners)[found[:, 0] == 1][:, 0]
        # What most corners agree on: some are on what moves, and some are lost.
        alike = np.abs(way[:, None] - way).max(-1) < 0.5
        drift = np.abs(way[alike[alike.sum(1).argmax()]].mean(0)).max() if len(way) >= 12 else 0.0
        if drift > DRIFT:
            raise SdfsimError(
                f"{clip.path}: the camera moves, by {drift:.1f} px",
                "film from a stand; shorten it by --start and --end",
            )
