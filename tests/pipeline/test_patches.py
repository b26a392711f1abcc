"""The compiled reading of patches, against the camera's own projection and another library's interpolation."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.cameras import View, frame_of
from pipeline.inputs.images import stacked
from pipeline.mesh.patch_kernel import NOISE, read_patches
from pipeline.mesh.photo_refining import GreyPhoto
from pipeline.mesh.visibility import bilinear
from tests.pipeline.photo_sets import around

HALF = 2


@pytest.mark.parametrize("bent", [0.0, -0.12])
def test_patches_are_what_the_cameras_see(bent):
    """Two photos of different sizes, one reduced; points reach past the border of the second."""
    rng = np.random.default_rng(1)
    pictures = []
    for k, (pose, (height, width), scale) in enumerate(
        zip(around(2, 2.4), [(90, 120), (60, 50)], (1.0, 0.5), strict=True)
    ):
        turn = np.diag([1.0, -1, -1]) @ pose[:3, :3].T
        full = (round(width / scale), round(height / scale))
        view = View(f"{k}.jpg", "", *full, 1.1 * full[0], full[0] / 2 + 3, full[1] / 2, bent, turn, -turn @ pose[:3, 3])
        pictures.append(GreyPhoto(view, scale, rng.uniform(0, 255, (height, width)).astype(np.float32)))
    middles = rng.uniform(-0.8, 0.8, (30, 3))
    normals = rng.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sides = 0.02 * frame_of(normals)[:, :2]
    moves = np.linspace(-0.1, 0.1, 5)
    numbers = np.stack([np.arange(30) % 2, np.where(np.arange(30) % 3 == 0, -1, 1 - np.arange(30) % 2)])
    found = np.zeros((30, 5, 2, (2 * HALF + 1) ** 2), np.float32)
    greys, sizes = stacked([picture.grey for picture in pictures])
    read_patches(
        greys, sizes, np.array([p.camera for p in pictures]), middles, normals, sides, moves, numbers, HALF, found
    )

    grid = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].reshape(2, -1)
    beyond = 0
    for s in range(30):
        points = middles[s] + moves[:, None, None] * normals[s] + np.einsum("kg,kc->gc", grid, sides[s])
        for slot in range(2):
            if numbers[slot, s] < 0:
                assert not found[s, :, slot].any()
                continue
            picture = pictures[numbers[slot, s]]
            pixels = picture.view.project(points.reshape(-1, 3))[0] * picture.scale - 0.5
            beyond += int((pixels < 0).any())
            grey = bilinear(picture.grey[..., None].astype(float), pixels)[:, 0].reshape(5, -1)
            grey -= grey.mean(1, keepdims=True)
            grey /= np.sqrt((grey**2).sum(1, keepdims=True) + NOISE * grey.shape[1])
            np.testing.assert_allclose(found[s, :, slot], grey, atol=2e-4)
    assert beyond > 0
