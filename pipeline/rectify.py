"""Photos of known cameras with any lens -> pinhole photos with square pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.cameras import View
from pipeline.given import Given
from pipeline.photo_file import Picture

SQUARE = 1e-3  # pixels that differ from squares by less are squares
# OpenCV counts pixel centres from 0.
CENTRE = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


@dataclass(frozen=True)
class Lens:
    """What bent a photo before it was made straight.

    Attributes:
        matrix: rows of the intrinsics [3, 3] for the prepared photo's size, pixel centres at +0.5.
        distortion: see `Given`.
        fisheye: see `Given`.
    """

    matrix: tuple[tuple[float, ...], ...]
    distortion: tuple[float, ...]
    fisheye: bool

    def straight(self, pixels: np.ndarray, view: View) -> np.ndarray:
        """Where the straight photo of `view` shows what pixels [P, 2] of the bent one show; may lie outside it."""
        import cv2

        until = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10)
        undistort = cv2.fisheye.undistortPoints if self.fisheye else cv2.undistortPoints
        new = np.array([[view.focal, 0, view.cx], [0, view.focal, view.cy], [0, 0, 1]])
        points = np.ascontiguousarray(pixels, float)[:, None]
        return undistort(points, np.array(self.matrix), np.array(self.distortion), P=new, criteria=until)[:, 0]


def scaled(given: Given, width: int, height: int) -> np.ndarray:
    """The camera's matrix [3, 3] for its photo at another size, px."""
    if not given.height:  # Only a field of view is known.
        return np.array([[given.matrix[0, 0] * width, 0, width / 2], [0, given.matrix[1, 1] * width, height / 2],
                         [0, 0, 1]])  # fmt: skip
    return np.diag([width / given.width, height / given.height, 1.0]) @ given.matrix


def rectified(picture: Picture, given: Given, name: str, source: str) -> tuple[Picture, View, Lens | None]:
    """A photo as a pinhole camera in the same place would have taken it, that camera, and the lens it was freed from.

    Nothing is resampled where the lens has no distortion: then there is no lens. Elsewhere the photo is cut to what the
    lens shows of the pinhole's picture all over.

    Args:
        picture: upright, sized.
        given: its camera, intrinsics at any size.
        name: of the prepared photo.
        source: the user's name of it.
    """
    height, width = picture.pixels.shape[:2]
    matrix, lens = scaled(given, width, height), None
    pixels, mask = picture.pixels, picture.mask
    # A fisheye bends also where all its coefficients are 0.
    if given.fisheye or any(given.distortion) or abs(matrix[0, 0] / matrix[1, 1] - 1) > SQUARE:
        import cv2

        lens = Lens(tuple(map(tuple, matrix.tolist())), given.distortion, given.fisheye)
        bent, size = np.array(given.distortion), (width, height)
        old = matrix - CENTRE
        if given.fisheye:
            new = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(old, bent, size, np.eye(3), balance=0.0)
        else:
            new, _ = cv2.getOptimalNewCameraMatrix(old, bent, size, 0.0)
        new = np.array(new, float)
        new[0, 0] = new[1, 1] = max(new[0, 0], new[1, 1])
        new[0, 1] = 0.0
        make = cv2.fisheye.initUndistortRectifyMap if given.fisheye else cv2.initUndistortRectifyMap
        x, y = make(old, bent, np.eye(3), new, size, cv2.CV_32FC1)
        pixels = cv2.remap(pixels, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        if mask is not None:
            mask = cv2.remap(mask, x, y, cv2.INTER_LINEAR)
        matrix = new + CENTRE
    focal = float(matrix[0, 0])
    view = View(name, source, width, height, focal, float(matrix[0, 2]), float(matrix[1, 2]), 0.0,
                given.rotation, given.translation)  # fmt: skip
    return replace(picture, pixels=pixels, mask=mask, focal=focal), view, lens
