"""Reads image files with more than 8 bits per channel, or with floats, and converts them to 8 bits."""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from PIL import ExifTags
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from sdfsim.base.errors import SdfsimError

PNG, TIFFS = b"\x89PNG\r\n\x1a\n", (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
OTHERWISE = "save it as PNG, or as TIFF of 8 or 16 bits, channels interleaved, uncompressed or with LZW or ZIP"
BITS = (8, 10, 12, 14, 16, 32)  # of integers, whatever the width in the file
BEYOND = 16.0  # floats up to this many times white are highlights; larger ones are treated like integers
# A photo whose range is a smaller share of its set's range is of a different kind, not a dark photo.
OTHER = 1 / 16
GREYS, RGB, ALPHA = (0, 1), 2, (1, 2)  # of the tags PhotometricInterpretation (0: zero is white) and ExtraSamples
# OpenCV turns TIFF files upright; for each orientation, the turn back to the stored pixels.
STORED: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    2: np.fliplr, 3: partial(np.rot90, k=2), 4: np.flipud, 5: partial(np.swapaxes, axis1=0, axis2=1), 6: np.rot90,
    7: lambda pixels: np.rot90(pixels, 2).swapaxes(0, 1), 8: partial(np.rot90, k=-1),
}  # fmt: skip


@dataclass(frozen=True)
class Deep:
    """The header of a file with more than 8 bits per channel."""

    size: tuple[int, int]  # width and height, px
    known: bool = True  # whether PIL supports this kind of file, though not all its bits
    planes: bool = False  # whether its channels are stored one after the other
    alpha: bool = True  # whether a fourth channel is transparency
    inverted: bool = False  # whether zero is white
    orientation: int | None = None  # as in EXIF; None for a PNG, whose EXIF is read later


def deep_header(path: Path) -> Deep | None:
    """The header of a file; None for 8 bits, for colours other than grey and RGB, and for files other than PNG and
    TIFF."""
    try:
        with open(path, "rb") as file:
            head = file.read(32)
            if head.startswith(PNG):
                return Deep(struct.unpack(">II", head[16:24])) if head[24] == 16 else None
            if not head.startswith(TIFFS):
                return None
            tags = ImageFileDirectory_v2(head[:16] if b"+" in head[2:4] else head[:8])
            file.seek(tags.next)
            tags.load(file)
        bits = max(tags.get(ExifTags.Base.BitsPerSample, (1,)))
        floats = max(tags.get(ExifTags.Base.SampleFormat, (1,))) == 3
        planar = tags.get(ExifTags.Base.PlanarConfiguration, 1) == 2
        shown = tags[ExifTags.Base.PhotometricInterpretation]
        if (bits <= 8 and not floats) or shown not in (*GREYS, RGB):
            return None
        return Deep(
            (tags[ExifTags.Base.ImageWidth], tags[ExifTags.Base.ImageLength]), known=bits <= 16 and not floats,
            planes=planar and tags.get(ExifTags.Base.SamplesPerPixel, 1) > 1,
            alpha=max(tags.get(ExifTags.Base.ExtraSamples, (0,))) in ALPHA, inverted=shown == 0,
            orientation=int(tags.get(ExifTags.Base.Orientation, 1)),
        )  # fmt: skip
    except (OSError, SyntaxError, ValueError, KeyError, TypeError, IndexError, struct.error):
        return None  # PIL reports the fault later.


def deep_values(path: Path, header: Deep) -> np.ndarray:
    """The numbers of a file, as stored: grey [H, W], RGB [H, W, 3] or RGBA [H, W, 4]. Raises SdfsimError if it is
    damaged or its layout is not supported."""
    import cv2

    if header.planes:
        raise SdfsimError(f"{path}: more than 8 bits with planar channels: not supported", OTHERWISE)
    before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        values = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except (OSError, cv2.error):
        values = None
    finally:
        cv2.utils.logging.setLogLevel(before)
    if values is not None and header.orientation in STORED:
        values = STORED[header.orientation](values)
    if values is None or values.dtype == np.uint8 or values.shape[1::-1] != header.size:
        raise SdfsimError(f"{path}: more than 8 bits, and damaged or in a compression that is not supported", OTHERWISE)
    if values.ndim == 3:
        values = values[..., [2, 1, 0, 3] if values.shape[2] == 4 and header.alpha else [2, 1, 0]]
    if not np.isfinite(values).any() or values.min() < -0.1 * np.abs(values).max():
        low, high = np.nanmin(values), np.nanmax(values)
        raise SdfsimError(f"{path}: values from {low:.3g} to {high:.3g}; photos have none below 0", OTHERWISE)
    return values


def white_of(values: np.ndarray) -> float:
    """The value of white, given the largest values: 1 for floats; for integers the maximum of the bits that they
    need."""
    most = float(np.nanmax(values, initial=0.0, where=np.isfinite(values)))
    if values.dtype.kind == "f" and most <= BEYOND:
        return max(1.0, most)
    signed = values.dtype.kind == "i"  # with half as many numbers above 0
    whites = [2.0 ** (bits - (signed and bits >= 16)) - 1 for bits in BITS]
    return next((white for white in whites if most <= white), most)


def common_white(paths: Sequence[Path]) -> dict[Path, float]:
    """White of each photo in a set with more than 8 bits: the same for all, so that a dark photo stays darker than the
    others. Raises the errors of `deep_values`."""
    own: dict[Path, float] = {}
    for path in paths:
        if (header := deep_header(path)) is not None:
            own[path] = white_of(deep_values(path, header)[..., :3])
    most = max(own.values(), default=0.0)
    return {path: most if white > OTHER * most else white for path, white in own.items()}


def eight_bits(values: np.ndarray, header: Deep, white: float | None = None) -> np.ndarray:
    """Numbers from `deep_values` as uint8 of the same shape; `white` comes from their own range if not given."""

    def scaled(part: np.ndarray, most: float) -> np.ndarray:
        return (255 * np.nan_to_num(part / np.float32(most), posinf=1.0).clip(0, 1) + 0.5).astype(np.uint8)

    if values.ndim == 2:
        grey = scaled(values, white or white_of(values))
        return 255 - grey if header.inverted else grey
    colors = scaled(values[..., :3], white or white_of(values[..., :3]))
    opaque = [scaled(values[..., 3:], white_of(values[..., 3:]))] if values.shape[2] == 4 else []
    return np.concatenate([colors, *opaque], 2)
