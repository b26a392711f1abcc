"""Makes the shapes that the sample scenes use: python scripts/sample_shapes.py (some minutes)."""

import runpy
from pathlib import Path

import numpy as np

from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.geometry.primitives import sphere
from sdfsim.shape.make import fit_mesh, shape_from_primitive

ROOT = Path(__file__).resolve().parents[1]
SHAPES = {"bowl": ("bowl", 0.6), "ring": ("torus", 0.22), "can": ("cylinder", 0.14), "cone": ("cone", 0.16)}  # m


def stone() -> Mesh:
    """A pebble of 12 cm, in centimetres and with colours, like the file of a scanner."""
    draw, ball = np.random.default_rng(4), sphere(1.0, 4)
    unit = ball.vertices / np.linalg.norm(ball.vertices, axis=1, keepdims=True)
    ways = draw.normal(size=(24, 3)) * np.linspace(1.0, 7.0, 24)[:, None]
    waves = np.sin(unit @ ways.T + draw.uniform(0, 6, 24)) / np.linalg.norm(ways, axis=1)
    bumps = waves.sum(1)
    shade = np.clip(120 + 40 * bumps + draw.normal(scale=6, size=len(unit)), 0, 255)
    vertices = unit * [6.0, 4.6, 3.4] * (1.0 + 0.08 * bumps[:, None])
    return Mesh(vertices, ball.faces, np.stack([shade, 0.97 * shade, 0.9 * shade], 1).astype(np.uint8))


def vase() -> Mesh:
    """The hollow vase of the bundled photos, m."""
    made = runpy.run_path(str(ROOT / "samples" / "photos" / "make.py"))
    profile = np.concatenate([made["smooth_profile"](made[part], 32) for part in ("VASE_OUTER", "VASE_INNER")])
    return Mesh(*made["lathe"](profile, 64))


if __name__ == "__main__":
    folder = ROOT / "samples" / "shapes"
    for name, (kind, size) in SHAPES.items():
        shape_from_primitive(kind, size, name=name).save(folder / name)
        print(folder / name)
    fit_mesh(vase(), name="vase").save(folder / "vase")
    (folder / "stone_cm.ply").write_bytes(write_ply(stone()))
