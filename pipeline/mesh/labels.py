"""A picture that tells which body has which name: some of the photos, with what was found drawn over them."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pipeline.cameras import View
from pipeline.mesh.cleaning import joined
from pipeline.mesh.visibility import Caster
from sdfsim.shape.mesh import Mesh

PHOTOS = 4  # at most
THUMB = 80  # px, the longer side while photos are chosen
WIDE = 720  # px of a photo in the picture
TINT = 0.45
PALE = (150, 150, 150)


@dataclass(frozen=True)
class Named:
    """Something with a name.

    Attributes:
        name: as in scene.yaml, or as `--keep` wants it.
        note: what to write below the name.
        mesh: in the space of the cameras.
        left_out: it is no part of the scene.
    """

    name: str
    note: str
    mesh: Mesh
    left_out: bool = False


def draw_names(items: list[Named], rest: Mesh, views: list[View], photos_folder: Path) -> Image.Image:
    """Photos that show the items best, each item tinted and labelled.

    Args:
        items: what to show.
        rest: everything else that can stand in the way.
        views: cameras in the space of the meshes.
        photos_folder: of the photos stage.
    """
    caster = Caster(joined([*(item.mesh for item in items), rest]))
    borders = np.cumsum([len(item.mesh.faces) for item in items])

    def seen(view: View, longest: int) -> np.ndarray:
        """Which item each pixel [H, W] shows; the number of items for none."""
        scale = longest / max(view.width, view.height)
        size = max(1, round(view.height * scale)), max(1, round(view.width * scale))
        row, column = (axis.ravel() for axis in np.indices(size))
        away, face = caster.hits(view.center, view.rays((column + 0.5) / scale, (row + 0.5) / scale))
        number = np.searchsorted(borders, face, side="right")
        return np.where(np.isfinite(away), number, len(items)).reshape(size)

    chosen = _best_views([seen(view, THUMB) for view in views], len(items))
    tiles = [_tile(views[k], seen(views[k], WIDE), items, photos_folder) for k in chosen]
    columns = 1 if len(tiles) == 1 else 2
    wide, high = max(tile.width for tile in tiles), max(tile.height for tile in tiles)
    sheet = Image.new("RGB", (columns * wide, -(-len(tiles) // columns) * high), (255, 255, 255))
    for number, tile in enumerate(tiles):
        sheet.paste(tile, (number % columns * wide, number // columns * high))
    return sheet


def _best_views(thumbs: list[np.ndarray], count: int) -> list[int]:
    """Indices of views: each next one shows most of what the earlier ones show worst."""
    pixels = np.array([np.bincount(thumb.ravel(), minlength=count + 1)[:count] for thumb in thumbs], float)
    if not count or not pixels.any():
        return [0]
    share = pixels / np.maximum(pixels.max(0), 1)
    chosen: list[int] = []
    best = np.zeros(count)
    while len(chosen) < min(PHOTOS, len(thumbs)):
        gain = np.maximum(share - best, 0).sum(1)
        if chosen and gain.max() < 0.3:
            break
        chosen.append(int(gain.argmax()))
        best = np.maximum(best, share[chosen[-1]])
    return chosen


def _tile(view: View, seen: np.ndarray, items: list[Named], photos_folder: Path) -> Image.Image:
    with Image.open(Path(photos_folder) / "images" / view.name) as photo:
        pixels = np.asarray(photo.convert("RGB").resize(seen.shape[::-1]), float)
    for number, item in enumerate(items):
        pixels[seen == number] += TINT * (np.array(_color(number, item)) - pixels[seen == number])
    tile = Image.fromarray(pixels.astype(np.uint8))
    draw = ImageDraw.Draw(tile)
    large, small = (ImageFont.load_default(size) for size in (18, 12))
    for number, item in enumerate(items):
        rows, columns = np.nonzero(seen == number)
        if len(rows) < 12:
            continue
        at = float(np.median(columns)), float(np.median(rows))
        dark = {"fill": (255, 255, 255), "stroke_width": 2, "stroke_fill": (0, 0, 0), "anchor": "mm"}
        draw.text(at, item.name, font=large, **dark)
        draw.text((at[0], at[1] + 17), item.note, font=small, **dark)
    draw.text((6, 4), view.source, font=small, fill=(255, 255, 255), stroke_width=1, stroke_fill=(0, 0, 0))
    return tile


def _color(number: int, item: Named) -> tuple[int, ...]:
    """Hues a golden section apart, so that neighbours differ; what is left out is pale."""
    if item.left_out:
        return PALE
    return tuple(round(255 * part) for part in colorsys.hsv_to_rgb(number * 0.618 % 1, 0.85, 1.0))
