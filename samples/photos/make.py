"""Renders the bundled photo set: a table with a hollow vase on it, in a room, with exact poses and geometry.

    python samples/photos/make.py            # writes samples/photos/table_vase/

Ray casting with open3d; every texture is made here from seeded noise and random cells and never repeats, because
repeating textures make structure-from-motion converge to wrong cameras. World frame: metres, z up, floor at z = 0.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

WIDTH, HEIGHT, FOCAL = 640, 480, 620.0
SUPERSAMPLE = 3
TABLE_SIZE = (1.2, 0.8)
TABLE_HEIGHT = 0.55
TABLE_THICKNESS = 0.05
LEG = 0.09
VASE_AT = (0.12, -0.05)
ROOM = 3.6
LIGHT = np.array([0.45, 0.35, 0.82]) / np.linalg.norm([0.45, 0.35, 0.82])
# Outer profile upwards, then inner profile downwards: radius, height above the table top (m).
VASE_OUTER = [
    (0.0, 0.0), (0.075, 0.0), (0.105, 0.05), (0.125, 0.12), (0.115, 0.19), (0.08, 0.25), (0.06, 0.29), (0.09, 0.34)
]  # fmt: skip
VASE_INNER = [
    (0.075, 0.34), (0.046, 0.29), (0.064, 0.25), (0.098, 0.19), (0.108, 0.12), (0.088, 0.05), (0.05, 0.02), (0.0, 0.018)
]  # fmt: skip


@dataclass
class Part:
    """One object of the scene: triangles and the colours of its texture.

    Attributes:
        vertices: [V, 3] m.
        faces: [F, 3].
        texture: [H, W, 3] float32 RGB in 0..1.
        mapping: "box" (each side its own part of the texture), "sheet" (x and y) or "lathe" (angle and height).
        texel: metres a texture pixel covers.
        moved: turn [3, 3] and shift [3] m by which the part has moved since its texture was laid on it, if it has.
    """

    vertices: np.ndarray
    faces: np.ndarray
    texture: np.ndarray
    mapping: str
    texel: float
    moved: tuple[np.ndarray, np.ndarray] | None = None

    def before(self, points: np.ndarray) -> np.ndarray:
        """Points [P, 3] where they were before the part moved."""
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


def noise(rng: np.random.Generator, height: int, width: int, coarsest: int, octaves: int) -> np.ndarray:
    """Sum of smoothed random grids, each octave twice as fine and 0.65 as strong; about zero mean, unit spread."""
    import cv2

    total = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        cell = max(1, coarsest >> octave)
        grid = rng.standard_normal((height // cell + 2, width // cell + 2)).astype(np.float32)
        big = cv2.resize(grid, None, fx=cell, fy=cell, interpolation=cv2.INTER_CUBIC)
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


def build() -> list[Part]:
    """The scene: room, table (one part a box) and vase."""
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
    # Only its upper side is seen, so it is a sheet: a box would spend half of its texture on the lower one.
    corners = np.array([[-ROOM, -ROOM, 0.0], [ROOM, -ROOM, 0], [ROOM, ROOM, 0], [-ROOM, ROOM, 0]])
    floor = (corners, np.array([[0, 1, 2], [0, 2, 3]]))
    parts.append(Part(*floor, texture(3, 3002, 3002, stone, 40, 0.18), "sheet", 0.0024))
    walls = box((-ROOM, -ROOM, 0.0), (ROOM, ROOM, 3.2))
    # Seen from inside, so its faces are turned round.
    add_box(4, (walls[0], walls[1][:, ::-1]), 0.006, plaster, 47, 0.12)
    return parts


def sample_texture(part: Part, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Colours [P, 3] of a part at surface points [P, 3] with normals [P, 3]."""
    import cv2

    vertices = part.before(part.vertices)
    if part.moved is not None:
        points, normals = part.before(points), normals @ part.moved[0]
    if part.mapping == "lathe":
        local = points - [*VASE_AT, TABLE_HEIGHT]
        angle = np.arctan2(local[:, 1], local[:, 0])
        inside = ((normals[:, :2] * local[:, :2]).sum(1) < 0) * 0.36
        u, v = (angle + np.pi) * 0.12, local[:, 2] + inside
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
    # remap allows at most 32767 rows or columns, hence two columns of the same query folded to many rows.
    count = len(u)
    pad = -count % 1024
    map_x = np.pad((u / part.texel).astype(np.float32), (0, pad)).reshape(-1, 1024)
    map_y = np.pad((v / part.texel).astype(np.float32), (0, pad)).reshape(-1, 1024)
    out = cv2.remap(part.texture, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return out.reshape(-1, 3)[:count]


def cameras() -> list[np.ndarray]:
    """48 camera-to-world matrices [4, 4], OpenGL axes (x right, y up, looking along -z), on four rings."""
    rng = np.random.default_rng(5)
    poses = []
    # The lowest ring looks under the table top: what no photo shows cannot be reconstructed.
    rings = ((12, 3, 1.95, 0.5), (14, 17, 1.95, 0.0), (13, 37, 1.9, 0.1), (9, 60, 1.75, 0.25))
    for count, elevation, radius, phase in rings:
        for k in range(count):
            azimuth = 2 * np.pi * (k + phase) / count + rng.normal(0, 0.03)
            tilt = np.radians(elevation + rng.normal(0, 2))
            distance = radius * (1 + rng.normal(0, 0.03))
            target = np.array([0.02, 0.0, 0.46]) + rng.normal(0, 0.03, 3)
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


def render(parts: list[Part], caster, pose: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One photo [H, W, 3] uint8: Lambert from one soft light with shadows, plus ambient light."""
    import open3d as o3d

    n = SUPERSAMPLE
    x = (np.arange(WIDTH * n) + 0.5) / n - WIDTH / 2
    y = (np.arange(HEIGHT * n) + 0.5) / n - HEIGHT / 2
    direction = np.empty((HEIGHT * n, WIDTH * n, 3), np.float32)
    direction[..., 0], direction[..., 1], direction[..., 2] = x[None, :] / FOCAL, -y[:, None] / FOCAL, -1
    direction = (direction @ pose[:3, :3].T).reshape(-1, 3).astype(np.float32)
    origin = np.broadcast_to(pose[:3, 3].astype(np.float32), direction.shape)
    hit = caster.cast_rays(o3d.core.Tensor(np.concatenate([origin, direction], 1)))
    distance, part_id = hit["t_hit"].numpy(), hit["geometry_ids"].numpy()
    normal = hit["primitive_normals"].numpy()
    normal *= -np.sign((normal * direction).sum(1, keepdims=True))
    point = origin + distance[:, None] * direction
    light = LIGHT + 0.12 * rng.standard_normal(point.shape)
    light = (light / np.linalg.norm(light, axis=1, keepdims=True)).astype(np.float32)
    # The room has no roof as far as the light is concerned: only what stands on the floor casts shadows.
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
    """Renders everything into the folder given (default: table_vase beside this file)."""
    import cv2
    import open3d as o3d

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "table_vase")
    parser.add_argument("--views", type=int, default=None, help="render only the first N views")
    arguments = parser.parse_args()
    folder = arguments.out
    (folder / "images").mkdir(parents=True, exist_ok=True)
    parts = build()
    caster = o3d.t.geometry.RaycastingScene()
    for part in parts:
        caster.add_triangles(
            o3d.core.Tensor(part.vertices.astype(np.float32)), o3d.core.Tensor(part.faces.astype(np.uint32))
        )
    frames = []
    rng = np.random.default_rng(6)
    for index, pose in enumerate(cameras()[: arguments.views]):
        image = render(parts, caster, pose, rng)
        name = f"images/{index:03d}.jpg"
        cv2.imwrite(str(folder / name), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
        print(f"\r{index + 1} views", end="", flush=True)
    write_truth(parts, folder / "truth.ply")
    about = {
        "comment": "camera-to-world, OpenGL axes; metres, z up; pixel centres at +0.5; made by samples/photos/make.py",
        "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT,
        "table_width": TABLE_SIZE[0], "table_height": TABLE_HEIGHT, "frames": frames,
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(about, indent=1), encoding="utf-8")
    print()


if __name__ == "__main__":
    main()
