"""Small photo sets made by ourselves, each with one thing wrong that the poses stage has to name.

They are drawn with the ray caster and the textures of samples/photos/make.py, smaller and coarser.
"""

from __future__ import annotations

import importlib.util
import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

import numpy as np
from PIL import Image, ImageFilter

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


def look(make: ModuleType, center: Iterable[float], target: Iterable[float]) -> np.ndarray:
    """Camera-to-world matrix [4, 4], OpenGL axes, of a level camera."""
    pose = np.eye(4)
    backward = np.asarray(center, float) - np.asarray(target, float)
    backward /= np.linalg.norm(backward)
    right = np.cross([0, 0, 1], backward)
    right /= np.linalg.norm(right)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(backward, right), backward, np.asarray(center)
    return pose


def orbit(make: ModuleType, count: int, *, radius: float = 1.3, span: float = 360.0) -> list[np.ndarray]:
    """Poses on an arc of `span` degrees around the still life, at two heights by turns."""
    angles = np.radians(np.arange(count) * span / count)
    return [
        look(make, (radius * np.cos(a), radius * np.sin(a), 0.55 + 0.3 * (k % 2)), (0, 0, 0.15))
        for k, a in enumerate(angles)
    ]


def shoot(make: ModuleType, parts: list, poses: list[np.ndarray], folder: Path, prefix: str = "") -> list[Path]:
    """Renders one photo a pose into `folder`, with the poses as transforms.json."""
    import open3d as o3d

    caster = o3d.t.geometry.RaycastingScene()
    for part in parts:
        triangles = (part.vertices.astype(np.float32), part.faces.astype(np.uint32))
        caster.add_triangles(*map(o3d.core.Tensor, triangles))
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(1)
    paths = []
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
    shoot(make, still_life(make, seed), orbit(make, count), folder)


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
    shoot(make, still_life(make, 1), orbit(make, larger), folder, "box_")
    shoot(make, still_life(make, 2), orbit(make, smaller), folder, "other_")


def one_spot(folder: Path, count: int = 20) -> None:
    """A tripod in the middle of a room, turned around."""
    make = studio()
    angles = np.radians(np.arange(count) * 360 / count)
    center = np.array([0.0, 1.0, 1.1])
    ahead = [np.array([np.cos(a), np.sin(a), -0.25 - 0.1 * (k % 2)]) for k, a in enumerate(angles)]
    poses = [look(make, center, center + step) for step in ahead]
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
    shoot(make, still_life(make, 1, tile=0.12), orbit(make, count), folder)


def turntable(folder: Path, count: int = 24) -> None:
    """The box turns on its own in front of a wall and on a table that stand still."""
    import open3d as o3d

    make = studio()
    parts = still_life(make, 1)
    fixed = look(make, (1.3, 0, 0.7), (0, 0, 0.15))
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        a = 2 * np.pi * number / count
        turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1.0]])
        # Textures follow the unturned box, so the camera goes round it while the room is drawn from the first pose.
        shots = []
        for chosen, pose in ((parts, fixed), (parts[:1], fixed)):
            if chosen is not parts:
                pose = pose.copy()
                pose[:3] = turn @ pose[:3]
            caster = o3d.t.geometry.RaycastingScene()
            for part in chosen if chosen is not parts else parts[1:]:
                triangles = (part.vertices.astype(np.float32), part.faces.astype(np.uint32))
                caster.add_triangles(*map(o3d.core.Tensor, triangles))
            shown = chosen if chosen is not parts else parts[1:]
            shots.append(make.render(shown, caster, pose, np.random.default_rng(number)))
        room, box = shots
        inside = box.max(-1, keepdims=True) > 0
        Image.fromarray(np.where(inside, box, room)).save(folder / f"{number:03d}.jpg", quality=92)
