"""The simulated motion drawn over the film."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from sdfsim.apps.film.track import Film
from sdfsim.apps.render import write_movie

SEEN, MADE = (245, 140, 20), (40, 120, 255)  # RGB of outlines: where the film shows a body, and where the solve has it
Pose = tuple[np.ndarray, np.ndarray]


def drawn(film: Film, k: int, made: Callable[[int, int], Pose | None]) -> np.ndarray:
    """Frame k [H, W, 3] with the outlines of the bodies: as seen, and where `made` (frame, body) says."""
    pixels = np.ascontiguousarray(film.clip.pixels[k])
    for d, track in enumerate([*film.tracks, *film.supports]):
        one = track.seen[k]
        fit = made(k, d) if d < len(film.tracks) else None
        for now, color in ((one and (one.place, one.turn), SEEN), (fit, MADE)):
            at = now and track.look.window(film.eye, *now, 3.0)
            if now is None or at is None:
                continue
            cover = (255 * track.look.cover(film.eye, *now, at).sum(0)).astype(np.uint8)
            edges, _ = cv2.findContours(cv2.threshold(cover, 127, 255, 0)[1], cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(pixels, edges, -1, color, 1, offset=(at.left, at.top))
    return pixels


def write_beside(film: Film, made: Callable[[int, int], Pose | None], out: Path) -> None:
    """Write a movie, ten frames a second, with the outlines of `drawn`."""
    high, wide = (size // 2 * 2 for size in film.clip.pixels.shape[1:3])

    def pictures() -> Iterator[np.ndarray]:
        for k in range(len(film.clip.time)):
            yield drawn(film, k, made)[:high, :wide]

    write_movie(out, pictures(), replace(film.eye.camera, width=wide, height=high), 10.0)
