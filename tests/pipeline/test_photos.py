"""Reading photos: what is accepted, and one clear line for each thing that is not."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps

from pipeline.inputs.images import read_photo
from pipeline.inputs.photos import load_photos, prepare_photos
from sdfsim.errors import EXIT_ERROR, SdfsimError
from tests.pipeline.conftest import noise


def picture(width: int = 120, height: int = 80, seed: int = 0) -> Image.Image:
    return Image.fromarray(np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8))


def fill(folder: Path, count: int = 3) -> None:
    noise(folder, [f"{k}.jpg" for k in range(count)], (120, 80))


def encoded(kind: str, width: int, height: int) -> bytes:
    data = io.BytesIO()
    picture(width, height).save(data, kind)
    return data.getvalue()


def absurd() -> bytes:
    """A PNG of a few bytes that claims 100,000 px a side."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(b"\0")), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize(
    ("count", "name", "content", "words"),
    [
        (0, "", b"", "photos found: 0, at least 3"),
        (2, "", b"", "photos found: 2, at least 3 are needed"),
        (3, "9.jpg", b"hello", "9.jpg: not an image"),
        (3, "cut.jpg", encoded("JPEG", 400, 300)[:40_000], "cut.jpg: truncated"),
        (3, "cut.png", encoded("PNG", 400, 300)[:40_000], "cut.png: truncated"),
        (3, "bomb.png", absurd(), "bomb.png: too large (100000 x 100000"),
        (3, "x.png", encoded("PNG", 20, 20), "x.png: too small"),
    ],
)
def test_what_cannot_be_used_is_one_clear_line(tmp_path, count, name, content, words):
    (tmp_path / "in").mkdir()
    fill(tmp_path / "in", count)
    if name:
        (tmp_path / "in" / name).write_bytes(content)
    with pytest.raises(SdfsimError) as caught:
        prepare_photos(tmp_path / "in", tmp_path, long_side=100)
    assert words in caught.value.message and "\n" not in caught.value.message
    assert caught.value.exit_code == EXIT_ERROR


def test_other_files_are_noted_and_sizes_may_differ(tmp_path):
    fill(tmp_path / "in")
    picture(60, 90).resize((80, 120)).save(tmp_path / "in" / "portrait.png")
    (tmp_path / "in" / "notes.txt").write_text("hello")
    photos, notes = prepare_photos(tmp_path / "in", tmp_path, long_side=100)
    assert {(p.width, p.height) for p in photos} == {(100, 67), (67, 100)}
    assert any("notes.txt" in note for note in notes)
    assert load_photos(tmp_path) == photos


def test_exif_orientation_and_focal_length(tmp_path):
    fill(tmp_path / "in", 2)
    pixels = np.zeros((80, 120, 3), np.uint8)
    pixels[:, :30] = 255  # The left edge; orientation 6 turns it to the top.
    image = Image.fromarray(pixels)
    exif = image.getexif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 36  # 35 mm equivalent
    image.save(tmp_path / "in" / "turned.jpg", exif=exif, quality=95)
    photos, _ = prepare_photos(tmp_path / "in", tmp_path, long_side=120)
    turned = next(p for p in photos if p.source == "turned.jpg")
    assert (turned.width, turned.height) == (80, 120)
    assert turned.focal == pytest.approx(120.0)  # 36 mm on a 36 mm frame: as long as the longer side.
    written = np.asarray(Image.open(tmp_path / "images" / turned.name))
    assert written[:25].mean() > 250 and written[40:].mean() < 5


def test_alpha_becomes_a_mask(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    for k in range(3):
        pixels = np.full((80, 80, 4), 200, np.uint8)
        pixels[:40, :, 3] = 0
        Image.fromarray(pixels).save(folder / f"{k}.png")
    photos, _ = prepare_photos(folder, tmp_path, long_side=80)
    assert all(p.mask for p in photos)
    mask = np.asarray(Image.open(tmp_path / "masks" / (photos[0].name + ".png")))
    assert mask[:38].max() == 0 and mask[42:].min() == 200
    rgb = np.asarray(Image.open(tmp_path / "images" / photos[0].name)).astype(int)
    assert np.abs(rgb[:38] - 128).max() < 6


def test_sixteen_bit_grey_is_scaled_not_clipped(tmp_path):
    fill(tmp_path / "in", 2)
    Image.fromarray(np.full((80, 80), 128 << 8, np.uint16)).save(tmp_path / "in" / "deep.png")
    photos, _ = prepare_photos(tmp_path / "in", tmp_path, long_side=80)
    deep = next(p for p in photos if p.source == "deep.png")
    assert abs(int(np.asarray(Image.open(tmp_path / "images" / deep.name))[40, 40, 0]) - 128) <= 1


def test_mask_files_that_only_some_photos_have_change_nothing(tmp_path):
    fill(tmp_path / "in", 4)
    (tmp_path / "masks").mkdir()
    for k in range(2):
        Image.new("L", (120, 80)).save(tmp_path / "masks" / f"{k}.png")
    photos, notes = prepare_photos(tmp_path / "in", tmp_path / "in", long_side=120)
    assert not any(photo.mask for photo in photos) and not (tmp_path / "in" / "masks").exists()
    for k in range(4):
        found = np.asarray(Image.open(tmp_path / "in" / "images" / f"000{k}.jpg")).astype(int)
        assert np.abs(found - np.asarray(Image.open(tmp_path / "in" / f"{k}.jpg"))).mean() < 8  # JPEG, twice
    assert notes[0].startswith("masks count only where every photo has one: 2 mask files are ignored")


def test_transparency_that_only_some_photos_have_is_grey_and_no_mask(tmp_path):
    fill(tmp_path / "in", 3)
    picture(seed=9).convert("RGBA").save(tmp_path / "in" / "opaque.png")
    Image.new("RGBA", (120, 80), (255, 0, 0, 0)).save(tmp_path / "in" / "z.png")
    _, notes = prepare_photos(tmp_path / "in", tmp_path, long_side=120)
    assert np.abs(np.asarray(Image.open(tmp_path / "images" / "0004.jpg")).astype(int) - 128).max() <= 2
    assert notes[0].endswith("what is transparent in 1 photos is grey")


def test_mask_files_and_transparency_count_together(tmp_path):
    fill(tmp_path / "in", 2)
    Image.new("RGBA", (120, 80), (255, 0, 0, 0)).save(tmp_path / "in" / "z.png")
    (tmp_path / "masks").mkdir()
    for k in range(2):
        Image.new("L", (120, 80), 255 * k).save(tmp_path / "masks" / f"{k}.png")
    photos, notes = prepare_photos(tmp_path / "in", tmp_path / "in", long_side=120)
    assert all(photo.mask for photo in photos) and not any("mask" in note for note in notes)
    for k in (0, 2):
        found = np.asarray(Image.open(tmp_path / "in" / "images" / f"000{k}.jpg")).astype(int)
        assert np.abs(found - 128).max() <= 2


def stored(path: Path, orientation: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Writes a photo of a white angle with this EXIF orientation; gives its pixels [H, W] as stored and upright."""
    pixels = np.zeros((90, 120), np.uint8)
    pixels[10:80, 20:40] = pixels[60:80, 20:110] = 255
    image = Image.fromarray(pixels)
    exif = image.getexif()
    if orientation:
        exif[ExifTags.Base.Orientation] = orientation
    image.convert("RGB").save(path, exif=exif)
    return pixels, np.asarray(ImageOps.exif_transpose(Image.open(path)).convert("L"))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_mask_lies_on_its_photo_pixel_by_pixel(tmp_path, orientation):
    _, upright = stored(tmp_path / "a.png", orientation)
    Image.fromarray(upright).save(tmp_path / "mask.png")
    found = read_photo(tmp_path / "a.png", 120, tmp_path / "mask.png")
    np.testing.assert_array_equal(found.mask, upright)
    np.testing.assert_array_equal(found.pixels, np.where(upright[..., None] > 0, 255, 128).repeat(3, 2))
    assert found.original == upright.shape[::-1]


@pytest.mark.parametrize("orientation", [None, 1, 3])
def test_a_mask_is_never_turned_where_its_photo_is_not(tmp_path, orientation):
    pixels, _ = stored(tmp_path / "a.png", orientation)
    Image.fromarray(pixels.T).save(tmp_path / "mask.png")
    with pytest.raises(SdfsimError, match=r"mask\.png: a mask of 90 x 120 does not fit"):
        read_photo(tmp_path / "a.png", 120, tmp_path / "mask.png")


@pytest.mark.parametrize("tagged", [False, True])
def test_a_photo_that_its_camera_has_unturned_stays_so_with_its_mask(tmp_path, tagged):
    pixels, _ = stored(tmp_path / "a.png", 6)
    stored(tmp_path / "mask.png", 6 if tagged else None)
    found = read_photo(tmp_path / "a.png", 60, tmp_path / "mask.png", shape=120 / 90)
    assert found.pixels.shape[:2] == (45, 60) and found.original == (120, 90)
    small = np.asarray(Image.fromarray(pixels).resize((60, 45), Image.Resampling.BOX))
    np.testing.assert_array_equal(found.mask, small)


def test_the_original_size_is_that_of_the_file_however_it_is_decoded(tmp_path):
    image = picture(1001, 667)
    exif = image.getexif()
    exif[ExifTags.Base.Orientation] = 8
    image.save(tmp_path / "a.jpg", exif=exif)
    found = read_photo(tmp_path / "a.jpg", 100)  # The decoder skips to a quarter of the size or less.
    assert found.pixels.shape[:2] == (100, 67) and found.original == (667, 1001)
