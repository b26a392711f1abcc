"""One image file -> upright pixels, its mask, the lens data of EXIF, and whether it is sharp and well
lit; and pictures of different sizes in one array."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pi_heif import register_heif_opener
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

from pipeline.inputs.bit_depth import OTHERWISE, TIFFS, deep_header, deep_values, eight_bits
from sdfsim.base.errors import SdfsimError

register_heif_opener(thumbnails=False)

MIN_SIDE = 64
MAX_PIXELS = 200_000_000
# PIL's names. PIL reads more formats, and starts a program for some of them, whatever the file's name is.
FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP", "AVIF", "HEIF")
# Photos with a mask get this grey background; it has no texture, so it adds no features.
BACKDROP = 0.5
# Measured on three real and four rendered sets: photos in focus have 0.19 to 0.6, blurred by 1.5 px less than 0.08.
BLURRED = 0.1
BLOCKS = 12  # per side, fewer for small photos
DARK = 0.1  # of white: a hundredth of a photo has to reach this
WHITE = 250  # of 255: brighter pixels show nothing


@dataclass(frozen=True)
class ReadPhoto:
    """A photo after reading."""

    pixels: np.ndarray  # RGB [H, W, 3] uint8
    # width and height of the whole photo before it was reduced, px; turned like `pixels`
    original: tuple[int, int]
    mask: np.ndarray | None = None  # [H, W] uint8 (255 = object), or None
    focal: float | None = None  # prior from EXIF, px of `pixels`, or None
    camera: str = ""  # make and model, empty if unknown
    labels: np.ndarray | None = None  # [H, W] uint8, see `Labels.of`, or None


def exif_focal(image: Image.Image) -> tuple[float | None, str]:
    """Focal length in units of the image's longer side, and the camera's name, from EXIF. If the aspect ratio differs
    from that in EXIF, the photo was cropped and its focal length is unknown."""
    try:
        exif, tags = image.getexif(), ExifTags.Base
        detail = exif.get_ifd(ExifTags.IFD.Exif)
        camera = " ".join(str(exif.get(tag, "")).strip("\0 ") for tag in (tags.Make, tags.Model)).strip()

        def number(tag: int) -> float:
            return float(detail.get(tag) or 0)

        width, height = number(tags.ExifImageWidth), number(tags.ExifImageHeight)
        longer, shorter = max(width, height), min(width, height)
        if shorter > 0 and abs(longer / shorter * min(image.size) / max(image.size) - 1) > 0.02:
            return None, camera
        if number(tags.FocalLengthIn35mmFilm) > 0:  # of a frame that is 36 mm wide
            return number(tags.FocalLengthIn35mmFilm) / 36.0, camera
        unit = {2: 25.4, 3: 10.0, 4: 1.0}.get(int(number(tags.FocalPlaneResolutionUnit)), 25.4)
        # The density is that of the original photo: a copy at half the size has half of it.
        ratio = number(tags.FocalLength) / unit * number(tags.FocalPlaneXResolution) / (longer or max(image.size))
        return (ratio if 0.3 < ratio < 20 else None), camera
    except (ValueError, TypeError, ZeroDivisionError, OSError, SyntaxError):
        return None, ""  # Broken EXIF is common and no reason to fail.


def read_photo(
    path: Path, long_side: int, mask: Path | None = None, shape: float | None = None, white: float | None = None
) -> ReadPhoto:
    """Reads one photo upright and no larger than `long_side` px; a mask file has priority over an alpha channel.

    If a known camera has a different `shape`, width over height, from the upright photo, the photo stays as stored.
    `white` is the value of white in a file of more than 8 bits (see `common_white`), by default from its own range.
    Raises SdfsimError, with the file's name, if it is no image, truncated, too small or too large.
    """
    image, original, focal, camera = shown(path, long_side, white)
    turned = ImageOps.exif_transpose(image)
    if shape is not None and misfit(turned, shape) > misfit(image, shape):
        turned = image
    if turned.size != image.size:
        original = original[1], original[0]
    has_alpha = turned.mode in ("RGBA", "LA", "PA") or "transparency" in turned.info
    upright = turned.convert("RGBA" if has_alpha else "RGB")
    upright = upright.resize(reduced(upright.size, long_side), Image.Resampling.LANCZOS)
    pixels, inside = np.asarray(upright), None
    if mask is not None:
        inside = read_mask(mask, upright.size)
    elif has_alpha and pixels[..., 3].min() < 128:
        inside = pixels[..., 3]
    if inside is not None:
        share = inside[..., None].astype(np.float32) / 255
        pixels = (255 * (pixels[..., :3] / 255.0 * share + BACKDROP * (1 - share)) + 0.5).astype(np.uint8)
    return ReadPhoto(
        np.ascontiguousarray(pixels[..., :3]), original, inside,
        focal * max(pixels.shape[:2]) if focal else None, camera,
    )  # fmt: skip


def read_mask(path: Path, size: tuple[int, int]) -> np.ndarray:
    """A mask [H, W] uint8, grey or with alpha, at the size (width, height) of its upright photo. White is the object;
    if a mask has only 0 and 1, 1 is the object. Raises SdfsimError if it cannot be read or is not shaped like the
    photo."""
    image = turned_like(shown(path, max(size))[0], size, path)
    grey = image.getchannel("A") if image.mode == "RGBA" else image.convert("L")
    if grey.getextrema() == (0, 1):
        grey = grey.point(lambda value: 255 * value)
    return np.asarray(grey.resize(size, Image.Resampling.BOX))


def turned_like(stored: Image.Image, size: tuple[int, int], path: Path) -> Image.Image:
    """A mask turned like its photo of this size (width, height): upright, or as stored. Raises SdfsimError if
    neither is shaped like the photo."""
    for image in (ImageOps.exif_transpose(stored), stored):
        if misfit(image, size[0] / size[1]) < 0.02:
            return image
    given = f"{stored.width} x {stored.height}"
    raise SdfsimError(f"{path}: a mask of {given} does not fit its photo, shaped {size[0]} x {size[1]}")


def shown(
    path: Path, long_side: int, white: float | None = None
) -> tuple[Image.Image, tuple[int, int], float | None, str]:
    """The result of `decoded`, reduced to 8 bits per channel if the file has more."""
    header = deep_header(path)
    if header is None:
        return decoded(path, long_side)
    focal, camera, orientation = None, "", header.orientation
    if header.known:
        image, _, focal, camera = decoded(path, long_side)
        if orientation is None:
            orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
    check_size(path, header.size)
    image = Image.fromarray(eight_bits(deep_values(path, header), header, white))
    image.getexif()[ExifTags.Base.Orientation] = orientation
    return image, header.size, focal, camera


def stored_size(path: Path) -> tuple[int, int]:
    """Width and height, px, of a photo as stored. Raises OSError if it is not an image."""
    with Image.open(path, formats=FORMATS) as image:
        return image.size


def check_size(path: Path, size: tuple[int, int]) -> None:
    """Raises SdfsimError for an image of a width and height, px, that is too large or too small."""
    width, height = size
    if width * height > MAX_PIXELS:
        raise SdfsimError(f"{path}: too large ({width} x {height}, at most {MAX_PIXELS // 1_000_000} megapixels)")
    if min(size) < MIN_SIDE:
        raise SdfsimError(f"{path}: too small ({width} x {height}, at least {MIN_SIDE} px a side)")


def decoded(path: Path, long_side: int) -> tuple[Image.Image, tuple[int, int], float | None, str]:
    """A decoded image, its size in the file, its focal length in longer sides, and its camera."""
    limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None  # Our own limit below applies before decoding.
    try:
        with Image.open(path, formats=FORMATS) as image:
            size = image.size
            check_size(path, size)
            focal, camera = exif_focal(image)
            if image.format == "JPEG":
                # The decoder may reduce the size, but not below twice the wanted size.
                image.draft("RGB", (2 * long_side, 2 * long_side))
            image.load()
            return image, size, focal, camera
    except UnidentifiedImageError as error:
        with open(path, "rb") as file:
            tiff = file.read(4) in TIFFS
        if tiff:
            raise SdfsimError(f"{path}: damaged, or a kind of TIFF that is not supported", OTHERWISE) from error
        message = f"{path}: not an image, whatever its name says, or cut short"
        raise SdfsimError(message, "remove it or replace it") from error
    except (OSError, SyntaxError, ValueError, EOFError, RuntimeError) as error:
        why = " ".join(str(error).split())
        raise SdfsimError(
            f"{path}: cannot be decoded ({why})", "copy it again from the camera, or remove it"
        ) from error
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def reduced(size: tuple[int, int], long_side: float) -> tuple[int, int]:
    """Width and height, px, of a picture reduced to `long_side`."""
    scale = min(1.0, long_side / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def misfit(image: Image.Image, shape: float) -> float:
    """Share by which an image is wider or narrower than a shape, width over height."""
    return abs(image.width / image.height / shape - 1)


def brightness(picture: ReadPhoto) -> float:
    """Brightness of the lightest hundredth of a photo, or of its object if it has a mask; from 0 to 1."""
    grey = picture.pixels.astype(np.float32).mean(-1) / 255
    inside = grey if picture.mask is None else grey[picture.mask >= 128]
    return float(np.quantile(inside, 0.99)) if inside.size else 1.0


def is_panorama(path: Path) -> bool:
    """Whether a photo shows all directions in one picture of 2:1: it says so, or its sides join and its top and bottom,
    each a single direction, have one colour."""
    try:
        width, height = stored_size(path)
        if abs(width / height - 2) > 0.01:
            return False
        with open(path, "rb") as file:
            if b"equirectangular" in file.read(1 << 16):  # in its XMP
                return True
        small = np.asarray(decoded(path, 512)[0].convert("RGB").resize((512, 256), Image.Resampling.BOX), float)
    except (OSError, SdfsimError, Image.DecompressionBombError):  # what is wrong with it is named when it is read
        return False
    joins = np.abs(small[:, 0] - small[:, -1]).mean() < 0.35 * np.abs(small - np.roll(small, 128, 1)).mean()
    top, middle, bottom = (small[row].std(0).mean() for row in (0, 128, -1))
    return bool(joins and max(top, bottom) < 0.35 * middle)


def whiteness(picture: ReadPhoto) -> float:
    """Share of a photo, or of its object if it has a mask, that is white."""
    white = picture.pixels.min(-1) >= WHITE
    inside = white if picture.mask is None else white[picture.mask >= 128]
    return float(inside.mean()) if inside.size else 0.0


def sharpness(pixels: np.ndarray) -> float:
    """Strength of edges at the finest scale relative to a scale eight times as coarse, in RGB [H, W, 3] uint8.

    Uses only the tenth of the picture's blocks with the most edges, so that an object in focus in front of a soft
    background counts as sharp. 0 if there are no edges.
    """
    import cv2

    grey = pixels.astype(np.float32).mean(-1) / 255
    rows, columns = (side // 8 for side in grey.shape)
    rough = cv2.resize(grey[: 8 * rows, : 8 * columns], (columns, rows), interpolation=cv2.INTER_AREA)
    blocks = min(BLOCKS, rows - 2, columns - 2)
    edges = (cv2.Laplacian(at, -1)[1:-1, 1:-1] ** 2 for at in (rough, grey))
    coarse, fine = (cv2.resize(at, (blocks, blocks), interpolation=cv2.INTER_AREA).ravel() for at in edges)
    chosen = np.argsort(coarse)[-max(1, len(fine) // 10) :]
    strong = float(coarse[chosen].mean())
    return float(np.sqrt(fine[chosen].mean() / strong)) if strong > 1e-6 else 0.0


def stacked(pictures: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Pictures [N, h, w] float32 of different sizes in one array, and their heights and widths [N, 2]."""
    sizes = np.array([picture.shape for picture in pictures])
    if (sizes == sizes[0]).all():
        return np.array(pictures, np.float32), sizes
    whole = np.zeros((len(pictures), *sizes.max(0)), np.float32)
    for number, picture in enumerate(pictures):
        whole[number, : picture.shape[0], : picture.shape[1]] = picture
    return whole, sizes
