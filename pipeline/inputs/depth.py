"""Depth maps that came with photos: their files, and which of their pixels can be believed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sdfsim.errors import SdfsimError

FARTHEST = 8.0  # m; a phone's sensor guesses beyond
# Neighbours whose depths differ by more than this share lie on both sides of an edge, which sensors smear.
EDGE = 0.04
BELIEVED = 0.5  # of the highest confidence
EXTRA = "install what reads it: bash scripts/setup.sh record3d (or pip install 'sdfsim[record3d]')"


@dataclass(frozen=True)
class DepthFile:
    """Where the depth of a photo is kept."""

    path: Path  # PNG or TIFF of integers, EXR, NPY, or Record3D's compressed floats (`.depth`)
    unit: float | None = None  # m that a count stands for; None: integers are millimetres, floats metres
    confidence: Path | None = None  # file of the same shape, higher is better; None: there is none
    shape: tuple[int, int] | None = None  # rows and columns, of a `.depth` file, which does not say so itself

    def files(self) -> list[Path]:
        """The files that this depth is read from."""
        return [self.path] + ([self.confidence] if self.confidence else [])


def read_depth(file: DepthFile) -> np.ndarray:
    """Depth [H, W] m along the optical axis; 0 where the sensor had none, was not sure, or saw an edge. Raises
    SdfsimError where the file is absent, damaged, or needs a package that is not installed."""
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
    return np.where(good & ~_edges(depth), depth, 0).astype(np.float32)


def _edges(depth: np.ndarray) -> np.ndarray:
    """Pixels [H, W] one of whose four neighbours is much nearer or farther."""
    from scipy import ndimage

    cross = ndimage.generate_binary_structure(2, 1)
    far = ndimage.maximum_filter(depth, footprint=cross)
    near = ndimage.minimum_filter(np.where(depth > 0, depth, np.inf), footprint=cross)
    return (far - depth > EDGE * depth) | (depth - near > EDGE * near)


def _read(path: Path, shape: tuple[int, int] | None, raw: type) -> np.ndarray:
    """The numbers [H, W] of a file, `raw` ones where it does not say what they are."""
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
        raise SdfsimError(f"{path}: no picture with one channel", "depth is a PNG of 16 bits, an EXR or an NPY")
    return np.squeeze(values)
