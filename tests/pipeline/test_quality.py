"""Sharpness: what a blur does, and what must not matter."""

import numpy as np
import pytest
from PIL import Image, ImageFilter

from pipeline.inputs.images import sharpness
from tests.pipeline.photo_sets import TABLE_VASE


@pytest.fixture(scope="module")
def photo() -> Image.Image:
    return Image.open(TABLE_VASE / "images" / "000.jpg").convert("RGB")


def test_a_blur_shows_whatever_the_contrast_and_the_noise(photo):
    rng = np.random.default_rng(0)
    for contrast in (1.0, 0.3):
        pixels = 128 + contrast * (np.asarray(photo, float) - 128) + rng.normal(0, 2, (*photo.size[::-1], 3))
        sharp = Image.fromarray(pixels.clip(0, 255).astype(np.uint8))
        blurred = sharp.filter(ImageFilter.GaussianBlur(2))
        assert sharpness(np.asarray(sharp)) > 0.3
        assert sharpness(np.asarray(blurred)) < 0.1


def test_an_object_in_focus_before_a_soft_background_is_sharp(photo):
    soft = photo.filter(ImageFilter.GaussianBlur(5))
    soft.paste(photo.crop((240, 120, 420, 320)), (240, 120))
    assert sharpness(np.asarray(soft)) > 0.3


def test_a_plain_photo_has_no_sharpness():
    assert sharpness(np.full((80, 80, 3), 90, np.uint8)) == 0.0
