"""A `Shape`: geometry, learned SDF, surface nodes and mass properties; and the folder it lives in."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sdfsim.shape.mesh import Mesh
from sdfsim.shape.sdf import Sdf


@dataclass(frozen=True)
class Shape:
    """One rigid shape in its own frame, metres, at scale 1.

    Attributes:
        name: what messages and the viewer call it.
        mesh: what is shown (and what the SDF was fitted to).
        sdf: signed distance in the same frame.
        nodes: [K, 3] float64 m, surface nodes that carry contact (empty for a plane).
        volume: m^3.
        com: [3] float64 m, centre of mass.
        inertia: [3, 3] float64 kg m^2 per unit density, about `com`, shape axes.
        certificate: fit errors measured on held-out points (empty for analytic shapes).
        source: where it came from and a content hash (for caching and for the record).
    """

    name: str
    mesh: Mesh
    sdf: Sdf
    nodes: np.ndarray
    volume: float
    com: np.ndarray
    inertia: np.ndarray
    certificate: dict = field(default_factory=dict)
    source: dict = field(default_factory=dict)
