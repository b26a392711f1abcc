"""Photos of known cameras with any lens -> pinhole photos with square pixels."""

from __future__ import annotations

import numpy as np

from pipeline.cameras import View
from pipeline.given import Given
from pipeline.photo_file import Picture

SQUARE = 1e-3  # pixels that differ from squares by less are squares


def scaled(given: Given, width: int, height: int) -> np.ndarray:
    """The camera's matrix [3, 3] for its photo at another size, px."""
    if not given.height:  # Only a field of view is known.
        return np.array([[given.matrix[0, 0] * width, 0, width / 2], [0, given.matrix[1, 1] * width, height / 2],
                         [0, 0, 1]])  # fmt: skip
    return np.diag([width / given.width, height / given.height, 1.0]) @ given.matrix


def rectified(picture: Picture, given: Given, name: str, source: str) -> tuple[Picture, View]:
    """A photo as a pinhole camera in the same place would have taken it, and that camera.

    Nothing is resampled where the lens has no distortion. Elsewhere the photo is cut to what the lens shows of the
    pinhole's picture all over.

    Args:
        picture: upright, sized.
        given: its camera, intrinsics at any size.
        name: of the prepared photo.
        source: the user's name of it.
    """
    height, width = picture.pixels.shape[:2]
    matrix = scaled(given, width, height)
    pixels, mask = picture.pixels, picture.mask
    if any(given.distortion) or abs(matrix[0, 0] / matrix[1, 1] - 1) > SQUARE:
        import cv2

        # OpenCV counts pixel centres from 0.
        lens, size = np.array(given.distortion), (width, height)
        old = matrix - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        new = old.copy()
        if given.fisheye:
            new = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(old, lens, size, np.eye(3), balance=0.0)
        else:
            new, _ = cv2.getOptimalNewCameraMatrix(old, lens, size, 0.0)
        new = np.array(new, float)
        new[0, 0] = new[1, 1] = max(new[0, 0], new[1, 1])
        new[0, 1] = 0.0
        make = cv2.fisheye.initUndistortRectifyMap if given.fisheye else cv2.initUndistortRectifyMap
        x, y = make(old, lens, np.eye(3), new, size, cv2.CV_32FC1)
        pixels = cv2.remap(pixels, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        if mask is not None:
            mask = cv2.remap(mask, x, y, cv2.INTER_LINEAR)
        matrix = new + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    focal = float(matrix[0, 0])
    view = View(name, source, width, height, focal, float(matrix[0, 2]), float(matrix[1, 2]), 0.0,
                given.rotation, given.translation)  # fmt: skip
    return Picture(pixels, mask, focal, picture.camera), view
