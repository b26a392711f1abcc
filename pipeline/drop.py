"""Where to drop a body onto a scenery so that it stays there: from geometry alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.visibility import Caster
from sdfsim.errors import EXIT_QUALITY, SdfsimError
from sdfsim.shape.mesh import Mesh

# Sides of the dropped slab as shares of the scenery's widest side: the largest that finds a level place is taken.
BODY_SHARES = (0.09, 0.06, 0.045)
THICKNESS = 0.5  # of the slab, as a share of its side; a cube tips over more easily
LEVEL = 10.0  # degrees; far below what friction holds, as learned contacts creep on slopes
SEEN = 0.9  # share of the slab's footprint that photos must show
GAP = 0.3  # of the fall, as a share of the side
SAMPLES = 11  # points along the side of the footprint


@dataclass(frozen=True)
class Drop:
    """Where a slab is dropped.

    Attributes:
        side: of the slab, m.
        thickness: of the slab, m.
        position: [3] m, its centre at the start.
        quat_xyzw: [4] its orientation, already that in which it comes to rest.
        support: height at which the middle of its underside comes to rest, m.
        slope: of the steepest plane that it may settle into, degrees.
    """

    side: float
    thickness: float
    position: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float]
    support: float
    slope: float


@dataclass(frozen=True)
class Spot:
    """How a plate lies at a place.

    Attributes:
        at: [2] m, where its middle is.
        height: of its middle, m.
        normal: [3] of it.
        slope: of the steepest plane that it may settle into, degrees.
        obstacle: how far the surface around reaches above it, m.
        score: how good the place is; larger is better.
    """

    at: np.ndarray
    height: float
    normal: np.ndarray
    slope: float
    obstacle: float
    score: float


class Above:
    """Heights of a mesh's topmost surface."""

    def __init__(self, mesh: Mesh) -> None:
        self.caster = Caster(mesh)
        self.top = float(mesh.vertices[:, 2].max()) + 1.0

    def heights(self, at: np.ndarray) -> np.ndarray:
        """Heights [...] m over the points `at` [..., 2] m; NaN where there is no surface."""
        origin = np.full((at.size // 2, 3), self.top)
        origin[:, :2] = at.reshape(-1, 2)
        distance, _ = self.caster.hits(origin, np.tile([0.0, 0.0, -1.0], (len(origin), 1)))
        return np.where(np.isfinite(distance), self.top - distance, np.nan).reshape(at.shape[:-1])


def plate_on(points: np.ndarray, side: float) -> tuple[float, np.ndarray, float]:
    """How a square plate comes to lie on surface points.

    Lowered flat onto them, a plate ends up on the face of their upper convex hull that its middle is over: the corners
    of that face are what it touches.

    Args:
        points: [P, 3] m; x and y from the plate's middle.
        side: of the plate, m.

    Returns:
        Height of the plate's middle; its normal [3]; and the steepest slope, degrees, of the faces within a tenth of
        the side of the middle: those it may rock into.
    """
    from scipy.spatial import ConvexHull

    # One point far below gives the hull a body where all the others lie in one plane.
    below = np.array([[0, 0, points[:, 2].min() - 10 * side]])
    faces = ConvexHull(np.concatenate([points, below])).equations
    faces = faces[faces[:, 2] > 1e-9]
    turn = np.arange(8) * np.pi / 4
    near = np.concatenate([[[0, 0]], 0.1 * side * np.stack([np.cos(turn), np.sin(turn)], 1)])
    heights = -(near @ faces[:, :2].T + faces[:, 3]) / faces[:, 2]
    over = heights.argmin(1)
    slope = float(np.degrees(np.arccos(np.clip(faces[over, 2].min(), -1, 1))))
    return float(heights[0, over[0]]), faces[over[0], :3], slope


def find_spots(shown: Above, solid: Above, bounds: np.ndarray, side: float, seen: float) -> list[Spot]:
    """Every place where a plate finds a support, on a grid of a quarter of its side.

    Args:
        shown: the surface that photos show.
        solid: all of the surface, also what no photo shows.
        bounds: [2, 3] m of the surface that photos show.
        side: of the plate, m.
        seen: least share of the footprint that photos must show.
    """
    low, high = bounds
    axes = [np.arange(low[k], high[k] + side / 8, side / 4) for k in range(2)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    # Wider than the plate: what stands beside it must not be in its way on the way down.
    line = np.linspace(-0.7, 0.7, SAMPLES + 4) * side
    around = np.stack(np.meshgrid(line, line, indexing="ij"), -1).reshape(-1, 2)
    under = (np.abs(around) <= 0.5 * side + 1e-9).all(1)
    visible = shown.heights(places[:, None] + around[under])
    top = solid.heights(places[:, None] + around)
    top[:, under] = np.fmax(top[:, under], visible)
    shares = (visible > top[:, under] - 0.2 * side).mean(1)
    extent, middle = np.maximum(high - low, 1e-9), (low + high) / 2
    found = []
    for at, share, heights in zip(places, shares, top, strict=True):
        there = np.isfinite(heights) & under
        if share < seen or there.sum() < 4:
            continue
        height, normal, slope = plate_on(np.c_[around[there], heights[there]], side)
        plane = height - (around @ normal[:2]) / normal[2]
        obstacle = max(0.0, float(np.nanmax(heights - plane)))
        central = float(np.linalg.norm((at - middle[:2]) / extent[:2]))
        score = (height - low[2]) / extent[2] - 1.2 * central - slope / LEVEL - obstacle / side
        found.append(Spot(at, height, normal, slope, obstacle, float(score)))
    return found


def choose_drop(shown: Mesh, solid: Mesh) -> Drop:
    """Chooses the body and the place: level, seen in the photos, high and central.

    Args:
        shown: visible surface, metres, z up; the body has to land on it.
        solid: closed surface, also what no photo shows.
    """
    bounds = np.stack([shown.vertices.min(0), shown.vertices.max(0)])
    widest = float((bounds[1] - bounds[0]).max())
    above, below = Above(shown), Above(solid)
    flattest: tuple[Spot, float] | None = None
    for seen in (SEEN, 0.5, 0.0):
        for side in (share * widest for share in BODY_SHARES):
            found = find_spots(above, below, bounds, side, seen)
            level = [spot for spot in found if spot.slope <= LEVEL]
            if level:
                return drop_at(max(level, key=lambda spot: spot.score), side)
            for spot in found:
                if flattest is None or spot.slope < flattest[0].slope:
                    flattest = spot, side
        if flattest is not None:
            return drop_at(*flattest)
    raise SdfsimError("scene: no place to drop a body onto", "look at mesh/mesh.ply", exit_code=EXIT_QUALITY)


def drop_at(spot: Spot, side: float) -> Drop:
    """The drop that ends with a slab lying at a spot."""
    normal, thickness = spot.normal, THICKNESS * side
    center = np.array([*spot.at, spot.height]) + 0.5 * thickness * normal
    center[2] += GAP * side + spot.obstacle
    turn = np.array([-normal[1], normal[0], 0.0, 1.0 + normal[2]])  # The shortest turn from z to the normal.
    x, y, z, w = (float(value) for value in turn / np.linalg.norm(turn))
    return Drop(side, thickness, (float(center[0]), float(center[1]), float(center[2])), (x, y, z, w),
                spot.height, spot.slope)  # fmt: skip
