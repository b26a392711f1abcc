"""The user's input -> upright photos of limited size with masks and focal priors."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image
from pydantic import TypeAdapter

from pipeline.cameras import View, save_views
from pipeline.inputs.bit_depth import common_white
from pipeline.inputs.captures import CAPTURE, read_depth, spread, unpack
from pipeline.inputs.images import (
    BLURRED,
    DARK,
    ReadPhoto,
    brightness,
    is_panorama,
    read_photo,
    reduced,
    sharpness,
    whiteness,
)
from pipeline.inputs.known_cameras import KnownCamera, Lens, rectified
from pipeline.inputs.labels import FOLDER, NAMES
from pipeline.inputs.sources import Source, find_source
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_json, write_json
from sdfsim.base.parallel import Progress, silent

LONG_SIDE = 1600  # px; later steps reduce the photos to the size that they need
KNOWN_CAMERAS = "known_cameras.json"  # cameras that came with the photos
BLOWN = (0.5, 0.3, 0.9)  # share of a photo that is white, and by how much more than in the median photo; or in any case
NAMED = 8  # photos named one by one in a note
PANORAMAS = (
    "these are not read: cut each into flat views of 60 to 90 degrees (as `ffmpeg -vf v360=e:flat` does), all with the "
    "same width, and give those; or take ordinary photos"
)
# What makes a photo useless, and what helps.
FAULTS = {
    "too dark": "take them again with more light", "blown out": "take them again with less light or exposure",
    "blurred": "take them again",
}  # fmt: skip


@dataclass(frozen=True)
class Photo:
    """One prepared photo."""

    name: str  # file name in `images/` (and, with `.png` added, in `masks/`)
    source: str  # the user's name for it, see `Source.name_of`, or the video's with a time; unique
    width: int  # prepared width, px
    height: int  # prepared height, px
    # width and height of the user's photo, px, turned like the prepared one; for a video frame those prepared
    original: tuple[int, int]
    lens: Lens | None  # the removed lens; None if the photo had no distortion
    focal: float | None  # from EXIF, px of the prepared photo; None if EXIF has none
    camera: str  # make and model from EXIF, empty where unknown
    mask: bool  # whether a mask came with it, as alpha or as a file
    sharpness: float  # see `sharpness`; 0.2 to 0.6 for photos in focus
    fault: str = ""  # "too dark", "blown out", "blurred" or nothing
    depth: bool = False  # whether depth came with it
    white: float = 0.0  # share of it that is white

    def prepared(self, pixels: np.ndarray, view: View) -> np.ndarray:
        """Pixels [P, 2] of the prepared photo, with camera `view`, from those of the user's photo."""
        found = pixels * np.array([self.width, self.height]) / self.original
        return found if self.lens is None else self.lens.straight(found, view)


def prepare_photos(
    given: Path, out: Path, *, long_side: int = LONG_SIDE, on_progress: Progress = silent
) -> tuple[list[Photo], list[str]]:
    """Reads every photo (see `find_source`) and writes upright copies of at most `long_side` px to `out`.

    Writes `images/NNNN.jpg` and `photos.json`; if they were given, also `masks/NNNN.jpg.png`, `depth/NNNN.jpg.npy`,
    `labels/NNNN.jpg.png` with their names, `known_cameras.json` and `capture.json`. Returns the photos in order, and
    notes for the report.
    """
    out = Path(out)
    with opened(given, out / ".capture") as source:
        round_about = [path for path in source.photos if is_panorama(path)] if not source.frames else []
        if len(round_about) > len(source.photos) / 2:
            message = f"{given}: {len(round_about)} photos are panoramas of 360 degrees (first: {round_about[0].name})"
            raise SdfsimError(message, PANORAMAS)
        (out / "images").mkdir(parents=True, exist_ok=True)
        photos: list[Photo] = []
        views: list[View] = []
        for origin, picture, known, fraction in pictures(source, long_side):
            name, lens = f"{len(photos):04d}.jpg", None
            if known:
                picture, view, lens = rectified(picture, known, name, origin)
                views.append(view)
            Image.fromarray(picture.pixels).save(out / "images" / name, quality=95, subsampling=0)
            for folder, shown in (("masks", picture.mask), (FOLDER, picture.labels)):
                if shown is not None:
                    (out / folder).mkdir(exist_ok=True)
                    Image.fromarray(shown).save(out / folder / f"{name}.png")
            if known and known.depth:
                depth = read_depth(known.depth)
                _check_shape(known.depth.path, depth.shape[::-1], known)
                (out / "depth").mkdir(exist_ok=True)
                np.save(out / "depth" / f"{name}.npy", depth)
            height, width = picture.pixels.shape[:2]
            sharp = round(sharpness(picture.pixels), 4)
            focal = None if known else picture.focal  # A known camera needs no prior.
            photos.append(
                Photo(name, origin, width, height, picture.original, lens, focal, picture.camera,
                      picture.mask is not None, sharp, "too dark" if brightness(picture) < DARK else "",
                      bool(known and known.depth), round(whiteness(picture), 4))
            )  # fmt: skip
            on_progress(fraction, f"{len(photos)} photos")
        # Relative to the set's typical value: if all photos are blurred alike, the scene may be the cause.
        least = max(BLURRED, 0.35 * float(np.quantile([p.sharpness for p in photos], 0.75)))
        usual = float(np.median([p.white for p in photos]))  # as before a white background
        for k, p in enumerate(photos):
            blown = p.white > BLOWN[2] or p.white > max(BLOWN[0], usual + BLOWN[1])
            fault = p.fault or ("blown out" if blown else "blurred" if p.sharpness < least else "")
            photos[k] = replace(p, fault=fault)
        if views:
            save_views(views, out / KNOWN_CAMERAS)
        if source.capture:
            write_json(out / CAPTURE, {"version": 1, **asdict(source.capture)})
        if source.labels.names:
            write_json(out / FOLDER / NAMES, {"version": 1, "names": list(source.labels.names)})
        save_photos(photos, out)
        return photos, [*source.notes, *notes_on(photos, len(source.masks))]


@contextmanager
def opened(given: Path, unpacked: Path) -> Iterator[Source]:
    """The user's input (see `find_source`); an archive is in the folder `unpacked` until the block ends, and a
    recording has only the photos that are used. Raises the errors of `find_source` and `unpack`."""
    source = find_source(given)
    try:
        if source.archive is not None:
            unpack(source.archive, unpacked)
            source = find_source(unpacked, unpacked=True)
        if source.capture:
            source = replace(source, photos=tuple(spread(source.photos, source.frames)))
        yield source
    except SdfsimError as error:  # which may name temporary files
        message, hint = (text.replace(str(unpacked), str(given)) for text in (error.message, error.hint))
        raise SdfsimError(message, hint, exit_code=error.exit_code) from error
    shutil.rmtree(unpacked, ignore_errors=True)


def pictures(source: Source, long_side: int = LONG_SIDE) -> Iterator[tuple[str, ReadPhoto, KnownCamera | None, float]]:
    """Name, picture, camera if it is known, and share done, for every photo of an input that is not an archive."""
    if source.video:
        from pipeline.inputs.video import chosen_frames

        for name, pixels, fraction in chosen_frames(source.video):
            image = Image.fromarray(pixels)
            image.thumbnail((long_side, long_side), Image.Resampling.LANCZOS)
            yield name, ReadPhoto(np.asarray(image), image.size), None, fraction
        return
    masks = source.masks
    # Masks are used if every photo has one, or has transparency.
    lacking = [path for path in source.photos if path not in masks] if masks else []
    if any(read_photo(path, long_side).mask is None for path in lacking):
        masks = {}
    white = common_white(source.photos)
    for index, path in enumerate(source.photos):
        camera = source.frames.get(path)
        shape = camera.width / camera.height if camera and camera.height else None
        picture = read_photo(path, long_side, masks.get(path), shape, white.get(path))
        size = picture.pixels.shape[1::-1]
        _check_shape(path, size, camera)
        picture = replace(picture, labels=source.labels.of(path, size))
        yield source.name_of(path), picture, camera, (index + 1) / len(source.photos)


def _check_shape(path: Path, size: tuple[int, int], camera: KnownCamera | None) -> None:
    """Checks that a photo or depth of this width and height has the aspect ratio of its camera's photo."""
    if camera and camera.height and abs(size[0] / size[1] / (camera.width / camera.height) - 1) > 0.02:
        message = f"{path}: shaped {size[0]} x {size[1]}, but its camera's photo {camera.width} x {camera.height}"
        raise SdfsimError(message, "give the photos and depth that the cameras were found for, uncropped and as turned")


def notes_on(photos: list[Photo], mask_files: int) -> list[str]:
    """Notes for users about a set of photos, some of which came with mask files; one line each."""
    notes = []
    masked = sum(p.mask for p in photos)
    if masked < len(photos) and (masked or mask_files):
        notes.append(f"masks are used only if every photo has one: {mask_files} mask files are ignored, and what is "
                     f"transparent in {masked} photos is grey")  # fmt: skip
    for fault, again in FAULTS.items():
        names = [p.source for p in photos if p.fault == fault]
        if names:
            named = ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
            notes.append(f"{len(names)} of {len(photos)} photos are {fault}, {again}: {named}")
    return notes


def open_photo(folder: Path, view: View, mode: str = "RGB", long_side: float = np.inf) -> Image.Image:
    """The prepared photo of a view, in one of PIL's modes, reduced to `long_side` px. Raises SdfsimError if it cannot
    be read."""
    image = _opened(Path(folder) / "images" / view.name)
    return image.convert(mode).resize(reduced(image.size, long_side), Image.Resampling.BOX)


def open_mask(folder: Path, view: View, size: tuple[int, int]) -> np.ndarray:
    """The mask [H, W] uint8 of a view at a size (width, height), px. Raises SdfsimError if it cannot be read."""
    image = _opened(Path(folder) / "masks" / f"{view.name}.png")
    return np.asarray(image.convert("L").resize(size, Image.Resampling.BOX))


def _opened(path: Path) -> Image.Image:
    try:
        with Image.open(path) as image:
            image.load()
            return image
    except OSError as error:
        raise SdfsimError(f"{path}: cannot be read", "run the photos stage again") from error


def save_photos(photos: list[Photo], folder: Path) -> None:
    """Writes `photos.json`."""
    write_json(folder / "photos.json", {"version": 1, "photos": [asdict(p) for p in photos]})


def load_photos(folder: Path) -> list[Photo]:
    """The photos that `prepare_photos` wrote to `folder`. Raises SdfsimError if the photos stage has not run."""
    path = Path(folder) / "photos.json"
    data = read_json(path, "run the photos stage first")
    try:
        return TypeAdapter(list[Photo]).validate_python(data["photos"])
    except (ValueError, KeyError, TypeError) as error:
        raise SdfsimError(f"{path}: damaged", "run the photos stage again") from error
