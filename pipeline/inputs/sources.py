"""What the user gave: a folder of photos, a video, or photos whose cameras are known already."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.inputs.captures import ARCHIVES, Capture, find_capture, read_capture
from pipeline.inputs.known_cameras import KnownCamera, read_cameras
from pipeline.inputs.labels import Labels, find_labels, find_masks
from sdfsim.errors import SdfsimError

MIN_PHOTOS = 3
SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp"}
READABLE = "photos are JPEG, PNG, TIFF, WebP or BMP; give a video itself to use it"
VIDEOS = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm"}


@dataclass(frozen=True)
class Source:
    """What is to be reconstructed."""

    photos: tuple[Path, ...] = ()  # photo files in name order; none where a video is given
    masks: dict[Path, Path] = field(default_factory=dict)  # mask file of each photo that has one
    labels: Labels = field(default_factory=Labels)  # which object each pixel shows, where that is given
    video: Path | None = None
    # transforms.json, or folder of a COLMAP model or of a phone's capture, whose poses are to be used; None: find them
    cameras: Path | None = None
    frames: dict[Path, KnownCamera] = field(default_factory=dict)  # camera of each photo in `cameras`
    capture: Capture | None = None  # what a capture with depth says of its world
    archive: Path | None = None  # a zipped capture that has to be unpacked first; then there is nothing else
    notes: tuple[str, ...] = ()  # what was passed over, for the report

    @property
    def folder(self) -> Path:
        """The folder in and below which all photos lie; absolute."""
        files = self.photos or (self.video or self.archive or Path(),)
        return Path(os.path.commonpath([path.absolute().parent for path in files]))

    def name_of(self, photo: Path) -> str:
        """What a photo is called: its file's name, where subfolders hold photos with theirs before it; no two alike."""
        return photo.absolute().relative_to(self.folder).as_posix()

    def files(self) -> list[Path]:
        """Every file whose content the result depends on."""
        found = [*self.photos, *sorted(self.masks.values()), *self.labels.files()]
        found += [path for camera in self.frames.values() if camera.depth for path in camera.depth.files()]
        if self.cameras and self.cameras.is_dir():
            about = (path for path in self.cameras.rglob("*") if path.is_file())
            return found + sorted(p for p in about if p.suffix in (".bin", ".txt", ".json") or p.name == "metadata")
        return found + [path for path in (self.video, self.archive, self.cameras) if path]


def find_source(given: Path) -> Source:
    """Looks at what the user gave; reads no photo yet.

    A folder holds photos (in it, or in its subfolder `images`), or is a COLMAP model, or a phone's capture (see
    `find_capture`); a file is a video, a transforms.json, or a zipped capture. Masks and labels: see `find_masks` and
    `find_labels`. Raises SdfsimError where nothing is there, of fewer than three photos, or of two cameras of a photo.
    """
    given = Path(given)
    if not given.exists():
        raise SdfsimError(f"{given}: no such folder", "give the folder that holds the photos, or a video")
    if given.is_file() and given.suffix.lower() in VIDEOS:
        return Source(video=given)
    if given.is_file() and given.suffix.lower() in ARCHIVES:
        return Source(archive=given)
    if given.suffix.lower() == ".json" or is_model(given):
        return _with_cameras(given, read_cameras(given))
    if given.is_file():
        told = f"{given}: not a folder, a video, a transforms.json or a zipped capture"
        raise SdfsimError(told, "give the folder that holds the photos, not a single file")
    if (place := find_capture(given)) is not None:
        capture, frames = read_capture(place)
        return _with_cameras(place, frames, capture)
    photos, notes = find_photos(given)
    labels = find_labels(photos)
    return Source(tuple(photos), find_masks(photos), labels, notes=(*notes, *labels.notes))


def find_photos(folder: Path) -> tuple[list[Path], list[str]]:
    """The photo files of a folder, or of its subfolder `images` where all are there, in name order, and a note on what
    was passed over. Raises SdfsimError for fewer than three."""
    try:
        entries = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    except OSError as error:
        raise SdfsimError(f"{folder}: cannot be read ({error.strerror})") from error
    found = [p for p in entries if p.suffix.lower() in SUFFIXES]
    if not found and (folder / "images").is_dir():
        return find_photos(folder / "images")
    other = [p.name for p in entries if p not in found and p.suffix != ".json"]
    notes = [f"{len(other)} files are not used (first: {other[0]}): {READABLE}"] if other else []
    if len(found) < MIN_PHOTOS:
        told = f"{folder}: photos found: {len(found)}, at least {MIN_PHOTOS} are needed (20 to 60 are good)"
        raise SdfsimError(told, notes[0] if notes else "take photos all around, each overlapping the one before")
    return found, notes


def is_model(folder: Path) -> bool:
    """Whether a folder is a COLMAP model."""
    return any(all((folder / (name + kind)).is_file() for name in ("cameras", "images")) for kind in (".bin", ".txt"))


def _with_cameras(cameras: Path, frames: list[KnownCamera], capture: Capture | None = None) -> Source:
    """The photos that known cameras belong to, in the order of the cameras."""
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
        if frame.mask is not None and (cameras.parent / frame.mask).is_file():
            masks[photo] = cameras.parent / frame.mask
    notes = [f"{len(missing)} of {len(frames)} cameras have no photo (first: {missing[0]})"] if missing else []
    photos = list(known)
    if len(photos) < MIN_PHOTOS:
        told = f"{cameras}: cameras with a photo: {len(photos)}, at least {MIN_PHOTOS} are needed {' '.join(notes)}"
        raise SdfsimError(told, "put the photos beside the cameras, or in a folder `images` there or just above")
    if capture is None and any(frame.depth for frame in known.values()):
        capture = Capture("transforms.json with depth", None)
    labels = find_labels(photos)
    return Source(tuple(photos), {**find_masks(photos), **masks}, labels, cameras=cameras, frames=known,
                  capture=capture, notes=(*notes, *labels.notes))  # fmt: skip


def _photo_of(name: str, cameras: Path) -> Path | None:
    """The file of a photo that a camera file names, by its path, else by its name in a folder `images`."""
    roots = [cameras.parent] if cameras.is_file() else [cameras, cameras.parent, cameras.parent.parent]
    suffixes = [""] if Path(name).suffix.lower() in SUFFIXES else [".png", ".jpg", ".jpeg"]
    for root in roots:
        for place in (root / name, root / "images" / name, root / "images" / Path(name).name):
            for suffix in suffixes:
                if place.with_name(place.name + suffix).is_file():
                    return place.with_name(place.name + suffix)
    return None
