"""Renders photos of a table with a hollow vase in a room, with exact poses and geometry.

    python samples/photos/make.py                       # writes samples/photos/table_vase/, the bundled set
    python samples/photos/make.py patches --out DIR     # or room: one of the two sets into another folder

Ray casting with open3d. Every texture is made here from seeded noise and random cells and never repeats, because
repeating textures make structure-from-motion converge to wrong cameras. Table and vase are the same in both sets.
`room` has ordinary materials: wood, glaze, tiles, a cloth and a plant in soft light, with slightly different exposures;
20 of the photos look down into the vase, seven of them from near, on to its floor. `patches` has texture everywhere and
no gloss: a benchmark for geometry only. World frame: metres, z up, floor at z = 0.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

SETS, BUNDLED = ("room", "patches"), "room"
WIDTH, HEIGHT, FOCAL = 640, 480, 620.0
# Rings of cameras: number, degrees above the level, distance from the target in m, rotation as a share of a step, and
# the target. The lowest look under the table top, because unseen surfaces cannot be reconstructed.
MIDDLE, MOUTH = (0.02, 0.0, 0.46), (0.10, -0.04, 0.70)
RINGS = {
    "room": (
        (8, 3, 1.95, 0.5, MIDDLE), (9, 17, 1.95, 0.0, MIDDLE), (11, 40, 1.9, 0.1, MIDDLE), (13, 66, 1.4, 0.25, MOUTH),
        (7, 82, 0.85, 0.0, MOUTH),
    ),
    "patches": (
        (12, 3, 1.95, 0.5, MIDDLE), (14, 17, 1.95, 0.0, MIDDLE), (13, 37, 1.9, 0.1, MIDDLE),
        (9, 60, 1.75, 0.25, MIDDLE),
    ),
}  # fmt: skip
SUPERSAMPLE = 3
QUALITY = 88  # of JPEG
EXPOSURE, BALANCE = 0.05, 0.012  # of the room's photos, standard deviations of the logarithm
TABLE_SIZE = (1.2, 0.8)
TABLE_HEIGHT = 0.55
TABLE_THICKNESS = 0.05
LEG = 0.09
VASE_AT = (0.12, -0.05)
BOWL_AT = (0.40, 0.16)
PLANT_AT = (-0.36, -0.17)
ROOM = 3.6
# A lathe's texture: m per radian, m from the outer side's rows to those of the inner one, m per pixel; and m of texture
# inside per m of height and distance from the axis together.
AROUND, INSIDE, LATHE_TEXEL, DOWN = 0.12, 0.36, 0.0008, 0.8
LIGHT = np.array([0.45, 0.35, 0.82]) / np.linalg.norm([0.45, 0.35, 0.82])
SPREAD = 0.3  # of the light's directions in the room, standard deviation over their length
DIRECTIONS = 160  # of the room's light, and as many more from all around
# Outer profile upwards, then inner profile downwards: radius, height above the table top (m).
VASE_OUTER = [
    (0.0, 0.0), (0.075, 0.0), (0.105, 0.05), (0.125, 0.12), (0.115, 0.19), (0.08, 0.25), (0.06, 0.29), (0.09, 0.34)
]  # fmt: skip
VASE_INNER = [
    (0.075, 0.34), (0.046, 0.29), (0.064, 0.25), (0.098, 0.19), (0.108, 0.12), (0.088, 0.05), (0.05, 0.02), (0.0, 0.018)
]  # fmt: skip
# The same for the bowl and for the pot.
BOWL_OUTER = [(0.0, 0.0), (0.045, 0.0), (0.05, 0.008), (0.085, 0.03), (0.105, 0.06), (0.112, 0.08)]
BOWL_INNER = [(0.104, 0.081), (0.096, 0.06), (0.076, 0.035), (0.045, 0.018), (0.0, 0.014)]
POT_OUTER = [(0.0, 0.0), (0.052, 0.0), (0.066, 0.075), (0.073, 0.077), (0.077, 0.108)]
POT_INNER = [(0.069, 0.109), (0.066, 0.094), (0.04, 0.097), (0.0, 0.099)]  # the soil closes it
TURNED = {
    "vase": ((VASE_OUTER, VASE_INNER), VASE_AT, 96), "bowl": ((BOWL_OUTER, BOWL_INNER), BOWL_AT, 64),
    "pot": ((POT_OUTER, POT_INNER), PLANT_AT, 64),
}  # fmt: skip


@dataclass
class Part:
    """One object of the scene: triangles and the colours of its texture.

    Attributes:
        vertices: [V, 3] m.
        faces: [F, 3].
        texture: [H, W, 3] float32 RGB in 0..1.
        mapping: "box" (each side its own part of the texture), "sheet" (x and y), "lathe" (angle and height),
            "turned" (the same; inside and on upward faces, height and distance from the axis together) or "uv".
        texel: metres a texture pixel covers.
        axis: of a lathe, its point on the support, m.
        uv: [V, 2] m, places on the texture; of "uv" only.
        gloss: share of a mirror's reflection; used only in the room.
        moved: turn [3, 3] and shift [3] m by which the part has moved since its texture was laid on it, if it has.
    """

    vertices: np.ndarray
    faces: np.ndarray
    texture: np.ndarray
    mapping: str
    texel: float
    axis: tuple[float, float, float] = (*VASE_AT, TABLE_HEIGHT)
    uv: np.ndarray | None = None
    gloss: float = 0.0
    moved: tuple[np.ndarray, np.ndarray] | None = None

    def before(self, points: np.ndarray) -> np.ndarray:
        """Points [P, 3] at their positions before the part moved."""
        return points if self.moved is None else (points - self.moved[1]) @ self.moved[0]


def box(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [8, 3] and outward faces [12, 3] of the box between two corners."""
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    vertices = np.array(low) + corner * (np.array(high) - np.array(low))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return vertices, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def lathe(profile: np.ndarray, segments: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """Turns a profile [P, 2] (radius, height; first and last on the axis) into a closed solid."""
    rings = profile[1:-1]
    angle = np.arange(segments) * 2 * np.pi / segments
    xyz = np.stack(
        [rings[:, :1] * np.cos(angle), rings[:, :1] * np.sin(angle), np.repeat(rings[:, 1:], segments, 1)], -1
    ).reshape(-1, 3)
    vertices = np.vstack([xyz, [[0, 0, profile[0, 1]], [0, 0, profile[-1, 1]]]])
    bottom, top = len(xyz), len(xyz) + 1
    k = np.arange(segments)
    following = (k + 1) % segments
    faces = [np.stack([np.full(segments, bottom), following, k], 1)]
    for ring in range(len(rings) - 1):
        a, b = ring * segments + k, ring * segments + following
        faces += [np.stack([a, b, b + segments], 1), np.stack([a, b + segments, a + segments], 1)]
    last = (len(rings) - 1) * segments
    faces.append(np.stack([last + k, last + following, np.full(segments, top)], 1))
    return vertices, np.vstack(faces)


def smooth_profile(points: list[tuple[float, float]], samples: int) -> np.ndarray:
    """Smooth curve through profile points (monotone in chord length), [samples, 2]."""
    from scipy.interpolate import PchipInterpolator

    p = np.array(points)
    t = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    return PchipInterpolator(t, p)(np.linspace(0, t[-1], samples))


def turned_solid(outer: list, inner: list, segments: int) -> tuple[np.ndarray, np.ndarray]:
    """A hollow object of the room, standing at the origin, from the points of its two profiles."""
    return lathe(np.vstack([smooth_profile(outer, 36), smooth_profile(inner, 30)]), segments)


def noise(
    rng: np.random.Generator, height: int, width: int, coarsest: int | tuple[int, int], octaves: int
) -> np.ndarray:
    """Sum of smoothed random grids, each octave twice as fine and 0.65 as strong; about zero mean, unit spread.

    `coarsest` is the cell of the first grid in pixels, or its height and width.
    """
    import cv2

    total = np.zeros((height, width), np.float32)
    first = coarsest if isinstance(coarsest, tuple) else (coarsest, coarsest)
    for octave in range(octaves):
        high, wide = (max(1, cell >> octave) for cell in first)
        grid = rng.standard_normal((height // high + 2, width // wide + 2)).astype(np.float32)
        big = cv2.resize(grid, None, fx=wide, fy=high, interpolation=cv2.INTER_CUBIC)
        total += 0.65**octave * big[:height, :width]
    return (total - total.mean()) / total.std()


def box_texture(seed: int, shape: tuple, texel: float, palette: list, cell: int, contrast: float) -> np.ndarray:
    """A texture with room for all six sides of a box (see `sample_texture`), a pixel every `texel` metres."""
    size = np.ptp(shape[0], axis=0)
    height, width = 2 * size[1] + 4 * size[2], max(size[0], size[1])
    return texture(seed, int(height / texel) + 2, int(width / texel) + 2, palette, cell, contrast)


def texture(
    seed: int, height: int, width: int, palette: list[tuple[float, float, float]], cell: int, contrast: float = 0.10
) -> np.ndarray:
    """A texture of random patches in the palette's colours, bent by noise and overlaid with finer noise."""
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(seed)
    sites = rng.random((height * width // (cell * cell), 2)) * (height, width)
    colors = np.array(palette)[rng.integers(0, len(palette), len(sites))]
    colors = np.clip(colors * (1 + 0.35 * rng.standard_normal((len(sites), 1))), 0.03, 1)
    row, column = np.mgrid[0:height, 0:width].astype(np.float32)
    row += 0.35 * cell * noise(rng, height, width, cell, 3)
    column += 0.35 * cell * noise(rng, height, width, cell, 3)
    nearest = cKDTree(sites).query(np.stack([row, column], -1).reshape(-1, 2), workers=-1)[1]
    image = colors[nearest].reshape(height, width, 3)
    shade = 1 + contrast * noise(rng, height, width, cell * 4, 6)[..., None]
    tint = 0.05 * np.stack([noise(rng, height, width, cell * 8, 3) for _ in range(3)], -1)
    return np.clip(image * shade + tint, 0.02, 0.98).astype(np.float32)


def build_patches() -> list[Part]:
    """Room, table (one part a box) and vase, all of random patches."""
    half_x, half_y = TABLE_SIZE[0] / 2, TABLE_SIZE[1] / 2
    wood = [(0.55, 0.33, 0.17), (0.72, 0.50, 0.28), (0.38, 0.22, 0.12), (0.80, 0.66, 0.42), (0.30, 0.34, 0.24)]
    stone = [(0.42, 0.46, 0.52), (0.60, 0.60, 0.58), (0.28, 0.31, 0.38), (0.68, 0.58, 0.48), (0.35, 0.42, 0.36)]
    plaster = [(0.70, 0.66, 0.58), (0.60, 0.62, 0.66), (0.75, 0.72, 0.66), (0.55, 0.50, 0.46)]
    glaze = [(0.12, 0.26, 0.55), (0.85, 0.84, 0.78), (0.20, 0.48, 0.58), (0.72, 0.28, 0.16), (0.90, 0.72, 0.30)]
    under = TABLE_HEIGHT - TABLE_THICKNESS
    parts = []

    def add_box(seed: int, shape: tuple, texel: float, palette: list, cell: int, contrast: float = 0.10) -> None:
        parts.append(Part(*shape, box_texture(seed, shape, texel, palette, cell, contrast), "box", texel))

    add_box(1, box((-half_x, -half_y, under), (half_x, half_y, TABLE_HEIGHT)), 0.0008, wood, 44)
    for sx in (-1, 1):
        for sy in (-1, 1):
            x, y = sx * (half_x - 0.04 - LEG / 2), sy * (half_y - 0.04 - LEG / 2)
            shape = box((x - LEG / 2, y - LEG / 2, 0.0), (x + LEG / 2, y + LEG / 2, under))
            add_box(10 + len(parts), shape, 0.0008, wood, 44)
    profile = np.vstack([smooth_profile(VASE_OUTER, 56), smooth_profile(VASE_INNER, 48)])
    vertices, faces = lathe(profile)
    vase = vertices + np.array([*VASE_AT, TABLE_HEIGHT])
    parts.append(Part(vase, faces, texture(2, 900, 1000, glaze, 30), "lathe", 0.0008))
    # Only its upper side is seen, so it is a sheet: a box would use half of its texture for the lower one.
    corners = np.array([[-ROOM, -ROOM, 0.0], [ROOM, -ROOM, 0], [ROOM, ROOM, 0], [-ROOM, ROOM, 0]])
    floor = (corners, np.array([[0, 1, 2], [0, 2, 3]]))
    parts.append(Part(*floor, texture(3, 3002, 3002, stone, 40, 0.18), "sheet", 0.0024))
    walls = box((-ROOM, -ROOM, 0.0), (ROOM, ROOM, 3.2))
    # Seen from inside, so its faces are turned round.
    add_box(4, (walls[0], walls[1][:, ::-1]), 0.006, plaster, 47, 0.12)
    return parts


def cells(rng: np.random.Generator, height: int, width: int, spacing: float, bend: float) -> tuple[np.ndarray, ...]:
    """Random cells about `spacing` pixels wide with bent borders: the cell of each pixel, its distance from the cell's
    middle and how much farther the next middle is, px."""
    from scipy.spatial import cKDTree

    sites = rng.random((max(2, round(height * width / spacing**2)), 2)) * (height, width)
    row, column = np.mgrid[0:height, 0:width].astype(np.float32)
    octaves = max(1, min(4, int(np.log2(spacing))))
    row += bend * spacing * noise(rng, height, width, max(2, int(spacing)), octaves)
    column += bend * spacing * noise(rng, height, width, max(2, int(spacing)), octaves)
    away, nearest = cKDTree(sites).query(np.stack([row, column], -1).reshape(-1, 2), k=2, workers=-1)
    shape = (height, width)
    return nearest[:, 0].reshape(shape), away[:, 0].reshape(shape), (away[:, 1] - away[:, 0]).reshape(shape)


def soft(low: float, high: float, values: np.ndarray) -> np.ndarray:
    """0 below `low`, 1 above `high`, smooth between."""
    t = np.clip((values - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def over(image: np.ndarray, color: tuple[float, ...] | np.ndarray, share: np.ndarray) -> np.ndarray:
    """An image [H, W, 3] with a colour laid over it by a share [H, W]."""
    return image + share[..., None] * (np.asarray(color, np.float32) - image)


def ramp(colors: list[tuple[float, float, float]], values: np.ndarray) -> np.ndarray:
    """Colours [H, W, 3] of values [H, W] in 0..1, between those of a list."""
    places = np.linspace(0, 1, len(colors))
    return np.stack([np.interp(values, places, [c[k] for c in colors]) for k in range(3)], -1).astype(np.float32)


def spotted(rng: np.random.Generator, image: np.ndarray, color: tuple, spacing: float, radius: float,
            share: float = 1.0) -> np.ndarray:  # fmt: skip
    """An image with ragged spots of random size in one colour; `share` of the cells have one."""
    cell, away, _ = cells(rng, *image.shape[:2], spacing, 0.12)
    size = radius * rng.uniform(0.4, 1.5, cell.max() + 1) * (rng.random(cell.max() + 1) < share)
    return over(image, color, 0.9 * soft(-1, 1, size[cell] - away))


def closed(image: np.ndarray, margin: int) -> np.ndarray:
    """An image without its last columns, which fade into the first, so that it has no seam around a lathe."""
    t = np.linspace(0, 1, margin, dtype=np.float32)[None, :, None]
    image[:, :margin] = t * image[:, :margin] + (1 - t) * image[:, -margin:]
    return image[:, :-margin]


def wood(seed: int, height: int, width: int, texel: float, stave: tuple[float, float]) -> np.ndarray:
    """Oak glued from staves that lie along the rows, `stave` m wide and on average long."""
    rng = np.random.default_rng(seed)
    y, x = np.arange(height) * texel, np.arange(width) * texel
    strip = (y / stave[0]).astype(int)
    tone = np.empty((height, width), np.float32)
    shift, joint = np.empty_like(tone), np.zeros_like(tone)
    for number in range(strip[-1] + 1):
        cuts = np.cumsum(stave[1] * rng.uniform(0.6, 1.4, int(width * texel / stave[1] * 2) + 3)) - stave[1]
        piece = np.searchsorted(cuts, x)
        tone[strip == number] = rng.normal(0, 0.13, len(cuts) + 1)[piece]
        shift[strip == number] = rng.uniform(0, 40, len(cuts) + 1)[piece]
        joint[strip == number] = np.abs(x[:, None] - cuts).min(1) < 0.8 * texel
    joint[np.flatnonzero(np.diff(strip)) + 1] = 1
    # Rings are contours of a height that rises across the grain; a bump makes them surround a knot.
    across = y[:, None] / 0.016 + shift + 1.3 * noise(rng, height, width, (40, 400), 4)
    for _ in range(int(40 * height * width * texel**2)):
        row, column, size = rng.uniform(0, y[-1]), rng.uniform(0, x[-1]), rng.uniform(0.5, 1.3)
        bump = ((y[:, None] - row) / (0.010 * size)) ** 2 + ((x - column) / (0.028 * size)) ** 2
        across += 2.4 * np.exp(-bump)
        tone -= 0.55 * np.exp(-4 * bump)
    rings = np.abs((across % 1) * 2 - 1) ** 1.5
    fibre = noise(rng, height, width, (6, 96), 3)
    pores = soft(1.1, 1.9, noise(rng, height, width, (3, 36), 2))
    cloud = noise(rng, height, width, (60, 90), 4)
    value = 0.56 + tone + 0.16 * (rings - 0.5) + 0.05 * fibre + 0.09 * cloud - 0.16 * pores
    image = ramp([(0.20, 0.11, 0.06), (0.44, 0.26, 0.14), (0.67, 0.46, 0.27), (0.84, 0.67, 0.46)], np.clip(value, 0, 1))
    return over(image, (0.20, 0.12, 0.07), 0.6 * joint)


def terrazzo(seed: int, side: int, texel: float, tile: float) -> np.ndarray:
    """Tiles of stone chips in cement, `tile` m wide, no two alike."""
    rng = np.random.default_rng(seed)
    place = (np.arange(side) * texel / tile).astype(int)
    number = place[:, None] * (place[-1] + 1) + place
    tint = rng.normal(0, 0.035, number.max() + 1)[:, None] + rng.normal(0, 0.012, (number.max() + 1, 3))
    image = np.float32([0.66, 0.63, 0.57]) + 0.03 * noise(rng, side, side, 16, 4)[..., None]
    chips = [(0.36, 0.33, 0.31), (0.52, 0.36, 0.27), (0.80, 0.77, 0.70), (0.47, 0.50, 0.47), (0.58, 0.50, 0.38)]
    for spacing, share in ((0.014, 0.45), (0.042, 0.55)):
        cell, _, gap = cells(rng, side, side, spacing / texel, 0.08)
        shown = (rng.random(cell.max() + 1) < share)[cell] * soft(0.06, 0.16, gap * texel / spacing)
        own = (
            np.array(chips)[rng.integers(0, len(chips), cell.max() + 1)]
            * rng.uniform(0.8, 1.15, cell.max() + 1)[:, None]
        )
        image = over(image, own[cell].astype(np.float32), 0.45 * shown)
    image += (tint[number] + 0.025 * noise(rng, side, side, 300, 6)[..., None]).astype(np.float32)
    seam = np.abs(((np.arange(side) * texel + tile / 2) % tile) - tile / 2) < 0.005
    return np.clip(over(image, (0.34, 0.33, 0.31), 0.9 * (seam[:, None] | seam)), 0.02, 0.98)


def glaze(seed: int, dipped: float, colors: list, under: list, dots: tuple) -> np.ndarray:
    """A glaze for a lathe: `under` with iron dots and brush marks, and `colors` dipped over it, which runs down.

    Args:
        seed: of all random numbers.
        dipped: how far up, m, the upper glaze reaches on average.
        colors: of the upper glaze, from thin to thick.
        under: the same of the lower one.
        dots: colour of the dots.
    """
    rng = np.random.default_rng(seed)
    margin, texel = 60, LATHE_TEXEL
    height, width = int(2 * INSIDE / texel), round(2 * np.pi * AROUND / texel) + margin
    up = np.arange(height)[:, None] * texel % INSIDE
    body = ramp(under, np.clip(0.5 + 0.22 * noise(rng, height, width, 40, 4), 0, 1))
    brush = noise(rng, height, width, (36, 20), 3) + 0.5 * noise(rng, height, width, 80, 2)
    body = over(body, dots, 0.65 * soft(1.15, 1.35, brush))
    body = spotted(rng, body, dots, 15, 3.2, 0.8)
    thick = up - dipped + 0.03 * noise(rng, 1, width, 64, 4) + 0.008 * noise(rng, height, width, (80, 40), 3)
    runs = np.clip(0.45 + 1.2 * thick / 0.3 + 0.22 * noise(rng, height, width, (60, 24), 5), 0, 1)
    top = spotted(rng, ramp(colors, runs), under[-1], 22, 3.6, 0.6)
    share = soft(-0.002, 0.003, thick)
    image = over(over(body, colors[0], 0.8 * soft(-0.006, 0.0, thick) * (1 - share)), top, share)
    return closed(np.clip(image, 0.02, 0.98).astype(np.float32), margin)


def lining(seed: int, colors: list, spots: tuple, shape: tuple[int, ...]) -> np.ndarray:
    """A light glaze [H, W, 3] with cloudy tone and large iron spots, as it lines a pot."""
    rng = np.random.default_rng(seed)
    height, width = shape[0], shape[1] + 60
    image = ramp(colors, np.clip(0.6 + 0.3 * noise(rng, height, width, 48, 4), 0, 1))
    image = over(image, spots, 0.5 * soft(0.8, 1.1, noise(rng, height, width, (28, 44), 3)))
    image = spotted(rng, image, spots, 30, 7.0, 0.8)
    return closed(np.clip(image, 0.02, 0.98).astype(np.float32), 60)


def plaster(seed: int) -> np.ndarray:
    """The room's walls, one side of the box below the other: plaster, skirting and pictures."""
    rng = np.random.default_rng(seed)
    texel, high = 0.006, 3.2
    height, width = int((4 * ROOM + 4 * high) / texel) + 2, int(2 * ROOM / texel) + 2
    image = np.float32([0.80, 0.76, 0.68]) + 0.018 * noise(rng, height, width, 200, 7)[..., None]
    image += 0.012 * noise(rng, height, width, 6, 2)[..., None]
    for side in range(4):
        first = int((4 * ROOM + side * high) / texel)
        wall = image[first : first + int(high / texel)]
        wall[:] = wall * (1.0, 0.985, 0.96) if side % 2 else wall
        wall[: int(0.11 / texel)] = wood(seed + 10 + side, int(0.11 / texel), width, texel, (0.3, 2.0)) * 0.75
        wall[int(0.11 / texel) : int(0.12 / texel)] *= 0.6
        at = rng.uniform(0.25, 0.6)
        while at < 2 * ROOM - 1.0:
            wide, tall, low = rng.uniform(0.45, 1.0), rng.uniform(0.5, 1.0), rng.uniform(0.65, 1.0)
            rows, columns = (slice(int(a / texel), int(b / texel)) for a, b in ((low, low + tall), (at, at + wide)))
            frame = wall[rows, columns]
            frame[:] = rng.choice([(0.22, 0.15, 0.10), (0.75, 0.70, 0.62), (0.12, 0.12, 0.13), (0.62, 0.46, 0.22)])
            picture = frame[8:-8, 8:-8]
            picture[:] = (0.90, 0.88, 0.83)
            picture = picture[12:-12, 12:-12]
            picture[:] = painting(rng, *picture.shape[:2])
            at += wide + rng.uniform(0.3, 0.8)
    return np.clip(image, 0.02, 0.98)


def painting(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Hills below a sky, in one of a few moods."""
    moods = [
        [(0.20, 0.30, 0.24), (0.38, 0.50, 0.36), (0.62, 0.66, 0.50), (0.78, 0.80, 0.80), (0.60, 0.72, 0.84)],
        [(0.25, 0.18, 0.20), (0.50, 0.28, 0.22), (0.74, 0.48, 0.28), (0.88, 0.74, 0.52), (0.70, 0.68, 0.72)],
        [(0.10, 0.18, 0.30), (0.16, 0.34, 0.48), (0.40, 0.56, 0.62), (0.80, 0.80, 0.74), (0.88, 0.84, 0.76)],
    ]
    up = np.linspace(0, 1, height)[:, None] + 0.16 * noise(rng, height, width, (24, 60), 4)
    layers = np.round(5 * up) / 5 + 0.05 * noise(rng, height, width, 10, 3)
    return ramp(moods[rng.integers(len(moods))], np.clip(layers, 0, 1))


def linen(seed: int, height: int, width: int) -> np.ndarray:
    """A woven cloth with stripes of random width both ways."""
    rng = np.random.default_rng(seed)

    def stripes(count: int) -> np.ndarray:
        edges = np.cumsum(rng.uniform(6, 34, count // 6))
        kind = rng.choice([0, 0, 0, 1, 2], len(edges) + 1)
        return kind[np.searchsorted(edges, np.arange(count))]

    image = np.full((height, width, 3), (0.86, 0.82, 0.73), np.float32)
    for lines in (stripes(height)[:, None], stripes(width)[None, :]):
        for kind, color in ((1, (0.20, 0.32, 0.46)), (2, (0.68, 0.27, 0.20))):
            image = over(image, color, 0.55 * np.broadcast_to(lines == kind, (height, width)))
    row, column = np.mgrid[0:height, 0:width]
    threads = 0.05 * np.where((row // 2 + column // 2) % 2, 1, -1) * (1 + 0.5 * noise(rng, height, width, 4, 2))
    return np.clip(image * (1 + threads + 0.07 * noise(rng, height, width, 24, 5))[..., None], 0.02, 0.98)


def leaf_green(seed: int, height: int, width: int) -> np.ndarray:
    """Bands across a leaf, as on a snake plant, with a light rim; a leaf lies along the columns."""
    rng = np.random.default_rng(seed)
    bands = noise(rng, height, width, (12, 48), 4) + 0.4 * noise(rng, height, width, 6, 2)
    image = ramp([(0.14, 0.26, 0.15), (0.26, 0.42, 0.22), (0.52, 0.62, 0.36)], np.clip(0.45 + 0.3 * bands, 0, 1))
    return np.clip(image, 0.02, 0.98)


def cloth() -> Part:
    """A cloth of 5 mm that lies on the table askew and hangs down over its edge, with folds."""
    count, (long, wide), thick, turn = 48, (0.42, 0.30), 0.005, 0.12
    along, across = np.meshgrid(np.linspace(0, long, count), np.linspace(0, wide, count), indexing="ij")
    x = -0.44 + across * np.cos(turn) + along * np.sin(turn)
    ahead = 0.10 + along * np.cos(turn) - across * np.sin(turn)  # along y, and then down
    bend, edge = 0.012, TABLE_SIZE[1] / 2
    angle = np.clip((ahead - edge) / bend, 0, np.pi / 2)
    down = np.maximum(ahead - edge - bend * np.pi / 2, 0)
    rng = np.random.default_rng(21)
    wave = noise(rng, count, count, 16, 2)
    lift = 0.0015 + 0.004 * soft(0.6, 2.2, wave) * np.cos(angle)  # it lies flat except for a few creases
    out = down * (0.09 * np.sin(2 * np.pi * across / 0.105 + 0.8) + 0.09) + lift
    y = np.minimum(ahead, edge) + bend * np.sin(angle) + out * np.sin(angle)
    z = TABLE_HEIGHT - bend * (1 - np.cos(angle)) - down + lift * np.cos(angle)
    sheet = np.stack([x, y, z], -1)
    normal = np.cross(np.gradient(sheet, axis=1), np.gradient(sheet, axis=0))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    vertices = np.concatenate([(sheet + thick * normal).reshape(-1, 3), sheet.reshape(-1, 3)])
    k = np.arange(count * count).reshape(count, count)
    a, b, c, d = k[:-1, :-1].ravel(), k[1:, :-1].ravel(), k[1:, 1:].ravel(), k[:-1, 1:].ravel()
    upper = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    rim = np.concatenate([k[0, :-1], k[:-1, -1], k[-1, :0:-1], k[:0:-1, 0]])
    after, under = np.roll(rim, -1), count * count
    side = np.concatenate([np.stack([rim, rim + under, after], 1), np.stack([after, rim + under, after + under], 1)])
    faces = np.concatenate([upper, upper[:, ::-1] + under, side])
    uv = np.tile(np.stack([along, across], -1).reshape(-1, 2), (2, 1))
    return Part(vertices, faces, linen(22, int(wide / 0.0008) + 2, int(long / 0.0008) + 2), "uv", 0.0008, uv=uv)


def leaves() -> Part:
    """The thick leaves of a plant, each a bent tapering spindle, one mesh."""
    rng = np.random.default_rng(31)
    rings, segments, parts, places = 18, 14, [], []
    for number in range(11):
        azimuth = number * 2.4 + rng.normal(0, 0.15)  # rad; the golden angle, as leaves grow
        lean, length = rng.uniform(0.10, 0.25) + 0.055 * number, rng.uniform(0.15, 0.18) - 0.003 * number
        t = np.linspace(0, 1, rings)
        tilt = lean * (0.5 + 1.1 * t)
        step = length / (rings - 1)
        reach = 0.012 + 0.0012 * number + np.concatenate([[0], np.cumsum(step * np.sin(tilt[:-1]))])
        high = np.concatenate([[0], np.cumsum(step * np.cos(tilt[:-1]))]) + TABLE_HEIGHT + 0.085
        outward = np.array([np.cos(azimuth), np.sin(azimuth), 0])
        beside = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
        middle = np.array([*PLANT_AT, 0]) + reach[:, None] * outward + high[:, None] * [0, 0, 1]
        flat = np.cos(tilt)[:, None] * outward - np.sin(tilt)[:, None] * [0, 0, 1]
        broad = 0.024 * (1 - t**2.2) ** 0.8 * (0.72 + 0.9 * t * (1 - t)) + 0.001
        thick = 0.008 * (1 - 0.6 * t) * (1 - t**6) + 0.0008
        angle = np.arange(segments) * 2 * np.pi / segments
        circle = broad[:, None, None] * np.cos(angle)[:, None] * beside + (
            (thick[:, None] * np.sin(angle))[..., None] * flat[:, None]
        )
        parts.append((middle[:, None] + circle).reshape(-1, 3))
        v = 0.05 * number + 0.025 + broad[:, None] * np.cos(angle)
        places.append(np.stack([np.broadcast_to(0.2 * t[:, None], v.shape), v], -1).reshape(-1, 2))
    k = np.arange(rings * segments).reshape(rings, segments)
    nxt = np.roll(k, -1, 1)
    a, b, c, d = k[:-1].ravel(), nxt[:-1].ravel(), nxt[1:].ravel(), k[1:].ravel()
    one = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    caps = [np.stack([np.full(segments - 2, 0), k[0, 1:-1], k[0, 2:]], 1),
            np.stack([np.full(segments - 2, k[-1, 0]), k[-1, 2:], k[-1, 1:-1]], 1)]  # fmt: skip
    one = np.concatenate([one, *caps])
    faces = np.concatenate([one + number * rings * segments for number in range(len(parts))])
    return Part(
        np.concatenate(parts), faces, leaf_green(32, 560, 210), "uv", 0.001, uv=np.concatenate(places), gloss=0.03
    )


def build_room() -> list[Part]:
    """Table, vase, bowl, plant and cloth on a tiled floor, and the walls."""
    half_x, half_y = TABLE_SIZE[0] / 2, TABLE_SIZE[1] / 2
    under, fine = TABLE_HEIGHT - TABLE_THICKNESS, 0.0008
    slab = box((-half_x, -half_y, under), (half_x, half_y, TABLE_HEIGHT))
    rows = int((2 * TABLE_SIZE[1] + 4 * TABLE_THICKNESS) / fine) + 2
    parts = [Part(*slab, wood(1, rows, int(TABLE_SIZE[0] / fine) + 2, fine, (0.066, 0.34)), "box", fine, gloss=0.02)]
    for sx in (-1, 1):
        for sy in (-1, 1):
            x, y = sx * (half_x - 0.04 - LEG / 2), sy * (half_y - 0.04 - LEG / 2)
            shape = box((x - LEG / 2, y - LEG / 2, 0.0), (x + LEG / 2, y + LEG / 2, under))
            # The grain of a leg runs upwards, along its texture's columns.
            upright = wood(
                10 + len(parts), int(LEG / fine) + 2, int((4 * under + 2 * LEG) / fine) + 2, fine, (0.045, 0.4)
            )
            parts.append(Part(*shape, np.ascontiguousarray(upright.transpose(1, 0, 2)), "box", fine))

    def turned(name: str, picture: np.ndarray, gloss: float) -> None:
        profiles, at, segments = TURNED[name]
        vertices, faces = turned_solid(*profiles, segments)
        axis = (*at, TABLE_HEIGHT)
        parts.append(Part(vertices + axis, faces, picture, "turned", LATHE_TEXEL, axis, gloss=gloss))

    cream = [(0.62, 0.54, 0.42), (0.80, 0.74, 0.62), (0.90, 0.87, 0.78)]
    teal = [(0.42, 0.30, 0.20), (0.14, 0.36, 0.40), (0.10, 0.30, 0.42), (0.24, 0.52, 0.56), (0.08, 0.20, 0.34)]
    honey = [(0.36, 0.22, 0.12), (0.66, 0.42, 0.18), (0.80, 0.60, 0.30), (0.54, 0.30, 0.14), (0.86, 0.72, 0.44)]
    clay = [(0.50, 0.25, 0.16), (0.66, 0.36, 0.24), (0.78, 0.48, 0.34)]
    vase = glaze(2, 0.19, teal, cream, (0.30, 0.17, 0.10))
    vase[len(vase) // 2 :] = lining(8, cream, (0.34, 0.19, 0.11), vase.shape)[len(vase) // 2 :]
    turned("vase", vase, 0.05)
    turned("bowl", glaze(5, 0.035, honey, cream, (0.26, 0.15, 0.09)), 0.05)
    pot = glaze(6, 0.3, clay, clay, (0.36, 0.17, 0.11))
    rng = np.random.default_rng(7)
    soil = ramp(
        [(0.10, 0.07, 0.05), (0.24, 0.17, 0.11), (0.42, 0.32, 0.22)],
        np.clip(0.4 + 0.25 * noise(rng, *pot.shape[:2], 12, 3), 0, 1),
    )
    pot[len(pot) // 2 :] = soil[len(pot) // 2 :]
    turned("pot", pot, 0.0)
    parts += [leaves(), cloth()]
    corners = np.array([[-ROOM, -ROOM, 0.0], [ROOM, -ROOM, 0], [ROOM, ROOM, 0], [-ROOM, ROOM, 0]])
    floor = (corners, np.array([[0, 1, 2], [0, 2, 3]]))
    parts.append(Part(*floor, terrazzo(3, 2402, 0.003, 0.40), "sheet", 0.003, gloss=0.02))
    # Its lower side lies below the floor, so that rays meet only that.
    walls = box((-ROOM, -ROOM, -0.01), (ROOM, ROOM, 3.2))
    parts.append(Part(walls[0], walls[1][:, ::-1], plaster(4), "box", 0.006))
    return parts


def sample_texture(part: Part, points: np.ndarray, normals: np.ndarray, uv: np.ndarray | None = None) -> np.ndarray:
    """Colours [P, 3] of a part at surface points [P, 3] with normals [P, 3], and `uv` [P, 2] m if it is mapped so."""
    import cv2

    vertices = part.before(part.vertices)
    if part.moved is not None:
        points, normals = part.before(points), normals @ part.moved[0]
    if uv is not None:
        u, v = uv.T
    elif part.mapping in ("lathe", "turned"):
        local = points - part.axis
        angle = np.arctan2(local[:, 1], local[:, 0])
        inside = (normals[:, :2] * local[:, :2]).sum(1) < 0
        u, v = (angle + np.pi) * AROUND, local[:, 2] + inside * INSIDE
        if part.mapping == "turned":
            inside |= normals[:, 2] > 0.5
            v = np.where(inside, INSIDE + DOWN * (local[:, 2] + np.linalg.norm(local[:, :2], axis=1)), v)
    elif part.mapping == "sheet":
        u, v = (points[:, :2] - vertices[:, :2].min(0)).T
    else:
        axis = np.abs(normals).argmax(1)
        sign = np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0
        low, high = vertices.min(0), vertices.max(0)
        size = high - low
        local = points - low
        # The six sides lie below one another in the texture: bottom and top, then the upright ones.
        side = np.where(axis == 2, sign * 1, 2 + axis * 2 + sign)
        offset = np.cumsum([0, size[1], size[1], size[2], size[2], size[2]])
        u = np.where(axis == 0, local[:, 1], local[:, 0])
        v = np.where(axis == 2, local[:, 1], local[:, 2]) + offset[side]
    # remap allows at most 32767 rows or columns, so the same query is folded to many rows in two columns.
    count = len(u)
    pad = -count % 1024
    map_x = np.pad((u / part.texel).astype(np.float32), (0, pad)).reshape(-1, 1024)
    map_y = np.pad((v / part.texel).astype(np.float32), (0, pad)).reshape(-1, 1024)
    out = cv2.remap(part.texture, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return out.reshape(-1, 3)[:count]


def cameras(name: str) -> list[np.ndarray]:
    """48 camera-to-world matrices [4, 4], OpenGL axes (x right, y up, looking along -z), on the rings of a set."""
    rng = np.random.default_rng(5)
    poses = []
    for count, elevation, radius, phase, middle in RINGS[name]:
        for k in range(count):
            azimuth = 2 * np.pi * (k + phase) / count + rng.normal(0, 0.03)
            tilt = np.radians(elevation + rng.normal(0, 2))
            distance = radius * (1 + rng.normal(0, 0.03))
            target = np.array(middle) + rng.normal(0, 0.03, 3)
            backward = np.array([np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)])
            right = np.cross([0, 0, 1], backward)
            right /= np.linalg.norm(right)
            up = np.cross(backward, right)
            roll = rng.normal(0, 0.04)
            pose = np.eye(4)
            pose[:3, 0] = np.cos(roll) * right + np.sin(roll) * up
            pose[:3, 1] = np.cos(roll) * up - np.sin(roll) * right
            pose[:3, 2] = backward
            pose[:3, 3] = target + distance * backward
            poses.append(pose)
    return poses


def view_rays(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions [N, 3] float32 of the rays of a photo, row by row, SUPERSAMPLE squared to a pixel."""
    n = SUPERSAMPLE
    x = (np.arange(WIDTH * n) + 0.5) / n - WIDTH / 2
    y = (np.arange(HEIGHT * n) + 0.5) / n - HEIGHT / 2
    direction = np.empty((HEIGHT * n, WIDTH * n, 3), np.float32)
    direction[..., 0], direction[..., 1], direction[..., 2] = x[None, :] / FOCAL, -y[:, None] / FOCAL, -1
    direction = (direction @ pose[:3, :3].T).reshape(-1, 3).astype(np.float32)
    return np.broadcast_to(pose[:3, 3].astype(np.float32), direction.shape), direction


def render(parts: list[Part], caster, pose: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One photo [H, W, 3] uint8 of patches: Lambert from one soft light with shadows, plus ambient light."""
    import open3d as o3d

    n = SUPERSAMPLE
    origin, direction = view_rays(pose)
    hit = caster.cast_rays(o3d.core.Tensor(np.concatenate([origin, direction], 1)))
    distance, part_id = hit["t_hit"].numpy(), hit["geometry_ids"].numpy()
    normal = hit["primitive_normals"].numpy()
    normal *= -np.sign((normal * direction).sum(1, keepdims=True))
    point = origin + distance[:, None] * direction
    light = LIGHT + 0.12 * rng.standard_normal(point.shape)
    light = (light / np.linalg.norm(light, axis=1, keepdims=True)).astype(np.float32)
    # The room has no roof for the light: only objects on the floor cast shadows.
    shadow = np.concatenate([point + 1e-4 * normal, light], 1).astype(np.float32)
    blocked = caster.cast_rays(o3d.core.Tensor(shadow))["geometry_ids"].numpy() < len(parts) - 2
    facing = np.clip((normal * light).sum(1), 0, 1) * ~blocked
    shade = 0.36 + 0.10 * normal[:, 2] + 0.44 * facing
    color = np.zeros_like(point)
    for index, part in enumerate(parts):
        chosen = part_id == index
        if chosen.any():
            color[chosen] = sample_texture(part, point[chosen], normal[chosen])
    color = np.clip(color * shade[:, None], 0, 1).reshape(HEIGHT, n, WIDTH, n, 3).mean((1, 3))
    return (255 * color ** (1 / 1.6) + 0.5).astype(np.uint8)


class Room:
    """The parts in realistic light: soft light from above, light from all around, and reflections between objects.

    Light is computed once, at the vertices of meshes that are fine enough for its shadows, and is the same in all
    photos.
    """

    def __init__(self, parts: list[Part]) -> None:
        import open3d as o3d

        self.parts = parts
        self.meshes = [_lit_mesh(part, 0.2 if part is parts[-1] else 0.045) for part in parts]
        self.caster = o3d.t.geometry.RaycastingScene()
        for vertices, faces, _, _ in self.meshes:
            self.caster.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(faces))
        self.light = self._light()

    def _light(self) -> list[np.ndarray]:
        """Light [V, 3] that falls onto the vertices of each mesh."""
        import open3d as o3d

        rng = np.random.default_rng(8)
        sun = LIGHT + SPREAD * rng.standard_normal((DIRECTIONS, 3))
        sun /= np.linalg.norm(sun, axis=1, keepdims=True)
        k = np.arange(DIRECTIONS) + 0.5
        turn, height = np.pi * (1 + 5**0.5) * k, 1 - 2 * k / DIRECTIONS
        around = np.stack([np.cos(turn) * np.sqrt(1 - height**2), np.sin(turn) * np.sqrt(1 - height**2), height], 1)
        point = np.concatenate([mesh[0] + 1e-3 * mesh[2] for mesh in self.meshes]).astype(np.float32)
        normal = np.concatenate([mesh[2] for mesh in self.meshes])
        # The room reflects a part of the light in its own colour; floor and walls block no light.
        back = np.array([0.7 * (part.texture.mean((0, 1)) ** 2.2) for part in self.parts], np.float32)
        standing = len(self.parts) - 2
        total = np.zeros((len(point), 3), np.float32)
        for directions, strength in ((sun, 1.15), (around, None)):
            for direction in directions:
                facing = np.clip(normal @ direction, 0, None).astype(np.float32)
                seen = np.flatnonzero(facing)
                rays = np.concatenate([point[seen], np.broadcast_to(direction, (len(seen), 3))], 1).astype(np.float32)
                met = self.caster.cast_rays(o3d.core.Tensor(rays))["geometry_ids"].numpy()
                blocked = met < standing
                if strength is None:  # skylight from above, reflections of floor and walls from below
                    sky = np.float32([0.80, 0.88, 1.0]) if direction[2] > 0 else np.float32([0.52, 0.47, 0.40])
                    arriving = np.where(blocked[:, None], back[np.minimum(met, standing)], sky)
                    total[seen] += (4 / DIRECTIONS * 0.62) * facing[seen, None] * arriving
                else:
                    color = np.float32([1.0, 0.95, 0.86])
                    total[seen] += (strength / DIRECTIONS) * (facing[seen] * ~blocked)[:, None] * color
        return np.split(total, np.cumsum([len(mesh[0]) for mesh in self.meshes])[:-1])

    def photo(self, pose: np.ndarray, gain: np.ndarray) -> np.ndarray:
        """One photo [H, W, 3] uint8, exposed by a `gain` [3]."""
        import open3d as o3d

        origin, direction = view_rays(pose)
        hit = self.caster.cast_rays(o3d.core.Tensor(np.concatenate([origin, direction], 1)))
        part_id, face, uv = (hit[name].numpy() for name in ("geometry_ids", "primitive_ids", "primitive_uvs"))
        point = origin + hit["t_hit"].numpy()[:, None] * direction
        ahead = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        weights = np.concatenate([1 - uv.sum(1, keepdims=True), uv], 1)[..., None]
        color = np.zeros_like(point)
        for index, part in enumerate(self.parts):
            chosen = part_id == index
            if not chosen.any():
                continue
            _, faces, normals, places = self.meshes[index]
            corner, weight = faces[face[chosen]], weights[chosen]
            normal = (weight * normals[corner]).sum(1)
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            place = (weight * places[corner]).sum(1) if places is not None else None
            light = (weight * self.light[index][corner]).sum(1)
            shown = sample_texture(part, point[chosen], normal, place) ** 2.2 * light
            if part.gloss:
                seen = ahead[chosen]
                cosine = np.clip(-(normal * seen).sum(1), 0, 1)
                mirrored = seen + 2 * cosine[:, None] * normal
                lamp = 9 * np.exp(28 * (np.clip(mirrored @ LIGHT, -1, 1) - 1)) + 0.6 * soft(-0.2, 1.0, mirrored[:, 2])
                shown += (part.gloss * (1 + 6 * (1 - cosine) ** 5) * lamp * light.mean(1))[:, None]
            color[chosen] = shown
        color = (color * gain).reshape(HEIGHT, SUPERSAMPLE, WIDTH, SUPERSAMPLE, 3).mean((1, 3))
        # Bright places are compressed, as a camera does.
        color = np.where(color > 0.6, 0.6 + 0.4 * np.tanh((color - 0.6) / 0.4), color)
        return (255 * np.clip(color, 0, 1) ** (1 / 2.2) + 0.5).astype(np.uint8)


def _lit_mesh(part: Part, longest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """A part's mesh with normals: vertices [V, 3], faces [F, 3], normals [V, 3] and places on the texture.

    Flat sides are cut until no edge is longer than `longest`, and share no vertices at edges.
    """
    import trimesh

    if part.mapping in ("lathe", "turned", "uv"):
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
        normals = mesh.vertex_normals.astype(np.float32)
        return mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32), normals, part.uv
    flat = part.vertices[part.faces].reshape(-1, 3)
    vertices, faces = trimesh.remesh.subdivide_to_size(flat, np.arange(len(flat)).reshape(-1, 3), longest, max_iter=20)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    key = np.concatenate([vertices[faces].reshape(-1, 3), np.repeat(mesh.face_normals, 3, 0)], 1).round(6)
    unique, inverse = np.unique(key, axis=0, return_inverse=True)
    vertices, normals = np.split(unique.astype(np.float32), 2, 1)
    return vertices, inverse.reshape(-1, 3).astype(np.uint32), normals, None


def write_truth(parts: list[Part], path: Path) -> None:
    """The true surface of table, vase and floor (not the walls) with plain colours, metres."""
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh()
    for part in parts[:-1]:
        piece = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(part.vertices), o3d.utility.Vector3iVector(part.faces)
        )
        piece.paint_uniform_color(part.texture.mean((0, 1)).astype(float))
        mesh += piece
    o3d.io.write_triangle_mesh(str(path), mesh, write_vertex_normals=False)


def main() -> None:
    """Renders a set into the given folder (default: table_vase next to this file)."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", nargs="?", choices=SETS, default=BUNDLED, help=f"default: {BUNDLED}, the bundled one")
    parser.add_argument("--out", type=Path, help=f"default for {BUNDLED}: table_vase next to this file")
    parser.add_argument("--views", type=int, default=None, help="render only the first N views")
    arguments = parser.parse_args()
    if arguments.out is None and arguments.set != BUNDLED:
        parser.error(f"{arguments.set}: give a folder with --out")
    make_set(arguments.set, arguments.out or Path(__file__).parent / "table_vase", arguments.views)


def make_set(name: str, folder: Path, views: int | None = None) -> None:
    """Writes the photos of "room" or "patches" with transforms.json and truth.ply into a folder.

    Args:
        name: of the set.
        folder: made if it does not exist.
        views: number of photos, from the first on.
    """
    import cv2
    import open3d as o3d

    (folder / "images").mkdir(parents=True, exist_ok=True)
    parts = build_room() if name == "room" else build_patches()
    rng = np.random.default_rng(6)
    if name == "room":
        room = Room(parts)

        def photo(pose: np.ndarray) -> np.ndarray:
            return room.photo(pose, np.exp(rng.normal(0, EXPOSURE) + rng.normal(0, BALANCE, 3)))
    else:
        caster = o3d.t.geometry.RaycastingScene()
        for part in parts:
            triangles = (part.vertices.astype(np.float32), part.faces.astype(np.uint32))
            caster.add_triangles(*map(o3d.core.Tensor, triangles))

        def photo(pose: np.ndarray) -> np.ndarray:
            return render(parts, caster, pose, rng)

    frames = []
    for index, pose in enumerate(cameras(name)[:views]):
        file = f"images/{index:03d}.jpg"
        cv2.imwrite(str(folder / file), photo(pose)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        frames.append({"file_path": file, "transform_matrix": pose.tolist()})
        print(f"\r{index + 1} views", end="", flush=True, file=sys.stderr)
    write_truth(parts, folder / "truth.ply")
    about = {
        "comment": "camera-to-world, OpenGL axes; metres, z up; pixel centres at +0.5; made by samples/photos/make.py",
        "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT,
        "table_width": TABLE_SIZE[0], "table_height": TABLE_HEIGHT, "frames": frames,
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(about, indent=1), encoding="utf-8")
    print(file=sys.stderr)


if __name__ == "__main__":
    main()
