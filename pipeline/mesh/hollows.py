"""The hollow of a body: its depth, whether photos see its bottom, and the thickness of the wall."""

import numpy as np
from scipy import ndimage

from pipeline.mesh.trust import FEW, Evidence
from pipeline.mesh.visibility import heights
from pipeline.records import Hollow
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, vertex_normals

PLACES, FEWEST = 64, 9  # looked at along a body's longest side for hollows; that a hollow has
# The matter below a hollow is its floor if it is thinner than this share of the hollow's depth.
FLOOR = 0.3
UPRIGHT = 0.5  # largest upward component of the normal of a wall
LEAK = 0.2  # share of a hollow's bottom: smaller holes in it are where its thin floor was not found; a ring has larger
KNOWN = 0.5  # share of a wall that photos have to see from both sides for a known thickness


def hollow(mesh: Mesh, least: float, evidence: Evidence | None = None) -> Hollow | None:
    """The hollow of a body, a closed mesh in metres with z up; None if it is not hollow, or not deeper than `least` m.
    `evidence` is the photos' evidence for the vertices; without it nothing counts as seen."""
    from skimage.morphology import reconstruction

    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    step = float((high - low)[:2].max()) / PLACES
    axes = [np.arange(low[k] - step, high[k] + 2 * step, step) for k in range(2)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    height = heights(mesh, places)
    through = np.isnan(height)
    height = np.where(through, low[2], height)
    around = np.asarray(ndimage.label(through)[0])  # type: ignore[index]
    outside, holes = around == around[0, 0], through & (around != around[0, 0])

    def filled(open_: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The water level, the depth of the water, and the deep places, if it flows out where `open_`."""
        water = reconstruction(np.where(open_, height, height.max()), height, method="erosion")
        depth = water - height
        return water, depth, depth > 0.5 * depth.max()

    water, depth, deep = filled(outside)
    if holes[deep].sum() > LEAK * deep.sum():
        holes[:] = False
        water, depth, deep = filled(through)
    found = float(np.median(depth[deep])) if depth.max() > 0 else 0.0
    if found < least or deep.sum() < FEWEST:
        return None
    missing, deep = float(holes[deep].mean()), deep & ~holes
    bottom = np.concatenate([places[deep], height[deep][:, None]], 1)
    seen = 0 if evidence is None else int(np.median(evidence.nearest(bottom).views))
    wall, wall_seen = _wall(mesh, float(np.median(water[deep])), bottom, evidence)
    return Hollow(found, float(np.median(height[deep]) - low[2]), seen, wall, wall_seen, missing)


def _wall(mesh: Mesh, rim: float, bottom: np.ndarray, evidence: Evidence | None) -> tuple[float | None, float]:
    """The median thickness of the wall around a hollow, m, and the share of it that photos see from both sides."""
    normals, middle = vertex_normals(mesh), bottom.mean(0)
    inwards = middle[:2] - mesh.vertices[:, :2]
    upright = np.abs(normals[:, 2]) < UPRIGHT
    between = (mesh.vertices[:, 2] < rim) & (mesh.vertices[:, 2] > bottom[:, 2].max())
    inner = np.flatnonzero(upright & between & ((normals[:, :2] * inwards).sum(1) > 0))
    if not len(inner):
        return None, 0.0
    # Through the wall, and out of it on the other side.
    skin = 1e-4 * float(np.ptp(mesh.vertices, axis=0).max())
    start = mesh.vertices[inner] - skin * normals[inner]
    away = Caster(mesh).hits(start, -normals[inner])[0]
    through = np.isfinite(away)
    # A line that meets the hollow again has not passed a wall.
    if not through.any():
        return None, 0.0
    thick = float(np.median(away[through]) + skin)
    if evidence is None:
        return thick, 0.0
    outer = start[through] - away[through][:, None] * normals[inner[through]]
    both = np.minimum(evidence.nearest(mesh.vertices[inner[through]]).views, evidence.nearest(outer).views) >= FEW
    return thick, float(both.mean())


def hollow_line(name: str, found: Hollow) -> str:
    """The report's line on the hollow of a body."""
    depth, below, seen = found.depth, found.below, found.seen
    photos = f"{seen} photos see its bottom" if seen > 1 else f"{('no', 'one')[seen]} photo sees its bottom"
    if below < FLOOR * depth:
        line = f"{name}: hollow, {depth:.2g} m deep below its rim, on a floor {below:.2g} m thick; {photos}"
    elif seen < FEW:
        line = f"{name}: hollow to {depth:.2g} m below its rim or deeper; {photos}, the {below:.2g} m below are a guess"
    else:
        line = f"{name}: hollow to {depth:.2g} m below its rim; {photos}, and the {below:.2g} m below that are solid"
    if found.holes:
        line += f"; {found.holes:.0%} of its floor was not found and is a hole"
    if found.wall is None:
        return line
    if found.wall_seen < KNOWN:
        return f"{line}; the thickness of its wall is unknown: photos see both sides of {found.wall_seen:.0%} of it"
    return f"{line}; its wall is {1000 * found.wall:.2g} mm thick"
