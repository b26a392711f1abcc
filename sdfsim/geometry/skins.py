"""One mesh with one texture, made from the parts of a file, each of which has an image of its own."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sdfsim.geometry.mesh import Mesh, is_closed, joined, signed_volume

LARGEST = 8192  # px, the longest side of the image that combines several images, or repetitions of one
SWATCH = 8  # px, side of the patch of a plain colour beside images
MOST_PLAIN = 1000  # colours that get such a patch each
USUAL = (204, 0, 128, 128, 255)  # maps of a surface of which nothing is known: roughness 0.8, no metal, no relief
EDGE = 1e-4  # relative to an image: places outside it by no more than this count as on its border


class Painted(NamedTuple):
    """Triangles with an image."""

    vertices: np.ndarray  # [V, 3] float64
    faces: np.ndarray  # [F, 3] int64
    uv: np.ndarray  # [V, 2] places in the image from its upper left (0, 0) to its lower right (1, 1); it repeats itself
    # [H, W, 3] uint8, or [H, W, 8] with the maps of `Mesh`; one pixel for a plain colour
    image: np.ndarray


def plain_parts(vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray) -> tuple[Painted | None, ...]:
    """A part for each colour of faces [F, 3], from the colours [F, 3, 3] uint8 of their corners; (None,) if the corners
    of a face differ, or if there are more than `MOST_PLAIN` colours."""
    packed = colors @ np.array([1 << 16, 1 << 8, 1])
    shades, label = np.unique(packed[:, 0], return_inverse=True)
    if (packed != packed[:, :1]).any() or len(shades) > MOST_PLAIN:
        return (None,)
    parts = []
    for k, shade in enumerate(shades.tolist()):
        used, own = np.unique(faces[label.reshape(-1) == k], return_inverse=True)
        image = np.array([[[shade >> 16, shade >> 8 & 255, shade & 255]]], dtype=np.uint8)
        parts.append(Painted(vertices[used], own.reshape(-1, 3), np.full((len(used), 2), 0.5), image))
    return tuple(parts)


def one_skin(parts: Sequence[Painted]) -> Mesh | None:
    """The parts as one mesh, with their images side by side if there are several. None if an image repeats too often to
    be written out."""
    places, tiles, images = [], {}, {}
    for part in parts:
        uv = np.nan_to_num(part.uv) if part.image.shape[:2] != (1, 1) else np.full(part.uv.shape, 0.5)
        uv = uv - np.floor(uv.min(0) + EDGE)
        places.append(uv)
        key, often = id(part.image), np.maximum(np.ceil(uv.max(0) - EDGE), 1)
        images[key], tiles[key] = part.image, np.maximum(tiles.get(key, 1), often)
    sheets = {}
    channels = max(image.shape[2] for image in images.values())
    for key, image in images.items():
        if image.shape[2] < channels:
            image = np.dstack([image, np.tile(np.array(USUAL, np.uint8), (*image.shape[:2], 1))])
        if image.shape[:2] == (1, 1):
            tiles[key], image = np.ones(2), np.broadcast_to(image, (SWATCH, SWATCH, image.shape[2]))
        often = tiles[key].astype(int)
        if often.max() > 1 and (often * image.shape[1::-1]).max() > LARGEST:
            return None
        sheets[key] = np.tile(image, (often[1], often[0], 1))
    if len(sheets) > 1:
        longest = sum(sheet.shape[1] for sheet in sheets.values())
        factor = min(1.0, LARGEST / max(longest, *(sheet.shape[0] for sheet in sheets.values())))
        for key, sheet in sheets.items() if factor < 1.0 else ():
            sheets[key] = resized(sheet, max(1, int(factor * sheet.shape[1])), max(1, int(factor * sheet.shape[0])))
    size = max(s.shape[0] for s in sheets.values()), sum(s.shape[1] for s in sheets.values())
    texture = np.zeros((*size, next(iter(sheets.values())).shape[2]), np.uint8)
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
    return painted_mesh(Painted(whole.vertices, faces, np.concatenate(placed), texture))


def painted_mesh(part: Painted) -> Mesh:
    """A part as a mesh."""
    maps = part.image[..., 3:] if part.image.shape[2] > 3 else None
    return Mesh(part.vertices, part.faces, None, part.uv, np.ascontiguousarray(part.image[..., :3]), maps)


def resized(image: np.ndarray, wide: int, tall: int) -> np.ndarray:
    """An image [H, W, C] uint8 in another size."""
    from PIL import Image

    layers = [Image.fromarray(layer).resize((wide, tall), Image.Resampling.BOX) for layer in np.moveaxis(image, 2, 0)]
    return np.stack([np.asarray(layer) for layer in layers], 2)
