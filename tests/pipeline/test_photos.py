"""Reading photos: what is accepted, how sharp they are, and one clear line for each that is not."""

import base64
import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import ExifTags, Image, ImageFilter, ImageOps

from pipeline.inputs.images import read_photo, sharpness
from pipeline.inputs.photos import load_photos, prepare_photos
from sdfsim.base.errors import EXIT_ERROR, SdfsimError
from tests.helpers.photos import noise
from tests.pipeline.photo_sets import TABLE_VASE


def picture(width: int = 120, height: int = 80, seed: int = 0) -> Image.Image:
    return Image.fromarray(np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8))


def fill(folder: Path, count: int = 3) -> None:
    noise(folder, [f"{k}.jpg" for k in range(count)], (120, 80))


def encoded(kind: str, width: int, height: int) -> bytes:
    data = io.BytesIO()
    picture(width, height).save(data, kind)
    return data.getvalue()


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(width: int, height: int, bits: int, color: int, rows: bytes, more: bytes = b"") -> bytes:
    """A PNG that claims a size, with rows of so many bits a channel; `more` chunks lie behind its head."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)) + more
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


DRAWING = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 100 100\n(x) run showpage\n%%EOF\n"


@pytest.mark.parametrize(
    ("count", "name", "content", "words"),
    [
        (0, "", b"", "photos found: 0, at least 3"),
        (2, "", b"", "photos found: 2, at least 3 are needed"),
        (3, "9.jpg", b"hello", "9.jpg: not an image"),
        (3, "cut.jpg", encoded("JPEG", 400, 300)[:40_000], "cut.jpg: cannot be decoded"),
        (3, "cut.png", encoded("PNG", 400, 300)[:40_000], "cut.png: cannot be decoded"),
        (3, "cut.webp", encoded("WEBP", 400, 300)[:40_000], "cut.webp: cannot be decoded"),
        (3, "cut.avif", encoded("AVIF", 400, 300)[:20_000], "cut.avif: "),
        (3, "9.jpg", DRAWING, "9.jpg: not an image"),  # which a program would have to draw
        # Claims that are refused before anything is decoded.
        (3, "bomb.png", png(100_000, 100_000, 8, 2, b"\0"), "bomb.png: too large (100000 x 100000"),
        (3, "bomb.png", png(2**31 - 1, 2**31 - 1, 8, 2, b"\0"), "bomb.png: "),
        (3, "bomb.png", png(2**31 - 1, 64, 8, 2, b"\0"), "bomb.png: "),
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
    assert notes[0].startswith("masks are used only if every photo has one: 2 mask files are ignored")


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
    with pytest.raises(SdfsimError, match=r"mask\.png: .*90 x 120.*"):
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


RAMP = np.stack([np.tile(np.linspace(0, 1, 120), (80, 1)), np.tile(np.linspace(0, 1, 80)[:, None], (1, 120)),
                 np.full((80, 120), 0.5)], 2)  # fmt: skip
EIGHT = (255 * RAMP + 0.5).astype(int)


def png16(values: np.ndarray, more: bytes = b"") -> bytes:
    """A PNG of 16 bits a channel, written by hand: grey, grey and alpha, RGB or RGBA [H, W, C]."""
    height, width, channels = values.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    return png(width, height, 16, {1: 0, 2: 4, 3: 2, 4: 6}[channels], rows, more)


def shown(path: Path) -> np.ndarray:
    return read_photo(path, 120).pixels.astype(int)


@pytest.mark.parametrize("form", ["png", "tiff", "lzw", "big endian", "tiles"])
@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_ten_and_twelve_bits_in_a_file_of_sixteen_are_as_bright_as_eight(tmp_path, bits, form):
    values = ((2**bits - 1) * RAMP + 0.5).astype(np.uint16)
    for colour in (True, False):
        stored = values if colour else values[..., :1]
        path = tmp_path / f"{colour}.{'png' if form == 'png' else 'tif'}"
        if form == "png":
            path.write_bytes(png16(stored))
        else:
            how: dict[str, dict[str, Any]] = {
                "lzw": {"compression": "lzw"},
                "big endian": {"byteorder": ">"},
                "tiles": {"tile": (16, 16)},
            }
            kind = "rgb" if colour else "minisblack"
            tifffile.imwrite(path, np.squeeze(stored), photometric=kind, **how.get(form, {}))
        assert np.abs(shown(path) - (EIGHT if colour else EIGHT[..., :1])).max() <= 1


@pytest.mark.parametrize(
    ("values", "kind", "wanted"),
    [
        (RAMP.astype(np.float32), "rgb", EIGHT),
        (RAMP, "rgb", EIGHT),
        (RAMP[..., 0].astype(np.float32), "minisblack", EIGHT[..., :1]),
        ((255 * RAMP).astype(np.float32), "rgb", EIGHT),
        ((4 * RAMP).astype(np.float32), "rgb", EIGHT),
        ((65535 * RAMP).astype(np.float32), "rgb", EIGHT),
        ((65535 * (1 - RAMP[..., 0])).astype(np.uint16), "miniswhite", EIGHT[..., :1]),
        ((32767 * RAMP[..., 0]).astype(np.int16), "minisblack", EIGHT[..., :1]),
        ((2.0**32 * 0.999 * RAMP).astype(np.uint32), "rgb", EIGHT),
        (np.where(RAMP < 0.1, np.nan, RAMP).astype(np.float32), "rgb", np.where(RAMP < 0.1, 0, EIGHT)),
    ],
    ids=["float", "double", "grey float", "float to 255", "float to 4", "float to 65535", "white is zero", "signed",
         "32 bits", "no number"],
)  # fmt: skip
def test_other_kinds_of_tiff_are_brought_to_the_range_that_is_there(tmp_path, values, kind, wanted):
    tifffile.imwrite(tmp_path / "a.tif", values, photometric=kind)
    assert np.abs(shown(tmp_path / "a.tif") - wanted).max() <= 1


DEEP, FLOATS = (65535 * RAMP).astype(np.uint16), RAMP.astype(np.float32)
FIVE = {"planarconfig": "contig", "extrasamples": ["unspecified"] * 2}


@pytest.mark.parametrize(
    ("values", "more", "lacking"),
    [
        (DEEP.transpose(2, 0, 1), {"planarconfig": "separate"}, 0),
        (FLOATS.transpose(2, 0, 1), {"planarconfig": "separate"}, 0),
        (RAMP.astype(np.float16), {}, 0), (2 * FLOATS - 1, {}, 0), (DEEP, {"compression": "zstd"}, 0),
        (np.dstack([DEEP, DEEP[..., :2]]), FIVE, 0), (DEEP, {"photometric": "cielab"}, 0), (DEEP, {}, 20_000),
        (FLOATS, {}, 20_000),
    ],
    ids=["planes", "float planes", "half", "below 0", "zstd", "five", "lab", "cut", "cut float"],
)  # fmt: skip
def test_deep_files_that_cannot_be_read_right_are_refused(tmp_path, values, more, lacking, capfd):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.ascontiguousarray(values), **{"photometric": "rgb", **more})
    path.write_bytes(path.read_bytes()[: path.stat().st_size - lacking])
    capfd.readouterr()
    with pytest.raises(SdfsimError, match=r"a\.tif: ") as caught:
        read_photo(path, 120)
    assert "\n" not in caught.value.message and caught.value.hint
    assert "ERROR" not in capfd.readouterr().err


@pytest.mark.parametrize(("bits", "opaque"), [(12, 4095), (12, 65535), (16, 65535)])
def test_deep_alpha_is_a_mask_in_its_own_range(tmp_path, bits, opaque):
    inside = np.zeros((80, 120, 1))
    inside[20:] = 1
    for name, values in (("rgba", RAMP), ("la", RAMP[..., :1])):
        whole = np.concatenate([(2**bits - 1) * values, opaque * inside], 2).astype(np.uint16)
        (tmp_path / f"{name}.png").write_bytes(png16(whole))
        found = read_photo(tmp_path / f"{name}.png", 120)
        np.testing.assert_array_equal(found.mask, 255 * inside[..., 0])
        assert np.abs(found.pixels[20:].astype(int) - (EIGHT if name == "rgba" else EIGHT[..., :1])[20:]).max() <= 1
    tifffile.imwrite(tmp_path / "x.tif", np.concatenate([(2**bits - 1) * RAMP, 0 * inside], 2).astype(np.uint16),
                     photometric="rgb", extrasamples=["unspecified"])  # fmt: skip
    found = read_photo(tmp_path / "x.tif", 120)
    assert found.mask is None and np.abs(found.pixels.astype(int) - EIGHT).max() <= 1  # infrared, say


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", ["png", "tiff", "float"])
def test_deep_photos_are_turned_upright(tmp_path, orientation, kind):
    deep = (4095 * RAMP).astype(np.uint16)
    path = tmp_path / ("a.png" if kind == "png" else "a.tif")
    if kind == "png":
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        path.write_bytes(png16(deep, chunk(b"eXIf", exif.tobytes()[6:])))
    else:
        tifffile.imwrite(path, RAMP.astype(np.float32) if kind == "float" else deep, photometric="rgb",
                         extratags=[(274, 3, 1, orientation, True)])  # fmt: skip
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    eight = Image.fromarray(EIGHT.astype(np.uint8))
    eight.save(tmp_path / "eight.png", exif=exif)
    upright = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / "eight.png"))).astype(int)
    found = read_photo(path, 120)
    assert found.original == upright.shape[1::-1] and np.abs(found.pixels.astype(int) - upright).max() <= 1
    as_stored = read_photo(path, 120, shape=120 / 80)  # what a known camera may ask for
    if orientation >= 5:
        assert np.abs(as_stored.pixels.astype(int) - EIGHT).max() <= 1


def test_deep_photos_of_one_set_keep_their_brightness_beside_each_other(tmp_path):
    """The second was taken with a quarter of the light, though it then needs only ten bits."""
    folder = tmp_path / "in"
    folder.mkdir()
    for name, factor in (("a", 1.0), ("b", 0.24), ("c", 1.0)):
        (folder / f"{name}.png").write_bytes(png16((4095 * factor * RAMP).astype(np.uint16)))
    prepare_photos(folder, tmp_path, long_side=120)
    found = [np.asarray(Image.open(tmp_path / "images" / f"000{k}.jpg")).astype(int) for k in range(3)]
    assert np.abs(found[0] - EIGHT).mean() < 2 and np.abs(found[1] - 0.24 * EIGHT).mean() < 2


def test_dark_photos_are_reported_apart_from_blurred_ones(tmp_path):
    fill(tmp_path / "in")
    for name, factor in (("dark", 0.05), ("dim", 0.4)):
        Image.fromarray((factor * np.asarray(picture())).astype(np.uint8)).save(tmp_path / "in" / f"{name}.png")
    picture().resize((12, 8)).resize((120, 80)).save(tmp_path / "in" / "soft.png")
    photos, notes = prepare_photos(tmp_path / "in", tmp_path, long_side=120)
    assert {p.source: p.fault for p in photos if p.fault} == {"dark.png": "too dark", "soft.png": "blurred"}
    assert notes == ["1 of 6 photos are too dark, take them again with more light: dark.png",
                     "1 of 6 photos are blurred, take them again: soft.png"]  # fmt: skip


@pytest.mark.parametrize("high", [1, 255, 1023, 4095, 65535])
def test_white_of_a_mask_is_its_largest_value(tmp_path, high):
    picture().save(tmp_path / "a.png")
    inside = np.zeros((80, 120), bool)
    inside[:, 50:] = True
    Image.fromarray((high * inside).astype(np.uint8 if high < 256 else np.uint16)).save(tmp_path / "mask.png")
    np.testing.assert_array_equal(read_photo(tmp_path / "a.png", 120, tmp_path / "mask.png").mask, 255 * inside)


# 96 x 64 px as an iPhone writes it: turned by a quarter (in EXIF and in the file's own way), 36 mm. Its left quarter is
# red, the rest blue. Written by pillow-heif.
HEIC = """
AAAAHGZ0eXBoZWljAAAAAG1pZjFoZWljbWlhZgAAAaFtZXRhAAAAAAAAACFoZGxyAAAAAAAAAABwaWN0AAAAAAAAAAAAAAAAAAAAADRpbG9jAAAAAERA
AAIAAQAAAAABxQABAAAAAAAAAEkAAgAAAAACDgABAAAAAAAAAFQAAAA4aWluZgAAAAAAAgAAABVpbmZlAgAAAAABAABodmMxAAAAABVpbmZlAgAAAQAC
AABFeGlmAAAAAA5waXRtAAAAAAABAAAA4GlwcnAAAADAaXBjbwAAAHhodmNDAQNwAAAAkAAAAAAAHvAA/P34+AAADwNgAAEAGEABDAH//wNwAAADAJAA
AAMAAAMAHroCQGEAAQArQgEBA3AAAAMAkAAAAwAAAwAeoDCBBZbqSSmubgIaDAgAAAMAyAAAAwAIQGIAAQAHRAHBcrAiQAAAABNjb2xybmNseAABAA0A
BoAAAAAUaXNwZQAAAAAAAABgAAAAQAAAABBwaXhpAAAAAAMICAgAAAAJaXJvdAMAAAAYaXBtYQAAAAAAAAABAAEFgQIDBIUAAAAaaXJlZgAAAAAAAAAO
Y2RzYwACAAEAAQAAAKVtZGF0AAAARSgBrwngi/+rxU//Okf/5YOy98tSVQI/8G4O8n7/+bxQa4JCNzWwSDw86bFHD0YICg1JpvEHZgNoPmU3iHA1bk3L
fdHZYAAAAAZFeGlmAABNTQAqAAAACAADAQ8AAgAAAAYAAAAyARIAAwAAAAEABgAAh2kABAAAAAEAAAA4AAAAAE1ha2VyAAABpAUAAwAAAAEAJAAAAAAA
AA==
"""


@pytest.mark.parametrize("name", ["a.heic", "a.HEIF", "a.hif", "a.jpg"])
def test_heic_is_read_upright_with_its_exif(tmp_path, name):
    fill(tmp_path / "in", 2)
    (tmp_path / "in" / name).write_bytes(base64.b64decode(HEIC))
    photos, notes = prepare_photos(tmp_path / "in", tmp_path, long_side=120)
    (photo,) = [p for p in photos if p.source == name]
    assert not any("used" in note for note in notes)
    assert (photo.width, photo.height) == photo.original == (64, 96)
    assert photo.focal == pytest.approx(96.0) and photo.camera == "Maker"
    pixels = read_photo(tmp_path / "in" / name, 120).pixels.astype(int)
    assert np.abs(pixels[:20] - [250, 40, 40]).max() <= 4 and np.abs(pixels[28:] - [30, 60, 200]).max() <= 4


@pytest.mark.parametrize("kind", ["AVIF", "WEBP"])
def test_avif_and_webp_are_read(tmp_path, kind):
    Image.fromarray(EIGHT.astype(np.uint8)).save(tmp_path / f"a.{kind.lower()}", quality=95)
    assert np.abs(shown(tmp_path / f"a.{kind.lower()}") - EIGHT).mean() < 3
    fill(tmp_path, 2)
    assert len(prepare_photos(tmp_path, tmp_path / "out")[0]) == 3


def lit(folder: Path, gains: list[float]) -> Path:
    """Photos of one texture, each with so many times the light, cut off at white."""
    folder.mkdir()
    texture = np.kron(np.random.default_rng(0).integers(20, 120, (30, 40, 3)), np.ones((4, 4, 1)))
    for number, gain in enumerate(gains):
        Image.fromarray((gain * texture).clip(0, 255).astype(np.uint8)).save(folder / f"{number}.png")
    return folder


@pytest.mark.parametrize(("gains", "blown"), [([1, 1, 1, 9], [3]), ([20, 20, 20], [0, 1, 2]), ([1, 1, 2], [])])
def test_photos_that_are_white_are_blown_out_not_blurred_or_dark(tmp_path, gains, blown):
    photos, notes = prepare_photos(lit(tmp_path / "in", gains), tmp_path)
    assert [k for k, photo in enumerate(photos) if photo.fault == "blown out"] == blown
    if blown:
        (note,) = notes
        assert note.startswith(f"{len(blown)} of {len(gains)} photos are blown out, take them again with less light")


def test_a_white_background_is_no_fault(tmp_path):
    """Two thirds of each photo are white, the rest is sharp."""
    lit(tmp_path / "in", [1, 1, 1])
    for path in (tmp_path / "in").iterdir():
        with Image.open(path) as image:
            pixels = np.array(image)
        pixels[:80] = 255
        Image.fromarray(pixels).save(path)
    photos, notes = prepare_photos(tmp_path / "in", tmp_path)
    assert [photo.fault for photo in photos] == [""] * 3 and notes == []
    assert photos[0].white == pytest.approx(2 / 3, abs=1e-3)


def round_about(width: int = 800) -> np.ndarray:
    """A picture of all directions, of 2:1: waves over the sphere."""
    row, column = np.mgrid[0 : width // 2, 0:width] + 0.5
    turn, up = 2 * np.pi * column / width, np.pi * (0.5 - row / (width // 2))
    x, y, z = np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)
    waves = [np.sin(7 * x + 3 * z) + np.cos(6 * y), np.sin(9 * y - 4 * x), np.cos(8 * x * y + 5 * z)]
    return (127 + 60 * np.stack(waves, -1)).clip(0, 255).astype(np.uint8)


def test_panoramas_are_refused_at_once(tmp_path):
    for k in range(4):
        Image.fromarray(np.roll(round_about(), 100 * k, 1)).save(tmp_path / f"{k}.jpg")
    with pytest.raises(SdfsimError, match=r"4 photos are panoramas of 360 degrees \(first: 0\.jpg\)") as caught:
        prepare_photos(tmp_path, tmp_path / "out")
    assert "flat views" in caught.value.hint and not (tmp_path / "out").exists()


def test_wide_photos_are_no_panoramas(tmp_path):
    """Of 2:1, but their sides do not join; one has a sky and a floor of one colour each."""
    photos = [np.roll(round_about(), 100 * k, 1)[:, 200 - k : 600] for k in range(3)]
    for k, pixels in enumerate(photos):
        tall = pixels[100:300] if k else np.concatenate([np.full((100, 400, 3), 200, np.uint8), pixels[150:250, :400]])
        Image.fromarray(tall[:200, :400]).save(tmp_path / f"{k}.png")
    assert len(prepare_photos(tmp_path, tmp_path / "out")[0]) == 3


def test_transparency_that_only_some_photos_have_is_grey_and_no_mask(tmp_path):
    fill(tmp_path / "in", 3)
    picture(seed=9).convert("RGBA").save(tmp_path / "in" / "opaque.png")
    Image.new("RGBA", (120, 80), (255, 0, 0, 0)).save(tmp_path / "in" / "z.png")
    _, notes = prepare_photos(tmp_path / "in", tmp_path, long_side=120)
    assert np.abs(np.asarray(Image.open(tmp_path / "images" / "0004.jpg")).astype(int) - 128).max() <= 2
    assert notes[0].endswith("what is transparent in 1 photos is grey")


def test_cmyk_palette_and_grey_show_what_they_show(tmp_path):
    image = Image.fromarray(EIGHT.astype(np.uint8))
    ink = np.dstack([255 - EIGHT, np.zeros((80, 120))]).astype(np.uint8)
    Image.fromarray(ink, "CMYK").save(tmp_path / "cmyk.jpg", quality=98, subsampling=0)
    image.quantize(256).save(tmp_path / "palette.png")
    image.convert("L").save(tmp_path / "grey.jpg", quality=98)
    image.convert("LA").save(tmp_path / "grey.png")
    grey = EIGHT @ [0.299, 0.587, 0.114]
    for name, wanted, close in (("cmyk.jpg", EIGHT, 3), ("palette.png", EIGHT, 8), ("grey.jpg", grey[..., None], 3),
                                ("grey.png", grey[..., None], 1)):  # fmt: skip
        assert np.abs(shown(tmp_path / name) - wanted).mean() < close, name
        assert read_photo(tmp_path / name, 120).mask is None


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
