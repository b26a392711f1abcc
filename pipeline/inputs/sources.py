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
UNREADABLE = {".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw"}
VIDEOS = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm"}


@dataclass(frozen=True)
class Source:
    """What is to be reconstructed."""

    photos: tuple[Path, ...] = ()  # photo files in name order; none where a video is given
    masks: dict[Path, Path] = field(default_factory=dict)  # mask file of each photo that has one
    labels: Labels = field(default_factory=Labels)  # which object each pixel shows, where that is given
    video: Path | None = None  # the video, or None
    # transforms.json, the folder of a COLMAP model or of a phone's capture, whose poses are to be used; None: find them
    cameras: Path | None = None
    frames: dict[Path, KnownCamera] = field(default_factory=dict)  # camera of each photo in `cameras`
    capture: Capture | None = None  # what a capture with depth says of its world; None where there is no depth
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
        found = [*self.photos, *sorted(self.masks.values()), *self.labels.files()] + [
            p for p in (self.video, self.archive) if p
        ]
        found += [path for camera in self.frames.values() if camera.depth for path in camera.depth.files()]
        if self.cameras and self.cameras.is_dir():
            return found + sorted(
                p for p in self.cameras.rglob("*") if p.suffix in (".bin", ".txt", ".json") or p.name == "metadata"
            )
        return found + ([self.cameras] if self.cameras else [])


def find_source(given: Path) -> Source:
    """Looks at what the user gave; reads no photo yet.

    A folder holds photos (in it, or in its subfolder `images`), or is a COLMAP model, text or binary, or a phone's
    capture (see `find_capture`); a file is a video, a transforms.json, or a zipped capture. Masks lie in a folder
    `masks` in or beside that of the photos, named like the photo, or like the photo with `.png` behind it, as COLMAP
    has them; white is the object. A folder in `masks` is about the object of its name alone; a folder `labels` has
    label images. Raises SdfsimError where nothing is there, of fewer than three photos, or of two cameras of one photo.
    """
    given = Path(given)
    if not given.exists():
        raise SdfsimError(f"{given}: no such folder", "give the folder that holds the photos, or a video")
    if given.is_file():
        if given.suffix.lower() in VIDEOS:
            return Source(video=given)
        if given.suffix.lower() == ".json":
            return _with_cameras(given, read_cameras(given))
        if given.suffix.lower() in ARCHIVES:
            return Source(archive=given)
        raise SdfsimError(
            f"{given}: not a folder, a video, a transforms.json or a zipped capture",
            "give the folder that holds the photos, not a single file",
        )
    if is_model(given):
        return _with_cameras(given, read_cameras(given))
    if (place := find_capture(given)) is not None:
        capture, frames = read_capture(place)
        return _with_cameras(place, frames, capture)
    photos, notes = find_photos(given)
    labels = find_labels(photos)
    return Source(tuple(photos), find_masks(photos), labels, notes=(*notes, *labels.notes, *_unused(given)))


def find_photos(folder: Path) -> tuple[list[Path], list[str]]:
    """The photo files of a folder, or of its subfolder `images` where all are there, in name order, and notes on what
    was passed over. Raises SdfsimError for fewer than three."""
    try:
        entries = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    except OSError as error:
        raise SdfsimError(f"{folder}: cannot be read ({error.strerror})") from error
    found = [p for p in entries if p.suffix.lower() in SUFFIXES]
    if not found and (folder / "images").is_dir():
        return find_photos(folder / "images")
    notes = []
    raw = [p.name for p in entries if p.suffix.lower() in UNREADABLE]
    videos = [p.name for p in entries if p.suffix.lower() in VIDEOS]
    other = [p.name for p in entries if p not in found and p.name not in (*raw, *videos) and p.suffix != ".json"]
    if raw:
        notes.append(f"{len(raw)} files in a format that is not read (first: {raw[0]}); convert them to JPEG")
    if videos:
        notes.append(f"{len(videos)} videos were not used (first: {videos[0]}); give a video itself to use it")
    if other:
        notes.append(f"{len(other)} files that are not photos were ignored (first: {other[0]})")
    if len(found) < MIN_PHOTOS:
        have = f"{len(found)} photo{'s' * (len(found) != 1)}" if found else "no photos"
        raise SdfsimError(
            f"{folder}: {have} found, at least {MIN_PHOTOS} are needed (20 to 60 are good)",
            "; ".join(n for n in notes if "convert" in n or "video" in n)
            or "take photos around the object, each overlapping the one before by two thirds",
        )
    return found, notes


def is_model(folder: Path) -> bool:
    """Whether a folder is a COLMAP model."""
    return any(all((folder / (name + kind)).is_file() for name in ("cameras", "images")) for kind in (".bin", ".txt"))


def _unused(folder: Path) -> list[str]:
    """Notes on cameras that lie beside the photos: they are used only where the user names them."""
    for root in (folder, folder.parent) if folder.name == "images" else (folder,):
        known = [root / "transforms.json", root / "sparse" / "0", root / "sparse"]
        for path in known:
            if path.is_file() or is_model(path):
                return [f"the cameras in {path.relative_to(root.parent)} were not used; give {path} itself to use them"]
    return []


def _with_cameras(cameras: Path, frames: list[KnownCamera], capture: Capture | None = None) -> Source:
    """The photos that known cameras belong to, in the order of the cameras."""
    photos, masks, missing = [], {}, []
    known: dict[Path, KnownCamera] = {}
    for frame in frames:
        photo = _photo_of(frame.name, cameras)
        if photo is None:
            missing.append(frame.name)
            continue
        if photo in known:
            raise SdfsimError(
                f"{cameras}: {known[photo].name} and {frame.name} are the same photo: {photo}", "remove one"
            )
        photos.append(photo)
        known[photo] = frame
        if frame.mask is not None and (cameras.parent / frame.mask).is_file():
            masks[photo] = cameras.parent / frame.mask
    if len(photos) < MIN_PHOTOS:
        raise SdfsimError(
            f"{cameras}: the photos of {len(missing)} of {len(frames)} cameras were not found (first: {missing[0]})"
            if missing else f"{cameras}: {len(frames)} cameras, at least {MIN_PHOTOS} are needed",
            "the photos have to lie beside the cameras, or in a folder `images` there or up to two folders above",
        )  # fmt: skip
    notes = [f"{len(missing)} cameras have no photo (first: {missing[0]})"] if missing else []
    with_depth = sum(frame.depth is not None for frame in known.values())
    if 0 < with_depth < len(photos):
        notes.append(f"{len(photos) - with_depth} of {len(photos)} photos have no depth")
    if with_depth and capture is None:
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
