"""Cameras from other programs: transforms.json (NeRF, instant-ngp, nerfstudio) and COLMAP models, text or binary."""

import codecs
import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.cameras import View
from pipeline.inputs.images import ReadPhoto
from sdfsim.base.errors import SdfsimError

# COLMAP's camera models, by number: name, and names of the parameters; only models that OpenCV supports.
# A transforms.json has the same names, with fl_x and fl_y instead of f, fx and fy.
MODELS = {
    0: ("SIMPLE_PINHOLE", "f cx cy"), 1: ("PINHOLE", "fx fy cx cy"), 2: ("SIMPLE_RADIAL", "f cx cy k1"),
    3: ("RADIAL", "f cx cy k1 k2"), 4: ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"), 6: ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    7: ("FOV", ""), 8: ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"), 9: ("RADIAL_FISHEYE", "f cx cy k1 k2"),
    10: ("THIN_PRISM_FISHEYE", ""), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", ""), 12: ("SIMPLE_DIVISION", ""),
    13: ("DIVISION", ""), 14: ("SIMPLE_FISHEYE", "f cx cy"), 15: ("FISHEYE", "fx fy cx cy"), 16: ("EUCM", ""),
    17: ("EQUIRECTANGULAR", ""),
}  # fmt: skip
PARAMETERS = {name: parameters.split() for name, parameters in MODELS.values() if parameters}
STRAIGHTEN = f"allowed: {', '.join(PARAMETERS)}; `colmap image_undistorter` makes photos of any other straight"
FORMS = "cameras are a transforms.json (NeRF, nerfstudio) or a COLMAP model; or give the folder of the photos alone"
# What files of other programs have as keys, and in their first entry; and what to give instead.
PROGRAMS: tuple[tuple[str, set[str], set[str], str], ...] = (
    ("OpenMVG", {"sfm_data_version"}, set(), "write its model with openMVG_main_openMVG2Colmap"),
    ("Meshroom (AliceVision)", {"views", "intrinsics"}, set(), "export its cameras to COLMAP"),
    ("OpenSfM", set(), {"shots"}, "write its model with `opensfm export_colmap`"),
    ("OpenSfM", set(), {"projection_type"}, "it has lenses but no poses: `opensfm export_colmap` writes both"),
    ("3D Gaussian splatting", set(), {"img_name"}, "give the COLMAP model (sparse/0) that it was trained from"),
    ("nerfstudio without cameras", {"transform", "scale"}, set(), "give the transforms.json of its input"),
    ("Polycam", {"t_00"}, set(), "give the folder or the zip of the capture"),
    ("sdfsim", {"views", "convention"}, set(), "give what it was made from"),
)
SQUARE = 1e-3  # pixels within this share of a square count as square
# OpenCV counts pixel centres from 0.
CENTRE = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


@dataclass(frozen=True)
class Lens:
    """Intrinsics and distortion for a photo of some size."""

    matrix: tuple[tuple[float, ...], ...]  # rows of the intrinsics [3, 3], pixel centres at +0.5
    distortion: tuple[float, ...]  # OpenCV's coefficients (k1, k2, p1, p2, k3, ...), or four of its fisheye model
    fisheye: bool  # which of the two

    def straight(self, pixels: np.ndarray, view: View) -> np.ndarray:
        """Pixels in the undistorted photo of `view` for pixels [P, 2] of the distorted one; may lie outside it."""
        import cv2

        until = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10)
        undistort = cv2.fisheye.undistortPoints if self.fisheye else cv2.undistortPoints
        new = np.array([[view.focal, 0, view.cx], [0, view.focal, view.cy], [0, 0, 1]])
        points = np.ascontiguousarray(pixels, float)[:, None]
        return undistort(points, np.array(self.matrix), np.array(self.distortion), P=new, criteria=until)[:, 0]


def lens_of(
    fx: float, fy: float, cx: float, cy: float, bends: Mapping[str, float] = MappingProxyType({}), fisheye: bool = False
) -> Lens:
    """The lens of two focal lengths and a middle, px, and of coefficients by their names in OpenCV."""
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    distortion = tuple(float(bends.get(name, 0.0)) for name in names)
    return Lens(((fx, 0, cx), (0, fy, cy), (0, 0, 1)), distortion, fisheye)


@dataclass(frozen=True)
class DepthFile:
    """The file with the depth of a photo."""

    path: Path  # PNG or TIFF of integers, EXR, NPY, or Record3D's compressed floats (`.depth`)
    unit: float | None = None  # m per count; None: integers are millimetres, floats metres
    confidence: Path | None = None  # file of the same shape, higher is better; None: no file
    shape: tuple[int, int] | None = None  # rows and columns of a `.depth` file, which does not contain them

    def files(self) -> list[Path]:
        """The files of this depth."""
        return [self.path] + ([self.confidence] if self.confidence else [])


@dataclass(frozen=True)
class KnownCamera:
    """A camera from another program."""

    name: str  # of its photo, as in the file
    width: int  # px of the photo of the lens
    height: int  # px
    lens: Lens  # of a photo of this size
    rotation: np.ndarray  # [3, 3] world to camera; x right, y down, z forward
    translation: np.ndarray  # [3]
    mask: str | None = None  # file name of its mask, or None
    depth: DepthFile | None = None  # its depth, or None

    @property
    def center(self) -> np.ndarray:
        """[3] its position in the world."""
        return -self.rotation.T @ self.translation


def posed(name: str, size: tuple[int, int], lens: Lens, pose: np.ndarray, mask: str | None = None,
          depth: DepthFile | None = None) -> KnownCamera:  # fmt: skip
    """A camera from its pose [3, 4], camera to world, OpenGL axes (x right, y up, z backwards). Raises SdfsimError if
    the matrix is not a pose."""
    turn, place = pose[:, :3], pose[:, 3]
    if not np.isfinite(pose).all() or abs(np.linalg.det(turn)) < 1e-6:
        raise SdfsimError(f"{name}: its matrix is not a pose")
    rotation = np.diag([1.0, -1, -1]) @ (turn / np.cbrt(np.linalg.det(turn))).T
    return KnownCamera(name, *size, lens, rotation, -rotation @ place, mask, depth)


def below(folder: Path, name: str) -> Path:
    """The file of this name in a folder; the name may have been written on Windows."""
    place = folder / name
    return place if place.exists() or "\\" not in name else folder / name.replace("\\", "/")


def read_cameras(path: Path) -> list[KnownCamera]:
    """The cameras of a transforms.json or of a COLMAP model's folder, in the order of their names. Raises SdfsimError
    if the file is damaged or of another kind, or if a lens is not supported."""
    read = read_model if path.is_dir() else read_transforms
    try:
        return sorted(read(path), key=lambda camera: camera.name)
    except KeyError as error:
        raise SdfsimError(f"{path}: cannot be read as cameras: it has no {error}", FORMS) from error
    except (OSError, ValueError, IndexError, TypeError, AttributeError, struct.error) as error:
        raise SdfsimError(f"{path}: cannot be read as cameras: {error!r}", "write it again") from error


def read_transforms(path: Path) -> list[KnownCamera]:
    """Cameras of a transforms.json: camera-to-world matrices with OpenGL axes; intrinsics for all or in each frame."""
    about = json.loads(path.read_bytes())  # Bytes: json handles a byte order mark.
    if not isinstance(about, dict) or "frames" not in about:
        raise _foreign(path, about)
    found = []
    for frame in about["frames"]:
        values = {**about, **frame}
        where = f"{path}: {frame['file_path']}"
        model = str(values.get("camera_model", "OPENCV")).upper()
        if model not in PARAMETERS:
            raise SdfsimError(f"{where}: camera_model: {values['camera_model']!r} is not supported", STRAIGHTEN)
        fisheye = model.endswith("FISHEYE") or bool(values.get("is_fisheye"))
        width, height = int(values.get("w", 0)), int(values.get("h", 0))
        sized = width > 0 and height > 0
        known = "fl_x" in values
        if (known or fisheye) and not (known and sized):
            raise SdfsimError(f"{where}: a fisheye, or a lens with fl_x, needs fl_x, w and h in px")
        if not sized:  # For a photo of any width: `scaled` adapts it.
            width, height = 1, 0
        fx = float(values["fl_x"]) if known else 0.5 * width / np.tan(0.5 * float(values["camera_angle_x"]))
        fy = float(values.get("fl_y", fx))
        cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
        # k4 has OpenCV's meaning only for a fisheye and for this model.
        bends = values if fisheye or model == "FULL_OPENCV" else {**values, "k4": 0, "k5": 0, "k6": 0}
        lens = lens_of(fx, fy, cx, cy, bends, fisheye)
        pose = _pose(frame["transform_matrix"], where)
        # In nerfstudio's form, or in instant-ngp's.
        name = values.get("depth_file_path") or values.get("depth_path")
        unit = values.get("depth_unit_scale_factor", values.get("integer_depth_scale"))
        depth = DepthFile(below(path.parent, name), unit and float(unit)) if name else None
        found.append(posed(str(frame["file_path"]), (width, height), lens, pose, frame.get("mask_path"), depth))
    return found


def _foreign(path: Path, about: Any) -> SdfsimError:
    """The error for a JSON file of another kind: names the program that writes such files, and what to give."""
    first = next(iter(about.values() if isinstance(about, dict) else about), None) if about else None
    keys, inner = (set(some) if isinstance(some, dict) else set() for some in (about, first))
    for program, there, below, instead in PROGRAMS:
        if there <= keys and below <= inner:
            return SdfsimError(f"{path}: is a file of {program}, which is not read", f"{instead}; {FORMS}")
    names = ", ".join(sorted(keys or inner)[:5])
    return SdfsimError(f"{path}: not a transforms.json: it has no `frames`, but {names or 'nothing'}", FORMS)


def _pose(matrix: Any, where: str) -> np.ndarray:
    """A pose [3, 4] from the 3 or 4 rows of its matrix, one after the other or nested."""
    values = np.array(matrix, float)
    if values.shape not in ((4, 4), (3, 4), (16,), (12,)):
        shape = " x ".join(map(str, values.shape))
        raise SdfsimError(f"{where}: transform_matrix: {shape} numbers", "it takes 4 x 4, or the first 3 rows of that")
    rows = values.reshape(-1, 4)
    if not np.allclose(rows[3:], [0, 0, 0, 1]):
        message = f"{where}: transform_matrix: its last row is {rows[3].tolist()}, not 0, 0, 0, 1"
        raise SdfsimError(message, "write it by rows, camera to world, with the place of the camera in the last column")
    return rows[:3]


def read_model(folder: Path) -> list[KnownCamera]:
    """Cameras of a COLMAP model (its documentation, "Output Format")."""
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    cameras, images = (_model_binary if binary else _model_text)(folder)
    found = []
    for name, camera, quaternion, translation in images:
        if camera not in cameras:
            raise SdfsimError(f"{folder}: {name}: there is no camera {camera}", "write the model again")
        model, width, height, values = cameras[camera]
        names = _parameters(folder, model)
        if len(names) != len(values):
            wanted = f"{model} has {len(names)} ({' '.join(names)})"
            raise SdfsimError(f"{folder}: camera {camera}: {len(values)} parameters, {wanted}", "write the model again")
        known = dict(zip(names, values, strict=True))
        fx = known.get("fx", known.get("f", 0.0))
        lens = lens_of(fx, known.get("fy", fx), known["cx"], known["cy"], known, model.endswith("FISHEYE"))
        rotation = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
        found.append(KnownCamera(name, width, height, lens, rotation, np.array(translation)))
    return found


def _parameters(folder: Path, model: str) -> list[str]:
    if model not in PARAMETERS:
        raise SdfsimError(f"{folder}: the camera model {model} is not supported", STRAIGHTEN)
    return PARAMETERS[model]


# For each camera number: model, width, height, parameters. For each image: name, camera, quaternion, translation.
Model = tuple[dict[int, tuple[str, int, int, list[float]]], list[tuple[str, int, Sequence[float], Sequence[float]]]]


def _model_text(folder: Path) -> Model:
    cameras, images = {}, []
    for where, line in _lines(folder / "cameras.txt"):
        try:
            number, model, width, height, *values = line.split()
            cameras[int(number)] = model, int(width), int(height), [float(v) for v in values]
        except ValueError as error:
            raise SdfsimError(f"{where}: not a camera's number, model, width, height, parameters") from error
    before = False  # whether the last line was an image
    for where, line in _lines(folder / "images.txt"):
        # Two lines per image. The second, its points, may be empty, and so may lines between images.
        if before and _are_points(line):
            before = False
            continue
        try:
            _, *values, camera, name = line.split(maxsplit=9)
            numbers = [float(v) for v in values]
            images.append((name, int(camera), numbers[:4], numbers[4:7]))
            before = len(numbers) == 7
        except ValueError:
            before = False
        if not before:
            raise SdfsimError(f"{where}: not an image's number, quaternion, translation, camera, name")
    return cameras, images


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """Lines that are neither empty nor a comment, each with its place in the file."""
    data = path.read_bytes()
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    for number, line in enumerate(data.decode("utf-16" if wide else "utf-8-sig").splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield f"{path}: line {number}", line.strip()


def _are_points(line: str) -> bool:
    """Whether a line of images.txt has only triples of numbers: x, y and the number of a point."""
    words = line.split()
    try:
        return len(words) % 3 == 0 and bool([float(word) for word in words])
    except ValueError:
        return False


def _model_binary(folder: Path) -> Model:
    data, at = (folder / "cameras.bin").read_bytes(), 8
    cameras, images = {}, []
    (count,) = struct.unpack_from("<Q", data)
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<IiQQ", data, at)
        name = MODELS.get(model, (f"of number {model}", ""))[0]
        values = struct.unpack_from(f"<{len(_parameters(folder, name))}d", data, at + 24)
        at += 24 + 8 * len(values)
        cameras[number] = name, width, height, list(values)
    data, at = (folder / "images.bin").read_bytes(), 8
    (count,) = struct.unpack_from("<Q", data)
    for _ in range(count):
        values = struct.unpack_from("<I7dI", data, at)
        end = data.index(b"\0", at + 64)
        (points,) = struct.unpack_from("<Q", data, end + 1)
        images.append((data[at + 64 : end].decode("utf-8"), values[8], values[1:5], values[5:8]))
        at = end + 9 + 24 * points
    return cameras, images


def scaled(known: KnownCamera, width: int, height: int) -> np.ndarray:
    """The camera's matrix [3, 3] for its photo at another size, px."""
    if not known.height:  # Only a field of view is known.
        focal = known.lens.matrix[0][0] * width
        return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return np.diag([width / known.width, height / known.height, 1.0]) @ known.lens.matrix


def rectified(picture: ReadPhoto, known: KnownCamera, name: str, source: str) -> tuple[ReadPhoto, View, Lens | None]:
    """A photo as a pinhole camera in the same place would have taken it, that camera, and the removed lens.

    A lens without distortion needs no resampling, and no lens is returned. Otherwise the photo is cropped to the region
    of the pinhole's picture that the lens covers completely.
    """
    height, width = picture.pixels.shape[:2]
    matrix, bent, lens = scaled(known, width, height), known.lens, None
    pixels, mask, labels = picture.pixels, picture.mask, picture.labels
    # A fisheye distorts even if all its coefficients are 0.
    if bent.fisheye or any(bent.distortion) or abs(matrix[0, 0] / matrix[1, 1] - 1) > SQUARE:
        import cv2

        lens = replace(bent, matrix=tuple(map(tuple, matrix.tolist())))
        curve, size = np.array(bent.distortion), (width, height)
        old = matrix - CENTRE
        if bent.fisheye:
            new = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(old, curve, size, np.eye(3), balance=0.0)
        else:
            new, _ = cv2.getOptimalNewCameraMatrix(old, curve, size, 0.0)
        new = np.array(new, float)
        new[0, 0] = new[1, 1] = max(new[0, 0], new[1, 1])
        new[0, 1] = 0.0
        make = cv2.fisheye.initUndistortRectifyMap if bent.fisheye else cv2.initUndistortRectifyMap
        x, y = make(old, curve, np.eye(3), new, size, cv2.CV_32FC1)
        pixels = cv2.remap(pixels, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        if mask is not None:
            mask = cv2.remap(mask, x, y, cv2.INTER_LINEAR)
        if labels is not None:
            labels = cv2.remap(labels, x, y, cv2.INTER_NEAREST)
        matrix = new + CENTRE
    focal = float(matrix[0, 0])
    view = View(name, source, width, height, focal, float(matrix[0, 2]), float(matrix[1, 2]), 0.0,
                known.rotation, known.translation)  # fmt: skip
    return replace(picture, pixels=pixels, mask=mask, labels=labels, focal=focal), view, lens
