"""How far bodies are hollow from above: what would hold water."""

from __future__ import annotations

import numpy as np

from pipeline.mesh.visibility import Above
from sdfsim.shape.mesh import Mesh

PLACES = 64  # looked at along a body's longest side
FEWEST = 9  # places of a hollow
# What is below a hollow is its floor if it is thinner than this share of the hollow's depth.
FLOOR = 0.3


def hollow(mesh: Mesh, least: float) -> tuple[float, float] | None:
    """How deep a body is hollow below its rim, and how thick what is below the hollow, m; None where it holds no water.

    Args:
        mesh: closed, in metres, z up.
        least: m, what is shallower is no hollow.
    """
    from skimage.morphology import reconstruction

    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    step = float((high - low)[:2].max()) / PLACES
    axes = [np.arange(low[k] - step, high[k] + 2 * step, step) for k in range(2)]
    height = Above(mesh).heights(np.stack(np.meshgrid(*axes, indexing="ij"), -1))
    through = np.isnan(height)
    height = np.where(through, low[2], height)
    water = reconstruction(np.where(through, height, height.max()), height, method="erosion")
    depth = water - height
    deep = depth > 0.5 * depth.max()
    found = float(np.median(depth[deep])) if depth.max() > 0 else 0.0
    if found < least or deep.sum() < FEWEST:
        return None
    return found, float(np.median(height[deep]) - low[2])


def hollow_line(name: str, depth: float, below: float) -> str:
    """What the report says about a hollow body, from what `hollow` gives."""
    if below < FLOOR * depth:
        return f"{name}: hollow, {depth:.2g} m deep below its rim, on a floor {below:.2g} m thick"
    return f"{name}: hollow to {depth:.2g} m below its rim as far as photos see; the {below:.2g} m below that are solid"
