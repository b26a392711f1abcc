"""Triangle meshes: loading, cleaning, and mass properties."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: [V, 3] float64 m.
        faces: [F, 3] int64 vertex indices, counter-clockwise seen from outside.
        colors: [V, 3] uint8 RGB, or None.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None
