"""Where along a ray to ask the field so that the opacity is right to within a given error (VolSDF, sections 3.3, 3.4).

Rays are bounded one by one: a ray whose error is small enough is done, the others get more samples.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pipeline.field import laplace_density

EPSILON = 0.1  # of opacity
START = 128  # samples of every ray at first, and added to those that need more
ROUNDS, BISECTIONS = 5, 10


def nearest(sdf: Tensor, delta: Tensor) -> Tensor:
    """A lower bound [R, S - 1] of the distance to the surface within each interval of a ray (eq. 13, figure 5).

    The balls around both ends hold no surface; what is left of the interval may come as near as the corner where the
    balls meet, and where they do not meet, anything may lie between.

    Args:
        sdf: [R, S] at the samples.
        delta: [R, S - 1] lengths of the intervals.
    """
    a, b = sdf[:, :-1].abs(), sdf[:, 1:].abs()
    half = (a + b + delta) / 2
    area = (half * (half - a) * (half - b) * (half - delta)).clamp_min(0)
    height = 2 * area.sqrt() / delta.clamp_min(1e-12)
    obtuse = (a**2 - b**2).abs() >= delta**2
    bound = torch.where(obtuse, torch.minimum(a, b), height)
    apart = (a + b <= delta) | (sdf[:, :-1].sign() * sdf[:, 1:].sign() <= 0)
    return torch.where(apart, torch.zeros_like(bound), bound)


def opacity_bound(distance: Tensor, sdf: Tensor, beta: Tensor) -> tuple[Tensor, Tensor]:
    """Bound of the error of the opacity by the rectangle rule, for each interval [R, S - 1] (theorem 1, eq. 12, 14).

    Args:
        distance: [R, S] of the samples, in order.
        sdf: [R, S] there.
        beta: [R, 1] of the density, alpha = 1 / beta.

    Returns:
        The bound, and the optical depth [R, S - 1] in front of each interval.
    """
    delta = distance[:, 1:] - distance[:, :-1]
    density = laplace_density(sdf[:, :-1], beta)
    before = torch.cumsum(density * delta, 1) - density * delta
    error = torch.cumsum(delta**2 * torch.exp(-nearest(sdf, delta) / beta), 1) / (4 * beta**2)
    return torch.exp(-before) * torch.expm1(error.clamp_max(30.0)), before


def worst(distance: Tensor, sdf: Tensor, beta: Tensor) -> Tensor:
    """The largest bound [R, 1] along each ray."""
    return opacity_bound(distance, sdf, beta)[0].amax(1, keepdim=True)


def _smallest_beta(distance: Tensor, sdf: Tensor, beta: Tensor, safe: Tensor) -> Tensor:
    """The smallest beta+ [R, 1] between `beta` and `safe` whose bound is below `EPSILON`, by bisection."""
    low, high = beta.expand_as(safe).clone(), safe.clone()
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        good = worst(distance, sdf, middle) <= EPSILON
        high, low = torch.where(good, middle, high), torch.where(good, low, middle)
    return high


def draw(distance: Tensor, weights: Tensor, uniforms: Tensor) -> Tensor:
    """Distances [R, M], in order, drawn from a density that is constant between samples [R, S].

    Args:
        distance: [R, S].
        weights: [R, S - 1] of the intervals, not negative.
        uniforms: [R, M] in 0..1.
    """
    weights = weights + 1e-5
    cumulative = torch.cumsum(weights / weights.sum(1, keepdim=True), 1)
    count = uniforms.shape[1]
    wanted = (torch.arange(count, device=distance.device) + uniforms) / count * 0.9999
    index = torch.searchsorted(cumulative, wanted.contiguous()).clamp_max(weights.shape[1] - 1)
    before = torch.where(index > 0, cumulative.gather(1, (index - 1).clamp_min(0)), torch.zeros_like(wanted))
    inside = ((wanted - before) / (cumulative.gather(1, index) - before).clamp_min(1e-9)).clamp(0, 1)
    left, right = distance.gather(1, index), distance.gather(1, index + 1)
    return (left + inside * (right - left)).sort(1).values


@torch.no_grad()
def bounded_samples(
    sdf_at: Callable[[Tensor, Tensor], Tensor], enter: Tensor, leave: Tensor, beta: Tensor, uniforms: Tensor
) -> tuple[Tensor, Tensor]:
    """Samples along rays by algorithm 1.

    Args:
        sdf_at: SDF [A, S] at distances [A, S] along the rays with indices [A].
        enter: [R] distance at which each ray enters the trained space.
        leave: [R] and leaves it.
        beta: scalar, of the density.
        uniforms: [R, M] in 0..1.

    Returns:
        Distances [R, M] in order, drawn by opacity, and whether each ray's error is below `EPSILON` [R].
    """
    count = len(enter)
    steps = torch.linspace(0, 1, START, device=enter.device, dtype=enter.dtype)
    distance = enter[:, None] + (leave - enter)[:, None] * steps
    chosen = torch.empty_like(uniforms)
    converged = torch.zeros(count, dtype=torch.bool, device=enter.device)
    active = torch.arange(count, device=enter.device)
    sdf = sdf_at(active, distance)
    beta = beta.detach().reshape(1, 1).to(enter.dtype)
    # Lemma 2: with this beta+ the first samples suffice.
    length = (leave - enter)[:, None]
    safe = (length**2 / (4 * (START - 1) * torch.log(torch.tensor(1 + EPSILON)))).sqrt().clamp_min(float(beta))
    for number in range(ROUNDS + 1):
        good = worst(distance, sdf, beta)[:, 0] <= EPSILON
        last = number == ROUNDS
        use = torch.where(good[:, None], beta, _smallest_beta(distance, sdf, beta, safe))
        done = good | last
        if done.any():
            before = opacity_bound(distance[done], sdf[done], use[done])[1]
            delta = distance[done, 1:] - distance[done, :-1]
            weights = torch.exp(-before) * -torch.expm1(-laplace_density(sdf[done, :-1], use[done]) * delta)
            chosen[active[done]] = draw(distance[done], weights, uniforms[active[done]])
            converged[active[done]] = good[done]
        if done.all():
            break
        active, distance, sdf, safe = active[~done], distance[~done], sdf[~done], use[~done]
        # More samples where the bound is large.
        bound, _ = opacity_bound(distance, sdf, safe)
        middle = torch.full((len(active), START), 0.5, device=enter.device, dtype=enter.dtype)
        added = draw(distance, bound, middle)
        distance, order = torch.cat([distance, added], 1).sort(1)
        sdf = torch.cat([sdf, sdf_at(active, added)], 1).gather(1, order)
    return chosen, converged
