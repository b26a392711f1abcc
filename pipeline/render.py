"""Rays through the field: where along them it is asked, and the colour that comes out."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from pipeline.field import BACKGROUND_SAMPLES, Field, laplace_density, render_weights
from pipeline.trilinear import interpolate


@torch.no_grad()
def sdf_cache(field: Field, resolution: int, coarse: int = 4) -> Tensor:
    """The SDF on a grid [n, n, n, 1] over [-1, 1]^3 (z, y, x order), from which samples along rays are chosen.

    Every `coarse`-th value is the field's, the others only in blocks that the surface may cross; elsewhere, in empty
    space and deep inside, they are interpolated.

    Args:
        field: the field.
        resolution: n, a multiple of `coarse` plus 1.
        coarse: see above.
    """
    device = field.background.device
    line = torch.linspace(-1, 1, resolution, device=device)

    def values(points: Tensor) -> Tensor:
        return torch.cat([field.sdf(part) for part in points.split(1 << 16)])

    knots = torch.stack(torch.meshgrid(*[line[::coarse]] * 3, indexing="ij"), -1)
    rough = values(knots.view(-1, 3).flip(1)).view(1, 1, *knots.shape[:3])
    cache = functional.interpolate(rough, size=(resolution,) * 3, mode="trilinear", align_corners=True)[0, 0]
    low, high = -functional.max_pool3d(-rough, 2, 1), functional.max_pool3d(rough, 2, 1)
    reach = 3**0.5 * coarse * float(line[1] - line[0])
    block = torch.nonzero((low < reach) & (high > -reach))[:, 2:] * coarse
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
    """Where the field is asked along some rays.

    Attributes:
        distance: [R, S] from the camera, in order, normalised units.
        delta: [R, S] length of each sample's interval.
        points: [R, S, 3].
        directions: [R, 3] unit.
        near_surface: [R, S] whether it was drawn by importance.
    """

    distance: Tensor
    delta: Tensor
    points: Tensor
    directions: Tensor
    near_surface: Tensor


@torch.no_grad()
def choose_samples(
    cache: Tensor, origins: Tensor, directions: Tensor, beta: float, uniforms: Tensor, *, bins: int = 96, plain: int = 8
) -> Samples:
    """Distances of the samples along each ray: some evenly spread, most where the cached SDF has its surface.

    Args:
        cache: from `sdf_cache`.
        origins: [R, 3].
        directions: [R, 3] unit.
        beta: of the density, normalised units.
        uniforms: [R, S] random in 0..1, S = number of samples.
        bins: even steps at which the cache is read.
        plain: how many of the S samples are evenly spread.

    """
    enter, leave = sphere_interval(origins, directions)
    length = (leave - enter)[:, None]
    steps = (torch.arange(bins, device=cache.device) + 0.5) / bins
    points = origins[:, None] + (enter[:, None] + length * steps)[..., None] * directions[:, None]
    sdf = interpolate(cache, points.view(-1, 3)).view(len(origins), bins)
    # The cache knows the surface only to a fraction of its cell: no narrower than that.
    broad = max(beta, 0.6 / cache.shape[0])
    weights, _ = render_weights(laplace_density(sdf, broad), (length / bins).expand(-1, bins))
    cumulative = torch.cumsum(weights + 1e-4, 1)
    cumulative = cumulative / cumulative[:, -1:]
    count = uniforms.shape[1] - plain
    device = cache.device
    wanted = (torch.arange(count, device=device) + uniforms[:, :count]) / count * 0.9999
    index = torch.searchsorted(cumulative, wanted.contiguous()).clamp_max(bins - 1)
    low = torch.where(index > 0, cumulative.gather(1, (index - 1).clamp_min(0)), torch.zeros_like(wanted))
    inside = ((wanted - low) / (cumulative.gather(1, index) - low).clamp_min(1e-9)).clamp(0, 1)
    importance = (index + inside) / bins
    even = (torch.arange(plain, device=device) + uniforms[:, count:]) / plain
    position, order = torch.cat([importance, even], 1).sort(1)
    distance = enter[:, None] + length * position
    edge = torch.cat([enter[:, None], (distance[:, 1:] + distance[:, :-1]) / 2, leave[:, None]], 1)
    points = origins[:, None] + distance[..., None] * directions[:, None]
    return Samples(distance, edge[:, 1:] - edge[:, :-1], points, directions, order < count)


def composite(
    field: Field, samples: Samples, geometry: tuple[Tensor, Tensor, Tensor], beta: float | Tensor, behind: Tensor
) -> dict[str, Tensor]:
    """Renders rays from the field's values at their samples.

    Args:
        field: the field.
        samples: of the rays.
        geometry: what `field.geometry_at` gave at `samples.points`.
        beta: of the density.
        behind: [R, 3] or [3] colour behind the unit sphere.

    Returns:
        `rgb` [R, 3], `opacity` [R] inside the sphere, `depth` [R].
    """
    sdf, features, grid = geometry
    shape = samples.distance.shape
    weights, left = render_weights(laplace_density(sdf, beta).view(shape), samples.delta)
    # Colour costs as much as the SDF, and most samples carry no weight.
    chosen = torch.nonzero(weights.detach().view(-1) > 5e-4)[:, 0]
    seen_along = samples.directions[:, None].expand(*shape, 3).reshape(-1, 3)[chosen]
    color = torch.zeros(sdf.shape[0], 3, device=sdf.device).index_put(
        (chosen,), field.color_of(features[chosen], grid[chosen], seen_along)
    )
    rgb = (weights[..., None] * color.view(*shape, 3)).sum(1)
    return {
        "rgb": rgb + left[:, None] * behind,
        "opacity": 1 - left,
        "depth": (weights * samples.distance).sum(1),
    }


@torch.no_grad()
def render(
    field: Field, cache: Tensor, origins: Tensor, directions: Tensor, beta: float, *,
    samples: int = 32, backdrop: Tensor | None = None,
) -> dict[str, Tensor]:  # fmt: skip
    """Renders rays for looking at, without gradients and the same every time.

    Args:
        field: the field.
        cache: from `sdf_cache`.
        origins: [R, 3] normalised units.
        directions: [R, 3] unit.
        beta: of the density.
        samples: along each ray inside the sphere.
        backdrop: [3] a constant colour in place of the background model.

    Returns:
        See `composite`.
    """
    middle = torch.full((len(origins), samples), 0.5, device=origins.device)
    chosen = choose_samples(cache, origins, directions, beta, middle)
    behind = backdrop
    if behind is None:
        behind = field.background_along(origins, directions, middle[:, :BACKGROUND_SAMPLES])
    return composite(field, chosen, field.geometry_at(chosen.points.view(-1, 3)), beta, behind)
