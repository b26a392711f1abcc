"""The volumetric field: an SDF and a colour on dense multi-resolution grids, rendered through a soft surface.

The transmittance along a ray is NeuS's (Wang et al., 2021, eq. 10 to 13), with VolSDF's Laplace distribution (Yariv et
al., 2021, section 3.1): half at the surface, also of a ray that only grazes it. VolSDF's own density hides half of such
a ray about three scales outside of the surface, so that training moves edges inwards. Space is the unit sphere; a
separate background outside of it uses contracted coordinates (Barron et al., 2022, eq. 10).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from pipeline.grids.interpolation import BRICK, interpolate, interpolate_bricks, near_bricks

if TYPE_CHECKING:
    from pipeline.stereo.fusion import Fused


@dataclass(frozen=True)
class FieldSize:
    """Resolution of a field."""

    levels: tuple[int, ...] = (16, 32, 64, 128)  # grid points per side of each level, coarse to fine
    channels: tuple[int, ...] = (4, 4, 4, 2)  # features per level
    width: int = 64  # hidden width of both small networks
    background: int = 64  # grid points per side of the finest level of the background
    finer: tuple[int, ...] = (2,)  # cells per cell of the last level along a side, in bricks near the surface
    finer_channels: tuple[int, ...] = (4,)  # features there

    @property
    def steps(self) -> list[float]:
        """Widths of the cells of all levels, coarse to fine, normalised units."""
        return [2.0 / (side - 1) for side in (*self.levels, *self.sides)]

    @property
    def sides(self) -> list[int]:
        """Grid points a side of the levels in bricks."""
        return [times * (self.levels[-1] - 1) + 1 for times in self.finer]

    @property
    def finest(self) -> float:
        """Width of a cell of the finest level, normalised units."""
        return self.steps[-1]

    @property
    def sampling(self) -> float:
        """Distance of samples along rays, normalised units: a cell of the last dense level."""
        return self.steps[len(self.levels) - 1]


BACKGROUND_SAMPLES = 12
GEOMETRY = 13  # features from the SDF network to the colour network


def optical_depths(sdf: Tensor, beta: float) -> Tensor:
    """Optical depth [R, S] from each sample's predecessor along a ray, from the camera for the first, to the sample, of
    signed distances [R, S] near to far: what they take from the logarithm of the Laplace distribution function of scale
    beta (VolSDF eq. 2; NeuS eq. 13)."""
    decay = 0.5 * torch.exp(-sdf.abs() / beta)
    passed = torch.where(sdf > 0, torch.log1p(-decay), math.log(0.5) - sdf.abs() / beta)
    return functional.relu(functional.pad(passed[:, :-1], (1, 0)) - passed)


def render_weights(depths: Tensor) -> tuple[Tensor, Tensor]:
    """Quadrature of the volume rendering integral, from optical depths [R, S] of intervals, near to far: the weight
    [R, S] of each interval, and the transmittance [R] behind the last one."""
    depth = torch.cumsum(depths, 1)
    before = functional.pad(depth[:, :-1], (1, 0))
    return torch.exp(-before) * -torch.expm1(-depths), torch.exp(-depth[:, -1])


def sample_weights(sdf: Tensor, beta: float) -> tuple[Tensor, Tensor]:
    """The weight [R, S] of each sample of a ray from signed distances [R, S], and the transmittance [R] behind the last
    one. An interval between two samples counts half for each."""
    weights, left = render_weights(optical_depths(sdf, beta))
    half = weights[:, 1:] / 2
    return torch.cat([weights[:, :1], half], 1) + functional.pad(half, (0, 1)), left


def direction_features(directions: Tensor) -> Tensor:
    """Spherical harmonics of degree 1 and 2 without constants, [..., 3] -> [..., 8]."""
    x, y, z = directions.unbind(-1)
    return torch.stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], -1)


def contract(points: Tensor) -> Tensor:
    """Points outside the unit sphere -> the shell between radius 0.5 and 1; infinity goes to radius 1."""
    radius = points.norm(dim=-1, keepdim=True).clamp_min(1.0)
    return points / radius * (2 - 1 / radius) / 2


class Background(nn.Module):
    """Density and colour outside the unit sphere, on contracted coordinates: a sum of grids, each half as wide as the
    next. A single fine grid is filled with noise where a few rays cross a cell; coarse ones move with many rays."""

    def __init__(self, side: int) -> None:
        super().__init__()
        # [n, n, n, 4], channel 0 a tenth of the density before softplus, channels 1 to 3 of the colour before sigmoid
        sides = [max(2, side // times) for times in (8, 4, 2, 1)]  # a cell needs two points
        self.levels = nn.ParameterList([torch.zeros(n, n, n, 4) for n in sides])

    def along(self, origins: Tensor, directions: Tensor, jitter: Tensor) -> Tensor:
        """RGB [R, 3] behind the unit sphere along rays [R, 3], by rendering; `jitter` [R, S] in 0..1 is the position of
        each sample within its step of inverse radius."""
        count = jitter.shape[1]
        inverse = 1 - (torch.arange(count, device=jitter.device) + jitter) / count * 0.995
        radius = 1 / inverse
        along = -(origins * directions).sum(1, keepdim=True)
        closest = (origins * origins).sum(1, keepdim=True) - along**2
        distance = along + torch.sqrt((radius**2 - closest).clamp_min(1e-6))
        points = contract(origins[:, None] + distance[..., None] * directions[:, None]).view(-1, 3)
        values = torch.stack([interpolate(level, points) for level in self.levels]).sum(0).view(*jitter.shape, 4)
        # Optical depth per step of inverse radius, so that far steps do not weigh more than near ones.
        depth = functional.softplus(values[..., 0] * 10 - 1.0)
        depth = torch.cat([depth[:, :-1], torch.full_like(depth[:, -1:], 20.0)], 1)
        weights, _ = render_weights(depth)
        return (weights[..., None] * torch.sigmoid(values[..., 1:] * 10)).sum(1)


class Bricks(nn.Module):
    """A level of a field that exists only near the surface."""

    places: Tensor  # [B, 3] int16 (z, y, x) of its bricks
    numbers: Tensor  # [m, m, m] int32, number of the brick at each place; -1 for none
    # [B * 64, 4] correction of the start distance by this level, and RGB there minus a middle grey
    start: Tensor

    def __init__(self, side: int, channels: int) -> None:
        super().__init__()
        self.side, self.channels, self.started = side, channels, False
        count = -(-side // BRICK)
        self.register_buffer("places", torch.zeros(0, 3, dtype=torch.int16))
        self.register_buffer("numbers", torch.full((count,) * 3, -1, dtype=torch.int32), persistent=False)
        self.register_buffer("start", torch.zeros(0, 4))
        self.values = nn.Parameter(torch.zeros(0, channels))

    def add(self, places: Tensor, start: Tensor | None = None) -> None:
        """Adds bricks [B, 3] (z, y, x) where none exist; their features are 0, and so is `start` unless it is given."""
        where = places.to(self.numbers.device).long()
        new = self.numbers[tuple(where.t())] < 0
        where, before = where[new], len(self.places)
        self.started |= start is not None
        if len(where):
            self.numbers[tuple(where.t())] = torch.arange(
                before, before + len(where), dtype=torch.int32, device=where.device
            )
        rows = len(where) * BRICK**3
        given = self.start.new_zeros(rows, 4)
        if start is not None:
            given = start.view(-1, BRICK**3, 4)[new.cpu()].reshape(-1, 4)
        self.places = torch.cat([self.places, where.to(torch.int16)])
        self.start = torch.cat([self.start, given.to(self.start)])
        self.values = nn.Parameter(torch.cat([self.values.detach(), self.values.new_zeros(rows, self.channels)]))

    def at(self, points: Tensor) -> Tensor:
        """Features [P, C] at points [P, 3]; 0 outside of bricks."""
        return interpolate_bricks(self.values, self.numbers, self.side, points)

    def start_at(self, points: Tensor) -> Tensor:
        """The correction of the start distance, and RGB minus a middle grey, [P, 4] at points [P, 3]."""
        return interpolate_bricks(self.start, self.numbers, self.side, points)


class GridField(nn.Module):
    """SDF and colour in the unit sphere, and a background outside. The SDF starts as a sphere of `start_radius`, or
    from depth maps."""

    start: Tensor  # [n, n, n, 1] SDF at the start, empty if it is a sphere
    size: FieldSize
    start_radius: float  # of the sphere, normalised units
    background: Background
    active: int  # how many levels of detail are in use
    view_dependence: float = 1.0  # dependence of colour on direction, 0 to 1

    def __init__(self, size: FieldSize, seed: int = 0, start_radius: float = 0.5, fused: Fused | None = None) -> None:
        super().__init__()
        self.size, self.start_radius = size, start_radius
        self.active = len(size.steps)
        rng = torch.Generator().manual_seed(seed)

        def uniform(*shape: int, bound: float) -> nn.Parameter:
            return nn.Parameter((torch.rand(*shape, generator=rng) * 2 - 1) * bound)

        self.grids = nn.ParameterList(
            [uniform(n, n, n, c, bound=1e-3) for n, c in zip(size.levels, size.channels, strict=True)]
        )
        self.bricks = nn.ModuleList(
            [Bricks(side, channels) for side, channels in zip(size.sides, size.finer_channels, strict=True)]
        )
        self.register_buffer("start", torch.zeros(0, 0, 0, 1))
        seen_features = sum(size.channels) + sum(size.finer_channels)
        inputs, width = 3 + seen_features, size.width

        def layer(count: int, outputs: int, gain: float = 1.0) -> nn.Linear:
            linear = nn.Linear(count, outputs)
            with torch.no_grad():
                linear.weight.copy_((torch.rand(outputs, count, generator=rng) * 2 - 1) * gain * (6 / count) ** 0.5)
                linear.bias.zero_()
            return linear

        self.geometry = nn.Sequential(layer(inputs, width), nn.ReLU(), layer(width, width), nn.ReLU())
        self.head = layer(width, 1 + GEOMETRY, gain=0.2)
        with torch.no_grad():
            self.head.weight[0] *= 0.1
        seen = GEOMETRY + 8 + seen_features
        last = layer(width, 3, gain=0.3)
        self.color = nn.Sequential(layer(seen, width), nn.ReLU(), last)
        self.background = Background(size.background)
        if fused is not None:
            self.start = torch.from_numpy(fused.coarse)[..., None].contiguous()
            with torch.no_grad():  # An untrained network must not change the known distance.
                self.head.weight[0] *= 0.05
                last.weight *= 0.1
            for level, side in zip(self.bricks, size.sides, strict=True):
                if side == fused.side:
                    given = torch.from_numpy(np.concatenate([fused.fine[:, None], fused.color - 0.5], 1))
                    level.add(torch.from_numpy(fused.bricks), given)  # type: ignore[operator]
                else:
                    level.add(torch.from_numpy(near_bricks(fused.coarse, side)))  # type: ignore[operator]

    @property
    def finest(self) -> float:
        """Size of the smallest detail, normalised units."""
        return self.size.finest

    @property
    def device(self) -> torch.device:
        """Of its parameters."""
        return next(self.parameters()).device

    def refine(self, cache: Tensor) -> list[Tensor]:
        """Adds bricks where a cached SDF [n, n, n, 1] has its surface and none exist. Returns the features that they
        replace, level by level."""
        before: list[Tensor] = []
        for level in self.bricks:
            assert isinstance(level, Bricks)
            before.append(level.values)
            level.add(torch.from_numpy(near_bricks(cache[..., 0].cpu().numpy(), level.side)))
        return before

    def load_state_dict(self, state_dict: Any, *more: Any, **options: Any) -> Any:
        for number, level in enumerate(self.bricks):
            assert isinstance(level, Bricks)
            level.add(state_dict[f"bricks.{number}.places"])
            level.started = bool(state_dict[f"bricks.{number}.start"].any())
        self.start = torch.zeros_like(state_dict["start"], device=self.start.device)
        return super().load_state_dict(state_dict, *more, **options)

    def sdf(self, points: Tensor) -> Tensor:
        """Signed distance [P] in normalised units at points [P, 3]."""
        return self.geometry_at(points)[0]

    def geometry_at(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """SDF [P], geometry features [P, 13] and grid features [P, F] at points [P, 3] of normalised space."""
        found = [interpolate(grid, points) for grid in list(self.grids)[: self.active]]
        for number, level in enumerate(self.bricks, len(self.grids)):
            if number < self.active:
                found.append(level.at(points))  # type: ignore[operator]
        channels = (*self.size.channels, *self.size.finer_channels)
        if missing := sum(channels[self.active :]):  # levels that are not active yet
            found.append(points.new_zeros(len(points), missing))
        features = torch.cat(found, 1)
        hidden = self.head(self.geometry(torch.cat([points, features], 1)))
        start, color = self.start_of(points)
        return start + hidden[:, 0], hidden[:, 1:], torch.cat([features, color], 1)

    def start_of(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The SDF [P] at the start of training, and RGB [P, 3] minus a middle grey, at points [P, 3]."""
        if not self.start.numel():
            return points.norm(dim=1) - self.start_radius, torch.zeros_like(points)
        found, color = interpolate(self.start, points)[:, 0], torch.zeros_like(points)
        for level in self.bricks:
            assert isinstance(level, Bricks)
            if level.started:
                more = level.start_at(points)
                found, color = found + more[:, 0], color + more[:, 1:]
        return found, color

    def color_of(self, geometry: Tensor, features: Tensor, directions: Tensor) -> Tensor:
        """RGB [P, 3] in 0..1 seen along unit directions [P, 3], from the features of `geometry_at`."""
        features, start = features[:, :-3], features[:, -3:]
        seen_along = self.view_dependence * direction_features(directions)
        # The photos' mean colour there, plus the network's correction.
        usual = torch.logit((start + 0.5).clamp(0.02, 0.98))
        return torch.sigmoid(usual + self.color(torch.cat([geometry, features, seen_along], 1)))


def stencil(points: Tensor, step: float) -> Tensor:
    """The seven points [P, 7, 3] for gradient and Laplacian by `differences` at `points` [P, 3]."""
    offsets = torch.eye(3, device=points.device, dtype=points.dtype) * step
    return torch.cat([points[:, None] + offsets, points[:, None] - offsets, points[:, None]], 1)


def differences(values: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Gradient [P, 3] and Laplacian [P] by central differences from values [P, 7] on a `stencil`: over one grid cell
    they reach all the cell's corners, where an analytic gradient touches its own (Li et al., Neuralangelo, 2023, eq.
    3)."""
    gradient = (values[:, :3] - values[:, 3:6]) / (2 * step)
    return gradient, (values[:, :6].sum(1) - 6 * values[:, 6]) / (step * step)
