"""Shapes: made up, and bundled."""

from pathlib import Path

import numpy as np
import torch

from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Frame, Mesh
from sdfsim.sdf.mlp import MlpSdf
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
