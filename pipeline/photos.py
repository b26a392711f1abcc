"""A folder of photos -> upright, sized images with masks and focal priors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

from sdfsim.errors import SdfsimError
from sdfsim.files import read_json, write_json

MIN_PHOTOS = 3
MIN_SIDE = 64
MAX_PIXELS = 200_000_000
SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp"}
UNREADABLE = {".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw"}
# Photos with an alpha mask are shown on this grey; it has no texture, so it adds no features.
BACKDROP = 0.5


@dataclass(frozen=True)
class Photo:
    """One prepared photo.

    Attributes:
        name: file name under `images/` (and, with `.png` added, under `masks/`).
        source: file name the user gave.
        width: prepared width, px.
        height: prepared height, px.
        focal: focal length read from EXIF, px of the prepared photo; None where EXIF has none.
        camera: make and model from EXIF, empty where unknown.
        mask: whether an alpha mask came with it.
        sharpness: variance of the Laplacian of the grey image in 0..1; larger is sharper.
    """

    name: str
    source: str
    width: int
    height: int
    focal: float | None
    camera: str
    mask: bool
    sharpness: float


def find_photos(folder: Path) -> tuple[list[Path], list[str]]:
    """The photo files of a folder in name order, and notes on what was passed over.

    A folder whose photos all lie in a subfolder `images` is read there.

    Raises:
        SdfsimError: the folder is missing, holds no photos, or fewer than three.
    """
    folder = Path(folder)
    if not folder.exists():
        raise SdfsimError(f"{folder}: no such folder", "give the folder that holds the photos")
    if not folder.is_dir():
        raise SdfsimError(f"{folder}: not a folder", "give the folder that holds the photos, not a single file")
    try:
        entries = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    except OSError as error:
        raise SdfsimError(f"{folder}: cannot be read ({error.strerror})") from error
    found = [p for p in entries if p.suffix.lower() in SUFFIXES]
    if not found and (folder / "images").is_dir():
        return find_photos(folder / "images")
    notes = []
    raw = [p.name for p in entries if p.suffix.lower() in UNREADABLE]
    other = [p.name for p in entries if p not in found and p.name not in raw]
    if raw:
        notes.append(f"{len(raw)} files in a format that is not read (first: {raw[0]}); convert them to JPEG")
    if other:
        notes.append(f"{len(other)} files that are not photos were ignored (first: {other[0]})")
    if len(found) < MIN_PHOTOS:
        have = f"{len(found)} photo{'s' * (len(found) != 1)}" if found else "no photos"
        raise SdfsimError(
            f"{folder}: {have} found, at least {MIN_PHOTOS} are needed (20 to 60 are good)",
            "; ".join(n for n in notes if "convert" in n)
            or "take photos around the object, each overlapping the one before by two thirds",
        )
    return found, notes


def exif_focal(image: Image.Image) -> tuple[float | None, str]:
    """Focal length in units of the image's longer side, and the camera's name, from EXIF.

    Uses the 35 mm equivalent (a 36 mm wide frame) or the focal length with the focal plane resolution.
    """
    try:
        exif = image.getexif()
        detail = exif.get_ifd(ExifTags.IFD.Exif)
        camera = " ".join(str(exif.get(tag, "")).strip("\0 ") for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
        equivalent = float(detail.get(ExifTags.Base.FocalLengthIn35mmFilm) or 0)
        if equivalent > 0:
            return equivalent / 36.0, camera.strip()
        focal = float(detail.get(ExifTags.Base.FocalLength) or 0)
        density = float(detail.get(ExifTags.Base.FocalPlaneXResolution) or 0)
        unit = {2: 25.4, 3: 10.0, 4: 1.0}.get(int(detail.get(ExifTags.Base.FocalPlaneResolutionUnit) or 2), 25.4)
        if focal > 0 and density > 0:
            ratio = focal / unit * density / max(image.size)
            if 0.3 < ratio < 20:
                return ratio, camera.strip()
        return None, camera.strip()
    except (ValueError, TypeError, ZeroDivisionError, OSError, SyntaxError):
        return None, ""  # Broken EXIF is common and never worth failing for.


def read_photo(path: Path, long_side: int) -> tuple[np.ndarray, np.ndarray | None, float | None, str]:
    """Reads one photo upright and no larger than `long_side`.

    Args:
        path: the file.
        long_side: limit of the longer side, px; smaller photos stay as they are.

    Returns:
        RGB [H, W, 3] uint8; mask [H, W] uint8 (255 = object) or None; focal prior in px or None; camera name.

    Raises:
        SdfsimError: not an image, truncated, too small or too large; the message names the file.
    """
    limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None  # Our own limit below, before anything is decoded.
    try:
        with Image.open(path) as image:
            width, height = image.size
            if width * height > MAX_PIXELS:
                raise SdfsimError(
                    f"{path}: too large ({width} x {height}, at most {MAX_PIXELS // 1_000_000} megapixels)",
                    "scale it down first",
                )
            if min(width, height) < MIN_SIDE:
                raise SdfsimError(f"{path}: too small ({width} x {height}, at least {MIN_SIDE} px a side)")
            focal, camera = exif_focal(image)
            if image.format == "JPEG":
                # The decoder may skip to a smaller size, but no smaller than twice what is wanted.
                image.draft("RGB", (2 * long_side, 2 * long_side))
            image.load()
            upright = ImageOps.exif_transpose(image)
    except SdfsimError:
        raise
    except UnidentifiedImageError as error:
        raise SdfsimError(f"{path}: not an image, in spite of its name", "remove it or replace it") from error
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        what = "truncated" if "truncated" in str(error) else f"cannot be decoded ({error})"
        raise SdfsimError(f"{path}: {what}", "copy it again from the camera, or remove it") from error
    except Image.DecompressionBombError as error:
        raise SdfsimError(f"{path}: too large", "scale it down first") from error
    finally:
        Image.MAX_IMAGE_PIXELS = limit
    if upright.mode.startswith("I"):  # 16 bits a pixel; PIL would clip instead of scaling.
        upright = Image.fromarray((np.asarray(upright).astype(np.uint32) >> 8).astype(np.uint8))
    has_alpha = upright.mode in ("RGBA", "LA", "PA") or "transparency" in upright.info
    upright = upright.convert("RGBA" if has_alpha else "RGB")
    scale = min(1.0, long_side / max(upright.size))
    if scale < 1.0:
        size = (max(1, round(upright.width * scale)), max(1, round(upright.height * scale)))
        upright = upright.resize(size, Image.Resampling.LANCZOS)
    pixels = np.asarray(upright)
    mask = None
    if has_alpha:
        alpha = pixels[..., 3:].astype(np.float32) / 255
        pixels = (255 * (pixels[..., :3] / 255.0 * alpha + BACKDROP * (1 - alpha)) + 0.5).astype(np.uint8)
        if alpha.min() < 0.5:
            mask = (alpha[..., 0] * 255).astype(np.uint8)
    return pixels[..., :3], mask, focal * max(pixels.shape[:2]) if focal else None, camera


def sharpness(pixels: np.ndarray) -> float:
    """Variance of the Laplacian of an RGB image [H, W, 3] uint8, on grey values in 0..1."""
    grey = pixels.astype(np.float32).mean(-1) / 255
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * grey[1:-1, 1:-1]
    return float(laplacian.var())


def prepare_photos(
    folder: Path, out: Path, *, long_side: int, on_progress: Callable[[float, str], None] | None = None
) -> tuple[list[Photo], list[str]]:
    """Reads every photo of `folder` and writes upright, sized copies to `out`.

    Writes `images/NNNN.jpg`, for photos with alpha `masks/NNNN.jpg.png`, and `photos.json`.

    Args:
        folder: where the user's photos lie; never written to.
        out: an existing folder.
        long_side: limit of the longer side, px.
        on_progress: called with (fraction, message).

    Returns:
        The photos in name order, and notes for the report.

    Raises:
        SdfsimError: see `find_photos` and `read_photo`.
    """
    paths, notes = find_photos(folder)
    out = Path(out)
    (out / "images").mkdir(parents=True, exist_ok=True)
    photos = []
    for index, path in enumerate(paths):
        pixels, mask, focal, camera = read_photo(path, long_side)
        name = f"{index:04d}.jpg"
        Image.fromarray(pixels).save(out / "images" / name, quality=95, subsampling=0)
        if mask is not None:
            (out / "masks").mkdir(exist_ok=True)
            Image.fromarray(mask).save(out / "masks" / (name + ".png"))
        height, width = pixels.shape[:2]
        photos.append(
            Photo(name, path.name, width, height, focal, camera, mask is not None, round(sharpness(pixels), 7))
        )
        if on_progress:
            on_progress((index + 1) / len(paths), f"{index + 1} of {len(paths)} photos")
    masked = sum(p.mask for p in photos)
    if 0 < masked < len(photos):
        notes.append(
            f"{masked} of {len(photos)} photos have an alpha mask: ignored, as masks count only where all have one"
        )
    sizes = sorted({(p.width, p.height) for p in photos})
    if len(sizes) > 1:
        notes.append("photos of several sizes: " + ", ".join(f"{w} x {h}" for w, h in sizes) + "; one camera for each")
    typical = float(np.median([p.sharpness for p in photos]))
    blurred = [p.source for p in photos if p.sharpness < 0.15 * typical]
    if blurred:
        notes.append(f"{len(blurred)} photos are much blurrier than the others: {', '.join(blurred[:5])}")
    save_photos(photos, out)
    return photos, notes


def save_photos(photos: list[Photo], folder: Path) -> None:
    """Writes `photos.json`."""
    write_json(Path(folder) / "photos.json", {"version": 1, "photos": [asdict(p) for p in photos]})


def load_photos(folder: Path) -> list[Photo]:
    """Reads the photos that `prepare_photos` wrote to `folder`.

    Raises:
        SdfsimError: the folder was not written by the photos stage.
    """
    path = Path(folder) / "photos.json"
    data = read_json(path, "run the photos stage first")
    try:
        return [Photo(**entry) for entry in data["photos"]]
    except (KeyError, TypeError) as error:
        raise SdfsimError(f"{path}: damaged", "run the photos stage again") from error
