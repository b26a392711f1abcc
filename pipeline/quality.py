"""Is a photo sharp, and is it exposed so that something can be seen on it?"""

from __future__ import annotations

import numpy as np

# Measured on three real and four rendered sets: photos in focus have 0.19 to 0.6, blurred by 1.5 px less than 0.08.
BLURRED = 0.1
DARK, BURNT = 0.04, 0.98
MOSTLY = 0.6  # share of the photo that is black or white
BLOCKS = 12  # a side, fewer of small photos


def halved(grey: np.ndarray) -> np.ndarray:
    """A grey picture [H, W] at half its size, each value the mean of four."""
    even = grey[: grey.shape[0] // 2 * 2, : grey.shape[1] // 2 * 2]
    return (even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]) / 4


def edges(grey: np.ndarray) -> np.ndarray:
    """Squared Laplacian [H - 2, W - 2] of a grey picture [H, W]."""
    inner = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * grey[1:-1, 1:-1]
    return inner**2


def block_means(values: np.ndarray, blocks: int) -> np.ndarray:
    """Means [blocks * blocks] over a grid of blocks of a picture [H, W]."""
    rows, columns = (np.linspace(0, n, blocks + 1).astype(int) for n in values.shape)
    sums = np.add.reduceat(np.add.reduceat(values, rows[:-1], 0), columns[:-1], 1)
    return (sums / (np.diff(rows)[:, None] * np.diff(columns))).ravel()


def sharpness(pixels: np.ndarray) -> float:
    """How strong edges are at the finest scale against a scale eight times as coarse; does not depend on contrast.

    Looks only where there are edges: the tenth of the picture's blocks with the most of them, so that an object in
    focus before a soft background counts as sharp. 0 where there is nothing to see.

    Args:
        pixels: RGB [H, W, 3] uint8, at least 64 px a side.
    """
    grey = pixels.astype(np.float32).mean(-1) / 255
    rough = edges(halved(halved(halved(grey))))
    blocks = min(BLOCKS, *rough.shape)
    coarse, fine = block_means(rough, blocks), block_means(edges(grey), blocks)
    chosen = np.argsort(coarse)[-max(1, len(fine) // 10) :]
    strong = float(coarse[chosen].mean())
    return float(np.sqrt(fine[chosen].mean() / strong)) if strong > 1e-6 else 0.0


def exposure(pixels: np.ndarray) -> tuple[float, float]:
    """Shares of a photo, RGB [H, W, 3] uint8, that are nearly black and nearly white."""
    grey = pixels.astype(np.float32).mean(-1) / 255
    return float((grey < DARK).mean()), float((grey > BURNT).mean())


def fault(sharp: float, dark: float, burnt: float, *, typical: float, masked: bool) -> str:
    """What is wrong with a photo in a word or two, or nothing.

    Args:
        sharp: its sharpness.
        dark: share that is nearly black.
        burnt: share that is nearly white.
        typical: sharpness of the sharper photos of the set: a blur that all have in common may be the scene's.
        masked: it has a mask: what lies outside says nothing about the exposure.
    """
    if not masked and dark > MOSTLY:
        return "too dark"
    if not masked and burnt > MOSTLY:
        return "burnt out"
    return "blurred" if sharp < max(BLURRED, 0.35 * typical) else ""
