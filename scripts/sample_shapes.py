"""Fits the shapes that the sample scenes use: python scripts/sample_shapes.py (some minutes)."""

from __future__ import annotations

from pathlib import Path

from sdfsim.shape.shape import shape_from_primitive

SHAPES = {"bowl": ("bowl", 0.6), "ring": ("torus", 0.22), "can": ("cylinder", 0.14), "cone": ("cone", 0.16)}  # m

if __name__ == "__main__":
    folder = Path(__file__).resolve().parents[1] / "samples" / "shapes"
    for name, (kind, size) in SHAPES.items():
        shape_from_primitive(kind, size, name=name).save(folder / name)
        print(folder / name)
