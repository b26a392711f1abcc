"""Shapes: made up, and bundled."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Frame, Mesh
from sdfsim.sdf.mlp import MlpSdf
from sdfsim.shape.make import mesh_shape
from sdfsim.shape.shape import Shape


def fitted() -> Shape:
    torch.manual_seed(0)
    weights = (torch.randn(8, 3), torch.randn(8, 8), torch.randn(1, 8))
    sdf = MlpSdf(
        weights,
        (torch.randn(8), torch.randn(8), torch.randn(1)),
        Frame(np.array([1.0, 2.0, 3.0]), 0.3),
        np.array([[0.9, 1.9, 2.85], [1.1, 2.1, 3.15]]),
    )
    mesh = primitives.torus(segments=8, sides=5)
    colors = np.arange(len(mesh.vertices) * 3, dtype=np.uint8).reshape(-1, 3)
    return Shape(
        name="ring",
        mesh=Mesh(mesh.vertices, mesh.faces, colors),
        sdf=sdf,
        nodes=np.random.default_rng(0).random((20, 3)),
        volume=0.125,
        com=np.array([0.1, 0.2, 0.3]),
        inertia=np.diag([1.0, 2.0, 3.0]) / 3,
        certificate={"passed": False, "reason": "thin walls", "error_in_box": 0.01},
        source={"file": "ring.obj"},
        pieces=tuple(np.random.default_rng(k).random((4 + k, 3)) for k in range(3)),
    )


SHAPES = Path(__file__).resolve().parents[2] / "samples" / "shapes"


def joined(name: str, boxes: list[tuple[tuple, tuple]], *, pieces: bool) -> Shape:
    """A body made of boxes, given by their lowest and highest corners; with these as convex pieces, or as a surface."""
    parts = [primitives.box(np.subtract(high, low)) for low, high in boxes]
    parts = [
        Mesh(part.vertices + np.add(low, high) / 2, part.faces) for part, (low, high) in zip(parts, boxes, strict=True)
    ]
    faces = np.concatenate([part.faces + 8 * k for k, part in enumerate(parts)])
    whole = mesh_shape(Mesh(np.concatenate([part.vertices for part in parts]), faces), name=name, kind="mesh")
    return replace(whole, pieces=tuple(part.vertices for part in parts)) if pieces else whole
