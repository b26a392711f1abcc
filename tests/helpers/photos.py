"""Photos that are made up, their cameras, and what stages report of them."""

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.inputs.photos import Photo


def noise(folder: Path, names: Sequence[str], size: tuple[int, int] = (120, 90)) -> Path:
    """Writes photos of noise, width x height, into a folder that is made where missing."""
    for k, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        pixels = np.random.default_rng(k).integers(0, 255, (*size[::-1], 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / name)
    return folder


RESULTS = {
    "poses": {"posed": 3, "photos": 3, "mean_error": 0.5, "points": 9, "field_of_view": [60.0], "left_out": []},
    "mesh": {"extent_m": [1.0, 1.0, 1.0], "size": "a ruler", "up_from": "plane", "up_within_degrees": 1.0},
}


def photo(index: int, width: int = 640, height: int = 480, focal: float | None = None, fault: str = "") -> Photo:
    size = (width, height)
    return Photo(f"{index:04d}.jpg", f"IMG_{index}.JPG", *size, size, None, focal, "", False, 0.4, fault)


def result(count: int, posed: int, *, focal: float = 600.0, error: float = 0.5, features: int = 2000,
           span: float = 360.0, still: float = 0.0, matches: int = 200) -> dict:  # fmt: skip
    """What the worker would say of `posed` of `count` photos on an arc around the origin, all in a chain of pairs."""
    views = []
    for k in range(posed):
        a = np.radians(span) * k / max(posed, 1)
        turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        views.append({"name": f"{k:04d}.jpg", "width": 640, "height": 480, "focal": focal, "cx": 320, "cy": 240,
                      "k": 0, "rotation": turn.tolist(), "translation": [0, 0, 3]})  # fmt: skip
    names = [f"{k:04d}.jpg" for k in range(count)]
    counts = {name: {"features": features, "best_matches": 10, "partners": 1} for name in names}
    pairs = [{"a": a, "b": b, "matches": matches, "still": still} for a, b in pairwise(names)]
    agreed = [{"a": pair["a"], "b": pair["b"], "matches": matches, "error": 0.3 if k < posed - 1 else None,
               "own": 0.25, "cost": 0.1} for k, pair in enumerate(pairs)]  # fmt: skip
    return {"views": views, "counts": counts, "pairs": pairs, "agreement": agreed, "mean_error": error,
            "points": 900,
            "lens": [0.1, 0.2], "middle": [0.0, 0.0, 0.0], "angle": min(span * (1 - 1 / max(posed, 2)), 180.0),
            "turn_only": 0.0, "cameras": [names], "judged": [dict(pair) for pair in agreed]}  # fmt: skip


def turned(angle: float) -> np.ndarray:
    """World to camera: about the y axis."""
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


NAMES = ["a.jpg", "b.jpg", "c.jpg"]


def write_transforms(folder: Path, names: list[str] = NAMES, **more) -> Path:
    frames = []
    for k, name in enumerate(names):
        pose = np.eye(4)
        pose[:3, :3] = turned(0.3 * k).T @ np.diag([1.0, -1, -1])
        pose[:3, 3] = [k, 2 * k, 3]
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    path = folder / "transforms.json"
    path.write_text(json.dumps({"fl_x": 100.0, "w": 120, "h": 90, "frames": frames, **more}))
    return path
