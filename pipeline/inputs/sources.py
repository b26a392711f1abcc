"""The user's input: a folder of photos, a video, or photos with known cameras."""

import os
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote

from pipeline.inputs.captures import ARCHIVES, Capture, find_capture, levels, read_capture
from pipeline.inputs.known_cameras import KnownCamera, below, read_cameras
from pipeline.inputs.labels import Labels, find_labels, find_masks
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import visible

MIN_PHOTOS = 3
SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".heic", ".heif", ".hif", ".avif"}
READABLE = "photos are JPEG, PNG, TIFF, HEIC, AVIF, WebP or BMP; give a video itself to use it"
INSIDE = ("images", "image", "rgb", "color")  # folders of photos below the one that is given
# Words in the names of pictures that are no photos but belong to some, and what they show.
HELPERS = {
    "depth": "depth", "disparity": "depth", "disp": "depth", "conf": "confidence", "confidence": "confidence",
    "mask": "masks", "masks": "masks", "matte": "masks", "normal": "normals", "normals": "normals", "label": "labels",
    "labels": "labels", "seg": "labels", "semantic": "labels", "segmentation": "labels", "thumb": "previews",
    "thumbnail": "previews", "preview": "previews",
}  # fmt: skip
ABOVE = 3  # levels above a COLMAP model in which its photos may lie: the model may be colmap/sparse/0
NAMED = 3  # folders with photos that an error names
VIDEOS = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm"}  # these are videos even if they cannot be decoded
ASKED = 20  # files of a folder without photos that are tried as videos


@dataclass(frozen=True)
class Source:
    """The input of a reconstruction."""

    photos: tuple[Path, ...] = ()  # photo files in name order; empty for a video
    masks: dict[Path, Path] = field(default_factory=dict)  # mask file of each photo that has one
    labels: Labels = field(default_factory=Labels)  # the object at each pixel, if given
    video: Path | None = None
    # transforms.json, or folder of a COLMAP model or of a phone's capture, whose poses are used; None: find them
    cameras: Path | None = None
    frames: dict[Path, KnownCamera] = field(default_factory=dict)  # camera of each photo in `cameras`
    capture: Capture | None = None  # the world of a capture with depth
    archive: Path | None = None  # a zipped capture that has to be unpacked first; the other fields are then empty
    notes: tuple[str, ...] = ()  # skipped files, for the report

    @property
    def folder(self) -> Path:
        """The folder that contains all photos, directly or in subfolders; absolute."""
        files = self.photos or (self.video or self.archive or Path(),)
        return Path(os.path.commonpath([path.absolute().parent for path in files]))

    def name_of(self, photo: Path) -> str:
        """The name of a photo: its file name, with that of its subfolder if photos lie in subfolders; unique."""
        return photo.absolute().relative_to(self.folder).as_posix()

    def files(self) -> list[Path]:
        """Every file whose content the result depends on."""
        found = [*self.photos, *sorted(self.masks.values()), *self.labels.files()]
        found += [path for camera in self.frames.values() if camera.depth for path in camera.depth.files()]
        if self.cameras and self.cameras.is_dir():
            about = (path for path in self.cameras.rglob("*") if path.is_file())
            return found + sorted(p for p in about if p.suffix in (".bin", ".txt", ".json") or p.name == "metadata")
        return found + [path for path in (self.video, self.archive, self.cameras) if path]


def find_source(given: Path, *, unpacked: bool = False) -> Source:
    """Identifies the user's input; reads no photo yet.

    A folder holds photos (in it, or in its subfolder `images`), or is a COLMAP model, or a phone's capture (see
    `find_capture`); a file is a video, a transforms.json, or a zipped capture. In an `unpacked` archive the photos may
    lie in any one folder. Masks and labels: see `find_masks` and `find_labels`. Raises SdfsimError if the input does
    not exist, for fewer than three photos, or for two cameras of one photo.
    """
    given = Path(given)
    if not given.exists():
        raise SdfsimError(f"{given}: no such folder", "give the folder that holds the photos, or a video")
    if given.is_file() and given.suffix.lower() in ARCHIVES:
        return Source(archive=given)
    if _is_video(given):
        return Source(video=given)
    if len(models := _models(given)) > 1:
        sizes = {model: len(read_cameras(model)) for model in models}
        given = max(models, key=lambda model: sizes[model])
        each = ", ".join(f"{count} photos in {model.name}" for model, count in sizes.items())
        note = f"{given.parent} holds {len(models)} models ({each}): the largest, {given.name}, is used"
        source = _with_cameras(given, read_cameras(given))
        return replace(source, notes=(note, *source.notes))
    if models:
        (given,) = models
    if given.suffix.lower() == ".json" or is_model(given):
        return _with_cameras(given, read_cameras(given))
    if given.is_file():
        message = f"{given}: not a folder, a video, a transforms.json or a zipped capture"
        raise SdfsimError(message, "give the folder that holds the photos, not a single file")
    own = photos_in(given)
    if (place := find_capture(given, deep=unpacked or len(own) < MIN_PHOTOS)) is not None:
        capture, frames = read_capture(place)
        return _with_cameras(place, frames, capture)
    if unpacked and len(own) < MIN_PHOTOS and len(inside := _with_photos(given)) == 1:
        (given,) = inside
    photos, notes = find_photos(given)
    labels = find_labels(photos)
    masks = {**masks_beside(photos), **find_masks(photos)}
    return Source(tuple(photos), masks, labels, notes=(*notes, *labels.notes))


def find_photos(folder: Path) -> tuple[list[Path], list[str]]:
    """The photo files of `photos_in` a folder, and a note on skipped files. Raises SdfsimError for fewer than three;
    the error names the subfolders with photos."""
    found = photos_in(folder)
    place = found[0].parent if found else folder
    notes = []
    if place != folder and (beside := _images(folder)):
        notes.append(f"{len(beside)} photos beside the folder {place.name} are not used (first: {beside[0].name})")
    others = helpers(place)
    for kind in sorted({what for what, _ in others.values()}):
        some = [path for path, (what, _) in others.items() if what == kind]
        used = "are used as such" if kind == "masks" else "are not used"
        notes.append(f"{len(some)} pictures are {kind} of photos, by their names (first: {some[0].name}): they {used}")
    other = [p.name for p in _files(place) if p not in found and p not in others and p.suffix != ".json"]
    if other:
        notes.append(f"{len(other)} files are not used (first: {other[0]}): {READABLE}")
    if len(found) < MIN_PHOTOS:
        message = f"{folder}: photos found: {len(found)}, at least {MIN_PHOTOS} are needed (20 to 60 are good)"
        inside = _with_photos(folder)
        if inside:
            some = ", ".join(f"{len(photos_in(sub))} in {sub}" for sub in inside[:NAMED])
            more = f" and {len(inside) - NAMED} more folders" if len(inside) > NAMED else ""
            raise SdfsimError(f"{message}; below it are {some}{more}", "give the folder that holds the photos")
        if models := [place for level in levels(folder) for place in level if is_model(place)]:
            raise SdfsimError(f"{message}; {models[0]} holds cameras", "give that folder")
        if films := [path for path in _files(folder)[:ASKED] if _is_video(path)]:
            told = f"{message}; it holds the video {films[0].name}"
            raise SdfsimError(told, f"give the video: sdfsim reconstruct {quote(str(films[0]))} -o ROOM")
        raise SdfsimError(message, notes[0] if notes else "take photos all around, each overlapping the one before")
    return found, notes


def photos_in(folder: Path) -> list[Path]:
    """The photo files of a folder in name order, or those of its subfolder `images` (see `INSIDE`), next to which a few
    previews may lie. Raises SdfsimError if the folder cannot be read."""
    own = _images(folder)
    inner = next((found for name in INSIDE if (folder / name).is_dir() and (found := _images(folder / name))), [])

    def size(photos: list[Path]) -> int:
        return sum(photo.stat().st_size for photo in photos)

    if not own or (len(inner) >= MIN_PHOTOS and (len(inner) >= len(own) or size(inner) >= size(own))):
        return inner
    return own


def _images(folder: Path) -> list[Path]:
    others = helpers(folder)
    return [path for path in _pictures(folder) if path not in others]


def _pictures(folder: Path) -> list[Path]:
    return [path for path in _files(folder) if path.suffix.lower() in SUFFIXES]


def helpers(folder: Path) -> dict[Path, tuple[str, Path]]:
    """The pictures of a folder that are no photos but belong to one, by their names: what they show, and the photo.
    `depth_00007.png` belongs to `frame_00007.jpg`, `left_mask.png` to `left.png`."""
    photos, others = {}, {}
    for path in _pictures(folder):
        words = re.findall(r"[^\W\d_]+|\d+", path.stem.lower())
        kind = next((HELPERS[word] for word in words if word in HELPERS), None)
        numbers = tuple(int(word) for word in words if word.isdecimal())
        key = numbers or tuple(word for word in words if word not in HELPERS)
        if kind is None:
            photos[key] = path
        else:
            others[path] = kind, key
    return {path: (kind, photos[key]) for path, (kind, key) in others.items() if key in photos}


def masks_beside(photos: list[Path]) -> dict[Path, Path]:
    """The masks that lie among the photos, by photo."""
    found = [helpers(folder) for folder in dict.fromkeys(photo.parent for photo in photos)]
    return {photo: path for each in found for path, (kind, photo) in each.items() if kind == "masks"}


def _is_video(path: Path) -> bool:
    suffix = path.suffix.lower()
    if not path.is_file() or suffix in SUFFIXES or suffix == ".json":
        return False
    from pipeline.inputs.video import is_film

    return suffix in VIDEOS or is_film(path)


def _files(folder: Path) -> list[Path]:
    try:
        return [path for path in visible(folder) if path.is_file()]
    except OSError as error:
        raise SdfsimError(f"{folder}: cannot be read ({error.strerror})") from error


def _with_photos(folder: Path) -> list[Path]:
    """The subfolders with enough photos, at the highest level that has any."""
    for level in levels(folder):
        found = [place for place in level if place != folder and len(photos_in(place)) >= MIN_PHOTOS]
        if found:
            return found
    return []


def _models(given: Path) -> list[Path]:
    """The numbered COLMAP models in a folder, or beside one, as COLMAP's mapper leaves them: one is of most photos."""
    folder = given.parent if is_model(given) and given.name.isdecimal() else given
    found = [place for place in folder.glob("[0-9]*") if place.name.isdecimal() and is_model(place)]
    return [] if found and folder == given and photos_in(given) else sorted(found, key=lambda place: int(place.name))


def is_model(folder: Path) -> bool:
    """Whether a folder is a COLMAP model."""
    return any(all((folder / (name + kind)).is_file() for name in ("cameras", "images")) for kind in (".bin", ".txt"))


def _with_cameras(cameras: Path, frames: list[KnownCamera], capture: Capture | None = None) -> Source:
    """The photos of the known cameras, in the order of the cameras."""
    masks, missing = {}, []
    known: dict[Path, KnownCamera] = {}
    for frame in frames:
        photo = _photo_of(frame.name, cameras)
        if photo is None:
            missing.append(frame.name)
            continue
        if photo in known:
            both = f"{known[photo].name} and {frame.name}"
            raise SdfsimError(f"{cameras}: {both} are the same photo: {photo}", "remove one")
        known[photo] = frame
        if frame.mask is not None and below(cameras.parent, frame.mask).is_file():
            masks[photo] = below(cameras.parent, frame.mask)
    notes = [f"{len(missing)} of {len(frames)} cameras have no photo (first: {missing[0]})"] if missing else []
    photos = list(known)
    if len(photos) < MIN_PHOTOS:
        message = f"{cameras}: cameras with a photo: {len(photos)}, at least {MIN_PHOTOS} are needed {' '.join(notes)}"
        raise SdfsimError(message, "put the photos next to the cameras, or in a folder `images` there or just above")
    if capture is None and any(frame.depth for frame in known.values()):
        capture = Capture("transforms.json with depth", None)
    labels = find_labels(photos)
    return Source(tuple(photos), {**find_masks(photos), **masks}, labels, cameras=cameras, frames=known,
                  capture=capture, notes=(*notes, *labels.notes))  # fmt: skip


def _photo_of(name: str, cameras: Path) -> Path | None:
    """The file of a photo that a camera file names, by its path, else by its name in a folder `images`. A name from
    Windows, or with the path of another computer, works as well."""
    alone = cameras.is_file()
    roots = [cameras.parent] if alone else [cameras, *list(cameras.absolute().parents)[:ABOVE]]
    suffixes = [""] if Path(name).suffix.lower() in SUFFIXES else [".png", ".jpg", ".jpeg"]
    for written in dict.fromkeys([name, name.replace("\\", "/")]):
        for root in roots:
            inner = root / "images"
            # A model's names are relative to its folder of photos; previews may lie next to it.
            first = (root / written, inner / written) if alone else (inner / written, root / written)
            for place in (*first, inner / Path(written).name, root / Path(written).name):
                for suffix in suffixes:
                    if place.with_name(place.name + suffix).is_file():
                        return place.with_name(place.name + suffix)
    return None
