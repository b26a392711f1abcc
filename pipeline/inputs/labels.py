"""The object at each pixel: masks by object, or label images, that came with the photos."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.inputs.images import decoded, read_mask, turned_like
from pipeline.naming import NAMING, can_be_named
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_json, visible

MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp")
FOLDER, NAMES = "labels", "names.json"  # written by the photos stage
MASKS = ("masks", "mask")  # folders
UNKNOWN = 255  # a pixel without information


@dataclass(frozen=True)
class Labels:
    """Object masks, or label images, of a set of photos."""

    # mask file of each object for each photo that has one: white is the object
    masks: dict[Path, dict[str, Path]] = field(default_factory=dict)
    images: dict[Path, Path] = field(default_factory=dict)  # label image of each photo that has one
    # of the objects; pixels of a prepared label image count from 1 in this order, 0 is no object
    names: tuple[str, ...] = ()
    values: tuple[int, ...] = ()  # label of each object in `images`; empty if masks are given
    notes: tuple[str, ...] = ()  # skipped files, for the report

    def files(self) -> list[Path]:
        """Every file whose content the result depends on."""
        return sorted([path for each in self.masks.values() for path in each.values()] + list(self.images.values()))

    def of(self, photo: Path, size: tuple[int, int]) -> np.ndarray | None:
        """Number of the object at each pixel [H, W] uint8 of a photo that is width x height upright; None: not given.

        If some objects have no mask for this photo, a pixel outside the other masks is `UNKNOWN`; so is a pixel in two
        masks. Raises SdfsimError if a file cannot be read or is not shaped like the photo.
        """
        if photo in self.images:
            found = read_label_image(self.images[photo], size)
            result = np.zeros(found.shape, np.uint8)
            for number, value in enumerate(self.values, start=1):
                result[found == value] = number
            return result
        if photo not in self.masks:
            return None
        inside = {name: read_mask(path, size) >= 128 for name, path in self.masks[photo].items()}
        result = np.full(size[::-1], 0 if len(inside) == len(self.names) else UNKNOWN, np.uint8)
        for number, name in enumerate(self.names, start=1):
            if name in inside:
                result[inside[name]] = number
        result[np.sum(list(inside.values()), axis=0) > 1] = UNKNOWN
        return result


def find_masks(photos: list[Path]) -> dict[Path, Path]:
    """The mask file of each photo that has one in a folder `masks` in or next to the photo's folder; white is the
    object."""
    masks: dict[Path, Path] = {}
    own = {photo.parent for photo in photos}
    for folder in (root / name for root in _roots(photos) for name in MASKS):
        if folder not in own:
            masks = {**_of_photos(folder.parent, folder, photos)[0], **masks}
    return masks


def find_labels(photos: list[Path]) -> Labels:
    """Looks for `masks/NAME/` (white is the object of that name) and `labels/` (label images) in and next to the
    photos' folders. Raises SdfsimError if both are given, if a name is not allowed for bodies, or if no file is
    usable."""
    masks: dict[Path, dict[str, Path]] = {}
    images: dict[Path, Path] = {}
    notes: list[str] = []
    for root in _roots(photos):
        inside = [path for name in MASKS if (root / name).is_dir() for path in visible(root / name)]
        for folder in sorted(path for path in (root / FOLDER, *inside) if path.is_dir()):
            if folder in [photo.parent for photo in photos]:
                continue
            found, more = _of_photos(root, folder, photos)
            notes += more
            if folder == root / FOLDER:
                images = {**found, **images}
                continue
            if found and not can_be_named(folder.name):
                raise SdfsimError(f"{folder}: no body can have this name", NAMING)
            for photo, path in found.items():
                masks.setdefault(photo, {}).setdefault(folder.name, path)
    if images and masks:
        raise SdfsimError("both label images and masks by object are given", "keep only one of masks/NAME and labels")
    if notes and not masks and not images:
        raise SdfsimError(f"{'; '.join(notes)}: none of these files can be used",
                          "name a mask like its photo: a.png or a.jpg.png for a.jpg")  # fmt: skip
    names = tuple(sorted({name for each in masks.values() for name in each}))
    values: tuple[int, ...] = ()
    if images:
        there = np.unique(np.concatenate([np.unique(read_label_image(path)) for path in images.values()]))
        values = tuple(int(value) for value in there if value)
        names = tuple(f"object{value}" for value in values)
        if not names:
            raise SdfsimError(f"{next(iter(images.values())).parent}: all labels are 0", "0 is no object")
    if len(names) >= UNKNOWN:
        raise SdfsimError(f"{len(names)} objects in labels and masks, at most {UNKNOWN - 1} are allowed")
    return Labels(masks, images, names, values, tuple(notes))


def _roots(photos: list[Path]) -> list[Path]:
    """The folders in which `masks` and `labels` may lie: those of the photos, and those above them."""
    return list(dict.fromkeys(root for photo in photos for root in (photo.parent, photo.parent.parent)))


def _of_photos(root: Path, folder: Path, photos: list[Path]) -> tuple[dict[Path, Path], list[str]]:
    """The file of each photo in or next to `root`, in a folder below it, and a note on files without a photo. A file is
    named like its photo, with `.png` added or with another suffix."""
    if not folder.is_dir():
        return {}, []
    there = {path.name for path in visible(folder) if path.is_file() and path.suffix.lower() in MASK_SUFFIXES}
    found = {}
    for photo in photos:
        names = [photo.name + ".png", *(photo.stem + suffix for suffix in MASK_SUFFIXES)]
        name = next((name for name in names if name in there), None)
        if name and root in (photo.parent, photo.parent.parent):
            found[photo] = folder / name
    rest = sorted(there - {path.name for path in found.values()})
    return found, [f"{len(rest)} files in {folder} belong to no photo (first: {rest[0]})"] if rest else []


def read_label_image(path: Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """A label image [H, W] int, palette or grey of 8 or 16 bits, at the size (width, height) of its upright photo, else
    as stored. Raises SdfsimError if it cannot be read, is in colour, or is not shaped like the photo."""
    stored = decoded(path, 1 << 20)[0]
    if stored.mode not in ("1", "L", "P") and not stored.mode.startswith("I"):
        raise SdfsimError(f"{path}: a label image has one number per pixel, this one is {stored.mode}",
                          "write it as a palette PNG, or in grey of 8 or 16 bits")  # fmt: skip
    if size is None:
        return np.asarray(stored).astype(np.int64)
    found = np.asarray(turned_like(stored, size, path)).astype(np.int64)
    rows, columns = ((np.arange(n) + 0.5) / n for n in size[::-1])
    return found[np.ix_((rows * found.shape[0]).astype(int), (columns * found.shape[1]).astype(int))]


def load_names(folder: Path) -> list[str]:
    """Names of the objects whose labels the photos stage wrote; empty if there are none."""
    path = Path(folder) / FOLDER / NAMES
    return read_json(path)["names"] if path.exists() else []


def load_labels(folder: Path, name: str) -> np.ndarray | None:
    """Labels [H, W] uint8 of a prepared photo: numbers of the names from 1 on, 0 for no object, `UNKNOWN`; None: not
    given."""
    path = Path(folder) / FOLDER / (name + ".png")
    if not path.exists():
        return None
    with Image.open(path) as image:
        return np.asarray(image)
