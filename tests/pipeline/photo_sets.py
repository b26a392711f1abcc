"""Small photo sets made by ourselves, each with one thing wrong that the poses stage has to name.

They are drawn with the ray caster and the textures of samples/photos/make.py, smaller and coarser.
"""

import importlib.util
import json
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from PIL import Image, ImageFilter

from sdfsim.geometry.mesh import Mesh, joined
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.geometry.primitives import torus

SAMPLES = Path(__file__).resolve().parents[2] / "samples" / "photos"
TABLE_VASE = SAMPLES / "table_vase"
WARM = [(0.55, 0.33, 0.17), (0.72, 0.50, 0.28), (0.38, 0.22, 0.12), (0.80, 0.66, 0.42), (0.30, 0.34, 0.24)]
COOL = [(0.12, 0.26, 0.55), (0.85, 0.84, 0.78), (0.20, 0.48, 0.58), (0.72, 0.28, 0.16), (0.90, 0.72, 0.30)]


def studio(width: int = 480, height: int = 360, focal: float = 465.0) -> ModuleType:
    """A copy of samples/photos/make.py of its own, set to small pictures."""
    spec = importlib.util.spec_from_file_location("photo_set_studio", SAMPLES / "make.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    import sys

    sys.modules[spec.name] = module  # dataclasses look their module up by name
    spec.loader.exec_module(module)
    module.WIDTH, module.HEIGHT, module.FOCAL, module.SUPERSAMPLE = width, height, focal, 2
    return module


def still_life(make: ModuleType, seed: int, *, tile: float | None = None) -> list:
    """A box on a floor within four walls; with `tile`, one square patch of that side (m) repeats everywhere."""
    low, high = (-0.3, -0.2, 0.0), (0.3, 0.2, 0.35)
    room = 2.5

    def part(number: int, shape: tuple, texel: float, palette: list, cell: int, mapping: str = "box"):
        size = np.ptp(shape[0], axis=0)
        if mapping == "sheet":
            rows, columns = int(size[1] / texel) + 2, int(size[0] / texel) + 2
        else:
            rows, columns = int((2 * size[1] + 4 * size[2]) / texel) + 2, int(max(size[0], size[1]) / texel) + 2
        if tile is None:
            picture = make.texture(seed * 100 + number, rows, columns, palette, cell, 0.15)
        else:
            side = int(tile / texel)
            patch = make.texture(seed * 100 + number, side, side, palette, max(4, side // 6), 0.15)
            picture = np.tile(patch, (rows // side + 1, columns // side + 1, 1))[:rows, :columns]
        return make.Part(*shape, picture, mapping, texel)

    corners = np.array([[-room, -room, 0.0], [room, -room, 0], [room, room, 0], [-room, room, 0]])
    walls = make.box((-room, -room, 0.0), (room, room, 2.2))
    return [
        part(1, make.box(low, high), 0.0012, COOL if seed % 2 else WARM, 22),
        part(2, (corners, np.array([[0, 1, 2], [0, 2, 3]])), 0.004, WARM if seed % 2 else COOL, 22, "sheet"),
        part(3, (walls[0], walls[1][:, ::-1]), 0.008, COOL, 24),
    ]


def look(center: Iterable[float], target: Iterable[float]) -> np.ndarray:
    """Camera-to-world matrix [4, 4], OpenGL axes, of a level camera."""
    pose = np.eye(4)
    backward = np.asarray(center, float) - np.asarray(target, float)
    backward /= np.linalg.norm(backward)
    right = np.cross([0, 0, 1], backward)
    right /= np.linalg.norm(right)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(backward, right), backward, np.asarray(center)
    return pose


def orbit(count: int, *, radius: float = 1.3, span: float = 360.0) -> list[np.ndarray]:
    """Poses on an arc of `span` degrees around the still life, at two heights by turns."""
    angles = np.radians(np.arange(count) * span / count)
    return [
        look((radius * np.cos(a), radius * np.sin(a), 0.55 + 0.3 * (k % 2)), (0, 0, 0.15)) for k, a in enumerate(angles)
    ]


def caster_of(parts: list) -> Any:
    """What casts rays onto parts; the number of a geometry is that of its part."""
    import open3d as o3d

    caster = o3d.t.geometry.RaycastingScene()
    for part in parts:
        triangles = (part.vertices.astype(np.float32), part.faces.astype(np.uint32))
        caster.add_triangles(*map(o3d.core.Tensor, triangles))
    return caster


def shoot(make: ModuleType, parts: list, poses: list[np.ndarray], folder: Path, prefix: str = "") -> list[Path]:
    """Renders one photo a pose into `folder`, with the poses as transforms.json."""
    folder.mkdir(parents=True, exist_ok=True)
    caster, rng, paths = caster_of(parts), np.random.default_rng(1), []
    for number, pose in enumerate(poses):
        paths.append(folder / f"{prefix}{number:03d}.jpg")
        Image.fromarray(make.render(parts, caster, pose, rng)).save(paths[-1], quality=92)
    about = {
        "fl_x": make.FOCAL, "fl_y": make.FOCAL, "cx": make.WIDTH / 2, "cy": make.HEIGHT / 2,
        "w": make.WIDTH, "h": make.HEIGHT,
        "frames": [{"file_path": p.name, "transform_matrix": m.tolist()} for p, m in zip(paths, poses, strict=True)],
    }  # fmt: skip
    (folder / f"{prefix}transforms.json").write_text(json.dumps(about))
    return paths


def good(folder: Path, count: int = 24, seed: int = 1) -> None:
    """An ordinary set: all around a box on a floor."""
    make = studio()
    shoot(make, still_life(make, seed), orbit(count), folder)


def blank_wall(folder: Path, count: int = 30) -> None:
    """A white wall, with nothing but a camera's noise on it."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        rng = np.random.default_rng(number)
        shade = 205 + 12 * np.linspace(-1, 1, 480)[None, :, None] * np.cos(number) + np.zeros((360, 480, 3))
        Image.fromarray((shade + rng.normal(0, 1.5, shade.shape)).clip(0, 255).astype(np.uint8)).save(
            folder / f"{number:03d}.jpg", quality=90
        )


def two_sets(folder: Path, larger: int = 18, smaller: int = 10) -> None:
    """Photos of two things that have nothing to do with each other, mixed in one folder."""
    make = studio()
    shoot(make, still_life(make, 1), orbit(larger), folder, "box_")
    shoot(make, still_life(make, 2), orbit(smaller), folder, "other_")


def one_spot(folder: Path, count: int = 20) -> None:
    """A tripod in the middle of a room, turned around."""
    make = studio()
    angles = np.radians(np.arange(count) * 360 / count)
    center = np.array([0.0, 1.0, 1.1])
    ahead = [np.array([np.cos(a), np.sin(a), -0.25 - 0.1 * (k % 2)]) for k, a in enumerate(angles)]
    poses = [look(center, center + step) for step in ahead]
    shoot(make, still_life(make, 1), poses, folder)


def half_blurred(folder: Path, source: Path = TABLE_VASE / "images", every: int = 2) -> None:
    """The bundled set with every second photo out of focus."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, path in enumerate(sorted(source.glob("*.jpg"))):
        if number % every:
            with Image.open(path) as image:
                image.filter(ImageFilter.GaussianBlur(6)).save(folder / path.name, quality=92)
        else:
            shutil.copy(path, folder / path.name)


def repeating(folder: Path, count: int = 24) -> None:
    """The still life papered with one repeating patch."""
    make = studio()
    shoot(make, still_life(make, 1, tile=0.12), orbit(count), folder)


def turntable(folder: Path, count: int = 24) -> None:
    """The box turns on its own in front of a wall and on a table that stand still."""
    make = studio()
    box, *others = still_life(make, 1)
    fixed = look((1.3, 0, 0.7), (0, 0, 0.15))
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        a = 2 * np.pi * number / count
        # Textures follow the unturned box, so the camera goes round it while the room is drawn from the first pose.
        beside = fixed.copy()
        beside[:3] = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1.0]]) @ beside[:3]
        room, shown = (
            make.render(parts, caster_of(parts), pose, np.random.default_rng(number))
            for parts, pose in ((others, fixed), ([box], beside))
        )
        Image.fromarray(np.where(shown.max(-1, keepdims=True) > 0, shown, room)).save(
            folder / f"{number:03d}.jpg", quality=92
        )


def ring(axis: Iterable[float], major: float, minor: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and outward faces of a torus that lies flat, its middle at `axis`."""
    mesh = torus(major, minor, 64, 64)
    return mesh.vertices + np.array(list(axis)), mesh.faces


def hues(color: Iterable[float]) -> list[tuple[float, ...]]:
    """A palette of lighter and darker shades around one colour."""
    return [tuple(np.clip(np.array(list(color)) * share, 0.04, 0.95)) for share in (0.35, 0.65, 1.0, 1.35)]


def in_room(make: ModuleType, shapes: dict[str, tuple], colors: dict[str, tuple], texel: float = 0.0015) -> list:
    """Parts: each shape (vertices, faces) in shades of its colour, then a floor and four walls."""
    parts = []
    for number, (name, shape) in enumerate(shapes.items()):
        size = np.ptp(shape[0], axis=0)
        rows, columns = int((2 * size[1] + 4 * size[2]) / texel) + 2, int(max(size[0], size[1]) / texel) + 2
        picture = make.texture(900 + number, rows, columns, hues(colors[name]), 14, 0.12)
        parts.append(make.Part(*shape, picture, "box", texel))
    return [*parts, *still_life(make, 3)[1:]]


def touching(make: ModuleType) -> tuple[list, list[str]]:
    """A cup that touches a vase, and beside them three books in a stack, on a floor; and the names of these parts."""

    def turned(profile: list[tuple[float, float]], at: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
        vertices, faces = make.lathe(np.array(profile))
        return vertices + np.array([*at, 0]), faces

    cup = [(0, 0), (0.08, 0), (0.08, 0.16), (0.062, 0.16), (0.062, 0.03), (0, 0.03)]
    vase = [(0, 0), (0.09, 0), (0.12, 0.1), (0.12, 0.16), (0.075, 0.28), (0.09, 0.34), (0, 0.34)]
    shapes = {
        "cup": turned(cup, (-0.08, 0.2)), "vase": turned(vase, (-0.28, 0.2)),
        "book1": make.box((0.0, -0.3, 0), (0.34, -0.06, 0.08)),
        "book2": make.box((0.03, -0.27, 0.08), (0.3, -0.08, 0.16)),
        "book3": make.box((0.05, -0.26, 0.16), (0.33, -0.1, 0.24)),
    }  # fmt: skip
    colors = {"cup": (0.75, 0.72, 0.62), "vase": (0.16, 0.3, 0.62), "book1": (0.6, 0.14, 0.12),
              "book2": (0.72, 0.62, 0.3), "book3": (0.14, 0.42, 0.24)}  # fmt: skip
    return in_room(make, shapes, colors), list(shapes)


def shelf(make: ModuleType) -> tuple[list, list[str]]:
    """A torus, a box and a jug apart from one another on a shelf that is open in front and behind; and their names."""
    profile = [(0, 0), (0.07, 0), (0.1, 0.06), (0.1, 0.14), (0.06, 0.22), (0.075, 0.27), (0, 0.27)]
    jug, faces = make.lathe(np.array(profile))
    shapes = {
        "torus": ring((-0.33, 0, 0.27), 0.11, 0.05),
        "carton": make.box((-0.08, -0.09, 0.22), (0.1, 0.09, 0.42)),
        "jug": (jug + np.array([0.34, 0, 0.22]), faces),
        "board": make.box((-0.6, -0.2, 0.18), (0.6, 0.2, 0.22)),
        "left": make.box((-0.64, -0.2, 0.0), (-0.6, 0.2, 0.34)),
        "right": make.box((0.6, -0.2, 0.0), (0.64, 0.2, 0.34)),
    }
    wood = (0.6, 0.45, 0.28)
    colors = {"torus": (0.62, 0.2, 0.16), "carton": (0.2, 0.42, 0.3), "jug": (0.2, 0.32, 0.62), "board": wood,
              "left": wood, "right": wood}  # fmt: skip
    return in_room(make, shapes, colors), ["torus", "carton", "jug"]


def around(count: int, radius: float, target: Iterable[float] = (0, 0, 0.12)) -> list[np.ndarray]:
    """Poses on three rings around what stands at the origin, the last one looking down steeply."""
    poses = []
    for ring_number, elevation in enumerate((12, 32, 58)):
        angles = np.arange(ring_number, count, 3) * 2 * np.pi / count + 0.1
        tilt = np.radians(elevation)
        for a in angles:
            offset = np.array([np.cos(tilt) * np.cos(a), np.cos(tilt) * np.sin(a), np.sin(tilt)])
            poses.append(look(np.array(list(target)) + radius * offset, target))
    return poses


def shoot_labels(make: ModuleType, parts: list, poses: list[np.ndarray], count: int) -> list[np.ndarray]:
    """Which of the first `count` parts each pixel [H, W] uint8 of each photo shows, from 1 on; 0 for the others."""
    caster = caster_of(parts)
    row, column = np.mgrid[0 : make.HEIGHT, 0 : make.WIDTH] + 0.5
    x, y = (column - make.WIDTH / 2) / make.FOCAL, (make.HEIGHT / 2 - row) / make.FOCAL
    found = []
    for pose in poses:
        direction = np.stack([x, y, -np.ones_like(x)], -1) @ pose[:3, :3].T
        rays = np.concatenate([np.broadcast_to(pose[:3, 3], direction.shape), direction], -1).astype(np.float32)
        part = caster.cast_rays(rays)["geometry_ids"].numpy().astype(np.int64)
        found.append(np.where(part < count, part + 1, 0).astype(np.uint8))
    return found


def shoot_bodies(folder: Path, build: Callable[[ModuleType], tuple[list, list[str]]], count: int = 48,
                 radius: float = 1.25) -> None:  # fmt: skip
    """A set with truth: `images`, `masks/NAME` of each body where a photo shows it, and `truth/NAME.ply`."""
    make = studio(640, 480, 620.0)
    parts, names = build(make)
    poses = around(count, radius)
    photos = shoot(make, parts, poses, folder / "images")
    (folder / "truth").mkdir()
    for name, part in zip(names, parts, strict=False):
        (folder / "truth" / f"{name}.ply").write_bytes(write_ply(Mesh(part.vertices, part.faces)))
        (folder / "masks" / name).mkdir(parents=True)
    for photo, labels in zip(photos, shoot_labels(make, parts, poses, len(names)), strict=True):
        for number, name in enumerate(names, start=1):
            if (labels == number).any():
                Image.fromarray(255 * (labels == number).astype(np.uint8)).save(
                    folder / "masks" / name / f"{photo.stem}.png"
                )


def hinged(make: ModuleType, degrees: float) -> tuple[list, list[str]]:
    """A cupboard with a shelf, a carton on it and one beside it, its door open by so many degrees; names of what moves.

    The hinge is upright, through `HINGE`.
    """
    boards = [make.box(*ends) for ends in (
        ((-0.25, 0.15, 0.0), (0.25, 0.17, 0.56)), ((-0.25, -0.15, 0.0), (-0.23, 0.15, 0.56)),
        ((0.23, -0.15, 0.0), (0.25, 0.15, 0.56)), ((-0.23, -0.15, 0.0), (0.23, 0.15, 0.03)),
        ((-0.23, -0.15, 0.53), (0.23, 0.15, 0.56)), ((-0.23, -0.11, 0.27), (0.23, 0.15, 0.29)),
    )]  # fmt: skip
    still = {f"board{k}": board for k, board in enumerate(boards)}
    still["carton"] = make.box((-0.16, -0.1, 0.56), (0.06, 0.1, 0.68))
    still["crate"] = make.box((0.31, -0.12, 0.0), (0.48, 0.1, 0.2))
    moves = {"door": make.box((-0.25, -0.17, 0.02), (0.25, -0.15, 0.55)),
             "handle": make.box((0.17, -0.2, 0.24), (0.195, -0.17, 0.36))}  # fmt: skip
    a = np.radians(-degrees)
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1.0]])
    return _with_moved(make, moves, still, (turn, HINGE - turn @ HINGE)), list(moves)


HINGE = np.array([-0.25, -0.15, 0.0])  # m, a point of the axis of `hinged`


def sliding(make: ModuleType, out: float) -> tuple[list, list[str]]:
    """A chest with a crate on it and one beside it, its drawer out by so many metres, towards -y; names of what
    moves."""
    boards = [make.box(*ends) for ends in (
        ((-0.25, 0.18, 0.0), (0.25, 0.2, 0.46)), ((-0.25, -0.18, 0.0), (-0.22, 0.18, 0.46)),
        ((0.22, -0.18, 0.0), (0.25, 0.18, 0.46)), ((-0.22, -0.18, 0.0), (0.22, 0.18, 0.2)),
        ((-0.22, -0.18, 0.43), (0.22, 0.18, 0.46)),
    )]  # fmt: skip
    still = {f"board{k}": board for k, board in enumerate(boards)}
    still["carton"] = make.box((-0.05, -0.05, 0.46), (0.18, 0.13, 0.58))
    still["crate"] = make.box((0.31, -0.12, 0.0), (0.48, 0.1, 0.2))
    drawer = (
        ((-0.215, -0.2, 0.21), (0.215, -0.18, 0.42)), ((-0.21, -0.18, 0.215), (0.21, 0.15, 0.235)),
        ((-0.21, -0.18, 0.235), (-0.19, 0.15, 0.39)), ((0.19, -0.18, 0.235), (0.21, 0.15, 0.39)),
        ((-0.19, 0.13, 0.235), (0.19, 0.15, 0.39)), ((-0.07, -0.225, 0.31), (0.07, -0.2, 0.33)),
    )  # fmt: skip
    moves = {f"drawer{k}": make.box(*ends) for k, ends in enumerate(drawer)}
    return _with_moved(make, moves, still, (np.eye(3), np.array([0, -out, 0]))), list(moves)


def _with_moved(make: ModuleType, moves: dict, still: dict, motion: tuple[np.ndarray, np.ndarray]) -> list:
    """Parts in a room, the first of which have moved with their textures."""
    wood, red, green = (0.6, 0.45, 0.28), (0.62, 0.2, 0.16), (0.2, 0.42, 0.3)
    colors = dict.fromkeys(still, wood) | {"carton": red, "crate": green} | dict.fromkeys(moves, (0.3, 0.4, 0.6))
    parts = in_room(make, moves | still, colors)
    for part in parts[: len(moves)]:
        part.vertices, part.moved = part.vertices @ motion[0].T + motion[1], motion
    return parts


def state_poses(make: ModuleType, count: int, radius: float, rng: np.random.Generator) -> list[np.ndarray]:
    """Poses around `hinged` and `sliding`, most of them in front."""
    poses = []
    for number in range(count):
        # Two thirds of the way around is the front's half.
        share = (number + rng.random()) / count
        azimuth = -np.pi / 2 + 2 * np.pi * (share - 0.5) * (0.6 + 0.4 * abs(2 * share - 1))
        tilt = np.radians((8, 28, 50)[number % 3] + rng.normal(0, 2))
        way = np.array([np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)])
        target = np.array([0.05, -0.1, 0.26]) + rng.normal(0, 0.02, 3)
        poses.append(look(target + radius * (1 + rng.normal(0, 0.03)) * way, target))
    return poses


def shoot_state(
    folder: Path, build: Callable[[ModuleType, float], tuple[list, list[str]]], state: float, *, seed: int,
    count: int = 30, radius: float = 1.45,
) -> None:  # fmt: skip
    """Photos of `hinged` or `sliding` in one state, from all around, most of them from the front, at places of its
    own; and the true surface of what moves and of the rest, `truth/moves.ply` and `truth/still.ply`."""
    make, rng = studio(640, 480, 620.0), np.random.default_rng(seed)
    parts, names = build(make, state)
    shoot(make, parts, state_poses(make, count, radius, rng), folder / "images")
    (folder / "truth").mkdir()
    meshes = [Mesh(part.vertices, part.faces) for part in parts[:-2]]
    for name, some in (("moves", meshes[: len(names)]), ("still", meshes[len(names) :])):
        (folder / "truth" / f"{name}.ply").write_bytes(write_ply(joined(some)))
