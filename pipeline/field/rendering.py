"""Volume rendering: samples of the field along rays, and the resulting colour.

Samples are chosen from a cached SDF.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from pipeline.field.grid_field import BACKGROUND_SAMPLES, GridField, sample_weights
from pipeline.grids.interpolation import interpolate

COARSE = 4  # cells of the cached SDF between points where the field is always evaluated
SLACK = 1.4  # factor by which a field may be steeper than a distance
BINS = 0.75  # reads of the cached SDF along a ray, per cell of a side


@torch.no_grad()
def sdf_cache(field: GridField, cell: float) -> Tensor:
    """The SDF on a grid [n, n, n, 1] over [-1, 1]^3 (z, y, x order), used to choose samples along rays.

    Its cells are no wider than `cell`. Every `COARSE`-th value is the field's, the others only in blocks in reach of
    the unit sphere that the surface may cross; elsewhere they are interpolated.
    """
    device, coarse = field.device, COARSE
    resolution = math.ceil(2 / cell / coarse - 1e-6) * coarse + 1
    line = torch.linspace(-1, 1, resolution, device=device)

    def values(points: Tensor) -> Tensor:
        return torch.cat([field.sdf(part) for part in points.split(1 << 16)])

    knots = torch.stack(torch.meshgrid(*[line[::coarse]] * 3, indexing="ij"), -1)
    rough = values(knots.view(-1, 3).flip(1)).view(1, 1, *knots.shape[:3])
    cache = functional.interpolate(rough, size=(resolution,) * 3, mode="trilinear", align_corners=True)[0, 0]
    low, high = -functional.max_pool3d(-rough, 2, 1), functional.max_pool3d(rough, 2, 1)
    diagonal = 3**0.5 * coarse * float(line[1] - line[0])
    reach = 0.5 * SLACK * diagonal  # No place in a block is farther than half of it from a corner.
    middle = (line[:-1:coarse] + line[coarse::coarse]) / 2
    inside = (middle**2)[:, None, None] + (middle**2)[:, None] + middle**2 < (1 + 0.5 * diagonal) ** 2
    block = torch.nonzero((low < reach) & (high > -reach) & inside)[:, 2:] * coarse
    step = torch.stack(torch.meshgrid(*[torch.arange(coarse + 1, device=device)] * 3, indexing="ij"), -1).view(-1, 3)
    near = torch.zeros_like(cache, dtype=torch.bool)
    index = (block[:, None] + step).reshape(-1, 3)
    near[index[:, 0], index[:, 1], index[:, 2]] = True
    index = torch.nonzero(near)
    cache[index[:, 0], index[:, 1], index[:, 2]] = values(line[index].flip(1))
    return cache[..., None]


def sphere_interval(origins: Tensor, directions: Tensor, near: float = 0.02) -> tuple[Tensor, Tensor]:
    """Distances [R] at which rays enter and leave the unit sphere (equal where they miss it)."""
    along = -(origins * directions).sum(1)
    closest = (origins * origins).sum(1) - along**2
    half = torch.sqrt((1 - closest).clamp_min(0))
    enter = (along - half).clamp_min(near)
    return enter, torch.maximum(along + half, enter)


@dataclass(frozen=True)
class Samples:
    """Sample points of the field along some rays."""

    distance: Tensor  # [R, S] from the camera, in order, normalised units
    points: Tensor  # [R, S, 3]
    directions: Tensor  # [R, 3] unit
    near_surface: Tensor  # [R, S] whether it was drawn by importance


@torch.no_grad()
def choose_samples(
    cache: Tensor, origins: Tensor, directions: Tensor, beta: float, uniforms: Tensor, *, plain: int = 8
) -> Samples:
    """Samples along rays [R, 3], one for each of `uniforms` [R, S] in 0..1: `plain` of them evenly spread, the others
    near the surface of the cached SDF, which is read at even steps."""
    bins = round(BINS * (cache.shape[0] - 1))
    enter, leave = sphere_interval(origins, directions)
    length = (leave - enter)[:, None]
    steps = (torch.arange(bins, device=cache.device) + 0.5) / bins
    points = origins[:, None] + (enter[:, None] + length * steps)[..., None] * directions[:, None]
    sdf = interpolate(cache, points.view(-1, 3)).view(len(origins), bins)
    # The cache has the surface only to a fraction of its cell, so the width is not smaller.
    broad = max(beta, 0.6 / cache.shape[0])
    weights, _ = sample_weights(sdf, broad)
    count = uniforms.shape[1] - plain
    edges = torch.linspace(0, 1, bins + 1, device=cache.device).expand(len(origins), -1)
    importance = draw(edges, weights + 9e-5, uniforms[:, :count])
    even = (torch.arange(plain, device=cache.device) + uniforms[:, count:]) / plain
    position, order = torch.cat([importance, even], 1).sort(1)
    distance = enter[:, None] + length * position
    points = origins[:, None] + distance[..., None] * directions[:, None]
    return Samples(distance, points, directions, order < count)


def composite(
    field: GridField, samples: Samples, geometry: tuple[Tensor, Tensor, Tensor], beta: float, behind: Tensor
) -> dict[str, Tensor]:
    """Renders rays from the output of `field.geometry_at` at their samples, in front of a colour `behind` [R, 3] or
    [3]: `rgb` [R, 3] and `opacity` [R] inside the sphere."""
    sdf, features, grid = geometry
    shape = samples.distance.shape
    weights, left = sample_weights(sdf.view(shape), beta)
    # Colour costs as much as the SDF, and most samples have no weight.
    chosen = torch.nonzero(weights.detach().view(-1) > 5e-4)[:, 0]
    seen_along = samples.directions[:, None].expand(*shape, 3).reshape(-1, 3)[chosen]
    color = torch.zeros(sdf.shape[0], 3, device=sdf.device).index_put(
        (chosen,), field.color_of(features[chosen], grid[chosen], seen_along)
    )
    rgb = (weights[..., None] * color.view(*shape, 3)).sum(1)
    return {"rgb": rgb + left[:, None] * behind, "opacity": 1 - left}


@torch.no_grad()
def render(
    field: GridField, cache: Tensor, origins: Tensor, directions: Tensor, beta: float, *,
    samples: int = 32, backdrop: Tensor | None = None,
) -> dict[str, Tensor]:  # fmt: skip
    """Renders rays [R, 3] like `composite`, without gradients and deterministically; a `backdrop` [3] is a constant
    colour instead of the background model."""
    middle = torch.full((len(origins), samples), 0.5, device=origins.device)
    chosen = choose_samples(cache, origins, directions, beta, middle)
    behind = backdrop
    if behind is None:
        behind = field.background.along(origins, directions, middle[:, :BACKGROUND_SAMPLES])
    return composite(field, chosen, field.geometry_at(chosen.points.view(-1, 3)), beta, behind)


def draw(distance: Tensor, weights: Tensor, uniforms: Tensor) -> Tensor:
    """Distances [R, M], in order, drawn by uniforms [R, M] in 0..1 from a density that is constant between samples [R,
    S], where it has weights [R, S - 1]."""
    weights = weights + 1e-5
    cumulative = torch.cumsum(weights / weights.sum(1, keepdim=True), 1)
    count = uniforms.shape[1]
    wanted = (torch.arange(count, device=distance.device) + uniforms) / count * 0.9999
    index = torch.searchsorted(cumulative, wanted.contiguous()).clamp_max(weights.shape[1] - 1)
    before = torch.where(index > 0, cumulative.gather(1, (index - 1).clamp_min(0)), torch.zeros_like(wanted))
    inside = ((wanted - before) / (cumulative.gather(1, index) - before).clamp_min(1e-9)).clamp(0, 1)
    left, right = distance.gather(1, index), distance.gather(1, index + 1)
    return (left + inside * (right - left)).sort(1).values
