"""Captures of phones with depth, gravity and metric scale: Record3D, Polycam, and transforms.json with depth."""

import json
import os
import re
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter
from scipy import ndimage
from scipy.spatial.transform import Rotation

from pipeline.inputs.images import read_photo, sharpness, stored_size
from pipeline.inputs.known_cameras import DepthFile, KnownCamera, lens_of, posed
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_json, visible

CAPTURE = "capture.json"  # file of `Capture`, in the folder of the photos stage
LARGEST = 32 << 30  # bytes of a capture
ARCHIVES = {".r3d", ".zip"}
MOST = 100  # frames of a recording that are used
DEEPEST = 4  # levels of folders below the given one in which a capture or photos may lie
FOLDERS = 2000  # at one level; more are surely given by mistake
TRIED = 5  # frames of a stretch among which the sharpest is chosen
TURN = 1.0  # m of path that a turn by one radian counts as, when frames are spread along the path
POLYCAM = ("corrected_cameras", "cameras")  # folders of its cameras, the better ones first
UP = (0.0, 1.0, 0.0)  # ARKit measures gravity, and its worlds have y up
FARTHEST = 8.0  # m; beyond this a phone's sensor is unreliable
# Neighbours whose depths differ by more than this share lie on both sides of an edge, which sensors smear.
EDGE = 0.04
BELIEVED = 0.5  # of the highest confidence
EXTRA = "install what reads it: bash scripts/setup.sh record3d (or pip install 'sdfsim[record3d]')"


@dataclass(frozen=True)
class Capture:
    """The world of a capture with depth, in metres."""

    app: str  # what wrote it
    up: tuple[float, float, float] | None  # [3] against gravity, in the world of its cameras; None: unknown


def find_capture(folder: Path, *, deep: bool = False) -> Path | None:
    """The folder of a Record3D or Polycam export in `folder`, if `deep` also in folders below it; None if there is
    none. Raises SdfsimError if there are several."""
    near = [folder, folder / "EXR_RGBD", folder / "keyframes"]
    for places in [*([place] for place in near), *(levels(folder) if deep else [])]:
        found = [place for place in places if _is_capture(place)]
        if len(found) > 1:
            raise SdfsimError(f"{folder}: holds several captures: {found[0]}, {found[1]}", "give one of them")
        if found:
            return found[0]
    return None


def _is_capture(place: Path) -> bool:
    record3d = _metadata(place).is_file() and any((place / name).is_dir() for name in ("rgb", "rgbd"))
    return record3d or any(_jsons(place / kind) for kind in POLYCAM)


def _jsons(folder: Path) -> list[Path]:
    return [path for path in visible(folder) if path.suffix == ".json"] if folder.is_dir() else []


def levels(folder: Path) -> Iterator[list[Path]]:
    """A folder, and its subfolders level by level, without hidden and unreadable ones."""
    level = [folder]
    for _ in range(DEEPEST + 1):
        yield level
        if len(level) > FOLDERS:
            return
        inside = []
        for place in level:
            with suppress(OSError):
                inside += [path for path in visible(place) if path.is_dir() and os.access(path, os.R_OK | os.X_OK)]
        level = inside


def read_capture(folder: Path) -> tuple[Capture, list[KnownCamera]]:
    """The world of a Record3D or Polycam export, and its cameras, whose names are paths in `folder`. Raises
    SdfsimError if it is damaged."""
    try:
        if _metadata(folder).is_file():
            return Capture("Record3D", UP), _record3d(folder)
        return Capture("Polycam", UP), _polycam(folder)
    except (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        raise SdfsimError(f"{folder}: cannot be read as a capture: {error!r}", "export it again") from error


def _metadata(folder: Path) -> Path:
    return folder / "metadata.json" if (folder / "metadata.json").is_file() else folder / "metadata"


def _record3d(folder: Path) -> list[KnownCamera]:
    """Record3D: a `.r3d` unpacked (`rgbd/N.jpg`, `N.depth`, `N.conf`), or its EXR export (`rgb/N.jpg`, `depth/N.exr`).

    `metadata` holds the matrix K by columns, and one pose per frame: the quaternion x, y, z, w of the camera in the
    world, OpenGL axes, and its position in metres.
    """
    about: dict[str, Any] = json.loads(_metadata(folder).read_bytes())
    same = np.reshape(about["K"], (3, 3)).T
    each = about.get("perFrameIntrinsicCoeffs")
    shape = (int(about.get("dh", 256)), int(about.get("dw", 192)))
    rgb = folder / "rgb" if (folder / "rgb").is_dir() else folder / "rgbd"
    photos = sorted((p for p in rgb.iterdir() if p.suffix in (".jpg", ".png") and p.stem.isdigit()),
                    key=lambda p: int(p.stem))  # fmt: skip
    if len(photos) > len(about["poses"]):
        raise SdfsimError(f"{folder}: {len(photos)} photos, but {len(about['poses'])} poses", "export it again")
    found = []
    for photo in photos:
        number = int(photo.stem)
        fx, fy, cx, cy = map(float, each[number] if each else (same[0, 0], same[1, 1], same[0, 2], same[1, 2]))
        x, y, z, w, *position = about["poses"][number]
        pose = np.column_stack([Rotation.from_quat([x, y, z, w]).as_matrix(), position])
        exr, raw = folder / "depth" / f"{number}.exr", photo.with_suffix(".depth")
        depth = depth_file(exr if exr.is_file() else raw, photo.with_suffix(".conf"), shape)
        size = int(about["w"]), int(about["h"])
        found.append(posed(photo.relative_to(folder).as_posix(), size, lens_of(fx, fy, cx, cy), pose, depth=depth))
    return found


def depth_file(path: Path, confidence: Path, shape: tuple[int, int] | None = None) -> DepthFile | None:
    """The depth file of a frame, if it exists, with its confidence file, if it exists."""
    return DepthFile(path, None, confidence if confidence.is_file() else None, shape) if path.is_file() else None


def _polycam(folder: Path) -> list[KnownCamera]:
    """Polycam's raw data: one JSON per camera with its matrix as t_00 to t_23 (OpenGL axes, y up), depth in
    millimetres. The corrected cameras do not give the size of their photos."""
    kinds = [folder / name for name in POLYCAM if _jsons(folder / name)]
    # The corrected cameras have separate photos, which may not have been exported.
    cameras = next((kind for kind in kinds if _images_of(kind).is_dir()), kinds[0])
    there = visible(_images_of(cameras)) if _images_of(cameras).is_dir() else []
    images = {path.stem: path for path in there if path.suffix.lower() in (".jpg", ".jpeg", ".png")}
    found = []
    for path in _jsons(cameras):
        about = json.loads(path.read_bytes())
        photo = images.get(path.stem, _images_of(cameras) / f"{path.stem}.jpg")
        pose = np.array([[about[f"t_{row}{column}"] for column in range(4)] for row in range(3)], float)
        depth = depth_file(folder / "depth" / f"{path.stem}.png", folder / "confidence" / f"{path.stem}.png")
        fx, fy, cx, cy = (float(about[key]) for key in ("fx", "fy", "cx", "cy"))
        size = int(about.get("width", 0)), int(about.get("height", 0))
        if not all(size) and photo.is_file():
            size = stored_size(photo)
        found.append(posed(photo.relative_to(folder).as_posix(), size, lens_of(fx, fy, cx, cy), pose, depth=depth))
    return found


def _images_of(cameras: Path) -> Path:
    return cameras.with_name(cameras.name.replace("cameras", "images"))


def unpack(archive: Path, folder: Path) -> None:
    """Unpacks the files of a zipped capture, all into the folder, whatever their names. Raises SdfsimError if it is
    damaged or not a zip, or too large once unpacked."""
    try:
        with zipfile.ZipFile(archive) as file:
            entries = [
                entry for entry in file.infolist() if not entry.is_dir()
                and not re.search(r"(^|[/\\])(__MACOSX[/\\]|\._)", entry.filename)  # what macOS adds
            ]  # fmt: skip
            if sum(entry.file_size for entry in entries) > LARGEST:
                raise SdfsimError(f"{archive}: more than {LARGEST >> 30} GiB unpacked", "export fewer frames")
            for entry in entries:
                entry.filename = entry.filename.replace("\\", "/")  # as some programs on Windows write them
                file.extract(entry, folder)
    except (OSError, zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
        raise SdfsimError(f"{archive}: cannot be unpacked: {error}", "export the capture again") from error


def spread(photos: Sequence[Path], cameras: dict[Path, KnownCamera], most: int = MOST) -> list[Path]:
    """At most `most` photos of a recording, evenly along the path of its camera: the sharpest of each stretch."""
    if len(photos) <= most:
        return list(photos)
    centers = np.array([cameras[p].center for p in photos])
    ahead = np.array([cameras[p].rotation[2] for p in photos])
    turned = np.arccos(np.clip((ahead[1:] * ahead[:-1]).sum(1), -1, 1))
    way = np.append(0, np.cumsum(np.linalg.norm(np.diff(centers, axis=0), axis=1) + TURN * turned))
    stretch = np.minimum((way / max(way[-1], 1e-9) * most).astype(int), most - 1)
    chosen = []
    for number in np.unique(stretch):
        members = np.flatnonzero(stretch == number)
        some = members[np.linspace(0, len(members) - 1, min(TRIED, len(members))).round().astype(int)]
        chosen.append(max(some, key=lambda k: sharpness(read_photo(photos[k], 640).pixels)))
    return [photos[k] for k in chosen]


def load_capture(folder: Path) -> Capture | None:
    """The capture from which a folder of prepared photos comes; None for plain photos."""
    path = Path(folder) / CAPTURE
    if not path.exists():
        return None
    return TypeAdapter(Capture).validate_python(read_json(path, "run the photos stage again"))


def read_depth(file: DepthFile) -> np.ndarray:
    """Depth [H, W] m along the optical axis; 0 where the sensor had no value, low confidence, or an edge. Raises
    SdfsimError if the file is absent, damaged, or needs a package that is not installed."""
    counts = _read(file.path, file.shape, np.float32)
    unit = file.unit or (1e-3 if counts.dtype.kind in "ui" else 1.0)
    depth = counts.astype(np.float32) * np.float32(unit)
    good = np.isfinite(depth) & (depth > 0) & (depth < FARTHEST)
    if file.confidence is not None:
        confidence = _read(file.confidence, file.shape, np.uint8)
        if confidence.shape != depth.shape:
            raise SdfsimError(f"{file.confidence}: shaped {confidence.shape}, its depth {depth.shape}")
        good &= confidence >= BELIEVED * confidence.max()
    depth = np.where(good, depth, 0)
    # At an edge one of the four neighbours is much nearer or farther.
    cross = ndimage.generate_binary_structure(2, 1)
    far = ndimage.maximum_filter(depth, footprint=cross)
    near = ndimage.minimum_filter(np.where(depth > 0, depth, np.inf), footprint=cross)
    edge = (far - depth > EDGE * depth) | (depth - near > EDGE * near)
    return np.where(good & ~edge, depth, 0).astype(np.float32)


def _read(path: Path, shape: tuple[int, int] | None, raw: type) -> np.ndarray:
    """The numbers [H, W] of a file, in the form of `raw` if the file does not name its type."""
    try:
        if path.suffix in (".depth", ".conf"):  # of Record3D
            import imagecodecs

            rows, columns = shape or (256, 192)
            size = rows * columns * np.dtype(raw).itemsize
            values = np.frombuffer(imagecodecs.lzfse_decode(path.read_bytes(), out=size), raw).reshape(rows, columns)
        elif path.suffix.lower() == ".exr":
            import OpenEXR

            with OpenEXR.File(str(path)) as file:
                pixels = next(iter(file.channels().values())).pixels
            values = pixels if pixels.ndim == 2 else pixels[..., 0]
        elif path.suffix.lower() == ".npy":
            values = np.load(path, allow_pickle=False)
        else:
            import cv2

            values = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    except ImportError as error:
        raise SdfsimError(f"{path}: needs the package {error.name}", EXTRA) from error
    except (OSError, ValueError, RuntimeError) as error:
        raise SdfsimError(f"{path}: cannot be read as depth: {error}", "export the capture again") from error
    if values is None or np.squeeze(values).ndim != 2:
        raise SdfsimError(f"{path}: not an image with one channel", "depth is a PNG of 16 bits, an EXR or an NPY")
    return np.squeeze(values)
