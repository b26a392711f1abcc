"""How a field is trained: settings, presets and schedules."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pipeline.field import FieldSize
from pipeline.mlp_field import MlpSize


@dataclass(frozen=True)
class Recipe:
    """How a field is trained. Lengths are in normalised units (the scene is the unit sphere).

    Attributes:
        size: resolutions of the grids, or of the MLP of the VolSDF paper.
        start_radius: radius of the ball that training starts from. Small, because what is solid at first has to be
            carved away, and shadowed parts hardly are.
        iterations: steps of Adam.
        rays: a step.
        samples: along a ray inside the sphere.
        long_side: of the photos used, px.
        beta: density scale at the start and at the end.
        rate: Adam's rate for the grids at the start (the networks use a quarter of it).
        eikonal: weight of (|grad| - 1)^2.
        curvature: weight of |Laplacian| at the start, in units of the finest active cell.
        sparse: weight of |sdf| at the points of structure-from-motion.
        free: weight of what is solid between a camera and a point that it sees.
        mask: weight of the opacity loss where photos have masks.
        surface_points: points of the eikonal loss.
    """

    size: FieldSize | MlpSize = FieldSize()  # noqa: RUF009  frozen
    start_radius: float = 0.25
    iterations: int = 4000
    rays: int = 512
    samples: int = 32
    long_side: int = 480
    beta: tuple[float, float] = (0.1, 0.004)
    rate: float = 0.02
    eikonal: float = 0.1
    curvature: float = 0.01
    sparse: float = 0.3
    free: float = 1.0
    mask: float = 0.3
    surface_points: int = 512


PRESETS = {
    "quick": Recipe(),
    "standard": Recipe(iterations=7500, rays=768, samples=40, long_side=800, beta=(0.1, 0.0025)),
    "fine": Recipe(
        size=FieldSize((16, 32, 64, 128, 224), (4, 4, 4, 4, 2), 64, 96),
        iterations=20000, rays=1024, samples=48, long_side=1280, beta=(0.1, 0.0015),
    ),
    # The paper's (section 4, appendix B): L1 colour, eikonal 0.1, Adam 5e-4, 1024 rays of 64 samples. Its beta is
    # learned; sparse points, which the paper did without, get little weight.
    "paper": Recipe(
        size=MlpSize(), iterations=100_000, rays=1024, samples=64, long_side=1600, rate=5e-4, eikonal=0.1,
        curvature=0.0, sparse=0.1, free=0.0, surface_points=2048,
    ),
}  # fmt: skip


def beta_at(recipe: Recipe, fraction: float) -> float:
    """Density scale: falls geometrically over the first 85 % of training, then stays."""
    start, end = recipe.beta
    return start * (end / start) ** min(1.0, fraction / 0.85)


def active_levels(recipe: Recipe, fraction: float) -> int:
    """Grid levels in use: two at first, the others one after the other until 45 % of training."""
    assert isinstance(recipe.size, FieldSize)
    extra = len(recipe.size.levels) - 2
    return 2 + min(extra, int(extra * fraction / 0.45 + 0.4)) if extra > 0 else len(recipe.size.levels)


def view_dependence_at(fraction: float) -> float:
    """How much colour may change with direction: not at all at first, or a wrong surface is painted right."""
    return min(1.0, max(0.0, (fraction - 0.4) / 0.3))


def rate_at(fraction: float) -> float:
    """Factor of the learning rates: short warm-up, then cosine down to 3 %."""
    warm = min(1.0, fraction / 0.02)
    return max(0.05, warm) * (0.03 + 0.97 * 0.5 * (1 + math.cos(math.pi * fraction)))
