"""One mesh with one texture, made from the parts of a file, each of which has an image of its own."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sdfsim.geometry.mesh import Mesh, is_closed, joined, signed_volume

LARGEST = 8192  # px, the longest side of the image that combines several images, or repetitions of one
SWATCH = 8  # px, side of the patch of a plain colour beside images
EDGE = 1e-4  # relative to an image: places outside it by no more than this count as on its border


class Painted(NamedTuple):
    """Triangles with an image."""

    vertices: np.ndarray  # [V, 3] float64
    faces: np.ndarray  # [F, 3] int64
    uv: np.ndarray  # [V, 2] places in the image from its upper left (0, 0) to its lower right (1, 1); it repeats itself
    image: np.ndarray  # [H, W, 3] uint8; one pixel for a plain colour


def one_skin(parts: Sequence[Painted]) -> Mesh | None:
    """The parts as one mesh, with their images side by side if there are several. None if an image repeats too often to
    be written out."""
    from PIL import Image

    places, tiles, images = [], {}, {}
    for part in parts:
        uv = np.nan_to_num(part.uv)
        uv = uv - np.floor(uv.min(0) + EDGE)
        places.append(uv)
        key, often = id(part.image), np.maximum(np.ceil(uv.max(0) - EDGE), 1)
        images[key], tiles[key] = part.image, np.maximum(tiles.get(key, 1), often)
    sheets = {}
    for key, image in images.items():
        if image.shape[:2] == (1, 1):
            tiles[key], image = np.ones(2), np.broadcast_to(image, (SWATCH, SWATCH, 3))
        often = tiles[key].astype(int)
        if often.max() > 1 and (often * image.shape[1::-1]).max() > LARGEST:
            return None
        sheets[key] = np.tile(image, (often[1], often[0], 1))
    if len(sheets) > 1:
        wide = sum(sheet.shape[1] for sheet in sheets.values())
        factor = min(1.0, LARGEST / max(wide, *(sheet.shape[0] for sheet in sheets.values())))
        for key, sheet in sheets.items() if factor < 1.0 else ():
            size = [max(1, int(factor * length)) for length in sheet.shape[1::-1]]
            sheets[key] = np.asarray(Image.fromarray(sheet).resize(size, Image.Resampling.BOX))
    texture = np.zeros(
        (max(s.shape[0] for s in sheets.values()), sum(s.shape[1] for s in sheets.values()), 3), np.uint8
    )
    left, at = 0, {}
    for key, sheet in sheets.items():
        texture[: sheet.shape[0], left : left + sheet.shape[1]] = sheet
        at[key], left = left, left + sheet.shape[1]
    extent = np.array(texture.shape[1::-1])
    placed = []
    for part, uv in zip(parts, places, strict=True):
        key = id(part.image)
        size = np.array(sheets[key].shape[1::-1])
        pixel = uv / tiles[key] * size
        if len(sheets) > 1:  # so that no colour of the next image shows
            pixel = np.clip(pixel, 0.5, size - 0.5) + np.array([at[key], 0.0])
        placed.append(np.clip(pixel / extent, 0.0, 1.0))
    whole = joined(parts)
    welded = np.unique(whole.vertices, axis=0, return_inverse=True)[1].reshape(-1)[whole.faces]
    inside_out = is_closed(Mesh(whole.vertices, welded)) and signed_volume(whole) < 0
    faces = whole.faces[:, ::-1].copy() if inside_out else whole.faces
    return Mesh(whole.vertices, faces, None, np.concatenate(placed), texture)
